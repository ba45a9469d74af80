"""How a command meets its vehicle: options, keys, exit codes, and every way in which it is not there."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from groundstation import codes, station
from onboard.admission import vehicle_security
from onboard.roster import Role, Roster
from onboard.wire import Outcome, Stop
from tests.groundstation.craft import Craft, command, process
from tests.waiting import LONG
from tests.zenoh_sessions import Fleet, free_port


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (station.CONNECT, station.VEHICLE, station.KEYS):
        monkeypatch.delenv(name, raising=False)


Told = pytest.CaptureFixture[str]


def refused(capsys: Told, *arguments: str) -> str:
    """What a command says that is wrong with its arguments."""
    assert command("status", *arguments) == codes.WRONG_INPUT
    return capsys.readouterr().err


def test_a_process_of_its_own_finds_the_vehicle_by_the_environment_and_has_its_exit_code(vehicle: Craft) -> None:
    out, err = process("status", "--json", "--station", "alice").communicate(timeout=LONG)
    assert json.loads(out)["vehicle"] == "x500", err
    asking = process("stop", "--station", "alice")
    out, _ = asking.communicate(timeout=LONG)
    assert (asking.returncode, out) == (0, "Now in hold.\n")
    gone = process("status", "--connect", f"tcp/127.0.0.1:{free_port()}", "--timeout", "0.2")
    _, err = gone.communicate(timeout=LONG)
    assert gone.returncode == codes.NOT_THERE
    assert "nothing lets us in" in err


def test_no_vehicle_is_told_with_what_to_look_at(capsys: Told) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    assert command("land", "--connect", endpoint, "--timeout", "0.2", "--json") == codes.NOT_THERE
    told = capsys.readouterr()
    outcome = json.loads(told.out)
    assert outcome["outcome"] == "no_vehicle"
    assert "the machine is there, but no vehicle listens; does its service run, and on this port?" in outcome["text"]
    assert told.err.startswith("pipewright: nothing lets us in at tcp/127.0.0.1:")


def test_another_vehicle_is_there(vehicle: Craft, capsys: Told) -> None:
    assert command("status", "--vehicle", "eagle", "--timeout", "0.5") == codes.NOT_THERE
    assert "no vehicle 'eagle' at " in (told := capsys.readouterr().err)
    assert "; there: x500" in told


def test_no_answer_in_time(vehicle: Craft, capsys: Told) -> None:
    vehicle.answer = lambda asked: asked.accepted()
    assert command("stop", "--timeout", "0.4", "--json") == codes.TIMED_OUT
    told = capsys.readouterr()
    assert json.loads(told.out)["outcome"] == "timed_out"
    assert told.err == "pipewright: x500: it was accepted, but is not done within 0.4 s\n"


def test_a_refusal_is_the_vehicles_own_sentence(vehicle: Craft, capsys: Told) -> None:
    vehicle.answer = lambda asked: asked.refused("stop refused. Not today.")
    assert command("stop") == codes.REFUSED
    assert capsys.readouterr().err == "pipewright: stop refused. Not today.\n"


def test_what_cannot_be(capsys: Told, tmp_path: Path) -> None:
    assert "'X 500' is no name of a vehicle" in refused(capsys, "--vehicle", "X 500")
    assert "'Al' is no name of a station" in refused(capsys, "--station", "Al")
    assert "falcon: is no endpoint; like tls/" in refused(capsys, "--connect", "falcon")
    assert "plain TCP is only for loopback" in refused(capsys, "--connect", "tcp/10.0.0.7:7447")
    assert "tls/falcon:7447: give the keys of this station" in refused(capsys, "--connect", "tls/falcon:7447")
    assert "ca.pem: is missing" in refused(capsys, "--keys", str(tmp_path))
    assert "--plain and --keys: give one of them" in refused(capsys, "--plain", "--keys", str(tmp_path))


@pytest.mark.parametrize("wrong", ["0", "-1", "nan", "inf", "soon", "1e9"])
def test_times_that_cannot_be(wrong: str, capsys: Told) -> None:
    with pytest.raises(SystemExit) as ended:
        command("status", f"--timeout={wrong}")
    assert ended.value.code == codes.WRONG_INPUT
    assert f"{wrong}: must be a time in seconds" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (["takeof"], "pipewright: no command 'takeof'; nearest: takeoff, "),
        (["go", "pres"], "pipewright go: no phase 'pres'; nearest: press\n"),
        (["go", "nowhere-at-all"], "pipewright go: no phase 'nowhere_at_all'; there are: approach, align, "),
        (["params", "relaod"], "pipewright params: no command 'relaod'; nearest: reload"),
        (["completion", "bsh"], "pipewright completion: no shell 'bsh'; nearest: bash"),
    ],
)
def test_what_is_mistyped_is_answered_with_the_nearest(typed: list[str], said: str, capsys: Told) -> None:
    with pytest.raises(SystemExit) as ended:
        command(*typed)
    assert ended.value.code == codes.WRONG_INPUT
    assert capsys.readouterr().err.startswith(said)


# --- with certificates ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    folder = tmp_path_factory.mktemp("keys") / "authority"
    return Fleet(folder, x500=Role.VEHICLE, alice=Role.OPERATOR, victor=Role.VIEWER, mallory=Role.OPERATOR)


@pytest.fixture
def secured(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> Iterator[Craft]:
    roster = fleet.authority.roster
    admitted = Roster(members=tuple(member for member in roster.members if member.name != "mallory"))
    with Craft("x500", f"tls/127.0.0.1:{free_port()}", vehicle_security("x500", fleet["x500"], admitted)) as flying:
        monkeypatch.setenv(station.CONNECT, flying.endpoint)
        monkeypatch.setenv(station.VEHICLE, "x500")
        yield flying


def test_a_station_is_who_its_keys_say(secured: Craft, fleet: Fleet, capsys: Told) -> None:
    keys = str(fleet["alice"].folder)
    assert command("status", "--keys", keys, "--json") == 0
    assert json.loads(capsys.readouterr().out)["station"] == "alice"
    assert command("status", "--keys", keys, "--station", "alice") == 0
    assert "--station bob: the keys in " in refused(capsys, "--keys", keys, "--station", "bob")
    assert "without TLS, and there are keys" in refused(capsys, "--keys", keys, "--connect", "tcp/127.0.0.1:7447")
    assert "is a vehicle's; give the folder of an operator" in refused(capsys, "--keys", str(fleet["x500"].folder))


def test_a_viewer_may_stop_and_is_told_at_once_what_it_may_not(
    secured: Craft, fleet: Fleet, monkeypatch: pytest.MonkeyPatch, capsys: Told
) -> None:
    monkeypatch.setenv(station.KEYS, str(fleet["victor"].folder))
    assert command("stop") == 0
    assert command("land") == codes.REFUSED
    assert "victor is a viewer: for this an operator's certificate is needed" in capsys.readouterr().err
    assert secured.asked == [Stop()]


def test_who_is_not_admitted_is_told_why(secured: Craft, fleet: Fleet, capsys: Told) -> None:
    assert command("status", "--keys", str(fleet["mallory"].folder), "--timeout", "0.5") == codes.NOT_THERE
    assert "mallory is revoked, or not on the roster that x500 has" in capsys.readouterr().err


def test_without_keys_a_secured_vehicle_says_that_it_wants_them(secured: Craft, capsys: Told) -> None:
    plain = secured.endpoint.replace("tls/", "tcp/")
    assert command("status", "--connect", plain, "--timeout", "0.5") == codes.NOT_THERE
    assert "the vehicle wants certificates: connect to tls/127.0.0.1:" in capsys.readouterr().err


def test_plain_leaves_the_keys_of_the_environment_aside(
    vehicle: Craft, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Told
) -> None:
    monkeypatch.setenv(station.KEYS, str(tmp_path))
    assert "is missing" in refused(capsys)
    assert command("status", "--plain") == 0


def test_values_that_are_no_numbers_are_no_json_either() -> None:
    found = station.jsonable({"a": float("inf"), "b": [1.0, float("nan")], "c": Outcome.DONE, "d": (1, "x")})
    assert found == {"a": None, "b": [1.0, None], "c": "done", "d": [1, "x"]}
