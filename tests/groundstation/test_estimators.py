"""The table of the force estimators, from a log alone."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.console import Console

from groundstation import estimators, report, terminal
from groundstation.metrics import compute
from groundstation.run import Run, read_run
from onboard.core.types import Phase, Tick
from tests import synthetic
from tests.synthetic import change_outputs, mission, record

CYCLES = list(mission())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(record(tmp_path_factory.mktemp("run") / "log.mcap"))


def table(run: Run) -> dict[str, Any]:
    told: dict[str, Any] = compute(run)["estimators"]
    return told


def test_errors_are_those_put_in(run: Run) -> None:
    told = table(run)
    assert told["selected"] == "paper"
    assert list(told["table"]) == ["paper", "body", "momentum", "kalman", "felt"]
    paper, kalman, felt = (told["table"][name] for name in ("paper", "kalman", "felt"))
    assert (paper["rmse"], paper["bias"]) == pytest.approx((synthetic.ESTIMATED_ERROR,) * 2)
    assert paper["spread"] == pytest.approx(0.0, abs=1e-12)
    assert kalman["bias"] == pytest.approx(synthetic.KALMAN_ERROR)
    assert felt["rmse"] == pytest.approx(0.0, abs=1e-12)
    assert paper["delay"] == pytest.approx(0.0, abs=1e-3)
    assert paper["free_rms"] == pytest.approx(0.0, abs=1e-12)
    assert (told["false_contacts"], told["alarms"], told["cost_all"]) == (0, 0, None)
    free = sum(length for phase, length in synthetic.PHASES if phase in estimators._FREE)
    assert told["free_s"] == pytest.approx(free, abs=0.01)


@given(st.integers(0, 100), st.integers(0, 2**16))
@settings(max_examples=30)
def test_the_delay_put_in_is_found(ticks: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    true = np.cumsum(random.standard_normal(4000))
    late = np.concatenate((np.full(ticks, true[0]), true[: len(true) - ticks]))
    assert estimators.delay(late, true, 0.004) == pytest.approx(0.004 * ticks, abs=0.002)


def test_what_does_not_change_tells_no_delay() -> None:
    assert estimators.delay(np.full(1000, 2.0), np.full(1000, 2.5), 0.004) is None
    assert estimators.delay(np.zeros(3), np.zeros(3), 0.004) is None


def changed(tmp_path: Path, change: Any) -> dict[str, Any]:
    cycles = [(change(tick), truth) for tick, truth in CYCLES]
    return table(read_run(record(tmp_path / "log.mcap", cycles)))


def test_a_contact_without_touch_is_counted_once_each(tmp_path: Path) -> None:
    def twice(tick: Tick) -> Tick:
        outputs = tick.outputs
        pulled = outputs.phase is Phase.ADVANCE and 0.1 < outputs.phase_time < 0.15
        pulled |= outputs.phase is Phase.RETREAT and outputs.phase_time < 0.02
        estimate = outputs.estimate
        return change_outputs(tick, estimate=replace(estimate, in_contact=pulled or estimate.in_contact))

    assert changed(tmp_path, twice)["false_contacts"] == 1, "that of the retreat had a contact just before"


def test_alarms_in_free_flight_are_counted(tmp_path: Path) -> None:
    def alarmed(tick: Tick) -> Tick:
        estimate = tick.outputs.estimate
        rung = tick.outputs.phase in (Phase.APPROACH, Phase.RETURN) and tick.outputs.phase_time > 0.1
        return change_outputs(tick, estimate=replace(estimate, forces=replace(estimate.forces, alarm=rung)))

    assert changed(tmp_path, alarmed)["alarms"] == 2


def test_what_is_read_with_the_gate_open_and_nothing_touching(tmp_path: Path) -> None:
    """Twice long enough for the trigger, once too short, once while a contact fades: two pulls."""

    def gusty(tick: Tick) -> Tick:
        phase, time, estimate = tick.outputs.phase, tick.outputs.phase_time, tick.outputs.estimate
        blown = (phase is Phase.APPROACH and (0.1 <= time < 0.3 or 0.35 <= time < 0.4)) or (
            phase is Phase.ADVANCE and 0.1 <= time < 0.3
        )
        if not blown and phase is not Phase.RETURN:
            return tick
        forces = replace(estimate.forces, kalman=replace(estimate.forces.kalman, contact=0.2))
        return change_outputs(tick, estimate=replace(estimate, forces=forces))

    told = changed(tmp_path, gusty)
    assert told["watched_s"] == pytest.approx(0.45, abs=0.01)
    assert told["table"]["kalman"]["watched_rms"] == pytest.approx(0.2)
    assert told["table"]["kalman"]["pulls"] == 2
    assert (told["table"]["paper"]["watched_rms"], told["table"]["paper"]["pulls"]) == (pytest.approx(0.0), 0)
    assert "With the gate open and nothing touching: 0 s." in estimators.words(told)


def test_without_a_truth_only_the_costs_are_known(tmp_path: Path) -> None:
    log = record(tmp_path / "log.mcap", truth=False)
    (tmp_path / "costs.json").write_bytes(
        msgspec.json.encode(dict.fromkeys(("paper", "body", "momentum", "kalman"), 2.0))
    )
    told = table(read_run(log))
    assert told["cost_all"] == 8.0
    assert told["table"]["paper"] == {
        "rmse": None, "bias": None, "spread": None, "delay": None, "free_rms": pytest.approx(0.0), "cost": 2.0,
        "watched_rms": None, "pulls": None,
    }  # fmt: skip
    assert told["false_contacts"] is None


def test_a_log_from_before_has_no_table(run: Run) -> None:
    assert compute(run.with_estimates({}, run.triggered, run.alarm, "paper"))["estimators"] is None


def test_report_and_terminal_show_the_table(run: Run, tmp_path: Path) -> None:
    (run.path.parent / "costs.json").write_bytes(b'{"paper": 1.5, "body": 2.0, "momentum": 9.0, "kalman": 6.25}')
    figures = compute(run)
    page = tmp_path / "report.html"
    report.write(run, figures, page)
    text = page.read_text(encoding="utf-8")
    assert "Force estimators, side by side" in text
    assert "compression by each estimator" in text
    console = Console(width=160, record=True, file=StringIO())
    terminal.summarize(run, figures, page, console)
    shown = console.export_text()
    for words in ("momentum, with arm", "paper, eq. 11-17 *", "6.2", "-0.0050", "All together 18.8 us a tick"):
        assert words in shown, words


def test_the_ratio_of_the_selected_one_is_told(run: Run) -> None:
    again = run.with_estimates(run.forces, run.triggered, run.alarm, "kalman")
    told = table(again)
    assert told["ratio"] == pytest.approx(synthetic.ESTIMATED_ERROR / abs(synthetic.KALMAN_ERROR))
    assert "The paper's RMSE is 2.00 times its own." in estimators.words(told)
