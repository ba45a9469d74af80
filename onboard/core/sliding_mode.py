"""Adaptive fast terminal sliding mode with a super-twisting reaching law (paper, eq. 5 to 7).

For each axis of q_a = (phi, theta, psi, theta_1, theta_2, theta_3), with e = q_a - q_ad:

    s   = e' + lambda e_reg^(r/eta) sign(e),   e_reg = max(|e|, epsilon)               (5)
    v   = q_ad'' - lambda (r/eta) e_reg^(r/eta - 1) e'                                  (6)
    tau = M_a v + C_a q_a' + G_a + Xi + u,     Xi' = -zeta s                            (7)
    u   = M_a (-k1 |s|^(1/2) sign(s) + w),     w' = -k2 sign(s)      (super-twisting)

Inside epsilon the printed term lambda epsilon^(r/eta) sign(e) switches with the sign of e and chatters at a
finite rate; here it continues linearly, lambda epsilon^(r/eta - 1) e, which is continuous at |e| = epsilon.
Likewise |s|^(1/2) sign(s) and sign(s) continue linearly inside the boundary layer ``layer``. Xi is bounded and
leaks; w is bounded.

This file yields the acceleration v + M_a^-1 u and the torque Xi; the model turns both into tau.
"""

from __future__ import annotations

from math import sqrt
from typing import Annotated

from msgspec import Struct

from onboard.core.spec import spec

Six = tuple[float, float, float, float, float, float]
ZERO: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Gains(Struct, frozen=True, forbid_unknown_fields=True):
    """Gains of one group of axes."""

    sliding: Annotated[float, spec("rad^(1-r/eta)/s", 0.0, 200.0, "lambda of eq. 5")] = 8.0
    exponent: Annotated[float, spec("1", 0.3, 0.999, "r/eta of eq. 5")] = 0.85
    epsilon: Annotated[float, spec("rad", 1e-5, 0.5, "regularisation of the error")] = 0.02
    reaching: Annotated[float, spec("rad^0.5/s^1.5", 0.0, 500.0, "k1 of the super-twisting law")] = 8.0
    integral: Annotated[float, spec("rad/s^3", 0.0, 2000.0, "k2 of the super-twisting law")] = 20.0
    integral_bound: Annotated[float, spec("rad/s^2", 0.0, 200.0, "largest |w|")] = 20.0
    layer: Annotated[float, spec("rad/s", 1e-4, 2.0, "boundary layer of sign(s)")] = 0.05
    adaptation: Annotated[float, spec("N m/rad", 0.0, 50.0, "zeta")] = 0.5
    adaptation_bound: Annotated[float, spec("N m", 0.0, 2.0, "largest |Xi|")] = 0.4
    leak: Annotated[float, spec("1/s", 0.0, 10.0, "rate at which Xi is forgotten")] = 0.1


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Gains of the attitude axes and of the joints."""

    attitude: Gains = Gains(integral=5.0)
    joints: Gains = Gains(integral=2.0, reaching=12.0)


class State(Struct, frozen=True, gc=False):
    """Integral of the reaching law w (rad/s^2) and adapted torque Xi (N m), per axis."""

    integral: Six = ZERO
    adapted: Six = ZERO


def surface_rate(error: float, gains: Gains) -> float:
    """lambda e_reg^(r/eta) sign(e), rad/s: the rate at which the surface s = 0 takes ``error`` to zero."""
    slope: float = gains.sliding * max(abs(error), gains.epsilon) ** (gains.exponent - 1.0)
    return slope * error


def step(
    state: State, error: Six, error_rate: Six, acceleration: Six, adapt: bool, params: Params, dt: float
) -> tuple[State, Six, Six]:
    """One tick; returns the state, the accelerations (rad/s^2) and the adapted torques (N m).

    error, error_rate: q_a - q_ad and its rate; acceleration: q_ad''. adapt: integrate (false on the ground).
    """
    out, integral, adapted = [0.0] * 6, [0.0] * 6, [0.0] * 6
    for i in range(6):
        g = params.attitude if i < 3 else params.joints
        e, rate = error[i], error_rate[i]
        size = abs(e)
        slope = g.sliding * (size if size > g.epsilon else g.epsilon) ** (g.exponent - 1.0)
        s = rate + slope * e
        # d/dt of the surface term; inside epsilon the term is linear, so is its derivative
        v = acceleration[i] - (slope if size <= g.epsilon else g.exponent * slope) * rate
        size = abs(s)
        if size <= g.layer:
            sign = s / g.layer
            root = sign * sqrt(g.layer)
        else:
            sign = 1.0 if s > 0.0 else -1.0
            root = sign * sqrt(size)
        w, xi = state.integral[i], state.adapted[i]
        if adapt:
            w = min(g.integral_bound, max(-g.integral_bound, w - g.integral * sign * dt))
            xi = min(g.adaptation_bound, max(-g.adaptation_bound, xi * (1.0 - g.leak * dt) - g.adaptation * s * dt))
        out[i] = v - g.reaching * root + w
        integral[i] = w
        adapted[i] = xi
    i6: Six = (integral[0], integral[1], integral[2], integral[3], integral[4], integral[5])
    x6: Six = (adapted[0], adapted[1], adapted[2], adapted[3], adapted[4], adapted[5])
    return State(i6, x6), (out[0], out[1], out[2], out[3], out[4], out[5]), x6
