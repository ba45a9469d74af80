"""``pipewright params``: parameters looked up, compared and changed, in a configuration file or in a vehicle."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from groundstation import codes, station
from onboard.wire import Ask, ReloadParams, SaveParams, SetParams, ShowParams

if TYPE_CHECKING:
    from groundstation.client import Client
    from onboard.param_file import Change, Entry, ParameterFile, ParameterText

_EPILOG = """\
With --config they are those of a file, else those in force in a vehicle.

examples:
  pipewright params list --config my-vehicle.yaml             all of them, with their values
  pipewright params list --config desk --changed              only those that are not at their default
  pipewright params get repair pipe.radius --config desk      a group, a parameter: with bounds and meaning
  pipewright params set repair.force=3 pipe.radius=0.1 --config my-vehicle.yaml
  pipewright params diff desk --config my-vehicle.yaml        from desk to my-vehicle.yaml
  pipewright params save runs/desk-007 --config my-vehicle.yaml   the file then makes what that run flew with

  pipewright params set guidance.settle_time=1               in the vehicle, at once: all, or none
  pipewright params reload                                    the vehicle reads its files again
  pipewright params diff desk --vehicle falcon                from desk to what falcon flies with
  pipewright params save                                      the vehicle's files then make what it flies with
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


def add_parser(commands: Any) -> None:
    """Add ``params`` to the commands of an argparse parser."""
    raw = argparse.RawDescriptionHelpFormatter
    words = "look up, compare and change parameters of a configuration file, or of a vehicle"
    params = commands.add_parser(
        "params", help=words, description=words.capitalize() + ".", epilog=_EPILOG, formatter_class=raw
    )
    actions = params.add_subparsers(required=True, dest="action", metavar="ACTION")
    for action, words in (
        ("list", "names and values, all or those of a group"),
        ("get", "values with unit, bounds, meaning, and when each may change"),
        ("set", "change values: all, or none if one is wrong"),
        ("diff", "what differs from another configuration, or from the defaults"),
        ("reload", "let the vehicle read its files again: all of them, or nothing if anything in them is wrong"),
        (
            "save",
            "write into the file what differs from another configuration, so that both are the same; "
            "in a vehicle: into its files what is in force",
        ),
    ):
        parser = actions.add_parser(action, help=words, description=words.capitalize() + ".", formatter_class=raw)
        parser.epilog = station.examples_of(parser.prog, _EPILOG)
        station.add_options(parser)
        parser.set_defaults(run=run, config=None)
        if action != "reload":
            parser.add_argument("--config", metavar="NAME|FILE|RUN", help=_CONFIG_HELP)
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
                words = "whose values are wanted; with --config only"
                parser.add_argument("other", nargs="?", metavar="NAME|FILE|RUN", help=words)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Run one action; gives the exit code."""
    # Imported here so that --help answers at once.
    from onboard.param_file import ConfigError, ParameterFile

    try:
        if options.config is None:
            with station.open_client(options) as client:
                _of_vehicle(VehicleParameters(client, options), options)
        elif options.vehicle or options.connect:
            raise station.WrongInputError("--config is for a file, --vehicle and --connect for a vehicle: give either")
        else:
            _of_file(ParameterFile(options.config), options)
    except ConfigError as error:
        raise station.WrongInputError(str(error)) from None
    return codes.DONE


def _of_file(parameters: ParameterFile, options: argparse.Namespace) -> None:
    if options.action != "save":
        return answer(parameters, options)
    if options.other is None:
        raise station.WrongInputError("save into a file: give the configuration or run whose values are wanted")
    return _tell_changes(parameters.save(options.other), options)


def _of_vehicle(parameters: VehicleParameters, options: argparse.Namespace) -> None:
    match options.action:
        case "reload":
            _tell_changes(parameters.reload(), options)
        case "save" if options.other is not None:
            raise station.WrongInputError(f"save {options.other}: into which file? Give --config FILE")
        case "save":
            station.tell(options, parameters.save())
        case _:
            answer(parameters, options)


def answer(parameters: Parameters, options: argparse.Namespace) -> None:
    """Do what is asked of these parameters, and print the result."""
    match options.action:
        case "list" | "get":
            entries = parameters.find(options.names)
            if options.action == "list" and options.changed:
                entries = [entry for entry in entries if entry.value != entry.default]
            lines = _listed(entries) if options.action == "list" else _explained(entries)
            _tell(entries, lines, as_json=options.json)
        case "set":
            _tell_changes(parameters.put(options.sets), options)
        case "diff":
            _tell_changes(parameters.differences(options.other), options)


class VehicleParameters:
    """The parameters in force in a vehicle. Beside ConfigError, methods raise what a session with it does."""

    def __init__(self, client: Client, options: argparse.Namespace) -> None:
        self._client, self._options = client, options

    def find(self, names: Sequence[str]) -> Sequence[Entry]:
        """Those of these names, or all."""
        return self._shown().find(names)

    def put(self, sets: Sequence[str]) -> Sequence[Change]:
        """Set values, each given as ``name=value``: all or none; gives what has changed."""
        return self._changed_by(SetParams(tuple(sets)))

    def reload(self) -> Sequence[Change]:
        """Let the vehicle read its files again; gives what has changed."""
        return self._changed_by(ReloadParams())

    def differences(self, other: str | None) -> Sequence[Change]:
        """From a configuration (without: the defaults) to what is in force."""
        return self._shown().differences(other)

    def save(self) -> str:
        """Let the vehicle write what is in force into its files; gives what it says."""
        return station.command(self._client, SaveParams(), self._options).text

    def _changed_by(self, ask: Ask) -> Sequence[Change]:
        before = self._shown()
        station.command(self._client, ask, self._options)
        return self._shown().since(before)

    def _shown(self) -> ParameterText:
        from onboard.param_file import ConfigError, ParameterText

        vehicle = self._client.vehicle
        text = station.ask(self._client, ShowParams(), self._options).data.decode(errors="replace")
        try:
            return ParameterText(text, vehicle)
        except ConfigError as error:
            raise station.WrongInputError(f"{vehicle} has other parameters than this program knows: {error}") from None


def _tell_changes(changes: Sequence[Change], options: argparse.Namespace) -> None:
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
