"""Joint compensation: the arm holds the wrist and the tool's direction in the world while the base pitches.

Eq. 10, delta theta_3 = -theta, counts the pitch about the joints' own axis z_M. With pitch theta about +y_B
(nose down positive, the sign of eq. 4) and z_M = -y_B it reads theta_3 = e_3 + theta, where e_3 is the tool's
elevation in the levelled heading frame: then R_y(theta) R_ee(theta_3) of eq. 17 does not change with theta.

theta_3 alone does not hold the tip: the base turns about its own centre and the tip would slide along the
pipe. So theta_1 and theta_2 hold the wrist: with w its position relative to the arm mount in the levelled
frame and b the mount in B, the wrist belongs at r = R_y(theta)^T (w + b) - b of the arm's own plane.
"""

from __future__ import annotations

from math import cos, sin
from typing import Annotated

from msgspec import Struct

from onboard.core.spec import spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Smoothing of the joint reference, and how far the arm steadies the tool."""

    steady: Annotated[float, spec("1", 0.0, 1.0, "share of the base's position error that the arm makes up for")] = 1.0
    steady_blend: Annotated[float, spec("s", 0.05, 5.0, "time in which that begins and ends")] = 1.0
    steady_max: Annotated[float, spec("m", 0.0, 0.1, "largest error made up for, per axis")] = 0.04
    bandwidth: Annotated[float, spec("rad/s", 1.0, 150.0, "of the joint reference filter")] = 30.0


class State(Struct, frozen=True, gc=False):
    """Joint reference, rad, and its rate."""

    joints: tuple[float, float, float]
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)


def wrist_in_body(
    wrist: tuple[float, float],
    wrist_rate: tuple[float, float],
    mount: tuple[float, float],
    pitch: float,
    pitch_rate: float,
) -> tuple[float, float, float, float]:
    """Wrist relative to the mount in the arm plane of B (m) and its rate (m/s): (x, z, x', z').

    wrist, wrist_rate: forward and up in the levelled frame, relative to the mount; mount: (x, z) in B.
    """
    c, s = cos(pitch), sin(pitch)
    x, z = wrist[0] + mount[0], wrist[1] + mount[1]
    bx, bz = c * x - s * z, s * x + c * z
    vx = c * wrist_rate[0] - s * wrist_rate[1] - pitch_rate * bz
    vz = s * wrist_rate[0] + c * wrist_rate[1] + pitch_rate * bx
    return bx - mount[0], bz - mount[1], vx, vz


def step(
    state: State, target: tuple[float, float, float], rate: tuple[float, float, float], params: Params, dt: float
) -> tuple[State, tuple[float, float, float]]:
    """Follow ``target`` (rad) and its ``rate`` (rad/s) with a critically damped filter; returns accelerations too.

    The rate is fed forward, so a steadily moving target is followed without lag.
    """
    w = params.bandwidth
    w2, d = w * w, 2.0 * w
    (a, b, c), (u, v, x) = state.joints, state.rates
    aa = w2 * (target[0] - a) + d * (rate[0] - u)
    bb = w2 * (target[1] - b) + d * (rate[1] - v)
    cc = w2 * (target[2] - c) + d * (rate[2] - x)
    h = 0.5 * dt * dt
    return (
        State((a + dt * u + h * aa, b + dt * v + h * bb, c + dt * x + h * cc), (u + dt * aa, v + dt * bb, x + dt * cc)),
        (aa, bb, cc),
    )
