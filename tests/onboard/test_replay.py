from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import pytest
from msgspec.structs import replace

from onboard.config import Config, dump_config, load_config
from onboard.core.step import initial_state, step
from onboard.core.types import Inputs, Request, Tick
from onboard.logfile import LogError
from onboard.recorder import Recorder
from onboard.records import RunInfo
from onboard.replay import differences, replay
from tests.synthetic import mission

INFO = RunInfo(version="0.1.0", scenario="paper", law="tuned", seed=7)
TICKS = 800

Change = Callable[[Tick], Tick | None]


def same(tick: Tick) -> Tick:
    return tick


def inputs() -> Iterator[Inputs]:
    """Samples that no vehicle would give, late ones and broken ones among them."""
    for tick, _ in islice(mission(), TICKS):
        seen = tick.inputs
        if tick.index < 5:
            seen = replace(seen, odometry=None, autopilot=None, servos=None)
        elif tick.index == 30:
            seen = replace(seen, request=Request.START)
        elif tick.index in (100, 101) and seen.odometry is not None:
            seen = replace(seen, odometry=replace(seen.odometry, p_WB=(math.nan, 0.0, math.inf)))
        elif tick.index % 7 == 0 and seen.servos is not None:
            seen = replace(seen, dt=0.0047, servos=replace(seen.servos, t_ns=seen.t_ns - 12_345_678))
        yield seen


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config()


def fly(path: Path, config: Config, change: Change = same, revise_at: int | None = None) -> Path:
    """Run the core over the samples and record it, with some ticks changed or left out (None)."""
    state = initial_state(config)
    revision = 0
    with Recorder(path, INFO, config, dump_config(config)) as recorder:
        for index, seen in enumerate(inputs()):
            if index == revise_at:
                config = replace(config, observer=replace(config.observer, cutoff=0.5 * config.observer.cutoff))
                revision = 1
                recorder.revision(index, seen.t_ns, revision, config)
            before = state
            state, outputs = step(state, seen, config, seen.dt)
            if index % 250 == 0:
                recorder.keyframe(index, seen.t_ns, before)
            if (tick := change(Tick(index, revision, seen, outputs))) is not None:
                recorder.tick(tick)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, config: Config) -> Path:
    return fly(tmp_path_factory.mktemp("replay") / "log.mcap", config)


def test_whole_log(log: Path) -> None:
    result = replay(log)
    assert result.same
    assert (result.ticks, result.keyframes, result.missing, result.start) == (TICKS, 3, 0, 0.0)
    assert "no difference" in str(result)


@pytest.mark.parametrize(
    ("start", "begun", "ticks"), [(0.0, 0.0, TICKS), (1.5, 1.0, TICKS - 250), (2.0, 2.0, TICKS - 500)]
)
def test_from_any_keyframe(log: Path, start: float, begun: float, ticks: int) -> None:
    result = replay(log, start)
    assert result.same
    assert (result.start, result.ticks) == (begun, ticks)


@pytest.mark.parametrize("start", [-1.0, 3.3, 100.0])
def test_from_where_there_is_nothing(log: Path, start: float) -> None:
    with pytest.raises(LogError, match=r"no keyframe at or before .* give a time from 0 s to 3\.196 s"):
        replay(log, start)


def test_first_difference_field_by_field(tmp_path: Path, config: Config) -> None:
    def change(tick: Tick) -> Tick:
        if tick.index < 321:
            return tick
        control = tick.outputs.control
        x, y, z = control.attitude
        thrust = math.nextafter(control.thrust, math.inf)
        changed = replace(control, attitude=(x, y, z + 1e-9), thrust=thrust)
        return replace(tick, outputs=replace(tick.outputs, control=changed))

    result = replay(fly(tmp_path / "log.mcap", config, change))
    assert not result.same
    assert result.difference is not None
    assert (result.difference.index, result.ticks) == (321, 321)
    assert result.difference.t == pytest.approx(321 * 0.004)
    assert [field.path for field in result.difference.fields] == ["control.thrust", "control.attitude.2"]
    text = str(result)
    assert "tick 321" in text
    assert f"{result.difference.fields[0].recorded!r}" in text


def test_gap_is_left_at_the_next_keyframe(tmp_path: Path, config: Config) -> None:
    result = replay(fly(tmp_path / "log.mcap", config, lambda tick: None if 100 <= tick.index < 110 else tick))
    assert result.same
    assert (result.ticks, result.missing) == (100 + TICKS - 250, 150)
    assert "150 ticks" in str(result)


def test_revised_parameters_are_taken_over(tmp_path: Path, config: Config) -> None:
    result = replay(fly(tmp_path / "log.mcap", config, revise_at=400))
    assert result.same
    assert result.ticks == TICKS
    assert replay(tmp_path / "log.mcap", 2.0).same


def test_unknown_revision(tmp_path: Path, config: Config) -> None:
    path = fly(tmp_path / "log.mcap", config, lambda tick: replace(tick, revision=3) if tick.index > 9 else tick)
    with pytest.raises(LogError, match="tick 10 was made with parameter revision 3"):
        replay(path)


def test_cut_off_log(log: Path, tmp_path: Path) -> None:
    cut = tmp_path / "log.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 3 // 4])
    with pytest.raises(LogError, match="--partial"):
        replay(cut)
    result = replay(cut, partial=True)
    assert result.same
    assert 0 < result.ticks < TICKS


def test_log_without_ticks(tmp_path: Path, config: Config) -> None:
    path = fly(tmp_path / "log.mcap", config, lambda tick: None)
    with pytest.raises(LogError, match="no tick"):
        replay(path)


def test_differences_see_signs_and_kinds() -> None:
    assert not differences({"a": [1.0, math.nan], "b": "x"}, {"a": [1.0, math.nan], "b": "x"})
    found = differences({"a": [0.0, math.inf], "b": None, "c": 1}, {"a": [-0.0, math.nan], "b": 2.0, "c": 1})
    assert [field.path for field in found] == ["a.0", "a.1", "b"]


def test_progress_is_told(log: Path) -> None:
    told: list[float] = []
    replay(log, on_second=lambda t, whole: told.append(t))
    assert told == pytest.approx([0.0, 1.0, 2.0, 3.0])
