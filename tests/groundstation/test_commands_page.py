"""docs/commands.md says what the parsers say."""

from __future__ import annotations

import argparse
import runpy
from pathlib import Path

import pytest

from groundstation import cli
from groundstation.parsing import leaves

DOCS = Path(__file__).parents[2] / "docs"
COMMANDS = {command.prog: command for command in leaves(cli._parser())}


def test_the_page_says_what_the_parsers_say() -> None:
    for name, text in runpy.run_path(str(DOCS / "commands.py"))["pages"]().items():
        assert (DOCS / name).read_text(encoding="utf-8") == text, f"docs/{name} is stale: run python docs/commands.py"


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS.keys())
def test_every_command_says_what_it_is_for(command: argparse.ArgumentParser) -> None:
    assert command.description
    assert command.description.endswith(".")
    for action in command._actions:
        assert action.help or not action.option_strings, f"{command.prog}: {action.dest} has no help"
