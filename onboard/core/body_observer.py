"""Force observer in the body frame: what the accelerometer feels beside thrust and drag.

    F_B = m f_B - T e_z - drag,    low-pass filtered twice in B

Neither attitude nor position enters before the result is turned into W, and along x and y of B the thrust does not
enter at all: a lean into the pipe is felt, not computed. Two equal first-order filters, so that the rotors' vibration
falls off with the square of its frequency. The arm's own acceleration is left out.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from drivers.samples import Vec3
from onboard.core.compiled import compiled
from onboard.core.spec import spec
from onboard.core.told import Told
from onboard.core.types import Mat3


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """The filter."""

    cutoff: Annotated[float, spec("rad/s", 0.1, 200.0, "of each of the two filters")] = 40.0


class State(Struct, frozen=True, gc=False):
    """Output of the first and of the second filter, N, B; and the second's in W."""

    first: Vec3 = (0.0, 0.0, 0.0)
    second: Vec3 = (0.0, 0.0, 0.0)
    force: Vec3 = (0.0, 0.0, 0.0)


def step(state: State, told: Told, params: Params, dt: float) -> State:
    """One tick."""
    kappa = params.cutoff * dt / (1.0 + params.cutoff * dt)
    return State(*_step(state.first, state.second, told.f_B, told.mass, told.thrust, told.drag, told.R, kappa))


@compiled(
    "UniTuple(UniTuple(f8, 3), 3)"
    "(UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), f8, f8, UniTuple(f8, 3), UniTuple(f8, 9), f8)"
)
def _step(
    first: Vec3, second: Vec3, f: Vec3, mass: float, thrust: float, drag: Vec3, r: Mat3, kappa: float
) -> tuple[Vec3, Vec3, Vec3]:
    ax = first[0] + kappa * (mass * f[0] - drag[0] - first[0])
    ay = first[1] + kappa * (mass * f[1] - drag[1] - first[1])
    az = first[2] + kappa * (mass * f[2] - drag[2] - thrust - first[2])
    x = second[0] + kappa * (ax - second[0])
    y = second[1] + kappa * (ay - second[1])
    z = second[2] + kappa * (az - second[2])
    return (
        (ax, ay, az),
        (x, y, z),
        (r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z),
    )
