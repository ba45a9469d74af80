"""The contact trigger: tip at the crack *and* estimated force above a threshold, both for a while.

Contact is lost when next to no force is left for ``lost_time``; or, while a larger force is asked for, when the
estimate falls far short of it: then the push goes into nothing and moves the vehicle towards the pipe, so that is
told at once. A noisy reading now and then hides no loss: the time counts back as fast as it has counted up.

A gust at the crack is force at the crack. Two more witnesses tell it from contact, each asked for by a parameter: what
the joints feel at the tip, where no wind acts (``felt``), and the onset: a contact rises in tenths of a second above
what was read before, a gust in seconds.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from onboard.core.spec import spec

#: So many times the tolerance from the crack, contact is lost.
FAR = 2.0


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """When contact is believed, and when it is believed lost."""

    tolerance: Annotated[float, spec("m", 0.001, 0.5, "distance of the tip from the crack")] = 0.03
    threshold: Annotated[float, spec("N", 0.01, 3.0, "estimated compressive force that means contact")] = 0.15
    debounce: Annotated[float, spec("s", 0.0, 2.0, "how long both must hold")] = 0.10
    height: Annotated[
        float, spec("m", 0.005, 0.1, "tip above or below the crack at which it is slipping off the pipe, in the press")
    ] = 0.04
    turn: Annotated[
        float, spec("rad", 0.05, 1.0, "heading off the pipe's normal at which it swings about the tip, in the press")
    ] = 0.20
    lost_force: Annotated[float, spec("N", -1.0, 3.0, "estimated force below which contact is doubtful")] = 0.05
    lost_time: Annotated[float, spec("s", 0.0, 5.0, "how long it must stay below")] = 0.5
    short_share: Annotated[float, spec("1", 0.0, 0.9, "share of the desired force that is far too little")] = 0.4
    short_force: Annotated[float, spec("N", 0.1, 5.0, "desired force from which that counts")] = 0.8
    short_time: Annotated[float, spec("s", 0.0, 5.0, "how long it must be too little")] = 0.08
    felt: Annotated[float, spec("N", 0.0, 3.0, "compression by the joints' currents that means contact; 0: any")] = 0.0
    onset: Annotated[float, spec("N", 0.0, 3.0, "rise of the estimate that means contact; 0: any")] = 0.0
    onset_time: Annotated[float, spec("s", 0.05, 10.0, "time in which that rise is to be seen")] = 1.0


class State(Struct, frozen=True, gc=False):
    """Whether contact is believed, and for how long the opposite has been seen, s."""

    contact: bool = False
    time: float = 0.0
    before: float | None = None
    """Slow mean of the estimate before the contact, N; None before the first tick."""


def step(
    state: State, distance: float, force: float, felt: float, desired: float, params: Params, dt: float, again: bool
) -> State:
    """One tick.

    distance: of the tip from the crack, m. force, felt, desired: compression as estimated, as felt by the joints, as
    wanted, N. again: contact was there and is looked for: it is found wherever it would not be lost.
    """
    before = force if state.before is None else state.before
    if state.contact:
        short = desired >= params.short_force and force < params.short_share * desired
        against = short or force < params.lost_force or distance > FAR * params.tolerance
        limit = params.short_time if short else params.lost_time
    else:
        against = (
            force > params.threshold
            and distance < (FAR if again else 1.0) * params.tolerance
            and (params.felt == 0.0 or felt > params.felt)
            and (params.onset == 0.0 or force - before > params.onset)
        )
        limit = params.debounce
        if not against:
            before += (force - before) * dt / (params.onset_time + dt)
    if not against:
        return State(state.contact, max(0.0, state.time - dt) if state.contact else 0.0, before)
    time = state.time + dt
    return State(not state.contact, 0.0, before) if time >= limit else State(state.contact, time, before)
