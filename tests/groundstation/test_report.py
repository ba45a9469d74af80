from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from groundstation import metrics, report, table, terminal
from groundstation.run import Run, read_run
from groundstation.svg import Chart, number, thin, ticks
from onboard.core.types import Event, Phase, Severity
from onboard.recorder import Recorder
from onboard.records import DeviceReport, RunInfo, Timing
from tests.synthetic import ConfigStub, change_outputs, mission, record

CYCLES = list(mission())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(record(tmp_path_factory.mktemp("run") / "log.mcap"))


@pytest.fixture(scope="module")
def figures(run: Run) -> dict[str, Any]:
    return metrics.compute(run, wall_s=0.84)


@pytest.fixture(scope="module")
def page(run: Run, figures: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    report.write(run, figures, path)
    return path.read_text(encoding="utf-8")


class Checker(HTMLParser):
    """Notes every tag, and that all of them are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attributes)))
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attributes)))


def parse(page: str) -> Checker:
    checker = Checker()
    checker.feed(page)
    checker.close()
    assert not checker.open
    return checker


def test_page_is_well_formed_and_needs_no_network(page: str) -> None:
    for tag, attributes in parse(page).seen:
        assert not {"src", "href", "srcset", "data"} & set(attributes), tag
    assert "http" not in page
    assert "url(" not in page
    assert "@import" not in page


def test_page_shows_what_is_asked(page: str) -> None:
    for heading in ("Phases", "Table II", "figure 5", "figure 6", "figure 7", "At the pipe", "Events", "Configuration"):
        assert heading in page
    assert "✓ completed" in page
    assert "limit 13 N" in page
    assert "limit 0.93 N m" in page
    assert "now in press" in page
    assert "0.04000" in page  # measured against desired, in the table
    assert "NaN" not in page
    assert "nan" not in re.sub(r"[a-z]*nan[a-z]+", "", page)


def test_text_from_the_log_is_escaped(tmp_path: Path) -> None:
    tick, truth = CYCLES[0]
    event = Event(0, "x", Severity.ERROR, "<script>alert(1)</script>")
    info = RunInfo(version="0.1.0", scenario="a<b", law="tuned", seed=7)
    run = read_run(
        record(tmp_path / "log.mcap", [(change_outputs(tick, events=(event,)), truth), *CYCLES[1:9]], info=info)
    )
    report.write(run, metrics.compute(run), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    parse(page)
    assert "<script>alert" not in page
    assert "a<b" not in page


@pytest.mark.parametrize("ticks", [1, 2, 90, 600])
def test_short_runs_have_a_report_too(tmp_path: Path, ticks: int) -> None:
    run = read_run(record(tmp_path / "log.mcap", CYCLES[:ticks]))
    report.write(run, metrics.compute(run), tmp_path / "report.html")
    parse((tmp_path / "report.html").read_text(encoding="utf-8"))


def test_run_without_truth_has_a_report_too(tmp_path: Path) -> None:
    run = read_run(record(tmp_path / "log.mcap", truth=False))
    report.write(run, metrics.compute(run), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    parse(page)
    assert "figure 5" in page
    assert "figure 7" not in page


def test_wall_clock_run_shows_its_punctuality(tmp_path: Path) -> None:
    info = RunInfo("0.1.0", "paper", "tuned", 7, realtime=True, started="2025-01-02T03:04:05+00:00")
    with Recorder(tmp_path / "log.mcap", info, ConfigStub(), "") as recorder:
        for tick, truth in CYCLES[:500]:
            recorder.tick(tick, truth)
            recorder.timing(Timing(tick.index, tick.inputs.t_ns, 0.0012, 0.0004, 0.0003))
        for second in (0, 1):
            recorder.devices(DeviceReport(10**9 * second, {"cpu.loop": 0.25, "servos.cycle.p99": 0.0021}))
        recorder.event(Event(1_000_000_000, "servo bus", Severity.WARNING, "servo 3 does not answer"))
    run = read_run(tmp_path / "log.mcap")
    report.write(run, metrics.compute(run), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    parse(page)
    assert "Punctuality" in page
    assert '<td class="n">250.0</td><td class="n">1.20</td>' in page
    assert "0 of the ticks owed were missed (0.000 %)" in page
    for title in ("lateness of the ticks", "from tick to tick", "largest in each 0.5 s", "oldest in each 0.5 s"):
        assert f'aria-label="{title}' in page
    assert "late by 1 to 1.26 ms: 500 ticks" in page
    assert 'data-label="set-point"' in page
    assert 'data-label="loop"' in page
    assert '<td>cpu.loop</td><td class="n">25 %</td>' in page
    assert '<td>servos.cycle.p99</td><td class="n">0.0021</td>' in page
    assert "△ servo 3 does not answer" in page
    assert "begun 2025-01-02T03:04:05+00:00" in page


def test_rows_tell_better_from_worse(figures: dict[str, Any]) -> None:
    changed = {**figures, "force_rmse": {"est_des": 0.2093, "meas_des": 0.4076, "est_meas": None}}
    rows = table.rows(changed)
    assert [row.better for row in rows[:3]] == [True, False, None]
    assert [row.verdict for row in rows[:3]] == ["better, 1x", "worse, 2x", "no value"]
    assert [row.label for row in rows[3:]] == ["x", "y", "z", "φ", "θ", "ψ", "θ₁", "θ₂", "θ₃"]
    assert {row.unit for row in rows[3:6]} == {"m"}


def test_terminal_shows_table_and_reasons(run: Run, figures: dict[str, Any], tmp_path: Path) -> None:
    console = Console(record=True, width=80, force_terminal=False, file=(tmp_path / "out").open("w", encoding="utf-8"))
    event = Event(2_000_000_000, "wind", Severity.WARNING, "Gusts.")
    terminal.summarize(
        Run(**{**vars(run), "events": [event]}), {**figures, "outcome": "safe"}, Path("report.html"), console
    )
    text = console.export_text()
    console.file.close()
    assert "not completed" in text
    assert "10 times real time" in text
    assert "2.00 s  wind: Gusts." in text
    assert "report: report.html" in text
    assert re.search(r"F meas vs des +0\.2038 +0\.04000 +N +✓ better, 5\.09x", text)
    assert all(len(line) <= 80 for line in text.splitlines())


@settings(deadline=None, max_examples=200, derandomize=True)
@given(low=st.floats(-1e6, 1e6), span=st.floats(1e-6, 1e6), count=st.integers(2, 12))
def test_ticks_are_round_and_within(low: float, span: float, count: int) -> None:
    values, step = ticks(low, low + span, count)
    assert len(values) <= count + 1
    assert all(low - 1e-6 * step <= value <= low + span + 1e-6 * step for value in values)
    assert f"{step:e}"[:3] in ("1.0", "2.0", "2.5", "5.0")
    labels = [number(value, step) for value in values]
    if abs(low) + span < 1e4 * step:
        assert len(set(labels)) == len(labels)


def test_thinning_keeps_every_peak() -> None:
    x = np.linspace(0.0, 1.0, 30_000)
    y = np.sin(40.0 * x)
    y[12_345], y[23_456] = 9.0, -9.0
    thin_x, thin_y = thin(x, y)
    assert len(thin_x) < 1000
    assert np.all(np.diff(thin_x) > 0.0)
    assert (thin_y.max(), thin_y.min()) == (9.0, -9.0)
    assert (thin_x[0], thin_x[-1]) == (0.0, 1.0)


def test_chart_places_points_and_limits() -> None:
    chart = Chart("force", "N", (0.0, 10.0), y=(0.0, 5.0), width=156, height=172)
    chart.line(np.array([0.0, 10.0]), np.array([0.0, 5.0]), "a < b", "c1").limit(2.5, "limit")
    text = chart.svg()
    assert 'points="46.0,140.0 146.0,40.0"' in text
    assert '<path class="limit" d="M46 90.0H146"/>' in text
    assert "a &lt; b" in text
    parse(text)


def test_logarithmic_axes_are_laid_out_by_decades() -> None:
    chart = Chart("ages", "%", (0.1, 10.0), y=(1.0, 100.0), width=256, height=172, log="xy")
    chart.line(np.array([0.1, 1.0, 2.0, 10.0]), np.array([100.0, 10.0, 0.0, 1.0]), "", "c1")
    chart.bar(0.1, 1.0, 10.0, "ten").bar(1.0, 10.0, 0.0, "none").mark(1.0, "one")
    text = chart.svg()
    assert 'points="46.0,40.0 146.0,90.0 246.0,140.0"' in text  # zero has no place
    assert '<rect class="bar" x="46.0" y="90.0" width="100.0" height="50.0">' in text
    assert text.count('class="bar"') == 1
    assert '<path class="limit" d="M146.0 40V140"/>' in text
    assert [float(v) for v in re.findall(r'class="tick mid"[^>]*>([\d.]+)</text>', text)] == [0.1, 1.0, 10.0]
    assert [float(v) for v in re.findall(r'class="tick end"[^>]*>([\d.]+)</text>', text)] == [1.0, 10.0, 100.0]
    assert 'data-range="-1 1 0 2" data-log="xy"' in text
    parse(text)


def test_drawing_keeps_its_proportions() -> None:
    text = (
        Chart("plane", "mm", (-100.0, 100.0), y=(-50.0, 50.0), width=256, equal=True)
        .circle(0.0, 0.0, 40.0, "pipe")
        .svg()
    )
    match = re.search(r'rx="([\d.]+)" ry="([\d.]+)"', text)
    assert match is not None
    assert float(match[1]) == pytest.approx(float(match[2]), rel=0.01)


def test_phases_in_the_page_follow_the_run(page: str) -> None:
    names = re.findall(r"<title>([a-z ]+): [\d.]+ to [\d.]+ s</title>", page)
    assert names == [phase.replace("_", " ") for phase in (p for p, _ in _phases())]


def _phases() -> list[tuple[Phase, int]]:
    found: list[tuple[Phase, int]] = []
    for tick, _ in CYCLES:
        if not found or found[-1][0] is not tick.outputs.phase:
            found.append((tick.outputs.phase, tick.index))
    return found
