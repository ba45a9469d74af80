"""The ways into the project: targets of the Makefile, and every command that the README shows."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest

from groundstation import cli
from onboard.config import load_config

ROOT = Path(__file__).resolve().parents[2]


def shown(program: str) -> list[list[str]]:
    """Arguments of every call of a program in the README's blocks, indented or fenced."""
    text = (ROOT / "README.md").read_text("utf-8")
    calls = re.findall(rf"^(?: {{4}})?(?:\$ )?(?:\.venv/bin/)?{program}((?: .*)?)$", text, re.MULTILINE)
    return [shlex.split(call, comments=True) for call in calls]


def dry(target: str) -> str:
    """What make would do for a target."""
    done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("target", "does"),
    [
        ("sim", "pipewright sim"),
        ("test", "-m pytest"),
        ("check", "lint-imports"),
        ("bench", "-m tests.bench"),
    ],
)
def test_targets(target: str, does: str) -> None:
    assert does in dry(target)


def test_ci_checks_and_tests() -> None:
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o100
    text = script.read_text("utf-8")
    assert "make check" in text
    assert "make test" in text


def test_the_readme_shows_the_two_commands() -> None:
    assert {"sim", "test"} <= {arguments[0] for arguments in shown("make")}


def test_targets_of_the_readme_exist() -> None:
    for arguments in shown("make"):
        for target in arguments:
            if "=" not in target:
                dry(target)


def test_commands_of_the_readme_are_accepted() -> None:
    for arguments in shown("pipewright"):
        options = cli._parser().parse_args(arguments)
        if hasattr(options, "scenario") and Path(options.scenario or "").suffix == "":
            load_config(options.scenario or "paper", options.law, options.sets, options.seed)
