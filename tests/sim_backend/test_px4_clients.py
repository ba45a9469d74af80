"""Others at the stand-in, each a process of its own: a plain pymavlink script, and MAVProxy."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import IO

import pytest

from drivers.vehicle import Vehicle
from sim_backend.px4_emulator import Px4StandIn, main
from sim_backend.world import World

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


@pytest.fixture
def port() -> Iterator[int]:
    """Port of a stand-in that was started from the command line."""
    command = [sys.executable, "-m", "sim_backend.px4_emulator", "--bind", "127.0.0.1:0", "--peer", "127.0.0.1:9"]
    with subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            said = process.stdout.readline()
            found = re.search(r"on UDP 127\.0\.0\.1:(\d+), telling 127\.0\.0\.1:9", said)
            assert found is not None, said
            yield int(found[1])
        finally:
            process.send_signal(2)
            rest = process.communicate(timeout=30.0)[0]
    assert process.returncode == 0
    assert re.search(r"after \d+\.\d s at .* received \d+ messages, fell \d", rest), rest


def test_a_plain_pymavlink_script_flies(port: int) -> None:
    script = Path(__file__).with_name("plain_client.py")
    done = subprocess.run(
        [sys.executable, str(script), f"udpout:127.0.0.1:{port}"], capture_output=True, text=True, timeout=150.0
    )
    assert done.returncode == 0, done.stderr
    met = json.loads(done.stdout)
    assert met["firmware"] == 12  # MAV_AUTOPILOT_PX4
    assert met["parameters"] > 60
    assert abs(met["roll"]) < 0.01
    assert (met["interval"], met["offboard"], met["arm"]) == (0, 0, 0)
    assert met["mode"] == "OFFBOARD"
    assert met["in_air"]
    assert met["land"] == 0
    assert met["mode_at_the_end"] == "OFFBOARD"  # once disarmed, the last mode in which one may arm


def until(stream: IO[str], pattern: str) -> str:
    """Read lines until one matches; what was read."""
    read = ""
    for line in stream:
        read += line
        if re.search(pattern, line):
            return read
    pytest.fail(f"{pattern} never came: {read}")


def test_mavproxy_connects(vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = shutil.which("mavproxy.py", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    if found is None:
        pytest.skip("MAVProxy is not installed (pip install MAVProxy: it brings 0.6 GB with it)")
    stand_in = Px4StandIn(World(vehicle))
    changed, change = Event(), stand_in.parameters.set_wire

    def set_wire(name: str, field: float) -> None:
        change(name, field)
        changed.set()

    monkeypatch.setattr(stand_in.parameters, "set_wire", set_wire)
    stand_in.start()
    try:
        with subprocess.Popen(
            [
                sys.executable, found, f"--master=udpout:127.0.0.1:{stand_in.port}", f"--state-basedir={tmp_path}",
                "--default-modules=param,mode,link",
            ],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path,
                env={**ENVIRONMENT, "PYTHONUNBUFFERED": "1"},
        ) as process:  # fmt: skip
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                told = until(process.stdout, r"Received \d+ parameters")
                assert "Mode LOITER" in told
                assert f"Received {len(stand_in.parameters)} parameters" in told
                process.stdin.write("param show COM_OF_LOSS_T\nparam set COM_OF_LOSS_T 0.8\n")
                process.stdin.flush()
                until(process.stdout, r"COM_OF_LOSS_T +0\.5")
                assert changed.wait(20.0)
            finally:
                process.stdin.close()
                process.terminate()
    finally:
        stand_in.stop()
    assert stand_in.parameters["COM_OF_LOSS_T"] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--vehicle", "none.yaml"], "none.yaml"),
        (["--fault", "{device: autopilot, kind: jump}"], "autopilot can show corrupt, delay, drop"),
        (["--fault", "{device: autopilot, kind: nonsense}"], "fault 1: Invalid enum value 'nonsense'"),
        (["--faults", "none.yaml"], "want a YAML list of faults"),
        (["--set", "COM_OF_LOSS=1"], "no parameter COM_OF_LOSS; want perhaps COM_OF_LOSS_T"),
        (["--bind", "203.0.113.1:1"], "cannot listen on UDP 203.0.113.1:1"),
    ],
)
def test_wrong_arguments_are_told(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--bind", "127.0.0.1:0", *arguments]) == 1
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--bind", "14580"], ["--set", "COM_OF_LOSS_T"], ["--peer", "host:port"]])
def test_arguments_that_cannot_be_read(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(arguments)
    assert "want for example" in capsys.readouterr().err
