"""``pipewright params``: parameters looked up, compared and changed, in a configuration file."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

if TYPE_CHECKING:
    from onboard.param_file import Change, Entry

_EPILOG = """\
examples:
  pipewright params list --config my-vehicle.yaml             all of them, with their values
  pipewright params list --config desk --changed              only those that are not at their default
  pipewright params get repair pipe.radius --config desk      a group, a parameter: with bounds and meaning
  pipewright params set repair.force=3 pipe.radius=0.1 --config my-vehicle.yaml
  pipewright params diff desk --config my-vehicle.yaml        from desk to my-vehicle.yaml
  pipewright params save runs/desk-007 --config my-vehicle.yaml   the file then makes what that run flew with
"""
_CONFIG_HELP = "name or file of a configuration, or a run folder; set and save write into it: a file"


class Parameters(Protocol):
    """Where parameters are. Each method raises an error whose text says everything that is wrong."""

    def find(self, names: Sequence[str]) -> Sequence[Entry]:
        """Those of these names, or all."""

    def put(self, sets: Sequence[str]) -> Sequence[Change]:
        """Set values, each given as ``name=value``: all or none; gives what has changed."""

    def differences(self, other: str | None) -> Sequence[Change]:
        """From the other configuration (without: the defaults) to this one."""

    def save(self, other: str) -> Sequence[Change]:
        """Take over all of another configuration for good; gives what has changed."""


def add_parser(commands: Any) -> None:
    """Add ``params`` to the commands of an argparse parser."""
    raw = argparse.RawDescriptionHelpFormatter
    words = "look up, compare and change parameters of a configuration file"
    params = commands.add_parser(
        "params", help=words, description=words.capitalize() + ".", epilog=_EPILOG, formatter_class=raw
    )
    actions = params.add_subparsers(required=True, dest="action", metavar="ACTION")
    for action, words in (
        ("list", "names and values, all or those of a group"),
        ("get", "values with unit, bounds, meaning, and when each may change"),
        ("set", "write values into the file: all, or none if one is wrong"),
        ("diff", "what differs from another configuration, or from the defaults"),
        ("save", "write into the file what differs from another configuration, so that both are the same"),
    ):
        parser = actions.add_parser(action, help=words, description=words.capitalize() + ".")
        parser.add_argument("--config", required=True, metavar="NAME|FILE|RUN", help=_CONFIG_HELP)
        parser.add_argument("--json", action="store_true", help="for a program to read")
        parser.set_defaults(run=run)
        match action:
            case "list":
                parser.add_argument("names", nargs="*", metavar="NAME", help="a parameter or a group")
                parser.add_argument("--changed", action="store_true", help="only what is not at its default")
            case "get":
                parser.add_argument("names", nargs="+", metavar="NAME", help="a parameter, an element, or a group")
            case "set":
                parser.add_argument("sets", nargs="+", metavar="NAME=VALUE", help="the value is YAML")
            case "diff":
                parser.add_argument("other", nargs="?", metavar="NAME|FILE|RUN", help="default: the defaults")
            case "save":
                parser.add_argument("other", metavar="NAME|FILE|RUN", help="whose values are wanted")


def run(options: argparse.Namespace) -> int:
    """Run one action; gives the exit code: 0, or 2 for wrong input."""
    # Imported here so that --help answers at once.
    from onboard.param_file import ConfigError, ParameterFile

    try:
        answer(ParameterFile(options.config), options)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def answer(parameters: Parameters, options: argparse.Namespace) -> None:
    """Do what is asked of these parameters, and print the result."""
    match options.action:
        case "list" | "get":
            entries = parameters.find(options.names)
            if options.action == "list" and options.changed:
                entries = [entry for entry in entries if entry.value != entry.default]
            lines = _listed(entries) if options.action == "list" else _explained(entries)
            _tell(entries, lines, as_json=options.json)
        case action:
            changes = (
                parameters.put(options.sets)
                if action == "set"
                else parameters.differences(options.other)
                if action == "diff"
                else parameters.save(options.other)
            )
            _tell(changes, _compared(changes), as_json=options.json)


def _tell(found: Sequence[Any], lines: Iterable[str], *, as_json: bool) -> None:
    if as_json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
    else:
        for line in lines:
            print(line)


def _listed(entries: Iterable[Entry]) -> Iterator[str]:
    return (f"{entry.path} = {_value(entry.value)}{_unit(entry)}" for entry in entries)


def _explained(entries: Sequence[Entry]) -> Iterator[str]:
    for entry, line in zip(entries, _listed(entries), strict=True):
        default = "" if entry.default is None else f"default {_value(entry.default)}"
        yield line
        yield f"    {'; '.join(filter(None, (entry.type, entry.bounds, default, f'may change {entry.may_change}')))}"
        if entry.doc:
            yield f"    {entry.doc}"


def _compared(changes: Sequence[Change]) -> Iterator[str]:
    if not changes:
        yield "nothing differs"
    for change in changes:
        yield f"{change.path} = {_value(change.old)} -> {_value(change.new)}"


def _unit(entry: Entry) -> str:
    return f" {entry.unit}" if entry.unit not in ("", "1") else ""


def _value(value: Any) -> str:
    """As it is written in YAML and on the command line."""
    return value if isinstance(value, str) and value else json.dumps(value, ensure_ascii=False)
