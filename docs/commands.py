"""Writes docs/commands.md from the parsers of the commands: ``python docs/commands.py`` from the root."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from groundstation import cli, station

HEADER = """\
<!-- Written by docs/commands.py from the parsers; do not edit. -->
# Commands

`pipewright COMMAND --help` says the same in a terminal. Who commands, and why `lease take` stays: [link.md](link.md).
How flights are run and configured: [running.md](running.md).

"""
_VEHICLE = """\
## The vehicle, and who asks

Every command marked with *vehicle* takes these:

"""
_JSON = """
`--json` prints one JSON object in the end; commands that go on print one on each line. What fails prints
`{"outcome": ..., "text": ...}` too, where the outcome is `wrong_input` (code 2), `refused` or `unfinished` (3),
`no_vehicle` (5) or `timed_out` (6).

"""
Rows = list[tuple[str, str]]


def page() -> str:
    """The whole page."""
    whole = cli._parser()
    probe = argparse.ArgumentParser(add_help=False)
    station.add_options(probe)
    shared = _rows(probe, skip=set())
    names = {name for name, _ in shared}
    parts = [HEADER, f"    {_indented(whole.epilog or '')}\n\n", _VEHICLE, _table(shared), _JSON]
    for _, command in _commands(whole):
        parts += _section(command, names, 2)
    return "".join(parts).rstrip() + "\n"


def _section(command: argparse.ArgumentParser, shared: set[str], depth: int) -> Iterator[str]:
    inner = list(_commands(command))
    rows = _rows(command, skip=shared)
    vehicle = not inner and len(rows) < len(_rows(command, skip=set()))
    positionals = "".join(f" {name}" for name, _ in _rows(command, skip=set(), positionals=True))
    yield f"{'#' * depth} {command.prog.partition(' [')[0]}{positionals if not inner else ''}\n\n"
    yield f"{command.description}{' *vehicle*' if vehicle else ''}\n\n"
    if rows and not inner:
        yield f"{_table(rows)}\n"
    if command.epilog:
        yield f"    {_indented(command.epilog)}\n\n"
    for _, part in inner:
        yield from _section(part, shared, depth + 1)


def _commands(command: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in command._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.items()


def _rows(command: argparse.ArgumentParser, *, skip: set[str], positionals: bool = False) -> Rows:
    """How each argument is written, and what it means."""
    formatter = argparse.HelpFormatter(command.prog, width=1000)
    found: Rows = []
    for action in command._actions:
        if isinstance(action, argparse._HelpAction | argparse._SubParsersAction):
            continue
        args = formatter._format_args(action, formatter._get_default_metavar_for_optional(action))
        name = " ".join(filter(None, (", ".join(action.option_strings), args if action.nargs != 0 else "")))
        if positionals and action.option_strings:
            continue
        if name not in skip:
            required = " (required)" if action.option_strings and action.required else ""
            found.append((name, f"{action.help or ''}{required}"))
    return found


def _table(rows: Rows) -> str:
    lines = [f"| `{_cell(name)}` | {_cell(meaning)} |\n" for name, meaning in rows]
    return "".join(["| argument | meaning |\n", "|---|---|\n", *lines])


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("%%", "%")


def _indented(text: str) -> str:
    return "\n".join(f"    {line}".rstrip() for line in text.strip().splitlines()).lstrip()


def pages() -> dict[str, str]:
    """File name in docs, and content."""
    return {"commands.md": page()}


if __name__ == "__main__":
    for name, text in pages().items():
        (Path(__file__).parent / name).write_text(text, encoding="utf-8")
