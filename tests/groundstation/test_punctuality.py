"""Wall-clock runs: punctuality of the loop, ages of what it sent, and a world that keeps its own time."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from groundstation.metrics import compute
from groundstation.run import TRUTH_LASTS, read_run
from onboard.config import Config, load_config
from onboard.core.types import Event, Phase, Severity, Tick
from onboard.devices import mock_devices, world_of
from onboard.loop import Loop
from onboard.messages import Truth
from onboard.recorder import Recorder
from onboard.records import DeviceReport, RunInfo, Timing
from tests.synthetic import ConfigStub, mission, record

CYCLES = list(mission())
INFO = RunInfo(version="0.1.0", scenario="desk", law="tuned", seed=7, realtime=True)
BASE_NS = 5_000_000_000_000


class LateClock:
    """Comes back late (ns) from the sleeps named by their number from 0."""

    def __init__(self, late: dict[int, int]) -> None:
        self._now, self._late, self._sleeps = BASE_NS, late, 0

    def now_ns(self) -> int:
        return self._now

    async def sleep_until(self, t_ns: int) -> None:
        self._now = max(self._now, t_ns) + self._late.get(self._sleeps, 0)
        self._sleeps += 1


class LossyRecorder(Recorder):
    """Loses what concerns some ticks."""

    lost: frozenset[int] = frozenset()

    def tick(self, tick: Tick, truth: Truth | None = None) -> None:
        if tick.index not in self.lost:
            super().tick(tick, truth)

    def timing(self, timing: Timing) -> None:
        if timing.index not in self.lost:
            super().timing(timing)


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("paper")


def loop_timing(
    path: Path, config: Config, late: dict[int, int], ticks: int, lost: frozenset[int] = frozenset()
) -> dict[str, Any]:
    """The figures of a real loop on a clock that is late, with devices that stand still."""
    recorder = LossyRecorder(path, INFO, ConfigStub(), "", t_ns=BASE_NS)
    with recorder:
        recorder.lost = lost
        loop = Loop(mock_devices(world_of(config)), LateClock(late), config, recorder, timed=True)
        left = iter(range(ticks - 1, -1, -1))
        asyncio.run(loop.run(lambda outputs: bool(next(left))))
    timing: dict[str, Any] = compute(read_run(path))["timing"]
    return timing


@pytest.mark.parametrize(
    ("late", "missed"),
    [
        ({}, (0, 0)),
        ({9: 3_900_000}, (0, 0)),  # begun within its own period
        ({9: 10_000_000}, (2, 0)),  # the tick and the next began more than a period late; caught up
        ({9: 10_000_000, 60: 5_000_000}, (3, 0)),
        ({9: 400_000_000}, (1, 99)),  # given up: 400 ms are 100 periods, and one tick began in the last
    ],
)
def test_missed_ticks_are_periods_that_passed_without_one(
    tmp_path: Path, config: Config, late: dict[int, int], missed: tuple[int, int]
) -> None:
    found = loop_timing(tmp_path / "log.mcap", config, late, 200)["missed"]
    assert (found["late"], found["skipped"]) == missed
    assert found["count"] == sum(missed)
    assert found["share"] == pytest.approx(sum(missed) / (200 + missed[1]))
    assert found["period"] == pytest.approx(0.004)


def test_ticks_that_only_the_log_lacks_are_not_missed(tmp_path: Path, config: Config) -> None:
    timing = loop_timing(tmp_path / "log.mcap", config, {}, 200, frozenset(range(50, 60)))
    assert timing["missed"]["count"] == 0
    assert timing["missing_ticks"] == 10
    assert timing["period"]["max"] == pytest.approx(0.004)


def test_lateness_histogram_holds_every_tick(tmp_path: Path, config: Config) -> None:
    timing = loop_timing(tmp_path / "log.mcap", config, {9: 3_000_000, 30: 150_000, 60: 2_000_000_000}, 200)
    edges, counts = timing["lateness"]["edges"], timing["lateness"]["counts"]
    assert len(edges) == len(counts)
    assert sum(counts) == 200
    # after the stall one more tick is late by its rest, which no sleep absorbs
    assert {edge: count for edge, count in zip(edges, counts, strict=True) if count and edge} == {
        1e-4: 1,
        2e-3: 1,
        1.0: 1,
    }
    assert timing["late"]["max"] == pytest.approx(2.0)


def wall_clock_run(path: Path, reports: list[DeviceReport] | None = None) -> dict[str, Any]:
    with Recorder(path, INFO, ConfigStub(), "") as recorder:
        for tick, _ in CYCLES[:500]:
            estimate = replace(tick.outputs.estimate, age_autopilot=0.002)
            recorder.tick(replace(tick, outputs=replace(tick.outputs, estimate=estimate)))
            recorder.timing(Timing(tick.index, tick.inputs.t_ns, 0.0, 0.0009, 0.0005 + 1e-6 * (tick.index % 2)))
        for report in reports or []:
            recorder.devices(report)
    timing: dict[str, Any] = compute(read_run(path))["timing"]
    return timing


def test_a_set_point_is_as_old_as_its_attitude_when_it_leaves(tmp_path: Path) -> None:
    timing = wall_clock_run(tmp_path / "log.mcap")
    assert timing["sent"]["max"] == pytest.approx(0.000501)
    assert timing["setpoint_age"]["max"] == pytest.approx(0.002501)
    assert timing["setpoint_age"]["median"] == pytest.approx(0.0025005, abs=1e-6)


def test_what_the_devices_reported_is_told_over_time(tmp_path: Path) -> None:
    reports = [
        DeviceReport(10**9 * k, {"cpu.loop": 0.1 * k, "servos.errors": float(k), "odometry.POSE.rate": float("nan")})
        for k in (1, 2, 4)
    ]
    timing = wall_clock_run(tmp_path / "log.mcap", reports)
    assert timing["cpu"] == {"loop": pytest.approx({"min": 0.1, "median": 0.2, "max": 0.4, "last": 0.4})}
    assert timing["devices"]["servos.errors"] == {"min": 1.0, "median": 2.0, "max": 4.0, "last": 4.0}
    assert timing["devices"]["odometry.POSE.rate"] is None


def test_a_simulated_run_is_never_late(tmp_path: Path) -> None:
    timing = compute(read_run(record(tmp_path / "log.mcap")))["timing"]
    assert timing["late"] is timing["missed"] is timing["lateness"] is timing["setpoint_age"] is None
    assert timing["period"]["max"] == pytest.approx(0.004)
    assert timing["without_truth"] == 0
    assert timing["devices"] == timing["cpu"] == {}


# --- a world in a process of its own --------------------------------------------------------------------------------


def record_apart(path: Path, truths: list[tuple[int, Truth]], cycles: list[tuple[Tick, Truth]]) -> Path:
    """Record ticks, and truths at their own times (ns), each stream as its process would."""
    left = sorted(truths, key=lambda pair: pair[0])
    with Recorder(path, INFO, ConfigStub(), "") as recorder:
        for tick, _ in cycles:
            recorder.tick(tick)
            # the link is behind by up to one tick
            while left and left[0][0] <= tick.inputs.t_ns:
                recorder.truth(*left.pop(0))
        for t_ns, truth in left:
            recorder.truth(t_ns, truth)
    return path


def test_truths_with_each_tick_give_the_same_figures_either_way(tmp_path: Path) -> None:
    together = compute(read_run(record(tmp_path / "a.mcap", info=INFO)))
    apart = compute(
        read_run(record_apart(tmp_path / "b.mcap", [(tick.inputs.t_ns, truth) for tick, truth in CYCLES], CYCLES))
    )
    assert apart == together


def test_a_tick_takes_the_newest_truth_at_or_before_it(tmp_path: Path) -> None:
    # three truths in the time of two ticks, the first 30 ms after the first tick
    period = 2_666_667
    truths = [
        (30_000_000 + k * period, replace(CYCLES[0][1], tip_slip=float(k), contact_peak=float(k % 7)))
        for k in range(1500)
    ]
    run = read_run(record_apart(tmp_path / "log.mcap", truths, CYCLES[:1000]))
    assert run.truth is not None
    assert not run.truth.known[:8].any()
    assert np.isnan(run.truth.p[:8]).all()
    assert run.truth.known[8:].all()
    for row in range(8, 1000):
        t_ns = row * 4_000_000
        newest = (t_ns - 30_000_000) // period
        before = (t_ns - 4_000_000 - 30_000_000) // period
        assert run.truth.slip[row] == newest
        assert run.truth.peak[row] == max(k % 7 for k in range(max(before, -1) + 1, newest + 1))


def test_an_old_truth_says_nothing_and_its_peak_is_kept(tmp_path: Path) -> None:
    truths = [(tick.inputs.t_ns, truth) for tick, truth in CYCLES]
    first = next(i for i, (tick, _) in enumerate(CYCLES) if tick.outputs.phase is Phase.PRESS) + 300
    truths[first] = (truths[first][0], replace(truths[first][1], contact_peak=9.0))
    kept = [pair for i, pair in enumerate(truths) if not first < i < first + 50]
    # the peak comes with a truth that another one follows before the next tick
    t_ns, truth = kept[first]
    kept[first : first + 1] = [(t_ns - 3_000_000, truth), (t_ns - 1_000_000, replace(truth, contact_peak=0.0))]
    run = read_run(record_apart(tmp_path / "log.mcap", kept, CYCLES))
    assert run.truth is not None
    stale = int((TRUTH_LASTS - 0.001) / 0.004) + 1
    assert run.truth.known[first : first + stale].all()
    assert not run.truth.known[first + stale : first + 50].any()
    assert run.truth.known[first + 50 :].all()
    metrics = compute(run)
    assert metrics["contact"]["peak"] == 9.0
    assert metrics["contact"]["bounces"] == 0
    assert metrics["timing"]["without_truth"] == 50 - stale
    whole = compute(read_run(record(tmp_path / "whole.mcap")))
    assert metrics["force_rmse"] == pytest.approx(whole["force_rmse"])
    assert metrics["state_rmse"]["flight"] == pytest.approx(whole["state_rmse"]["flight"], abs=5e-4)
    assert metrics["limits"]["torque_max"] == pytest.approx(whole["limits"]["torque_max"], rel=1e-3)


def test_the_end_is_what_the_last_truth_says(tmp_path: Path) -> None:
    truths = [(tick.inputs.t_ns, replace(truth, on_ground=False)) for tick, truth in CYCLES]
    after = CYCLES[-1][0].inputs.t_ns + 20_000_000
    landed = record_apart(tmp_path / "a.mcap", [*truths, (after, CYCLES[-1][1])], CYCLES)
    assert compute(read_run(landed))["outcome"] == "completed"
    crashed = replace(CYCLES[-1][1], crashed="hit the ground at 3.2 m/s")
    lost = record_apart(tmp_path / "b.mcap", [*truths, (after, crashed)], CYCLES)
    assert compute(read_run(lost))["outcome"] == "lost"


def test_events_of_drivers_stand_at_their_own_time(tmp_path: Path) -> None:
    with Recorder(tmp_path / "log.mcap", INFO, ConfigStub(), "") as recorder:
        for tick, _ in CYCLES[:100]:
            recorder.tick(tick)
        recorder.event(Event(100_000_000, "servo bus", Severity.WARNING, "told late"))
    codes = [event.code for event in read_run(tmp_path / "log.mcap").events]
    assert codes == ["phase", "servo bus"] or codes == ["phase", "servo bus", "phase"]
