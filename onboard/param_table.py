"""All parameters of a set with their values, for a person to look through: listed, and found by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from msgspec import NODEFAULT, Struct

from onboard.declared import Parameter, describe, to_mapping
from onboard.layers import ConfigError, Key, dotted
from onboard.params import Change, nearest
from onboard.reload import needs_restart


class Entry(Struct, frozen=True):
    """One parameter, as it is in force and as it is declared. Values are plain: numbers, text, lists, mappings."""

    path: str
    value: Any
    default: Any
    """None where a value must be given."""
    type: str
    unit: str
    bounds: str
    may_change: str
    """``in flight``, ``on the ground`` or ``by a restart``."""
    doc: str


def entries(params: Struct) -> tuple[Entry, ...]:
    """Every parameter, in the order of the declarations; those of a list of groups once for each group."""
    values = to_mapping(params)
    return tuple(
        _entry(parameter, dotted(path), value)
        for parameter in describe(type(params))
        for path, value in _places(values, tuple(parameter.path.split(".")), ())
    )


def find(params: Struct, names: Sequence[str]) -> tuple[Entry, ...]:
    """What these names stand for: a parameter, an element of one, or all of a group.

    Raises ConfigError with every name that stands for nothing, each with the nearest that do.
    """
    table = entries(params)
    found: dict[str, Entry] = {}
    errors: list[str] = []
    for name in names:
        matching = [entry for entry in table if _is_or_is_in(entry.path, name)] or list(_parts(table, name))
        found |= {entry.path: entry for entry in matching}
        if not matching:
            best = nearest(type(params), tuple(name.split(".")))
            errors.append(f"{name}: no such parameter" + (f"; nearest: {', '.join(best)}" if best else ""))
    if errors:
        raise ConfigError(errors)
    return tuple(found.values())


def may_change(path: str, in_flight: bool) -> str:
    """When a parameter may change, in words."""
    if needs_restart(Change(path, None, None, in_flight)):
        return "by a restart"
    return "in flight" if in_flight else "on the ground"


def _entry(parameter: Parameter, path: str, value: Any) -> Entry:
    default = None if parameter.default is NODEFAULT else parameter.default
    when = may_change(path, parameter.in_flight)
    return Entry(path, value, default, parameter.type, parameter.unit, parameter.bounds, when, parameter.doc)


def _places(values: Any, rest: Key, path: Key) -> Iterator[tuple[Key, Any]]:
    """Where a declared path leads in these values; ``N`` stands for every element of a list."""
    if not rest:
        yield path, values
    elif rest[0] == "N":
        for i, item in enumerate(values):
            yield from _places(item, rest[1:], (*path, str(i)))
    else:
        yield from _places(values[rest[0]], rest[1:], (*path, rest[0]))


def _is_or_is_in(path: str, name: str) -> bool:
    return path == name or path.startswith(f"{name}.")


def _parts(table: Sequence[Entry], name: str) -> Iterator[Entry]:
    """The part of a parameter: an element of a list, or a value of a group that need not be given."""
    for entry in table:
        if _is_or_is_in(name, entry.path):
            value = entry.value
            for key in name[len(entry.path) + 1 :].split("."):
                if isinstance(value, Mapping) and key in value:
                    value = value[key]
                elif isinstance(value, list) and key.isdecimal() and int(key) < len(value):
                    value = value[int(key)]
                else:
                    return
            yield Entry(name, value, None, "", entry.unit, entry.bounds, entry.may_change, entry.doc)
