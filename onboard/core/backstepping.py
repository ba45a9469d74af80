"""Adaptive backstepping of the base's translation (paper, eq. 2 and 3).

    e1 = q_p - q_pd                      position error, W
    e2 = e1' + alpha e1
    v  = q_pd'' - alpha e1' - gamma e2 - e1                           (2)
    tau_p = M_p v + C_p q_p' + G_p + Xi,   Xi' = -beta e2             (3)

With M_p = m I the law is a position loop of stiffness m (1 + alpha gamma), damping m (alpha + gamma) and an
integral action Xi. Signs: a base ahead of its reference (e1 > 0) is pushed back.

Two things that the printed law lacks, off unless asked for. In contact the pipe holds the base, so the
position loop along the contact normal becomes a second force controller that fights the first: ``compliant``
replaces its stiffness and damping there. And Xi winds up against the wall: it is bounded and leaks always,
``freeze_in_contact`` stops it along the normal, and from a force of ``grip`` on across it too, where friction holds
the tip and hides the wind.

The integral action is slow. ``wind`` leans against what the Kalman filter observes as disturbance, the contact apart,
within half a second, and in contact too: there a gust is what the accelerometer feels and the tip does not.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from drivers.samples import Vec3
from onboard.core.spec import note, spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Gains of the translation law."""

    alpha: Annotated[float, spec("1/s", 0.0, 20.0, "error gain, horizontal")] = 1.6
    gamma: Annotated[float, spec("1/s", 0.0, 20.0, "augmented-error gain, horizontal")] = 1.6
    beta: Annotated[float, spec("N/m", 0.0, 50.0, "adaptation gain, horizontal")] = 0.6
    alpha_z: Annotated[float, spec("1/s", 0.0, 20.0, "error gain, vertical")] = 4.0
    gamma_z: Annotated[float, spec("1/s", 0.0, 20.0, "augmented-error gain, vertical")] = 4.0
    beta_z: Annotated[float, spec("N/m", 0.0, 50.0, "adaptation gain, vertical")] = 4.0
    bound: Annotated[float, spec("N", 0.0, 20.0, "largest adapted force per axis")] = 5.0
    leak: Annotated[float, spec("1/s", 0.0, 5.0, "rate at which the adapted force is forgotten")] = 0.0
    compliant: Annotated[
        bool, note("replace stiffness and damping along the contact normal while pressing", in_flight=False)
    ] = True
    freeze_in_contact: Annotated[bool, note("no adaptation along the contact normal near the pipe")] = True
    contact_stiffness: Annotated[
        float, spec("1/s^2", 0.0, 20.0, "stiffness per mass along the normal in contact", in_flight=False)
    ] = 0.3
    contact_damping: Annotated[float, spec("1/s", 0.0, 20.0, "damping per mass along the normal in contact")] = 1.2
    grip: Annotated[
        float, spec("N", 0.0, 100.0, "desired force from which friction holds the tip: no adaptation across the normal")
    ] = 100.0
    wind: Annotated[float, spec("1", 0.0, 1.0, "share of the observed horizontal wind that is leant against")] = 0.0
    wind_bandwidth: Annotated[float, spec("rad/s", 0.05, 20.0, "with which that is done")] = 2.0
    feed_forward: Annotated[
        float, spec("1", 0.0, 1.5, "share of the desired contact force added along the normal", in_flight=False)
    ] = 1.0


class State(Struct, frozen=True, gc=False):
    """Adapted disturbance force Xi, and the wind as it is leant against (x, y), N, W."""

    disturbance: Vec3 = (0.0, 0.0, 0.0)
    wind: tuple[float, float] = (0.0, 0.0)


def step(
    state: State,
    error: Vec3,
    error_rate: Vec3,
    acceleration: Vec3,
    mass: float,
    weight: float,
    normal: tuple[float, float],
    contact: float,
    adapt: bool,
    hold_normal: bool,
    force: float,
    wind: Vec3,
    params: Params,
    dt: float,
) -> tuple[State, Vec3, Vec3]:
    """One tick of the law.

    error, error_rate: q_p - q_pd and its rate, m and m/s, W. acceleration: of the reference, m/s^2, W.
    mass, weight: kg and N of the whole vehicle (C_p is zero for a mass-proportional M_p).
    normal: unit horizontal direction of the press, W. contact: 0 in free flight to 1 when the force loop is
    closed. adapt: the vehicle flies. hold_normal: the tip is at the pipe, adaptation along the normal rests.
    force: desired compressive force, N. wind: disturbance as observed, the contact apart, N, W.

    Returns the state, the force tau_p (N, W) and the virtual acceleration v (m/s^2, W).
    """
    p = params
    ex, ey, ez = error
    ux, uy, uz = error_rate
    stiffness = p.alpha * p.gamma + 1.0
    damping = p.alpha + p.gamma
    vx = acceleration[0] - damping * ux - stiffness * ex
    vy = acceleration[1] - damping * uy - stiffness * ey
    vz = acceleration[2] - (p.alpha_z + p.gamma_z) * uz - (p.alpha_z * p.gamma_z + 1.0) * ez
    nx, ny = normal
    if contact > 0.0 and p.compliant:
        correction = contact * (
            (damping - p.contact_damping) * (ux * nx + uy * ny)
            + (stiffness - p.contact_stiffness) * (ex * nx + ey * ny)
        )
        vx += correction * nx
        vy += correction * ny

    if adapt:
        e2x, e2y, e2z = ux + p.alpha * ex, uy + p.alpha * ey, uz + p.alpha_z * ez
        if hold_normal and p.freeze_in_contact:
            along = e2x * nx + e2y * ny
            e2x -= along * nx
            e2y -= along * ny
        dx, dy, dz = state.disturbance
        keep = 1.0 - p.leak * dt
        gripped = contact > 0.0 and force >= p.grip
        if gripped:
            e2x = e2y = e2z = 0.0
        b = p.bound
        state = State(
            (
                min(b, max(-b, keep * dx - p.beta * e2x * dt)),
                min(b, max(-b, keep * dy - p.beta * e2y * dt)),
                min(b, max(-b, keep * dz - p.beta_z * e2z * dt)),
            ),
            _leant(state.wind, wind, normal, gripped, p, dt) if p.wind > 0.0 else state.wind,
        )
    dx, dy, dz = state.disturbance
    if p.wind > 0.0:
        dx, dy = dx - p.wind * state.wind[0], dy - p.wind * state.wind[1]
    push = contact * p.feed_forward * force
    return (
        state,
        (mass * vx + dx + push * nx, mass * vy + dy + push * ny, mass * vz + weight + dz),
        (vx, vy, vz),
    )


def _leant(
    old: tuple[float, float], wind: Vec3, normal: tuple[float, float], gripped: bool, params: Params, dt: float
) -> tuple[float, float]:
    """The wind, low-pass filtered. While the pipe holds the tip, friction across the normal would be taken for it."""
    w = params.wind_bandwidth * dt
    share, b = w / (1.0 + w), params.bound
    cx, cy = share * (wind[0] - old[0]), share * (wind[1] - old[1])
    if gripped:
        nx, ny = normal
        along = cx * nx + cy * ny
        cx, cy = along * nx, along * ny
    return (min(b, max(-b, old[0] + cx)), min(b, max(-b, old[1] + cy)))
