"""The desk mission, from configuration to log."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from onboard import simulate as simulating
from onboard.config import Config, load_config
from onboard.core.types import Outputs, Phase, Request
from onboard.devices import world_of
from onboard.errand import START_AT
from onboard.layers import Layer
from onboard.logfile import LogReader
from onboard.params import compose
from onboard.simulate import simulate
from sim_backend import layout as at
from sim_backend.world import World

NOMINAL = [
    Phase.PREFLIGHT, Phase.TAKEOFF, Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE,
    Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, Phase.RETURN, Phase.LAND, Phase.STOPPED,
]  # fmt: skip


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("paper", sets=["repair.hold=0.5"], seed=3)


@pytest.fixture(scope="module")
def watched() -> list[tuple[Phase, float]]:
    return []


@pytest.fixture(scope="module")
def whole(config: Config, watched: list[tuple[Phase, float]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a whole mission."""
    log = tmp_path_factory.mktemp("whole") / "log.mcap"
    simulate(config, log, lambda outputs, t: watched.append((outputs.phase, t)))
    return log


def short(config: Config, log: Path, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Fly only the first seconds."""
    monkeypatch.setattr(simulating, "LONGEST", seconds)
    simulate(config, log)


def test_the_mission_completes_through_all_phases(whole: Path) -> None:
    phases: list[Phase] = []
    with LogReader(whole) as log:
        assert log.complete
        for tick in log.ticks():
            if not phases or phases[-1] is not tick.outputs.phase:
                phases.append(tick.outputs.phase)
        codes = [event.code for event in log.events()]
    assert phases == NOMINAL
    assert codes[0] == "start"
    assert codes[-1] == "completed"


def test_the_truth_stands_beside_every_tick(config: Config, whole: Path) -> None:
    with LogReader(whole) as log:
        ticks = [(tick.index, tick.inputs.t_ns) for tick in log.ticks()]
        truths = list(log.truths())
    assert [round(truth.t * 1e9) for truth in truths] == [t_ns for _, t_ns in ticks]
    assert [index for index, _ in ticks] == list(range(len(ticks)))
    end = truths[-1]
    assert end.crashed == ""
    assert end.on_ground
    assert end.sleeve_on_pipe
    assert max(truth.contact_force for truth in truths) == pytest.approx(config.repair.force, rel=0.2)


def test_the_log_tells_what_was_flown(config: Config, whole: Path) -> None:
    with LogReader(whole) as log:
        assert (log.info.scenario, log.info.law, log.info.seed) == ("paper", "tuned", 3)
        assert not log.info.realtime
        assert log.info.started == ""
        text = log.config_yaml
    assert compose(Config, [Layer("the log", yaml.safe_load(text))]) == config


def test_the_watcher_sees_every_tick(whole: Path, watched: list[tuple[Phase, float]]) -> None:
    with LogReader(whole) as log:
        assert watched == [(tick.outputs.phase, tick.inputs.t_ns * 1e-9) for tick in log.ticks()]


def test_the_start_is_asked_for_once_after_a_rest(whole: Path) -> None:
    with LogReader(whole) as log:
        asked = [(tick.inputs.request, tick.inputs.t_ns * 1e-9) for tick in log.ticks() if tick.inputs.request]
    assert [request for request, _ in asked] == [Request.START]
    assert START_AT <= asked[0][1] <= START_AT + 0.01


def test_two_runs_give_the_same_bytes(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        short(config, tmp_path / name, monkeypatch, 3.0)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_another_seed_makes_other_noise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in (1, 2):
        noisy = load_config("paper", sets=["world.sensors.odometry.position_noise=0.001"], seed=seed)
        short(noisy, tmp_path / str(seed), monkeypatch, 0.5)
    ticks = []
    for seed in (1, 2):
        with LogReader(tmp_path / str(seed)) as log:
            ticks.append([tick.inputs.odometry for tick in log.ticks()][-1])
    assert ticks[0] != ticks[1]


def test_a_mission_without_end_is_broken_off(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short(config, tmp_path / "log", monkeypatch, 1.0)
    with LogReader(tmp_path / "log") as log:
        assert log.complete
        assert log.duration == pytest.approx(1.0)


def test_the_run_ends_with_the_vehicle(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worlds: list[World] = []

    def kept(config: Config) -> World:
        worlds.append(world_of(config))
        return worlds[0]

    def breaks(outputs: Outputs, t: float) -> None:
        if t >= 0.5:
            worlds[0].plant.x[at.CRASH] = 2.0

    monkeypatch.setattr(simulating, "world_of", kept)
    simulate(config, tmp_path / "log", breaks)
    with LogReader(tmp_path / "log") as log:
        assert log.duration == pytest.approx(0.504)
        *_, last = log.truths()
    assert last.crashed.startswith("turned over")
