"""The desired contact force over time.

From the force at the trigger to a small bias, a quintic ramp to the set force, a hold, and a quintic ramp back to the
bias before the sleeve is released.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from onboard.core.spec import spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Shape of the profile."""

    bias: Annotated[
        float, spec("N", 0.05, 2.0, "force that keeps contact before and after the ramps", in_flight=False)
    ] = 0.3
    settle: Annotated[float, spec("s", 0.1, 20.0, "time from the trigger to the bias", in_flight=False)] = 1.0
    bias_hold: Annotated[
        float, spec("s", 0.0, 20.0, "time at the bias before the ramp and after it", in_flight=False)
    ] = 1.0
    ramp: Annotated[float, spec("s", 0.5, 60.0, "duration of each quintic ramp", in_flight=False)] = 6.0
    lead: Annotated[float, spec("s", 0.0, 1.0, "lead of the force fed forward, for the attitude's lag")] = 0.11


def quintic(u: float) -> float:
    """Smooth step from 0 to 1 with zero first and second derivatives at both ends; u is clamped to 0..1."""
    if u <= 0.0:
        return 0.0
    if u >= 1.0:
        return 1.0
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


def desired_force(t: float, start: float, force: float, hold: float, params: Params) -> tuple[float, bool]:
    """Force (N) at ``t`` seconds after the trigger, and whether the profile has ended.

    start: force at the trigger (N); force: set force (N); hold: time it is held (s).
    """
    p = params
    if t < p.settle:
        return settled(t, start, p)[0], False
    t -= p.settle + p.bias_hold
    if t < p.ramp:
        return p.bias + (force - p.bias) * quintic(t / p.ramp), False
    t -= p.ramp + hold
    return force + (p.bias - force) * quintic(t / p.ramp), t >= p.ramp + p.bias_hold


def held_at(hold: float, params: Params) -> float:
    """Time from the trigger at which the set force has been held for ``hold``, s."""
    return params.settle + params.bias_hold + params.ramp + hold


def settled(t: float, start: float, params: Params) -> tuple[float, bool]:
    """The same where the set force has been held before: to the bias alone."""
    p = params
    return start + (p.bias - start) * quintic(t / p.settle), t >= p.settle + p.bias_hold
