"""``pipewright params``: what it prints, for people and for programs, and how it refuses."""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from groundstation import params
from onboard.config import CONFIGS
from onboard.param_file import Change, Entry


def parsed(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    params.add_parser(parser.add_subparsers(required=True))
    return parser.parse_args(["params", *arguments])


def run(*arguments: str) -> int:
    options = parsed(*arguments)
    code: int = options.run(options)
    return code


@pytest.fixture
def mine(tmp_path: Path) -> str:
    shutil.copy(CONFIGS / "desk.yaml", tmp_path / "mine.yaml")
    return str(tmp_path / "mine.yaml")


def test_set_then_get_then_diff(mine: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("set", "repair.force=3", "pipe.position.1=0.5", "--config", mine) == 0
    assert capsys.readouterr().out == "pipe.position.1 = 0.0 -> 0.5\nrepair.force = 2.5 -> 3.0\n"
    assert run("get", "repair.force", "interface", "--config", mine) == 0
    first, declared, meaning, second, *_ = capsys.readouterr().out.splitlines()
    assert (first, second) == ("repair.force = 3.0 N", "interface = attitude")
    assert declared.startswith("    number; from ")
    assert declared.endswith("; default 2.5; may change on the ground")
    assert meaning.strip()
    assert run("diff", "desk", "--config", mine) == 0
    assert capsys.readouterr().out == "pipe.position.1 = 0.0 -> 0.5\nrepair.force = 2.5 -> 3.0\n"
    assert run("save", "desk", "--config", mine) == 0
    assert run("diff", "desk", "--config", mine) == 0
    assert capsys.readouterr().out.endswith("repair.force = 3.0 -> 2.5\nnothing differs\n")


def test_a_list_of_what_is_not_at_its_default(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("list", "repair", "--config", "desk") == 0
    assert "repair.force = 2.5 N" in capsys.readouterr().out.splitlines()
    assert run("list", "--changed", "--config", "desk") == 0
    lines = capsys.readouterr().out.splitlines()
    assert "devices.autopilot.kind = emulated" in lines
    assert not any(line.startswith("repair.force ") for line in lines)


def test_for_a_program(mine: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("get", "pipe.position", "--config", mine, "--json") == 0
    (entry,) = json.loads(capsys.readouterr().out)
    assert (entry["path"], entry["value"], entry["unit"]) == ("pipe.position", [2.0, 0.0, 1.5], "m")
    assert run("set", "repair.force=3", "--config", mine, "--json") == 0
    (change,) = json.loads(capsys.readouterr().out)
    assert change == {"path": "repair.force", "old": 2.5, "new": 3.0, "in_flight": False}


def test_what_is_wrong_is_told_at_once(mine: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("get", "repair.forc", "pip", "--config", mine) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "repair.forc: no such parameter; nearest: repair.force" in told.err
    assert "pip: no such parameter" in told.err
    assert run("set", "repair.force=99", "pipe.radius=x", "--config", mine) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_parameters_of_something_else_than_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    """What a vehicle at the other end of a link has to offer, and no more."""

    class Vehicle:
        def find(self, names: Sequence[str]) -> Sequence[Entry]:
            return [Entry(name, 1.0, 1.0, "number", "N", "", "in flight", "") for name in names]

        def put(self, sets: Sequence[str]) -> Sequence[Change]:
            return [Change(text.partition("=")[0], 1.0, 2.0, in_flight=True) for text in sets]

        def differences(self, other: str | None) -> Sequence[Change]:
            return []

        def save(self, other: str) -> Sequence[Change]:
            return []

    params.answer(Vehicle(), parsed("get", "a.b", "--config", "x"))
    params.answer(Vehicle(), parsed("set", "a.b=2", "--config", "x"))
    params.answer(Vehicle(), parsed("diff", "--config", "x"))
    told = capsys.readouterr().out
    assert told == "a.b = 1.0 N\n    number; default 1.0; may change in flight\na.b = 1.0 -> 2.0\nnothing differs\n"
