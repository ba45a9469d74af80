"""A person's configuration file: values put into it, so that it makes a given set, and nothing else of it changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from msgspec.structs import replace
from yaml import YAMLError

from onboard.config import CONFIGS, Config, law_names, load_config, scenario_names
from onboard.declared import describe, to_mapping
from onboard.layers import ConfigError, Key, Layer, parse_yaml, show
from onboard.param_table import Entry, entries, find
from onboard.params import Change, compose, diff
from onboard.yaml_edit import Candidate, edited

#: These choose further files, by which others differ: they are written first, and then what still differs.
_CHOOSE: Final = ("law", "interface", "joints")
_ROUNDS: Final = 3
#: In the folder of a run.
RUN_CONFIG: Final = "config.yaml"
__all__ = [
    "Change",
    "ConfigError",
    "Entry",
    "ParameterFile",
    "ParameterText",
    "law_names",
    "parameter_names",
    "save",
    "save_in_force",
    "scenario_names",
]


class ParameterFile:
    """The parameters that a configuration makes, as a person gives it: name or file, or the folder of a run.

    Every method raises ConfigError, with all errors at once.
    """

    def __init__(self, given: str, directory: Path = CONFIGS) -> None:
        self._given, self._directory = given, directory

    def find(self, names: Sequence[str]) -> tuple[Entry, ...]:
        """Parameters, elements of them, or all of a group, by their names; without names, all."""
        config = self.load()
        return find(config, names) if names else entries(config)

    def put(self, sets: Sequence[str]) -> tuple[Change, ...]:
        """Write values, each given as ``name.of.parameter=value``, into the file; gives what is changed by them."""
        path = self.path()
        named = [(text.partition("=")[0].strip(), text) for text in sets]
        others = [text for name, text in named if name != "law"]
        law = next((text.partition("=")[2].strip() for name, text in reversed(named) if name == "law"), None)
        return save(path, load_config(str(path), law, others, directory=self._directory), self._directory)

    def differences(self, other: str | None) -> tuple[Change, ...]:
        """From the other configuration to this one; without another, from the defaults."""
        return _differences(self.load(), other, self._directory)

    def save(self, other: str) -> tuple[Change, ...]:
        """Make the file give what the other configuration gives (that of a run, say); gives what is changed by it."""
        return save(self.path(), ParameterFile(other, self._directory).load(), self._directory)

    def load(self) -> Config:
        """The whole set."""
        folder = Path(self._given)
        name = f"{folder / RUN_CONFIG}" if folder.is_dir() else self._given
        return load_config(name, directory=self._directory, option="--config")

    def path(self) -> Path:
        """The file. Raises ConfigError for a name: what belongs to the program is not written."""
        if "/" in self._given or self._given.endswith((".yaml", ".yml")):
            return Path(self._given)
        self.load()  # when there is no such name, that is what is to be said
        raise ConfigError(
            [f"--config {self._given}: belongs to the program; copy its file from {self._directory}, and give the copy"]
        )


class ParameterText:
    """The parameters of a full configuration that somebody shows as YAML. Raises ConfigError, with all errors."""

    def __init__(self, text: str, source: str, directory: Path = CONFIGS) -> None:
        self._config = compose(Config, [parse_yaml(text, source)])
        self._directory = directory

    def find(self, names: Sequence[str]) -> tuple[Entry, ...]:
        """Parameters, elements of them, or all of a group, by their names; without names, all."""
        return find(self._config, names) if names else entries(self._config)

    def differences(self, other: str | None) -> tuple[Change, ...]:
        """From a configuration (name, file, or run folder) to these; without one, from the defaults."""
        return _differences(self._config, other, self._directory)

    def since(self, before: ParameterText) -> tuple[Change, ...]:
        """From others to these."""
        return tuple(diff(before._config, self._config))


def _differences(mine: Config, other: str | None, directory: Path) -> tuple[Change, ...]:
    base = (
        Config(vehicle=load_config(directory=directory).vehicle)
        if other is None
        else ParameterFile(other, directory).load()
    )
    return tuple(diff(replace(base, scenario=mine.scenario), mine))


def parameter_names() -> tuple[str, ...]:
    """All parameters, as they are declared."""
    return tuple(parameter.path for parameter in describe(Config))


def save_in_force(given: str, loaded: Config, in_force: Config, directory: Path = CONFIGS) -> tuple[Change, ...]:
    """Write what has been changed since the start into the file of a configuration; gives what differed.

    given: name or file, as the process was started with; loaded: what file and options make now. What came from options
    of the command line stays with them. Raises ConfigError, and has written nothing then.
    """
    path = ParameterFile(given, directory).path()
    held = load_config(str(path), directory=directory)
    changed: dict[str, Any] = {}
    for change in diff(replace(loaded, scenario=in_force.scenario), in_force):
        *groups, name = change.path.split(".")
        place = changed
        for group in groups:
            place = place.setdefault(group, {})
        place[name] = _at(to_mapping(in_force), tuple(change.path.split(".")))
    wanted = compose(Config, [Layer(str(path), to_mapping(held)), Layer("parameters in force", changed)])
    return save(path, wanted, directory)


def save(path: Path, wanted: Config, directory: Path = CONFIGS) -> tuple[Change, ...]:
    """Write into a configuration file what differs from the set that it makes; gives what differed.

    The file then makes exactly ``wanted``, but for the name of the scenario, which stays its own. Its comments, order,
    quoting and layout stay. Raises ConfigError, and has written nothing then, for a file that cannot be read or
    written, or that cannot be brought to this set by changing single values. path: ends in .yaml.
    """
    before = load_config(str(path), directory=directory)
    wanted = replace(wanted, scenario=before.scenario)
    values = to_mapping(wanted)
    with Candidate(path) as candidate:
        changes = diff(before, wanted)
        for _ in range(_ROUNDS):
            if not changes:
                break
            first = [change for change in changes if change.path in _CHOOSE] or changes
            held = parse_yaml(candidate.text, str(path)).values
            places = dict.fromkeys(_place(held, values, change) for change in first)
            try:
                candidate.write(edited(candidate.text, [(place, _at(values, place)) for place in places]))
            except (LookupError, ValueError, YAMLError) as error:
                layout = "is laid out in a way that no value can be put into: lay it out plainly; nothing was written"
                raise ConfigError([f"{path}: {layout}"]) from error
            now = load_config(str(candidate.path), directory=directory)
            changes = diff(replace(now, scenario=before.scenario), wanted)
        if changes:
            raise ConfigError(
                f"{path}: {change.path} = {show(change.new)}: the file would still make it {show(change.old)} "
                "(does another value share its text?); nothing was written"
                for change in changes
            )
        changes = diff(before, wanted)
        if changes:
            candidate.commit()
    return tuple(changes)


def _place(held: Any, values: Any, change: Change) -> Key:
    """Where to write a change into a file that holds ``held``, for a set of ``values``.

    Of a list that the file does not hold, one group is written alone, under its index, and any other list as a whole.
    """
    path = tuple(change.path.split("."))
    for depth, key in enumerate(path):
        if isinstance(values, list) and not isinstance(held, list | Mapping) and not isinstance(values[0], Mapping):
            return path[:depth]
        values = values[int(key)] if isinstance(values, list) else values[key]
        held = held[int(key)] if isinstance(held, list) else held.get(key) if isinstance(held, Mapping) else None
    return path


def _at(values: Any, path: Key) -> Any:
    for key in path:
        values = values[int(key)] if isinstance(values, list) else values[key]
    return values
