"""One look at a vehicle, and what it has told."""

from __future__ import annotations

import json
import math
import signal

import pytest
from msgspec.structs import replace

from drivers.samples import SERVO_NAMES
from groundstation import codes, status
from groundstation.status import Status, brief, lines
from onboard.core.types import Action, Severity, Verdict
from tests.groundstation.craft import TICK, Craft, command, process
from tests.synthetic import mission
from tests.waiting import LONG, seconds_until

Told = pytest.CaptureFixture[str]
BARE = Status("x500", "alice", "", False, 0.05, 0.002, 0.0, 0, None)


def test_for_a_person(vehicle: Craft, capsys: Told) -> None:
    assert command("status") == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "x500: PREFLIGHT for 1.0 s"
    rows = dict(line.split(maxsplit=1) for line in told[1:])
    assert list(rows) == [
        *("verdict", "command", "link", "loop", "force", "body", "autopilot", "battery", "servos", "devices")
    ]
    assert rows["verdict"] == "all well"
    assert rows["command"] == "nobody commands"
    assert len(told) < 24
    assert all(len(line) < 80 for line in told)


def test_for_a_program(vehicle: Craft, capsys: Told) -> None:
    assert command("status", "--json", "--station", "alice") == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told) == list(Status.__struct_fields__)
    assert (told["vehicle"], told["station"], told["phase"], told["action"]) == ("x500", "alice", "preflight", "none")
    assert told["commanding"] is False
    assert 0.0 <= told["tick_age"] < LONG
    assert told["servo_temperatures"].keys() == set(SERVO_NAMES)


def test_a_vehicle_that_makes_no_ticks_yet(vehicle: Craft, capsys: Told) -> None:
    vehicle.link.stop()
    with Craft("x500", vehicle.endpoint, ticks=False):
        assert command("status") == 0
    assert capsys.readouterr().out.startswith("x500: it makes no ticks yet\n  command    nobody commands\n")


def test_a_loop_that_stands_still_since_before(vehicle: Craft, capsys: Told) -> None:
    seconds_until(lambda: vehicle.link._newest is not None)
    vehicle.stand_still()
    assert command("status", "--timeout", "0.5") == codes.TIMED_OUT
    assert "nothing is told of its flight: its last tick is 0." in capsys.readouterr().err


def test_what_is_wrong_stands_out() -> None:
    bad = replace(
        BARE,
        tick=7,
        tick_age=3.0,
        revision=2,
        phase="press",
        phase_time=12.34,
        action="retreat",
        reasons=("servos_hot", "late"),
        obstacles=("The odometry is a mock.",),
        clock_offset=-86400.0,
        events_missed=2,
        force_desired=2.5,
        force_estimated=2.481,
        in_contact=True,
        armed=True,
        mode="offboard",
        landed="in_air",
        battery_voltage=15.86,
        battery_remaining=0.866,
        servo_temperatures={"theta_1": 40.0, "pump": 71.4},
        servo_errors={"pump": 0x24},
        servo_torque=False,
        age_odometry=math.inf,
        age_autopilot=0.004,
        age_servos=0.012,
    )
    assert list(lines(bad)) == [
        "x500: PRESS for 12.3 s",
        "  verdict    RETREAT: servos_hot, late",
        "  command    nobody commands",
        "  link       heard 0.05 s ago, round trip 2.0 ms, its clock is 86400 s behind, 2 events missed",
        "  loop       tick 7, 3.00 s old; IT STANDS STILL; parameters of revision 2",
        "  force      2.50 N wanted, 2.48 N estimated, in contact",
        "  autopilot  armed, mode offboard, in air",
        "  battery    15.9 V, 87 %",
        "  servos     torque off; warmest pump, 71 degC; pump HAS AN ERROR (0x24)",
        "  devices    odometry not heard, autopilot 4 ms old, servos 12 ms old",
        "  not ready  The odometry is a mock.",
    ]
    assert brief(bad) == (
        "PRESS for 12.3 s | RETREAT: servos_hot, late | 2.50 N wanted, 2.48 N estimated, in contact | battery 87 % | "
        "heard 0.05 s ago | nobody commands"
    )


def test_devices_that_have_said_nothing_yet() -> None:
    silent = replace(TICK, inputs=replace(TICK.inputs, autopilot=None, servos=None))
    found = replace(BARE, **status._of_tick(silent))
    told = list(lines(found))
    assert "  autopilot  nothing heard of it" in told
    assert "  servos     nothing heard of them" in told
    assert not any("battery" in line for line in told)


def test_every_tick_of_a_mission_has_a_screen() -> None:
    for tick, _ in mission():
        verdict = Verdict(Action.HOLD, ("a", "b"))
        found = replace(BARE, **status._of_tick(replace(tick, outputs=replace(tick.outputs, verdict=verdict))))
        assert "  verdict    HOLD: a, b" in list(lines(found))


# --- events -----------------------------------------------------------------------------------------------------------


def test_the_last_events_are_there_for_who_comes_later(vehicle: Craft, capsys: Told) -> None:
    for i in range(60):
        vehicle.tell(f"e{i}")
    vehicle.tell("battery_low", Severity.WARNING)
    assert command("events") == 0
    told = capsys.readouterr().out.splitlines()
    assert len(told) == 50
    assert told[0].endswith("  INFO     e11: This is e11.")
    assert told[-1].endswith("  WARNING  battery_low: This is battery_low.")
    assert [line[:12] for line in told] == sorted(line[:12] for line in told), "times of day"


def test_they_are_followed_until_it_is_interrupted(vehicle: Craft) -> None:
    vehicle.tell("before")
    following = process("events", "--follow", "--json")
    assert following.stdout is not None
    assert json.loads(following.stdout.readline())["code"] == "before"
    vehicle.tell("after", Severity.ERROR)
    told = json.loads(following.stdout.readline())
    assert (told["number"], told["severity"], told["code"], told["text"]) == (2, "error", "after", "This is after.")
    following.send_signal(signal.SIGINT)
    out, err = following.communicate(timeout=LONG)
    assert (following.returncode, out, err) == (codes.INTERRUPTED, "", "")
