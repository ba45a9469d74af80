"""What a person types to fly: each order, its answer, its end, and why it is not done."""

from __future__ import annotations

import json
import os
import pty

import pytest

from groundstation import codes
from groundstation.client import Client
from onboard.core.types import Phase, Request
from onboard.wire import Arm, Ask, Go, Mission, Stop, Tare
from tests.groundstation.craft import Craft, command, process
from tests.waiting import LONG, seconds_until

Told = pytest.CaptureFixture[str]
KILL = Mission(Request.KILL)


def alice(*arguments: str) -> int:
    return command(*arguments, "--station", "alice")


@pytest.mark.parametrize(
    ("typed", "asked"),
    [
        ("arm", Arm()),
        ("takeoff", Mission(Request.TAKEOFF)),
        ("start", Mission(Request.START)),
        ("go TOOL-CHANGE", Go(Phase.TOOL_CHANGE)),
        ("hold", Mission(Request.HOLD)),
        ("resume", Mission(Request.RESUME)),
        ("retreat", Mission(Request.RETREAT)),
        ("land", Mission(Request.LAND)),
        ("stop", Stop()),
        ("kill --now", KILL),
        ("reset", Mission(Request.RESET)),
        ("tare", Tare()),
    ],
)
def test_each_order_reaches_the_vehicle_and_its_settled_answer_is_told(
    vehicle: Craft, commanding: Client, capsys: Told, typed: str, asked: Ask
) -> None:
    assert alice(*typed.split()) == 0
    assert vehicle.asked == [asked]
    assert capsys.readouterr().out == f"Now in {vehicle.phase}.\n"


