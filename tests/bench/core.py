"""The core's step, run again over the recorded inputs of a mission: the whole, and where its time goes."""

from __future__ import annotations

import gc
import resource
from collections.abc import Sequence
from contextlib import ExitStack
from time import perf_counter_ns

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from onboard.core import (
    actuation,
    admittance,
    backstepping,
    body_observer,
    compensation,
    control,
    dynamics,
    estimate,
    estimators,
    facts,
    fuzzy,
    guidance,
    kalman_observer,
    kinematics,
    limits,
    mission,
    momentum_observer,
    observer,
    safety,
    sliding_mode,
    tilt,
)
from onboard.core import step as core
from onboard.core.params import Params
from onboard.core.step import State, initial_state, step
from onboard.core.types import Tick
from tests.bench.measure import Probe, Stat, Where, cost_of_looking, stat

#: The blocks, in the order of the step; each with the facts that are made for it.
BLOCKS: dict[str, tuple[Where, ...]] = {
    "estimate": ((estimate, "step"),),
    "safety": ((safety, "step"), (facts, "airborne"), (facts, "for_safety")),
    "mission": ((mission, "step"), (mission, "engage"), (facts, "for_mission")),
    "guidance": ((guidance, "step"),),
    "control": ((control, "step"),),
    "actuation": ((actuation, "autopilot_command"), (actuation, "servo_command")),
    "limits": ((limits, "step"), (facts, "permission"), (facts, "measured")),
    "state and outputs": ((core, "State"), (core, "Outputs"), (core, "Event")),
}

#: What is inside of some blocks; the rest of each is its own code.
INSIDE: dict[str, dict[str, tuple[Where, ...]]] = {
    "estimate": {
        "paper's observer": ((observer, "step"),),
        "body observer": ((body_observer, "step"),),
        "momentum observer": ((momentum_observer, "step"), (momentum_observer, "felt")),
        "Kalman filter": ((kalman_observer, "step"),),
        "what they are told": ((estimators, "tell"),),
        "tip": ((kinematics, "tip_W"),),
    },
    "guidance": {"fuzzy, admittance": ((fuzzy, "evaluate"), (admittance, "step"))},
    "control": {
        "dynamics": ((dynamics.Model, "inverse_dynamics"), (dynamics.Model, "contact_torque")),
        "backstepping": ((backstepping, "step"),),
        "tilt": ((tilt, "attitude_and_thrust"), (tilt, "step")),
        "sliding mode": ((sliding_mode, "step"),),
        "arm": (
            (compensation, "wrist_in_body"),
            (compensation, "step"),
            (kinematics, "nearest_wrist"),
            (kinematics, "wrist_jacobian_inverse"),
        ),
    },
}

#: Ticks in a row that are run bare, then watched; so that a change of the machine's pace meets all alike.
STRETCH = 2000

Durations = NDArray[np.int64]


class Part(Struct, frozen=True):
    """One block, or a part of it. The share is of the whole step's mean time, disturbed ticks left out."""

    name: str
    time: Stat
    share: float
    inside: tuple[Part, ...] = ()


class Core(Struct, frozen=True):
    """The core's step over a mission."""

    step: Stat
    parts: tuple[Part, ...]
    interruptions: int
    """Times that the system gave the processor to somebody else meanwhile."""


class ImpureError(AssertionError):
    """The core did not answer as it did in flight."""


def measure(ticks: Sequence[Tick], params: Params) -> Core:
    """Run the step over the inputs of ``ticks``: bare, then with the blocks watched, then what is in them.

    Raises ImpureError when the step gives other outputs than in flight.
    """
    blocks = {name: Probe(*where) for name, where in BLOCKS.items()}
    inner = {(block, name): Probe(*where) for block, parts in INSIDE.items() for name, where in parts.items()}
    n = len(ticks)
    bare, outer, deeper = (np.zeros(n, np.int64) for _ in range(3))
    of_block = {name: np.zeros(n, np.int64) for name in blocks}
    of_inner = {name: np.zeros(n, np.int64) for name in inner}
    cost_of_looking()
    gc.collect()
    gc.freeze()  # the recorded ticks are no garbage to search; in flight they are not kept
    before = resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw
    try:
        state = initial_state(params)
        _run(state, ticks, 0, min(STRETCH, n), params, bare)  # to warm up
        for first in range(0, n, STRETCH):
            last = min(first + STRETCH, n)
            after = _run(state, ticks, first, last, params, bare)
            _run(state, ticks, first, last, params, outer, [(blocks[name], of_block[name]) for name in blocks])
            _run(state, ticks, first, last, params, deeper, [(inner[name], of_inner[name]) for name in inner])
            state = after
    finally:
        gc.unfreeze()
    interruptions = resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw - before

    total = float(np.mean(bare[_calm(bare)]))
    calm, calm_inside = _calm(outer), _calm(deeper)

    def inside(block: str) -> tuple[Part, ...]:
        durations = {name: of_inner[block, name] for name in INSIDE.get(block, {})}
        return tuple(Part(name, stat(ns), float(np.mean(ns[calm_inside])) / total) for name, ns in durations.items())

    parts = (Part(name, stat(ns), float(np.mean(ns[calm])) / total, inside(name)) for name, ns in of_block.items())
    return Core(stat(bare), tuple(parts), interruptions)


def _calm(whole: Durations) -> NDArray[np.bool_]:
    """Which ticks took at most 1.5 times the median of the hundred around them: nobody broke into those."""
    hundreds = [whole[first : first + 100] for first in range(0, len(whole), 100)]
    return np.concatenate([hundred <= 1.5 * np.median(hundred) for hundred in hundreds])


def _run(
    state: State,
    ticks: Sequence[Tick],
    first: int,
    last: int,
    params: Params,
    whole: Durations,
    watched: Sequence[tuple[Probe, Durations]] = (),
) -> State:
    """Step over ticks first to last; the time of each goes to ``whole``, what a probe saw in it to its durations."""
    with ExitStack() as stack:
        for probe, _ in watched:
            stack.enter_context(probe.watching())
        for index in range(first, last):
            inputs = ticks[index].inputs
            start = perf_counter_ns()
            state, outputs = step(state, inputs, params, inputs.dt)
            whole[index] = perf_counter_ns() - start
            for probe, seen in watched:
                seen[index] = probe.take()
    if outputs != ticks[last - 1].outputs:
        raise ImpureError(f"tick {last - 1}: the core's step does not give the outputs it gave in flight")
    return state
