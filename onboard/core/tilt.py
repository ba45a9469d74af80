"""From the translation law's force to roll, pitch and thrust (paper, eq. 4), and the attitude reference.

Eq. 4, for small angles:

    theta_d = ( tau_1 cos psi + tau_2 sin psi) / tau_3
    phi_d   = ( tau_1 sin psi - tau_2 cos psi) / tau_3,   thrust = tau_3

Signs: with z up and pitch about +y_B, a positive pitch leans the thrust to the front (+x_B), a positive roll
leans it to the right (-y_B). ``exact`` inverts R_z(psi) R_y(theta) R_x(phi) e_z instead, so that the vertical
force is kept when the vehicle tilts. tau_3 is kept above ``thrust_min`` (the map divides by it) and both
angles are limited.

The angles then pass a second-order filter, whose output, rate and acceleration are q_ad, q_ad' and q_ad'' of
eq. 5 and 6: the reference that the attitude law follows.
"""

from __future__ import annotations

from math import asin, atan2, cos, hypot, sin, sqrt
from typing import Annotated

from msgspec import Struct

from drivers.samples import Vec3
from onboard.core.spec import note, spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the map and bandwidth of the attitude reference."""

    exact: Annotated[bool, note("invert the rotation exactly instead of the small-angle map of eq. 4")] = True
    thrust_min: Annotated[float, spec("N", 0.5, 50.0, "tau_3 is not taken to be less than this")] = 6.0
    tilt_max: Annotated[float, spec("rad", 0.01, 0.8, "largest roll and pitch asked for")] = 0.35
    bandwidth: Annotated[float, spec("rad/s", 1.0, 100.0, "of the attitude reference filter")] = 16.0
    damping: Annotated[float, spec("1", 0.4, 2.0, "damping ratio of the attitude reference filter")] = 0.9


class State(Struct, frozen=True, gc=False):
    """Roll and pitch of the attitude reference, rad, and their rates."""

    roll: float = 0.0
    pitch: float = 0.0
    roll_rate: float = 0.0
    pitch_rate: float = 0.0


def attitude_and_thrust(force: Vec3, yaw: float, params: Params) -> tuple[float, float, float]:
    """Roll, pitch (rad) and thrust (N) that yield ``force`` (N, W) at heading ``yaw`` (rad), within the tilt limit."""
    c, s = cos(yaw), sin(yaw)
    ahead = c * force[0] + s * force[1]
    right = s * force[0] - c * force[1]
    lift = max(force[2], params.thrust_min)
    if params.exact:
        roll, pitch = asin(right / sqrt(ahead * ahead + right * right + lift * lift)), atan2(ahead, lift)
    else:
        roll, pitch = right / lift, ahead / lift
    m = params.tilt_max
    roll, pitch = min(m, max(-m, roll)), min(m, max(-m, pitch))
    # the lift is kept even where the tilt is limited: the horizontal force that cannot be had is not made up by thrust
    return roll, pitch, lift / (cos(roll) * cos(pitch)) if params.exact else lift


def turned(roll: float, pitch: float, turn: float) -> tuple[float, float]:
    """Roll and pitch that lean the thrust the same way, told at a heading ``turn`` (rad) further back.

    An autopilot leans the thrust first and turns to the heading later: told with the angles of another heading, it
    would push aside.
    """
    ahead, right, up = cos(roll) * sin(pitch), sin(roll), cos(roll) * cos(pitch)
    c, s = cos(turn), sin(turn)
    ahead, right = c * ahead + s * right, c * right - s * ahead
    return atan2(right, hypot(ahead, up)), atan2(ahead, up)


def step(state: State, roll: float, pitch: float, params: Params, dt: float) -> tuple[State, float, float]:
    """Advance the reference filter towards the wanted angles; returns the state and its angular accelerations."""
    w2 = params.bandwidth * params.bandwidth
    d = 2.0 * params.damping * params.bandwidth
    roll_acceleration = w2 * (roll - state.roll) - d * state.roll_rate
    pitch_acceleration = w2 * (pitch - state.pitch) - d * state.pitch_rate
    half = 0.5 * dt * dt
    return (
        State(
            state.roll + dt * state.roll_rate + half * roll_acceleration,
            state.pitch + dt * state.pitch_rate + half * pitch_acceleration,
            state.roll_rate + dt * roll_acceleration,
            state.pitch_rate + dt * pitch_acceleration,
        ),
        roll_acceleration,
        pitch_acceleration,
    )
