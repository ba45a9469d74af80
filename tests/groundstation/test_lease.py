"""Who commands, from the command line: the one who stays, and all that ends it."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import subprocess

import pytest

from groundstation import codes
from groundstation.client import Client, StationSettings
from onboard.core.types import Phase
from onboard.wire import TakeLease
from tests.groundstation.craft import Craft, command, keeper
from tests.waiting import LONG, seconds_until

Told = pytest.CaptureFixture[str]


def lines_until(process: subprocess.Popen[str], part: str) -> list[str]:
    """What a process says, up to a line that holds ``part``."""
    assert process.stdout is not None
    told: list[str] = []
    while not told or part not in told[-1]:
        line = process.stdout.readline()
        assert line, (told, process.communicate())
        told.append(line)
    return told


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=LONG)
    return process.returncode, out, err


def test_who_stays_keeps_the_link_for_all_commands_of_its_name(vehicle: Craft, capsys: Told) -> None:
    with keeper(vehicle, "--station", "alice") as staying:
        assert lines_until(staying, "Leave this running")[0] == "alice commands.\n"
        seconds_until(lambda: vehicle.link.state().present)
        assert command("takeoff", "--wait", "--station", "alice") == 0
        assert vehicle.link.state().present
        told = "".join(lines_until(staying, "HOLD for"))
        assert "INFO     takeoff: This is takeoff." in told
        assert command("land", "--wait", "--station", "alice") == 0
        lines_until(staying, "STOPPED for")
        staying.send_signal(signal.SIGINT)
        code, out, err = ended(staying)
        assert (code, err) == (0, "")
        assert out.endswith("alice commands no more.\n")
        assert vehicle.commander() == ""


def test_a_flying_vehicle_is_left_at_the_second_time_of_asking_only(vehicle: Craft) -> None:
    vehicle.phase = Phase.APPROACH
    with keeper(vehicle, "--station", "alice") as staying:
        lines_until(staying, "APPROACH for")
        staying.send_signal(signal.SIGINT)
        assert staying.stderr is not None
        assert staying.stderr.readline() == ("The vehicle flies: land first, or let another station seize command.\n")
        warning = staying.stderr.readline()
        assert "Ctrl-C again within 5 s leaves it all the same. Without its commander x500 holds" in warning
        assert staying.poll() is None
        assert vehicle.link.state().present
        staying.send_signal(signal.SIGINT)
        code, _, err = ended(staying)
        assert (code, err) == (codes.INTERRUPTED, "Leaving x500 without a commander.\n")
        seconds_until(lambda: not vehicle.link.state().present)
        assert vehicle.commander() == "alice", "silence takes nothing away"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize(("phase", "holder"), [(Phase.PREFLIGHT, ""), (Phase.APPROACH, "alice")])
def test_it_is_ended_from_outside(vehicle: Craft, number: signal.Signals, phase: Phase, holder: str) -> None:
    vehicle.phase = phase
    with keeper(vehicle, "--station", "alice") as staying:
        lines_until(staying, f"{phase.upper()} for")
        staying.send_signal(number)
        code, _, err = ended(staying)
        assert code == codes.INTERRUPTED
        assert ("Without its commander" in err) == bool(holder)
    assert vehicle.commander() == holder


def test_it_ends_when_another_seizes_command(vehicle: Craft, capsys: Told) -> None:
    with keeper(vehicle, "--station", "alice") as staying:
        lines_until(staying, "PREFLIGHT for")
        assert command("lease", "take", "--station", "bob") == codes.REFUSED
        assert "`pipewright lease take --seize` takes it all the same." in capsys.readouterr().err
        with keeper_of_another(vehicle):
            code, _, err = ended(staying)
        assert code == codes.REFUSED
        assert "x500: bob has taken command. alice commands no more." in err


def keeper_of_another(vehicle: Craft) -> Client:
    client = Client(StationSettings("x500", (vehicle.endpoint,), "bob", plain=True), timeout=LONG)
    client.ask(TakeLease(seize=True))
    return client


def test_it_ends_when_it_is_released_elsewhere(vehicle: Craft, capsys: Told) -> None:
    with keeper(vehicle, "--station", "alice", "--json") as staying:
        first = json.loads(lines_until(staying, "outcome")[0])
        assert first == {"outcome": "done", "text": "alice commands.", "vehicle": "x500", "station": "alice"}
        assert json.loads(lines_until(staying, "phase")[-1])["commanding"]
        assert command("lease", "release", "--station", "alice") == 0
        code, out, _ = ended(staying)
    assert code == 0
    assert json.loads(out.splitlines()[-1])["text"] == "alice commands x500 no more; this ends here."


def test_what_is_not_ones_own_is_not_released(vehicle: Craft, capsys: Told) -> None:
    assert command("lease", "release") == codes.REFUSED
    assert "Nobody commands: take the lease first." in capsys.readouterr().err


def test_it_outlives_a_vehicle_that_is_not_heard(vehicle: Craft) -> None:
    with keeper(vehicle, "--station", "alice") as staying:
        lines_until(staying, "PREFLIGHT for")
        vehicle.link.stop()
        lines_until(staying, "heard 1.")
        assert staying.poll() is None


def test_on_a_terminal_one_line_lives(vehicle: Craft) -> None:
    ours, theirs = pty.openpty()
    try:
        with keeper(vehicle, "--station", "alice", stdout=theirs) as staying:
            told = ""
            while "\r\x1b[KPREFLIGHT for 1.0 s" not in told:
                assert select.select([ours], [], [], LONG)[0], told
                told += os.read(ours, 65536).decode()
            staying.send_signal(signal.SIGINT)
            assert staying.wait(LONG) == 0
    finally:
        os.close(ours)
        os.close(theirs)
