"""What the rotors give of the thrust they are told: a first-order lag, and a scale that is measured in hover.

A thrust map some per cent off, a battery that sags, a mass that is not what was weighed: to the estimators each is the
same error along the thrust. In hover the specific force along z of B must carry the mass, so

    thrust = scale * lagged command,    scale = m f_z / lagged command, averaged

holds whatever the tilt. It is measured only where nothing touches the vehicle (arrived, away from the pipe), and kept
elsewhere. A bias of the accelerometer's z is a part of it: it cannot be told apart, and needs not be.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from onboard.core.spec import note, spec

#: A scale beyond these is no error of a thrust map.
LOWEST, HIGHEST = 0.7, 1.4


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Lag of the rotors, and how their scale is measured."""

    lag: Annotated[float, spec("s", 0.0, 0.5, "first-order lag from thrust command to thrust")] = 0.0
    calibrate: Annotated[bool, note("measure the scale of the thrust in hover")] = True
    time: Annotated[float, spec("s", 0.2, 60.0, "time the scale is averaged over")] = 4.0


class State(Struct, frozen=True, gc=False):
    """Lagged command (N), scale, and for how long the scale has been measured (s)."""

    lagged: float = 0.0
    scale: float = 1.0
    measured: float = 0.0


def step(state: State, command: float, f_z: float, mass: float, hovering: bool, params: Params, dt: float) -> State:
    """One tick. command: over the last tick, N; f_z: specific force along z of B, m/s^2; mass: of the vehicle, kg."""
    lagged = command if params.lag <= 0.0 else state.lagged + (command - state.lagged) * dt / (params.lag + dt)
    if not (hovering and params.calibrate and lagged > 0.3 * mass * f_z > 0.0):
        return State(lagged, state.scale, state.measured)
    measured = min(params.time, state.measured + dt)
    scale = state.scale + (mass * f_z / lagged - state.scale) * dt / (measured + dt)
    return State(lagged, min(HIGHEST, max(LOWEST, scale)), measured)


def thrust(state: State) -> float:
    """What the rotors give, N."""
    return state.scale * state.lagged
