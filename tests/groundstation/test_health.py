"""How servos, tracker and link did, in figures of known troubles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from groundstation import figures, metrics, report
from groundstation.run import Run, read_run
from onboard.core.types import LinkState, Tick
from tests.groundstation.test_report import parse
from tests.synthetic import mission, record

CYCLES = list(mission())
LEANING = (0.9999, 0.01414, 0.0, 0.0)


def troubled(tick: Tick) -> Tick:
    """A servo that grows warm and is overloaded, a tracker that jumps, a commander that goes away for two seconds."""
    inputs, index = tick.inputs, tick.index
    assert inputs.servos is not None
    assert inputs.odometry is not None
    servos = replace(
        inputs.servos,
        temperature=(30.0, 40.0 + 0.01 * index, 30.0, 30.0, 30.0),
        current=(0.1, -1.2 if index == 900 else 0.4, 0.0, 0.0, 0.0),
        voltage=(5.0, 4.6, 5.0, 5.0, 5.2),
        error=(0, 32 if index > 1000 else 0, 0, 0, 0),
    )
    odometry = replace(inputs.odometry, confidence=3 if index % 4 else 2, reset_counter=index // 1000)
    away = 500 <= index < 1000
    commander = "" if index < 100 else "ann" if index < 1500 else "ben"
    heard = inputs.t_ns - 100_000_000 - (inputs.t_ns - 500 * 4_000_000 if away else 0)
    link = LinkState(commander, heard, not away)
    return replace(tick, inputs=replace(inputs, servos=servos, odometry=odometry, link=link))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    path = tmp_path_factory.mktemp("run") / "log.mcap"
    return read_run(record(path, [(troubled(tick), truth) for tick, truth in CYCLES]))


@pytest.fixture(scope="module")
def health(run: Run) -> dict[str, Any]:
    told: dict[str, Any] = metrics.compute(run)["health"]
    return told


def test_servos(run: Run, health: dict[str, Any]) -> None:
    worst = health["servos"]["theta_2"]
    assert worst["temperature_max"] == pytest.approx(40.0 + 0.01 * (len(run.t) - 1))
    assert worst["current_max"] == pytest.approx(1.2)
    assert worst["current_rms"] == pytest.approx(0.4, rel=0.01)
    assert (worst["voltage_min"], worst["voltage_max"]) == (4.6, 4.6)
    assert worst["errors"] == "overload"
    assert health["servos"]["gripper"]["errors"] == ""


def test_vision(run: Run, health: dict[str, Any]) -> None:
    vision = health["vision"]
    assert vision["confidence"]["2"] == pytest.approx(0.25, abs=0.001)
    assert vision["confidence"]["0"] == 0.0
    assert vision["jumps"] == (len(run.t) - 1) // 1000
    assert vision["lean_deg"]["max"] == pytest.approx(0.0, abs=1e-4)


def test_the_angle_between_the_verticals(tmp_path: Path) -> None:
    tick, truth = CYCLES[0]
    assert tick.inputs.autopilot is not None
    assert tick.inputs.odometry is not None
    inputs = replace(
        tick.inputs,
        odometry=replace(tick.inputs.odometry, q_WB=(1.0, 0.0, 0.0, 0.0)),
        autopilot=replace(tick.inputs.autopilot, q_WB=LEANING),
    )
    run = read_run(record(tmp_path / "log.mcap", [(replace(tick, inputs=inputs), truth), *CYCLES[1:4]]))
    assert metrics.compute(run)["health"]["vision"]["lean_deg"]["max"] == pytest.approx(1.62, abs=0.01)


def test_link(health: dict[str, Any]) -> None:
    link = health["link"]
    assert link["commanders"] == ["ann", "ben"]
    assert link["age"]["median"] == pytest.approx(0.1)
    assert link["age"]["max"] == pytest.approx(0.1 + 499 * 0.004, abs=1e-6)
    assert link["silent_s"] == pytest.approx(2.0 - 0.9, abs=0.02)
    assert link["absent_s"] == pytest.approx(2.0)


def test_the_report_shows_it(run: Run, tmp_path: Path) -> None:
    report.write(run, metrics.compute(run), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    parse(page)
    assert "<h2>Servos</h2>" in page
    assert "✗ overload" in page
    assert "confidence (of 3) was 3 for 75.0 %, 2 for 25.0 % of the ticks; its frame jumped 2 times" in page
    assert "Commanded by ann, then ben. The newest word was at most 2.10 s old (median 0.10 s)" in page
    assert [len(charts(run)) for charts in (figures.servos, figures.vision, figures.link)] == [2, 2, 1]


def test_a_run_that_tells_nothing_of_it(tmp_path: Path) -> None:
    silent = [
        (replace(tick, inputs=replace(tick.inputs, servos=None, odometry=None)), truth) for tick, truth in CYCLES[:50]
    ]
    run = read_run(record(tmp_path / "log.mcap", silent))
    told = metrics.compute(run)
    assert told["health"] == {"servos": None, "vision": None, "link": None}
    report.write(run, told, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for heading in ("Servos", "Vision", "Link"):
        assert f"<h2>{heading}</h2>" not in page
