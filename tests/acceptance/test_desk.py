"""The mission in real time: all three real drivers over real bytes to their emulators, in two processes.

Bounds are wide on purpose: they tell a loop that keeps up from one that does not, on a busy machine too.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from onboard.replay import replay
from tests.acceptance.flights import Flown, completed, look, pipewright
from tests.brisk import BRISK
from tests.realtime import REALTIME, alone

pytestmark = REALTIME

#: Just over a minute of flight.
SETS = (*BRISK, "repair.hold=2")


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """The run folder of ``pipewright desk``."""
    with TemporaryDirectory(prefix="pipewright-") as name:
        with alone():
            sets = (f"--set={item}" for item in SETS)
            done = pipewright("desk", "--out", "run", *sets, cwd=Path(name), timeout=300.0)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        yield Path(name) / "run"


@pytest.fixture(scope="module")
def flown(folder: Path) -> Flown:
    return look(folder / "log.mcap")


@pytest.fixture(scope="module")
def told(folder: Path) -> dict[str, Any]:
    figures: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return figures


def test_the_mission_completes_in_real_time(flown: Flown, told: dict[str, Any]) -> None:
    assert completed(flown)
    assert flown.run.info.realtime
    assert flown.run.info.scenario == "desk"
    assert 40.0 < told["sim_s"] <= told["wall_s"] < 1.5 * told["sim_s"] + 30.0


def test_it_presses(told: dict[str, Any]) -> None:
    assert told["contact"]["source"] == "truth"
    assert told["contact"]["hold_mean"] == pytest.approx(1.5, abs=0.15)


def test_the_force_is_held_and_known(told: dict[str, Any]) -> None:
    assert told["force_rmse"]["meas_des"] <= 0.30
    assert told["force_rmse"]["est_meas"] <= 0.20
    assert told["contact"]["time_without_contact"] < 1.0


def test_every_device_tells_how_it_does(told: dict[str, Any]) -> None:
    devices, cpu = told["timing"]["devices"], told["timing"]["cpu"]
    assert devices["odometry.POSE.rate"]["median"] == pytest.approx(200.0, rel=0.1)
    assert devices["autopilot.ATTITUDE_QUATERNION.rate"]["median"] == pytest.approx(250.0, rel=0.1)
    assert devices["servos.rate"]["median"] > 150.0
    assert devices["autopilot.poses"]["last"] > 30.0 * told["sim_s"]
    assert 0.02 < cpu["loop"]["median"] < 1.0
    assert {"dynamixel", "mavsdk", "recorder"} <= set(cpu)


def test_ticks_that_are_missed_are_counted(told: dict[str, Any]) -> None:
    missed = told["timing"]["missed"]
    assert missed["count"] == missed["late"] + missed["skipped"]
    assert missed["share"] < 0.05


def test_achieved_rates_are_told(told: dict[str, Any]) -> None:
    rates = told["timing"]["rates"]
    assert set(rates) == {"tick", "odometry", "autopilot", "servos"}
    assert 150.0 < rates["tick"] < 255.0
    assert min(rates.values()) > 75.0


def test_the_age_of_every_sample_is_told(flown: Flown, told: dict[str, Any]) -> None:
    for device, ages in told["timing"]["ages"].items():
        assert 0.0 <= ages["median"] <= ages["p99"] <= ages["max"], device
        assert ages["median"] < 0.03, device
        assert flown.run.ages[device].shape == flown.run.t.shape


def test_the_lateness_of_the_loop_is_told(flown: Flown, told: dict[str, Any]) -> None:
    for name, values in (("late", flown.run.late), ("busy", flown.run.busy)):
        spread = told["timing"][name]
        assert len(values) == len(flown.run.t)
        assert 0.0 < spread["median"] < 0.004, name
        assert spread["median"] <= spread["p99"] <= spread["max"]


def test_the_same_core_replays_it_without_difference(flown: Flown) -> None:
    found = replay(flown.log)
    assert found.same, str(found)
    assert found.ticks == len(flown.run.t)
