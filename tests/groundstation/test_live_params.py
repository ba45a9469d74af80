"""``pipewright params`` with a vehicle at the other end."""

from __future__ import annotations

import json

import pytest

from groundstation import codes
from onboard.config import load_config
from onboard.wire import ReloadParams, SaveParams, SetParams, ShowParams
from tests.groundstation.craft import Craft, command

Told = pytest.CaptureFixture[str]


def params(*arguments: str) -> int:
    return command("params", *arguments, "--station", "alice")


def test_what_is_in_force_is_shown(vehicle: Craft, capsys: Told) -> None:
    vehicle.config = load_config("paper", sets=["repair.force=3"])
    assert params("get", "repair.force") == 0
    assert capsys.readouterr().out.splitlines()[0] == "repair.force = 3.0 N"
    assert params("diff", "paper") == 0
    assert capsys.readouterr().out == "repair.force = 2.5 -> 3.0\n"
    assert params("list", "repair", "--json") == 0
    assert {entry["path"]: entry["value"] for entry in json.loads(capsys.readouterr().out)}["repair.force"] == 3.0
    assert params("get", "repair.forc") == codes.WRONG_INPUT
    assert "repair.forc: no such parameter; nearest: repair.force" in capsys.readouterr().err


def test_values_are_set_and_what_has_changed_is_shown(vehicle: Craft, commanding: None, capsys: Told) -> None:
    assert params("set", "repair.force=3", "pipe.radius=0.1") == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("pipe.radius = ")
    assert told[1:] == ["repair.force = 2.5 -> 3.0"]
    assert vehicle.asked == [ShowParams(), SetParams(("repair.force=3", "pipe.radius=0.1")), ShowParams()]
    assert params("set", "repair.force=3") == 0
    assert capsys.readouterr().out == "nothing differs\n"


def test_all_that_is_wrong_is_told_at_once_and_nothing_is_changed(
    vehicle: Craft, commanding: None, capsys: Told
) -> None:
    before = vehicle.config
    assert params("set", "repair.force=99", "pipe.radius=0.1", "repair.hold=x", "pip.radius=1") == codes.REFUSED
    told = capsys.readouterr()
    assert told.out == ""
    first, *others = told.err.splitlines()
    assert first.startswith("pipewright: --set ")
    assert len(others) == 2
    for name in ("repair.force", "repair.hold", "pip.radius: no such parameter"):
        assert name in told.err
    assert vehicle.config == before


def test_files_are_read_again_and_written(vehicle: Craft, commanding: None, capsys: Told) -> None:
    vehicle.files = load_config("paper", sets=["repair.force=3"])
    assert params("reload", "--json") == 0
    assert json.loads(capsys.readouterr().out) == [{"path": "repair.force", "old": 2.5, "new": 3.0, "in_flight": False}]
    assert params("save") == 0
    assert capsys.readouterr().out == "the files make these parameters already\n"
    assert vehicle.asked == [ShowParams(), ReloadParams(), ShowParams(), SaveParams()]


def test_who_does_not_command_changes_nothing_and_is_told_how_to(vehicle: Craft, capsys: Told) -> None:
    assert params("set", "repair.force=3") == codes.REFUSED
    assert "Run `pipewright lease take`" in capsys.readouterr().err
    assert vehicle.asked == [ShowParams()]


def test_parameters_of_another_version_are_told_as_that(vehicle: Craft, capsys: Told) -> None:
    vehicle.answer = lambda asked: asked.done(data=b"pipe: {shape: round}\n")
    assert params("list") == codes.WRONG_INPUT
    told = capsys.readouterr().err
    assert told.startswith("pipewright: x500 has other parameters than this program knows: x500")
    assert "x500:1: pipe.shape: no such parameter" in told


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("list --config desk --vehicle x500", "--config is for a file, --vehicle and --connect for a vehicle"),
        ("save --config mine.yaml", "save into a file: give the configuration or run"),
        ("save desk", "save desk: into which file? Give --config FILE"),
    ],
)
def test_a_file_or_a_vehicle_and_not_both(vehicle: Craft, typed: str, said: str, capsys: Told) -> None:
    assert params(*typed.split()) == codes.WRONG_INPUT
    assert said in capsys.readouterr().err
    assert vehicle.asked == []
