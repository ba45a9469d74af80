"""The errand of an unattended run."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from onboard.config import load_config
from onboard.core.step import initial_state, step
from onboard.core.types import Action, Outputs, Phase, Request, Verdict
from onboard.errand import PATIENCE, START_AT, Errand
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
