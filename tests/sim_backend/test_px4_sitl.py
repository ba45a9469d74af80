"""Starting and ending a PX4, with a small program in its place."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.protocols import DeviceError
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.px4_sitl import VARIABLE, Px4Sitl, battery_parameters, build_folder, main
from sim_backend.world import World
from tests.sim_backend.flying import mass_of

PARAMETERS = {"COM_OF_LOSS_T": 0.5, "EKF2_EV_CTRL": 15, "MAV_SYS_ID": 7, "SYS_AUTOSTART": 4019}
WAITS = 'echo "px4 starting"; env; echo "$@" > arguments; while true; do sleep 0.05; done'
LONG = 20.0


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end, "the condition never held"
        select.select([], [], [], 0.01)


def build(folder: Path, script: str = WAITS) -> Path:
    """A build folder of PX4 with a shell script as the binary."""
    (folder / "bin").mkdir(parents=True)
    (folder / "etc").mkdir()
    binary = folder / "bin" / "px4"
    binary.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
    binary.chmod(0o755)
    return folder


def test_parameters_and_instance_are_handed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PX4_PARAM_COM_OF_LOSS_T", "9")
    monkeypatch.setenv("PX4_SIM_SPEED_FACTOR", "3")
    px4 = Px4Sitl(build(tmp_path / "build"), PARAMETERS, instance=2, folder=tmp_path / "run")
    assert (px4.simulator_url, px4.driver_url) == ("tcp://127.0.0.1:4562", "udpin://127.0.0.1:14542")
    with px4:
        until((tmp_path / "run" / "arguments").exists)
        given = dict(line.split("=", 1) for line in px4.output().splitlines() if line.startswith("PX4_"))
    # What the start script decides itself is left to it, and nothing of the caller's environment gets in.
    assert given == {"PX4_PARAM_COM_OF_LOSS_T": "0.5", "PX4_PARAM_EKF2_EV_CTRL": "15", "PX4_SIM_MODEL": "none_iris"}
    arguments = (tmp_path / "run" / "arguments").read_text(encoding="utf-8").split()
    assert arguments == ["-i", "2", "-d", "-w", str(tmp_path / "run"), str(tmp_path / "build" / "etc")]


def test_it_starts_from_its_defaults(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "parameters.bson").write_bytes(b"of the last time")
    with Px4Sitl(build(tmp_path / "build"), {}, folder=run):
        assert not (run / "parameters.bson").exists()


def test_stop_ends_it_and_removes_its_folder(tmp_path: Path) -> None:
    px4 = Px4Sitl(build(tmp_path / "build"), {})
    px4.start()
    pid, folder = px4.pid, px4.folder
    assert pid is not None
    px4.check()
    px4.stop()
    px4.stop()
    assert not folder.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_one_that_ignores_the_signal_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_backend.px4_sitl._PATIENCE", 0.1)
    px4 = Px4Sitl(build(tmp_path / "build", "trap '' TERM; echo deaf; while true; do sleep 0.05; done"), {})
    px4.start()
    pid = px4.pid
    until(lambda: "deaf" in px4.output())
    px4.stop()
    assert pid is not None
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_its_death_is_told_with_its_last_words(tmp_path: Path) -> None:
    px4 = Px4Sitl(build(tmp_path / "build", "echo 'PX4 server already running for instance 0'; exit 1"), {})
    px4.start()
    until(lambda: px4.pid is None)
    with pytest.raises(DeviceError, match=r"(?s)runs no more.*already running for instance 0"):
        px4.check()
    px4.stop()


def test_a_folder_that_is_no_build_is_told(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"bin/px4 is not there.*make px4_sitl_default"):
        Px4Sitl(tmp_path, {})


def test_the_environment_names_the_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert build_folder() is None
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert build_folder() == tmp_path


def test_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = build(tmp_path / "build", "echo last words; exit 3")
    assert main([str(folder)]) == 2
    out, err = capsys.readouterr()
    assert "last words" in out + err
    assert main([str(folder), "--parameters", "/none.params"]) == 2
    assert "/none.params" in capsys.readouterr().err


def test_px4s_own_battery_follows_the_worlds(vehicle: Vehicle) -> None:
    """After a while of hovering, both have lost the same voltage."""
    told = battery_parameters(vehicle.battery)
    world = World(vehicle)
    weight = mass_of(vehicle) * vehicle.gravity
    x = world.plant.x
    world.autopilot.armed = True
    x[at.POSITION + 2] = 30.0  # it holds itself in the air
    world.advance(100.0)
    assert sum(world.snapshot.x[at.ROTOR : at.ROTOR + 4]) == pytest.approx(weight, rel=0.02)
    charge = 1.0 - 100.0 / told["SIM_BAT_DRAIN"]
    cell = told["BAT1_V_EMPTY"] + charge * (told["BAT1_V_CHARGED"] - told["BAT1_V_EMPTY"])
    assert 4 * cell == pytest.approx(world.snapshot.x[at.VOLTAGE], abs=0.05)
