"""Layers of plain values: read from YAML files and command-line options, laid over each other, and where each stands.

A path is the tuple of keys from the root; elements of lists are addressed by their index, so
``vehicle.arm.parts.2.mass`` works on the command line and is what an error prints.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from msgspec import Struct

Key = tuple[str, ...]


class ConfigError(Exception):
    """Wrong input. ``errors`` holds one line per error: where, what, and what would be right."""

    def __init__(self, errors: Iterable[str]) -> None:
        self.errors = tuple(errors)
        super().__init__("\n".join(self.errors))


class Layer(Struct, frozen=True):
    """Values from one file or one option, and where in it they stand."""

    source: str
    values: dict[str, Any]
    lines: dict[Key, int] = {}

    def under(self, key: str) -> Layer:
        """The same values as the content of ``key``."""
        return Layer(self.source, {key: self.values}, {(key, *path): line for path, line in self.lines.items()})


def dotted(path: Key) -> str:
    """``("a", "b", "0")`` -> ``"a.b.0"``."""
    return ".".join(path) or "(root)"


def merge(base: Any, overlay: Any) -> Any:
    """Lay ``overlay`` over ``base``: mappings merge key by key, all else is replaced.

    A mapping of indices over a list replaces those elements (``parts.2.mass=...``).
    """
    if not isinstance(overlay, Mapping):
        return overlay
    if isinstance(base, list | tuple) and overlay and all(_is_index(key, base) for key in overlay):
        return [merge(item, overlay[str(i)]) if str(i) in overlay else item for i, item in enumerate(base)]
    if not isinstance(base, Mapping):
        base = {}
    return {**base, **{key: merge(base.get(key), value) for key, value in overlay.items()}}


def _is_index(key: Any, items: Sequence[Any]) -> bool:
    return isinstance(key, str) and key.isdecimal() and key == str(int(key)) and int(key) < len(items)


def origin(layers: Sequence[Layer], path: Key) -> str:
    """Where the value at ``path`` came from: the last of the layers that hold the longest part of the path."""
    best, depth = None, 0
    for layer in layers:
        held = _held(layer.values, path)
        if held and held >= depth:
            best, depth = layer, held
    if best is None:
        return layers[-1].source if layers else "configuration"
    line = next((best.lines[path[:n]] for n in range(len(path), 0, -1) if path[:n] in best.lines), None)
    return f"{best.source}:{line}" if line else best.source


def _held(values: Any, path: Key) -> int:
    """How many leading keys of ``path`` the layer holds; a list or a leaf holds all that is beneath it."""
    for depth, key in enumerate(path):
        if not isinstance(values, Mapping):
            return len(path)
        if key not in values:
            return depth
        values = values[key]
    return len(path)


def show(value: Any) -> str:
    """A value as an error prints it: one line, not long."""
    text = " ".join(
        ("null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)).split()
    )
    return text if len(text) <= 60 else text[:57] + "..."


# --- YAML -------------------------------------------------------------------------------------------------------------


#: Longer than any line.
_ENDLESS = 1_000_000
#: A file that is larger (bytes), or stands for more values once its aliases are followed, is no configuration.
LARGEST, MOST = 256 * 1024, 20_000
_TAG = "tag:yaml.org,2002:"
_FLOAT = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
# The core schema of YAML 1.2: 1e-4 is a number, `off` is text, 010 is ten, 1:30 is no number.
_SCALARS = {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+",
    "float": _FLOAT,
}


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


class _Dumper(yaml.SafeDumper):
    """Quotes whatever YAML 1.1 or 1.2 would not read back as text."""

    yaml_implicit_resolvers = {key: list(value) for key, value in yaml.SafeDumper.yaml_implicit_resolvers.items()}  # noqa: RUF012

    def represent_list(self, data: Any) -> yaml.SequenceNode:
        flat = not any(isinstance(item, list | dict) for item in data)
        return self.represent_sequence(_TAG + "seq", data, flow_style=flat)


_Dumper.add_representer(list, _Dumper.represent_list)

for _name, _pattern in _SCALARS.items():
    _Loader.add_implicit_resolver(_TAG + _name, re.compile(f"(?:{_pattern})\\Z"), None)
_Dumper.add_implicit_resolver(_TAG + "float", re.compile(f"(?:{_FLOAT})\\Z"), list("-+0123456789."))


def read_yaml(path: Path, source: str | None = None) -> Layer:
    """Read one YAML file. Raises ConfigError for a file that cannot be read or is not a mapping."""
    source = source or str(path)
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise ConfigError([f"{source}: is larger than {LARGEST // 1024} kB; want a file of parameters"])
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError([f"{source}: not UTF-8 text (byte {error.start})"]) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError([f"{source}: cannot be read: {reason}"]) from error
    return parse_yaml(text, source)


def parse_yaml(text: str, source: str) -> Layer:
    """Parse YAML text whose root is a mapping; an empty document is an empty mapping."""
    lines: dict[Key, int] = {}
    values = _parse(text, source, lines)
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise ConfigError([f"{source}: must be a mapping of names to values, not {show(values)}"])
    return Layer(source, values, lines)


def parse_set(text: str) -> Layer:
    """Parse one ``a.b.c=value`` of the command line; the value is YAML."""
    source = f"--set {text}"
    name, equals, value_text = text.partition("=")
    path = tuple(name.strip().split("."))
    if not equals or not all(re.fullmatch(r"\w+", part) for part in path):
        raise ConfigError([f"{source}: must have the form name.of.parameter=value"])
    value = _parse(value_text, source, {})
    for part in reversed(path):
        value = {part: value}
    return Layer(source, value)


def _parse(text: str, source: str, lines: dict[Key, int]) -> Any:
    builder = _Builder(source, lines)
    try:
        root = yaml.compose(text, Loader=_Loader)
        value = None if root is None else builder.build(root, (), ())
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigError([f"{source}:{line}: not valid YAML: the character U+{error.character:04X}"]) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        begun = error.context_mark
        context = f" ({error.context}, begun in line {begun.line + 1})" if error.context and begun else ""
        raise ConfigError([f"{source}{at}: not valid YAML: {error.problem}{context}"]) from error
    except RecursionError as error:
        raise ConfigError([f"{source}: nested too deeply"]) from error
    except (ValueError, OverflowError) as error:  # PyYAML takes \UFFFFFFFF and %YAML 1.<5000 digits> for right
        raise ConfigError([f"{source}: not valid YAML: a character or version that cannot be: {error}"]) from error
    if builder.errors:
        raise ConfigError(builder.errors)
    return value


class _Builder:
    """Turns YAML nodes into plain values; notes the line of each; refuses duplicate keys, cycles and foreign tags."""

    def __init__(self, source: str, lines: dict[Key, int]) -> None:
        self._source, self._lines = source, lines
        self._left = MOST
        self.errors: list[str] = []

    def build(self, node: yaml.Node, path: Key, open_nodes: tuple[int, ...]) -> Any:
        line = node.start_mark.line + 1
        self._lines.setdefault(path, line)
        self._left -= 1
        if self._left < 0:
            raise ConfigError([f"{self._source}:{line}: {dotted(path)}: more than {MOST} values (each alias counts)"])
        if id(node) in open_nodes:
            return self._fail(line, path, "contains itself")
        inside = (*open_nodes, id(node))
        if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
            return self._mapping(node, path, inside)
        if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
            return [self.build(item, (*path, str(i)), inside) for i, item in enumerate(node.value)]
        text = node.value if isinstance(node, yaml.ScalarNode) else ""
        kind = node.tag.removeprefix(_TAG) if isinstance(node, yaml.ScalarNode) else ""
        match kind if kind == "str" or re.fullmatch(_SCALARS.get(kind, "(?!)"), text) else "":
            case "str":
                return text if _is_text(text) else self._fail(line, path, f"{text!r:.40} holds half a character")
            case "null":
                return None
            case "bool":
                return text.lower() == "true"
            case "int":
                return _integer(text)
            case "float":
                return float(text.replace(".", "") if text.lower().lstrip("+-") in (".inf", ".nan") else text)
        return self._fail(line, path, f"{text!r:.40} with the tag {node.tag} is not allowed")

    def _mapping(self, node: yaml.MappingNode, path: Key, inside: tuple[int, ...]) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode) or not _is_text(key_node.value):
                self._fail(line, path, "a key must be a name")
                continue
            key = key_node.value
            if key in result:
                self._fail(line, (*path, key), "given twice")
            self._lines[(*path, key)] = line
            result[key] = self.build(value_node, (*path, key), inside)
        return result

    def _fail(self, line: int, path: Key, what: str) -> Any:
        self.errors.append(f"{self._source}:{line}: {dotted(path)}: {what}")


def _is_text(text: str) -> bool:
    """Whether it can be written: an escape may name half of a character (a surrogate)."""
    return text.isascii() or not any("\ud800" <= character <= "\udfff" for character in text)


def _integer(text: str) -> int | str:
    try:
        return int(text, 0) if text[:2] in ("0x", "0o") else int(text)
    except (
        ValueError
    ):  # Explicitly tagged, or longer than Python reads: not a number to us, whoever declares it says so.
        return text


def compose_yaml(text: str) -> yaml.Node | None:
    """The nodes of YAML text that ``parse_yaml`` reads, with their places; None when there is nothing in it."""
    root: yaml.Node | None = yaml.compose(text, Loader=_Loader)
    return root


def dump_text(values: dict[str, Any], indent: int = 2) -> str:
    """YAML text of plain values that reads back to the same values, to the bit."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120, indent=indent)


def inline_text(value: Any) -> str:
    """The same for one value, in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{inline_text(key)}: {inline_text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(inline_text, value)) + "]"
    if isinstance(value, str) and not value.isprintable():
        return json.dumps(value)
    return yaml.dump([value], Dumper=_Dumper, default_flow_style=True, allow_unicode=True, width=_ENDLESS)[1:-2]
