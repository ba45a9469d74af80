"""Disturbance observer of the contact force (paper, eq. 11 to 17).

    a_model = q_d'' + (tau_3 / m) R_b e_z - g e_z    (11; q_d'' along x and y only)
    F_raw   = m (a_meas - a_model)                   (12)
    F[n]    = F[n-1] + kappa (F_raw - F[n-1])        (13),  kappa = w_c dt / (1 + w_c dt)   (14)
    F_body  = R_b^T F_world                          (16)
    F_ee    = R_ee^T F_body                          (17)

Eq. 11 adds the *desired* acceleration: in motion the observer then reads the trajectory's own acceleration as
force. ``desired_acceleration`` keeps that form; without it the model is the thrust and gravity alone.
F is the force on the vehicle; a pipe pressed with compression f pushes the vehicle back with -f along the
contact normal.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from drivers.samples import Vec3
from onboard.core.spec import note, spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Filter and form of the observer."""

    cutoff: Annotated[float, spec("rad/s", 0.1, 200.0, "omega_c of eq. 14")] = 30.0
    desired_acceleration: Annotated[bool, note("add the desired acceleration to the model, as eq. 11 is printed")] = (
        False
    )
    thrust_lag: Annotated[float, spec("s", 0.0, 0.5, "first-order lag from thrust command to thrust in the model")] = (
        0.0
    )
    tare: Annotated[bool, note("subtract the mean force read in hover just before the contact")] = True


class State(Struct, frozen=True, gc=False):
    """Filtered force F (N, W), not tared, and lagged thrust (N)."""

    force: Vec3 = (0.0, 0.0, 0.0)
    thrust: float = 0.0


def step(
    state: State,
    acceleration: Vec3,
    desired: Vec3,
    thrust: float,
    thrust_axis: Vec3,
    mass: float,
    gravity: float,
    params: Params,
    dt: float,
) -> State:
    """One tick of eq. 11 to 14.

    acceleration: measured, m/s^2, W. desired: acceleration of the reference, m/s^2, W. thrust: commanded over
    the last tick, N. thrust_axis: third column of R_b. mass: of the whole vehicle, kg.
    """
    lagged = (
        thrust if params.thrust_lag <= 0.0 else state.thrust + (thrust - state.thrust) * dt / (params.thrust_lag + dt)
    )
    lift = lagged / mass
    mx, my, mz = lift * thrust_axis[0], lift * thrust_axis[1], lift * thrust_axis[2] - gravity
    if params.desired_acceleration:
        mx += desired[0]
        my += desired[1]
    kappa = params.cutoff * dt / (1.0 + params.cutoff * dt)
    fx, fy, fz = state.force
    return State(
        (
            fx + kappa * (mass * (acceleration[0] - mx) - fx),
            fy + kappa * (mass * (acceleration[1] - my) - fy),
            fz + kappa * (mass * (acceleration[2] - mz) - fz),
        ),
        lagged,
    )
