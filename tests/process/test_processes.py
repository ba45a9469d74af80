"""The two processes of a desk flight: how they are started, told things, refused things, and ended."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from groundstation.desk import Desk, end, start
from onboard.core.types import Event
from onboard.logfile import LogReader
from onboard.records import EVENT
from tests.acceptance.flights import COMMAND
from tests.process.flying import PATIENCE, Flying
from tests.realtime import REALTIME, alone

pytestmark = REALTIME


def onboard(*arguments: str, stdin: str = "", timeout: float = PATIENCE) -> subprocess.CompletedProcess[str]:
    """Run an onboard process whose standard input holds these lines and then closes."""
    command = [sys.executable, "-P", "-m", "onboard", *arguments]
    return subprocess.run(command, input=stdin, capture_output=True, text=True, timeout=timeout, check=False)


@contextmanager
def on_the_ground(folder: Path, *sets: str, config: str = "desk") -> Iterator[Flying]:
    with alone(), Flying(folder, *sets, config=config) as flight:
        yield flight


def events(folder: Path) -> dict[str, str]:
    """Code and text of the events in the log."""
    with LogReader(folder / "log.mcap") as log:
        return {event.code: event.text for event in log.one(EVENT, Event)}


# -- the world ------------------------------------------------------------------------------------------------------


def test_the_world_tells_where_it_is_and_ends_with_its_standard_input() -> None:
    done = onboard("world", "--config", "desk", stdin="")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert set(told) == {"devices.autopilot.url", "devices.servos.port", "devices.world"}


def test_a_fault_that_cannot_be_understood_is_told_and_the_world_goes_on() -> None:
    done = onboard("world", "--config", "desk", stdin="{device: toaster, kind: nan}\n{device: odometry, kind: bend}\n")
    assert done.returncode == 0
    assert "no toaster is emulated; emulated: autopilot, servos, odometry" in done.stderr
    assert "bend" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        ("faults=[{device: servos, kind: drift}]", "servos can show"),
        ("faults=[{device: toaster, kind: nan}]", "no toaster is emulated"),
        ("devices.servos.baud=12345", "devices.servos.baud"),
    ],
)
def test_a_world_that_cannot_be_is_refused(sets: str, words: str) -> None:
    done = onboard("world", "--config", "desk", "--set", sets)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr


# -- the flight process ---------------------------------------------------------------------------------------------


def test_everything_that_devices_lack_is_told_at_once(tmp_path: Path) -> None:
    done = onboard("fly", "--config", "desk", "--set", "interface=wrench", "--out", str(tmp_path / "run"))
    assert done.returncode == 2
    for words in ("interface = wrench", "devices.autopilot.url: missing", "devices.servos.port: missing",
                  "devices.world: missing"):  # fmt: skip
        assert words in done.stderr
    assert not (tmp_path / "run").exists()


def test_without_a_world_there_is_no_flight(tmp_path: Path) -> None:
    kinds = [f"--set=devices.{name}.kind=mock" for name in ("autopilot", "odometry", "servos")]
    done = onboard("fly", "--config=desk", *kinds, "--set=devices.world=127.0.0.1:9", "--out", str(tmp_path / "run"))
    assert done.returncode == 5
    assert "no world answers at 127.0.0.1:9" in done.stderr
    assert "Traceback" not in done.stderr


def test_every_device_that_cannot_be_had_is_told(tmp_path: Path) -> None:
    with Desk(["--config=desk"]) as desk:
        world = desk.start_world()
        sets = ["--set=devices.autopilot.url=udpout://127.0.0.1:9", "--set=devices.autopilot.timeout=2",
                "--set=devices.servos.port=/dev/no-such-port",
                f"--set=devices.world={world['devices.world']}"]  # fmt: skip
        done = onboard("fly", "--config=desk", *sets, "--out", str(tmp_path / "run"))
    assert done.returncode == 5
    assert "no heartbeat on udpout://127.0.0.1:9" in done.stderr
    assert "/dev/no-such-port" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "run" / "log.mcap").exists()


@pytest.mark.parametrize("device", ["autopilot", "odometry", "servos"])
def test_each_device_can_be_mock_among_emulated_ones(tmp_path: Path, device: str) -> None:
    with on_the_ground(tmp_path, f"devices.{device}.kind=mock") as flight:
        flight.wait_said("ready to fly")


def test_a_flight_with_all_devices_mock(tmp_path: Path) -> None:
    kinds = [f"devices.{name}.kind=mock" for name in ("autopilot", "odometry", "servos")]
    with on_the_ground(tmp_path, *kinds) as flight:
        flight.take_off()
        flight.ask("land")
        flight.ended_safely()


def test_a_real_autopilot_does_not_arm_among_devices_that_are_not(tmp_path: Path) -> None:
    with on_the_ground(tmp_path, "devices.autopilot.kind=emulated") as flight:
        url = flight.endpoints["devices.autopilot.url"]
        port, world = flight.endpoints["devices.servos.port"], flight.endpoints["devices.world"]
        end(flight.flight)
        flight.wait("nobody flies", lambda look: not look.armed)
        sets = ["devices.autopilot.kind=real", f"devices.autopilot.url={url}", f"devices.servos.port={port}",
                f"devices.world={world}"]  # fmt: skip
        asked = "takeoff\n" * 3
        for hitl in (False, True):
            given = [f"--set={item}" for item in (*sets, f"devices.hitl={str(hitl).lower()}")]
            out = tmp_path / str(hitl)
            command = ["fly", "--config=desk", *given, "--out", str(out), "--attended", "--duration=6"]
            child = start(command, stderr=subprocess.PIPE)
            assert child.stdin is not None
            assert child.stderr is not None
            said = ""
            while "ready to fly" not in said and "must not arm" not in said:
                said = child.stderr.readline()
                assert said, "it ended before it was ready"
            child.stdin.write(asked)
            child.stdin.flush()
            child.stderr.read()
            assert child.wait(PATIENCE) == 0
            end(child)
            child.stderr.close()
            told = events(out)
            if hitl:
                assert "must_not_arm" not in told
                assert "takeoff" in told
            else:
                assert "The autopilot is real, but odometry is emulated and servos is emulated" in told["must_not_arm"]
                assert "takeoff" not in told


# -- being ended, and being told to read its files again ------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_on_the_ground_an_interrupt_ends_it_at_once(tmp_path: Path, number: int) -> None:
    with on_the_ground(tmp_path) as flight:
        flight.wait_said("ready")
        flight.signal(number)
        assert flight.flight.wait(PATIENCE) == 0
    with LogReader(tmp_path / "log.mcap") as log:
        assert log.complete
    assert "ended" in events(tmp_path)


def test_in_flight_an_interrupt_lands_first(tmp_path: Path) -> None:
    with on_the_ground(tmp_path) as flight:
        flight.take_off()
        flight.signal(signal.SIGTERM)
        down = flight.ended_safely()
        assert flight.flight.wait(PATIENCE) == 0
        assert not down.truth.crashed
    told = events(tmp_path)
    assert "landing first" in told["ending"]
    assert "ended" in told


def test_asked_twice_it_leaves_and_the_autopilot_lands(tmp_path: Path) -> None:
    with on_the_ground(tmp_path) as flight:
        flight.take_off()
        flight.signal(signal.SIGTERM)
        flight.wait_said("landing first")
        flight.signal(signal.SIGTERM)
        assert flight.flight.wait(PATIENCE) == 0
        flight.ended_safely()
    assert "leaving in flight" in events(tmp_path)["left"]


def test_a_reload_puts_new_parameters_into_force_or_refuses_them_whole(tmp_path: Path) -> None:
    config = tmp_path / "mine.yaml"
    desk = (Path(__file__).parents[2] / "configs" / "desk.yaml").read_text()
    config.write_text(desk)
    with on_the_ground(tmp_path / "run", config=str(config)) as flight:
        flight.wait_said("ready")
        config.write_text(desk + "tilt: {bandwidth: 8.5}\n")
        flight.signal(signal.SIGHUP)
        flight.wait_said("revision 1: tilt.bandwidth = 9.0 -> 8.5")
        config.write_text(desk + "tilt: {bandwidth: fast, width: 3}\n")
        flight.signal(signal.SIGHUP)
        flight.wait_said("tilt.bandwidth = 'fast'")
        flight.wait_said("tilt.width: no such parameter")
        config.write_text(desk.replace("interface: attitude", "interface: body_rate"))
        flight.signal(signal.SIGHUP)
        flight.wait_said("takes a restart")


# -- nothing is left behind -----------------------------------------------------------------------------------------


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_children_of_a_desk_that_is_killed_end(tmp_path: Path) -> None:
    with alone():
        command: Sequence[str] = [str(COMMAND), "desk", "--out", "run", "--no-progress"]
        desk = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        assert desk.stderr is not None
        while "ready to fly" not in (line := desk.stderr.readline()):
            assert line, "it ended before it was ready"
        left = children(desk.pid)
        assert len(left) == 2
        watched = [os.pidfd_open(pid) for pid in left]
        os.kill(desk.pid, signal.SIGKILL)
        desk.wait(PATIENCE)
        for handle in watched:
            ended, _, _ = select.select([handle], [], [], PATIENCE)  # readable when the process has ended
            os.close(handle)
            assert ended
        desk.stderr.close()
    with LogReader(tmp_path / "run" / "log.mcap") as log:
        assert log.complete


def test_when_the_world_dies_the_flight_is_ended_and_reported(tmp_path: Path) -> None:
    with alone():
        desk = subprocess.Popen(
            [str(COMMAND), "desk", "--out", "run", "--no-progress"],
            cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert desk.stderr is not None
        while "ready to fly" not in (line := desk.stderr.readline()):
            assert line, "it ended before it was ready"
        world = min(children(desk.pid))
        began = time.monotonic()
        os.kill(world, signal.SIGKILL)
        printed, said = desk.communicate(timeout=3 * PATIENCE)
    assert desk.returncode == 1
    assert "the simulated world died (code -9)" in said
    assert "not completed" in printed
    assert time.monotonic() - began < 2 * PATIENCE
