"""The estimators over a recorded log again."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from onboard import estimator_cost
from onboard import simulate as simulating
from onboard.config import Config, load_config
from onboard.core.types import Tick
from onboard.layers import ConfigError
from onboard.logfile import LogError, LogReader
from onboard.recompute import recompute
from onboard.records import RunInfo
from onboard.simulate import simulate
from tests.sim_backend.noisy import NOISY_SET
from tests.synthetic import record


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first seconds of a flight with sensors that are not ideal."""
    config = load_config("paper", sets=[NOISY_SET, "world.plant.ideal_motors=false"], seed=3)
    path = tmp_path_factory.mktemp("run") / "log.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulating, "LONGEST", 8.0)
        simulate(config, path)
    return path


def recorded(path: Path) -> list[Tick]:
    with LogReader(path) as log:
        return list(log.ticks())


def test_with_the_parameters_of_the_flight_it_is_the_flight(log: Path) -> None:
    ticks, seconds = recorded(log), []
    again = recompute(log, on_second=lambda t, length: seconds.append((t, length)))
    assert again.selected == "paper"
    for name in ("paper", "body", "momentum", "kalman"):
        assert again.forces[name] == [getattr(tick.outputs.estimate.forces, name).contact for tick in ticks]
    assert again.forces["felt"] == [tick.outputs.estimate.forces.felt for tick in ticks]
    assert again.triggered == [tick.outputs.estimate.in_contact for tick in ticks]
    assert again.alarm == [tick.outputs.estimate.forces.alarm for tick in ticks]
    assert set(again.costs) == {"paper", "body", "momentum", "kalman"}
    assert len(seconds) >= 8


def test_with_others_only_what_they_concern_differs(log: Path) -> None:
    ticks = recorded(log)
    again = recompute(log, ["estimators.body.cutoff=5", "estimators.selected=body"])
    assert again.selected == "body"
    assert again.forces["paper"] == [tick.outputs.estimate.forces.paper.contact for tick in ticks]
    assert again.forces["body"] != [tick.outputs.estimate.forces.body.contact for tick in ticks]


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("repair.force=3", "repair.force=3: does not change the estimators"),
        ("estimators.body.cutoff=-1", "estimators.body.cutoff"),
        ("estimators.bodi.cutoff=10", "estimators.bodi"),
    ],
)
def test_wrong_options_are_told(log: Path, option: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        recompute(log, [option])


def test_a_log_without_parameters_of_a_flight_is_refused(tmp_path: Path) -> None:
    """Such as one that was recorded by something else."""
    with pytest.raises(LogError):
        recompute(record(tmp_path / "log.mcap", info=RunInfo("0", "x", "y", 1)))


def test_costs_are_measured_for_each_and_small(tmp_path: Path) -> None:
    config: Config = load_config("paper")
    estimator_cost.write(replace(config, seed=4), tmp_path / "log.mcap")
    costs = estimator_cost.measure(config)
    assert (tmp_path / estimator_cost.NAME).is_file()
    assert set(costs) == {"paper", "body", "momentum", "kalman"}
    assert all(0.0 < cost < 1000.0 for cost in costs.values())
