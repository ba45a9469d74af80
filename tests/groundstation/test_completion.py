"""What the Tab key gives, asked as a shell asks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from groundstation.parsing import nearest
from tests.groundstation.craft import command
from tests.waiting import LONG

PROGRAM = "import sys; sys.argv[0] = 'pipewright'; from groundstation.cli import main; sys.exit(main())"


def completed(line: str, folder: Path) -> list[str]:
    """What may follow a line."""
    answer = folder / "answer"
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_SHELL": "bash", "COMP_TYPE": "9"}
    asked |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    subprocess.run([sys.executable, "-c", PROGRAM], env={**os.environ, **asked}, timeout=LONG, check=True)
    return answer.read_text().replace("\n", " ").split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("pipewright ta", ["takeoff", "tare"]),
        ("pipewright go t", ["tool_change", "tare"]),
        ("pipewright lease ", ["take", "release"]),
        ("pipewright params get repair.fo", ["repair.force"]),
        ("pipewright params set repair.fo", ["repair.force="]),
        ("pipewright params list repa", ["repair."]),
        ("pipewright params diff des", ["desk"]),
        ("pipewright desk --config des", ["desk"]),
        ("pipewright sim --law pa", ["paper"]),
        ("pipewright land --wa", ["--wait"]),
    ],
)
def test_names_are_completed(line: str, expected: list[str], tmp_path: Path) -> None:
    assert completed(line, tmp_path) == expected


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("completion", shell) == 0
    script = capsys.readouterr().out
    assert "pipewright" in script
    if shell == "bash":
        assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("takeof", ["takeoff"]),
        ("TARE", ["tare"]),
        ("rel", ["release"]),
        ("evnets", ["events"]),
        ("zzz", []),
    ],
)
def test_the_nearest_of_some_names(wrong: str, right: list[str]) -> None:
    names = ["takeoff", "land", "tare", "release", "events"]
    assert nearest(wrong, names)[:1] == right
