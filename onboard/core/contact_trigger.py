"""The contact trigger: tip at the crack *and* estimated force above a threshold, both for a while.

Contact is lost when next to no force is left for ``lost_time``; or, while a larger force is asked for, when the
estimate falls far short of it: then the push goes into nothing and moves the vehicle towards the pipe, so that is
told at once.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from onboard.core.spec import spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """When contact is believed, and when it is believed lost."""

    tolerance: Annotated[float, spec("m", 0.001, 0.5, "distance of the tip from the crack")] = 0.03
    threshold: Annotated[float, spec("N", 0.01, 3.0, "estimated compressive force that means contact")] = 0.15
    debounce: Annotated[float, spec("s", 0.0, 2.0, "how long both must hold")] = 0.10
    lost_force: Annotated[float, spec("N", -1.0, 3.0, "estimated force below which contact is doubtful")] = 0.05
    lost_time: Annotated[float, spec("s", 0.0, 5.0, "how long it must stay below")] = 0.5
    short_share: Annotated[float, spec("1", 0.0, 0.9, "share of the desired force that is far too little")] = 0.4
    short_force: Annotated[float, spec("N", 0.1, 5.0, "desired force from which that counts")] = 0.8
    short_time: Annotated[float, spec("s", 0.0, 5.0, "how long it must be too little")] = 0.08


class State(Struct, frozen=True, gc=False):
    """Whether contact is believed, and for how long the opposite has been seen, s."""

    contact: bool = False
    time: float = 0.0


def step(state: State, distance: float, force: float, desired: float, params: Params, dt: float) -> State:
    """One tick; ``distance`` of the tip from the crack (m), ``force`` estimated and ``desired`` compression (N)."""
    if state.contact:
        short = desired >= params.short_force and force < params.short_share * desired
        against = short or force < params.lost_force or distance > 2.0 * params.tolerance
        limit = params.short_time if short else params.lost_time
    else:
        against = force > params.threshold and distance < params.tolerance
        limit = params.debounce
    if not against:
        return state if state.time == 0.0 else State(state.contact, 0.0)
    time = state.time + dt
    return State(not state.contact, 0.0) if time >= limit else State(state.contact, time)
