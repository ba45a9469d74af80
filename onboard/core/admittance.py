"""The outer admittance loop: compliant acceleration to displacement, and its direction in the world (eq. 9).

    x_comp'' = fuzzy(F_des - F_est, theta) - damping x_comp'
    (x, y)_d += x_comp (cos psi, sin psi)                                  (9)

``damping`` is not in the paper: integrated twice and undamped, the loop overshoots for seconds. Displacement
and speed are bounded; at a bound the integration stops (no wind-up).
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from onboard.core.spec import spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Damping and bounds of the compliant motion."""

    damping: Annotated[float, spec("1/s", 0.0, 20.0, "damping of the compliant velocity")] = 2.5
    displacement_max: Annotated[float, spec("m", 0.0, 1.0, "largest compliant displacement")] = 0.3
    velocity_max: Annotated[float, spec("m/s", 0.0, 0.5, "largest compliant velocity")] = 0.05


class State(Struct, frozen=True, gc=False):
    """Compliant displacement (m) and velocity (m/s) along the heading."""

    displacement: float = 0.0
    velocity: float = 0.0


def step(state: State, acceleration: float, params: Params, dt: float) -> tuple[State, float]:
    """Integrate ``acceleration`` (m/s^2) twice; returns the state and the acceleration in force."""
    a = acceleration - params.damping * state.velocity
    limit = params.velocity_max
    v = min(limit, max(-limit, state.velocity + a * dt))
    a = (v - state.velocity) / dt
    x = state.displacement + v * dt
    bound = params.displacement_max
    if x > bound or x < -bound:
        x, v = min(bound, max(-bound, x)), 0.0
    return State(x, v), a
