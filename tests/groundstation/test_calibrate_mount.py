"""The mount of the camera from the log of a motion in both hands."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from msgspec.structs import replace

from drivers.tracking import Mount
from groundstation import calibrate, codes
from groundstation.calibrate_mount import read
from onboard.config import Config, load_config
from onboard.recorder import Recorder
from onboard.records import RunInfo
from tests.drivers.moving import Motion, Noise, about_yaw, in_hands, moved, slowly
from tests.synthetic import change_outputs, mission

BEFORE = Mount((0.10, 0.0, 0.03), (0.0, 15.0, 0.0))
TRUE = Mount((0.11, -0.02, 0.05), (2.0, 20.0, -5.0))
STANDING = change_outputs(next(tick for tick, _ in mission()), events=())
DESK = load_config("desk")
CONFIG = replace(DESK, devices=replace(DESK.devices, odometry=replace(DESK.devices.odometry, mount=BEFORE)))
Told = tuple[int, str, str]
Run = Callable[..., Told]


def log_of(
    folder: Path, motion: Motion, seconds: float, config: Config = CONFIG, *, confidence: int = 3, finished: bool = True
) -> Path:
    """What the flight process records of it in PREFLIGHT: a tick each 4 ms, with the newest of what was told."""
    poses, states = moved(motion, TRUE, BEFORE, seconds, lag=0.003, noise=Noise())
    info = RunInfo(version="0.1.0", scenario="jetson", law="tuned", seed=0, realtime=True)
    recorder, k = Recorder(folder / "log.mcap", info, config, ""), 0
    for index, state in enumerate(states):
        while k + 1 < len(poses) and poses[k + 1].t_ns <= state.t_ns:
            k += 1
        pose = replace(poses[k], confidence=confidence) if poses[k].t_ns <= state.t_ns else None
        inputs = replace(STANDING.inputs, t_ns=state.t_ns, odometry=pose, autopilot=state)
        recorder.tick(replace(STANDING, index=index, inputs=inputs))
    if finished:
        recorder.close()
    else:
        recorder._writer.flush()
        recorder._stream.close()
    return folder / "log.mcap"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def running(*arguments: str) -> Told:
        parser = argparse.ArgumentParser()
        calibrate.add_parser(parser.add_subparsers())
        options = parser.parse_args(["calibrate", "mount", *arguments])
        code = options.run(options)
        told = capsys.readouterr()
        return code, told.out, told.err

    return running


def test_the_mount_is_found_and_written(run: Run, tmp_path: Path) -> None:
    log = log_of(tmp_path, in_hands, 10.0)
    code, out, _ = run(str(tmp_path))
    assert code == codes.DONE
    assert "poses are stamped 3." in out
    found = yaml.safe_load(out)["devices"]["odometry"]["mount"]
    assert found["rotation_deg"] == pytest.approx(TRUE.rotation_deg, abs=0.4)
    assert found["offset"] == pytest.approx(TRUE.offset, abs=0.008)
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        "devices:\n  odometry:\n    mount: {offset: [0.1, 0.0, 0.03], rotation_deg: [0, 15, 0]}  # a guess\n"
    )
    assert run(str(log), "--config", str(mine))[0] == codes.DONE
    assert "# a guess" in mine.read_text()
    mount = load_config(str(mine)).devices.odometry.mount
    assert list(mount.offset) == found["offset"]
    assert list(mount.rotation_deg) == found["rotation_deg"]


def test_slow_turns_write_the_rotation_alone(run: Run, tmp_path: Path) -> None:
    log_of(tmp_path, slowly, 20.0)
    code, out, _ = run(str(tmp_path))
    assert code == codes.DONE
    assert "too slow to tell where it sits" in out
    assert list(yaml.safe_load(out)["devices"]["odometry"]["mount"]) == ["rotation_deg"]


def test_a_turntable_is_refused(run: Run, tmp_path: Path) -> None:
    log = log_of(tmp_path, about_yaw, 7.0)
    code, out, err = run(str(tmp_path))
    assert (code, out) == (codes.WRONG_INPUT, "")
    assert err.startswith(f"pipewright: {log}: how the camera is turned about z (yaw)")


def test_logs_that_cannot_tell_are_refused(run: Run, tmp_path: Path) -> None:
    mock = load_config("paper")
    log_of(tmp_path, in_hands, 1.0, mock)
    assert "its tracker was a mock" in run(str(tmp_path))[2]
    log_of(tmp_path, in_hands, 1.0, confidence=1)
    assert "holds no pose of the camera" in run(str(tmp_path))[2]
    log_of(tmp_path, in_hands, 2.0)
    assert "at least 5 s are needed" in run(str(tmp_path))[2]
    assert "no such log" in run(str(tmp_path / "nothing.mcap"))[2]
    assert run(str(tmp_path / "nothing.mcap"))[0] == codes.WRONG_INPUT


def test_a_log_that_was_cut_off(run: Run, tmp_path: Path) -> None:
    log = log_of(tmp_path, in_hands, 8.0, finished=False)
    code, _, err = run(str(log))
    assert code == codes.WRONG_INPUT
    assert "--partial reads them" in err
    assert run(str(log), "--partial")[0] == codes.DONE
    assert len(read(log, partial=True).recorded.t) > 1000