def test_for_a_program(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    assert alice("hold", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"outcome": "done", "text": "Now in hold."}


def test_an_order_that_ends_as_asked_is_followed_to_its_end(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    assert alice("takeoff", "--wait") == 0
    first, *events, last = capsys.readouterr().out.splitlines()
    assert first == "Now in takeoff."
    assert [line.split()[1:3] for line in events] == [["INFO", "takeoff:"], ["INFO", "hover:"]]
    assert last.startswith("x500 is in HOLD, 0.")
    assert alice("land", "--wait", "--json") == 0
    *told, end = map(json.loads, capsys.readouterr().out.splitlines())
    assert [event["code"] for event in told] == ["land", "stopped"]
    assert (end["outcome"], end["phase"]) == ("done", "stopped")
    assert end["seconds"] > 0.0
    assert set(told[0]) == {"time", "t_ns", "number", "severity", "code", "text"}


def test_a_mission_is_followed_until_it_is_completed(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    assert alice("start", "--wait") == 0
    assert "completed: This is completed." in capsys.readouterr().out


def test_an_order_that_ends_otherwise_has_another_code(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    vehicle.courses[Mission(Request.START)] = [
        (Phase.TAKEOFF, "start"),
        (Phase.LAND, "land"),
        (Phase.STOPPED, "stopped"),
    ]
    assert alice("start", "--wait", "--json") == codes.REFUSED
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["outcome"] == "unfinished"
    vehicle.courses[Mission(Request.LAND)] = [(Phase.LAND, "land"), (Phase.HOLD, "hold")]
    assert alice("land", "--wait") == codes.REFUSED
    assert "x500 is in HOLD" in (told := capsys.readouterr().err)
    assert told.endswith("land has not ended as asked\n")


def test_a_phase_is_followed_until_it_has_been_gone_through(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    assert alice("go", "tare", "--wait") == 0
    assert "x500 is in ADVANCE" in capsys.readouterr().out
    vehicle.courses[Go(Phase.TARE)] = [(Phase.TARE, "tare"), (Phase.RETREAT_HOLD, "retreat_hold"), (Phase.HOLD, "hold")]
    assert alice("go", "tare", "--wait") == codes.REFUSED


def test_a_loop_that_stands_still_is_told_while_it_is_followed(
    vehicle: Craft, commanding: Client, capsys: Told
) -> None:
    vehicle.courses[Mission(Request.TAKEOFF)] = [(Phase.TAKEOFF, "takeoff")]
    vehicle.freezes = True
    assert alice("takeoff", "--wait", "--timeout", "0.5") == codes.TIMED_OUT
    assert "the loop of x500 has made no tick for 0." in capsys.readouterr().err


def test_a_vehicle_that_is_gone_is_told_while_it_is_followed(vehicle: Craft, commanding: Client) -> None:
    vehicle.courses[Mission(Request.TAKEOFF)] = [(Phase.TAKEOFF, "takeoff")]
    waiting = process("takeoff", "--wait", "--timeout", "1", "--station", "alice")
    assert waiting.stdout is not None
    assert waiting.stdout.readline() == "Now in takeoff.\n"
    assert "takeoff: This is takeoff." in waiting.stdout.readline()
    vehicle.link.stop()
    _, err = waiting.communicate(timeout=LONG)
    assert waiting.returncode == codes.NOT_THERE, err
    assert "It was in TAKEOFF." in err


# --- who may ----------------------------------------------------------------------------------------------------------


def test_who_does_not_command_is_told_how_to(vehicle: Craft, capsys: Told) -> None:
    assert alice("takeoff") == codes.REFUSED
    told = capsys.readouterr().err
    assert told.startswith("pipewright: Nobody commands: take the lease first. Run `pipewright lease take` in another")
    assert vehicle.asked == []


def test_who_does_not_command_while_another_does(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    assert command("land", "--station", "bob") == codes.REFUSED
    assert "alice commands, not bob" in (told := capsys.readouterr().err)
    assert "`pipewright lease take --seize` takes it" in told
    assert vehicle.asked == []


def test_stop_retreat_and_kill_need_no_lease(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    for order in (["stop"], ["retreat"], ["kill", "--now"]):
        assert command(*order, "--station", "bob") == 0
    assert vehicle.asked == [Stop(), Mission(Request.RETREAT), KILL]
    vehicle.answer = lambda asked: asked.refused("retreat refused. The vehicle is clear of the pipe already.")
    assert command("retreat", "--station", "bob") == codes.REFUSED
    assert "lease" not in capsys.readouterr().err


def test_nobody_sets_a_vehicle_going_and_leaves_it(vehicle: Craft, commanding: Client, capsys: Told) -> None:
    commanding.close()
    seconds_until(lambda: not vehicle.link.state().present)
    for order in ("arm", "takeoff", "start", "resume"):
        assert alice(order) == codes.REFUSED
        assert "alice commands x500, but nothing keeps the link" in capsys.readouterr().err
    assert alice("go", "press") == codes.REFUSED
    assert vehicle.asked == []
    for order in ("hold", "land", "reset"):
        assert alice(order) == 0, "what makes it safer is done"


# --- kill -------------------------------------------------------------------------------------------------------------


def test_kill_asks_only_where_somebody_can_answer(vehicle: Craft) -> None:
    asking = process("kill")
    _, err = asking.communicate(timeout=LONG)
    assert asking.returncode == codes.WRONG_INPUT
    assert "here is no terminal to ask on: give --now" in err
    assert vehicle.asked == []


@pytest.mark.parametrize(("answer", "code"), [("x500", 0), ("kill", 0), ("yes", 2), ("", 2)])
def test_kill_is_confirmed_by_its_name(vehicle: Craft, answer: str, code: int) -> None:
    ours, theirs = pty.openpty()
    try:
        asking = process("kill", stdin=theirs)
        os.write(ours, f"{answer}\n".encode())
        _, err = asking.communicate(timeout=LONG)
    finally:
        os.close(ours)
        os.close(theirs)
    assert asking.returncode == code, err
    assert "Type x500 or kill to do it: " in err
    assert vehicle.asked == ([KILL] if code == 0 else [])
