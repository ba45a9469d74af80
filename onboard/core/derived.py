"""What follows from a parameter set and is worth computing once: the model, the places of the mission."""

from __future__ import annotations

from typing import TYPE_CHECKING

from onboard.core import limits, plan
from onboard.core.dynamics import Model

if TYPE_CHECKING:
    from onboard.core.params import Params


class Derived:
    """Model and site of one parameter set. Raises ``plan.InfeasibleError`` when the pipe cannot be repaired.

    Takes milliseconds to make: not something for a tick.
    """

    def __init__(self, params: Params) -> None:
        self.params = params
        self.model = Model.from_vehicle(params.vehicle)
        self.site = plan.survey(params.pipe, params.vehicle, params.plan)
        self.bounds = limits.bounds(params.vehicle, params.limits)
        gains = params.backstepping
        per_mass = gains.contact_stiffness if gains.compliant else gains.alpha * gains.gamma + 1.0
        self.normal_stiffness = per_mass * self.model.mass(True)
        """Stiffness of the translation law along the contact normal while pressing, N/m."""


def check_mission(params: Params) -> Derived:
    """What follows from ``params``. Raises ``plan.InfeasibleError`` when the mission cannot be flown.

    Touches nothing that is in force, so that it may be asked while another set is being flown, in any thread.
    """
    derived = Derived(params)
    plan.check_fence(derived.site, params.pipe, params.plan, params.safety.fence_low, params.safety.fence_high)
    return derived


_last: Derived | None = None


def derive(params: Params) -> Derived:
    """``Derived`` of ``params``, remembered for as long as the same set is in force."""
    if _last is None or _last.params is not params:
        return adopt(Derived(params))
    return _last


def adopt(derived: Derived) -> Derived:
    """Remember what was made beforehand: ``derive`` of its parameters costs nothing from now on."""
    global _last
    _last = derived
    return derived
