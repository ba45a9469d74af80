"""The errand of an unattended run."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from onboard.config import load_config
from onboard.core.step import initial_state, step
from onboard.core.types import Action, Outputs, Phase, Request, Verdict
from onboard.errand import CALM, LONGEST_HOLD, PATIENCE, RESUMES, START_AT, Errand
from tests.core.sampled import inputs

CONFIG = load_config("paper")
PASSED: Outputs = replace(
    step(initial_state(CONFIG), inputs(), CONFIG, 0.004)[1], phase=Phase.PREFLIGHT, verdict=Verdict(Action.NONE, ())
)
WARNED = replace(PASSED, verdict=Verdict(Action.WARN, ("servos_late",)))
UNKNOWN = replace(PASSED, estimate=replace(PASSED.estimate, valid=False))


def errand() -> tuple[Errand, list[Request]]:
    asked: list[Request] = []
    return Errand(asked.append, 100.0), asked


def test_the_start_is_asked_for_once_after_a_rest() -> None:
    run, asked = errand()
    assert run.goes_on(PASSED, START_AT - 0.01)
    assert asked == []
    for k in range(3):
        assert run.goes_on(PASSED, START_AT + k)
    assert asked == [Request.START]


@pytest.mark.parametrize("outputs", [WARNED, UNKNOWN])
def test_the_start_waits_for_preflight_and_not_for_ever(outputs: Outputs) -> None:
    run, asked = errand()
    assert run.goes_on(outputs, PATIENCE - 0.01)
    assert not run.goes_on(outputs, PATIENCE)
    assert asked == []


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase is not Phase.PREFLIGHT])
def test_the_run_is_over_when_the_mission_has_stopped_or_takes_too_long(phase: Phase) -> None:
    run, asked = errand()
    assert run.goes_on(replace(PASSED, phase=phase), 99.9) is (phase is not Phase.STOPPED)
    assert not run.goes_on(replace(PASSED, phase=phase), 100.0)
    assert asked == []


def held(phase_time: float, action: Action = Action.NONE) -> Outputs:
    return replace(PASSED, phase=Phase.HOLD, phase_time=phase_time, verdict=Verdict(action, ()))


def test_a_hold_is_resumed_when_nothing_has_been_the_matter_for_a_while() -> None:
    run, asked = errand()
    for k in range(40):
        run.goes_on(held(0.1 * k, Action.HOLD), 0.1 * k)
    assert asked == []
    k = 40
    while not asked:
        run.goes_on(held(0.1 * k), 0.1 * k)
        k += 1
    assert asked == [Request.RESUME]
    assert CALM <= 0.1 * (k - 40) <= CALM + 0.2


def test_a_hold_that_comes_again_and_again_is_landed_in_the_end() -> None:
    run, asked = errand()
    for k in range(2 * RESUMES):
        run.goes_on(held(0.0), 10.0 * k)
        run.goes_on(held(5.0), 10.0 * k + 5.0)
    assert asked == [*[Request.RESUME] * RESUMES, Request.LAND]


def test_who_commands_ends_the_holds() -> None:
    asked: list[Request] = []
    run = Errand(asked.append, 100.0, lambda: True)
    for k in range(900):
        assert run.goes_on(held(0.1 * k), 0.1 * k)
    assert asked == []


def test_a_hold_without_end_is_landed() -> None:
    run, asked = errand()
    run.goes_on(held(LONGEST_HOLD + 0.1, Action.HOLD), 50.0)
    assert asked == [Request.LAND]
