"""Parameters: declared once as msgspec Struct fields, read from layers of YAML, checked all at once.

A field says everything: ``name: Annotated[float, Meta(ge=.., le=.., description="..", extra={"unit": "m",
"in_flight": True})] = default``. This module knows no concrete parameter. A path is the tuple of keys from the root;
elements of lists are addressed by their index, so ``vehicle.arm.parts.2.mass`` works on the command line and is
what an error prints.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import SequenceMatcher
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import yaml
from msgspec import NODEFAULT, Struct
from msgspec import inspect as mi

S = TypeVar("S", bound=Struct)
Key = tuple[str, ...]
Where = Callable[[Key], str]


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


class Parameter(Struct, frozen=True):
    """What is declared about one parameter."""

    path: str
    type: str
    default: Any
    """``msgspec.NODEFAULT`` where a value must be given."""
    unit: str
    bounds: str
    in_flight: bool
    doc: str


class Change(Struct, frozen=True):
    """One parameter that differs between two sets."""

    path: str
    old: Any
    new: Any
    in_flight: bool


# --- reading YAML -----------------------------------------------------------------------------------------------------

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
        text = path.read_bytes().decode("utf-8-sig")
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
        raise ConfigError([f"{source}: must be a mapping of names to values, not {_show(values)}"])
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
    errors: list[str] = []
    try:
        root = yaml.compose(text, Loader=_Loader)
        value = None if root is None else _build(root, (), lines, errors, source, ())
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
    if errors:
        raise ConfigError(errors)
    return value


def _build(
    node: yaml.Node, path: Key, lines: dict[Key, int], errors: list[str], source: str, open_nodes: tuple[int, ...]
) -> Any:
    """Turn a YAML node into plain values; note the line of each; refuse duplicate keys, cycles and foreign tags."""
    line = node.start_mark.line + 1
    lines.setdefault(path, line)
    if id(node) in open_nodes:
        errors.append(f"{source}:{line}: {dotted(path)}: contains itself")
        return None
    inside = (*open_nodes, id(node))
    if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key_line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                errors.append(f"{source}:{key_line}: {dotted(path)}: a key must be a name")
                continue
            key = key_node.value
            if key in result:
                errors.append(f"{source}:{key_line}: {dotted((*path, key))}: given twice")
            lines[(*path, key)] = key_line
            result[key] = _build(value_node, (*path, key), lines, errors, source, inside)
        return result
    if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
        return [_build(item, (*path, str(i)), lines, errors, source, inside) for i, item in enumerate(node.value)]
    text = node.value if isinstance(node, yaml.ScalarNode) else ""
    kind = node.tag.removeprefix(_TAG) if isinstance(node, yaml.ScalarNode) else ""
    match kind if kind == "str" or re.fullmatch(_SCALARS.get(kind, "(?!)"), text) else "":
        case "str":
            return text
        case "null":
            return None
        case "bool":
            return text.lower() == "true"
        case "int":
            return _integer(text)
        case "float":
            return float(text.replace(".", "") if text.lower().lstrip("+-") in (".inf", ".nan") else text)
    errors.append(f"{source}:{line}: {dotted(path)}: {text!r:.40} with the tag {node.tag} is not allowed")
    return None


def _integer(text: str) -> int | str:
    try:
        return int(text, 0) if text[:2] in ("0x", "0o") else int(text)
    except (
        ValueError
    ):  # Explicitly tagged, or longer than Python reads: not a number to us, whoever declares it says so.
        return text


# --- layers -----------------------------------------------------------------------------------------------------------


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


def compose(struct_type: type[S], layers: Sequence[Layer]) -> S:
    """Lay the layers over the defaults, in order, and check the whole. Raises ConfigError with every error."""
    values: Any = defaults(struct_type)
    for layer in layers:
        values = merge(values, layer.values)
    return load(struct_type, values, lambda path: _origin(layers, path))


def _origin(layers: Sequence[Layer], path: Key) -> str:
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


# --- declarations -----------------------------------------------------------------------------------------------------


class _Declared(NamedTuple):
    """A type and what its metadata say."""

    type: mi.Type
    unit: str = ""
    in_flight: bool = False
    doc: str = ""

    def inner(self, item: mi.Type) -> _Declared:
        """What is declared about an element: its own metadata before those of the whole."""
        own = _declared(item)
        return _Declared(own.type, own.unit or self.unit, own.in_flight or self.in_flight, own.doc or self.doc)


def _declared(info: mi.Type) -> _Declared:
    extra: dict[str, Any] = {}
    doc = ""
    while isinstance(info, mi.Metadata):
        extra = {**(info.extra or {}), **extra}
        doc = doc or (info.extra_json_schema or {}).get("description", "")
        info = info.type
    return _Declared(info, extra.get("unit", ""), extra.get("in_flight", False), doc)


@functools.cache
def _struct_info(struct_type: type[Struct]) -> mi.StructType:
    info = mi.type_info(struct_type)
    assert isinstance(info, mi.StructType)
    return info


def _default(field: mi.Field, instance: Struct | None = None) -> Any:
    if instance is not None:
        return getattr(instance, field.name)
    if field.default is not NODEFAULT:
        return field.default
    return NODEFAULT if field.default_factory is NODEFAULT else field.default_factory()


def defaults(struct_type: type[Struct]) -> dict[str, Any]:
    """All defaults as a mapping; what must be given is left out."""
    result: dict[str, Any] = {}
    for field in _struct_info(struct_type).fields:
        default, kind = _default(field), _declared(field.type).type
        if default is not NODEFAULT:
            result[field.name] = _plain(default)
        elif isinstance(kind, mi.StructType) and (nested := defaults(kind.cls)):
            result[field.name] = nested
    return result


def describe(struct_type: type[Struct]) -> list[Parameter]:
    """Every parameter below ``struct_type``; elements of a list of groups stand once, with the index ``N``."""
    return list(_describe(_struct_info(struct_type), (), None))


def _describe(info: mi.StructType, path: Key, instance: Struct | None) -> Iterator[Parameter]:
    for field in info.fields:
        declared = _declared(field.type)
        here = (*path, field.name)
        default = _default(field, instance)
        match declared.type:
            case mi.StructType():
                yield from _describe(declared.type, here, default if isinstance(default, Struct) else None)
            case mi.VarTupleType(item_type=mi.StructType() as item):
                yield from _describe(item, (*here, "N"), None)
            case _:
                leaf = declared
                if isinstance(declared.type, mi.TupleType | mi.VarTupleType):
                    items = _items(declared.type)
                    leaf = declared.inner(items[0]) if items and all(i == items[0] for i in items) else declared
                yield Parameter(
                    dotted(here),
                    _type_name(declared.type),
                    default if default is NODEFAULT else _plain(default),
                    leaf.unit,
                    _bounds(leaf.type),
                    leaf.in_flight,
                    leaf.doc,
                )


def _items(info: mi.TupleType | mi.VarTupleType) -> tuple[mi.Type, ...]:
    return info.item_types if isinstance(info, mi.TupleType) else (info.item_type,)


def _type_name(info: mi.Type) -> str:
    match _declared(info).type:
        case mi.FloatType():
            return "number"
        case mi.IntType():
            return "whole number"
        case mi.BoolType():
            return "true or false"
        case mi.StrType():
            return "text"
        case mi.NoneType():
            return "null"
        case mi.EnumType(cls=cls):
            return "one of " + ", ".join(str(member.value) for member in cls)
        case mi.LiteralType(values=values):
            return "one of " + ", ".join(map(str, values))
        case mi.TupleType(item_types=items):
            each = {_type_name(item) for item in items}
            return f"list of {len(items)}" + (f", each {each.pop()}" if len(each) == 1 else "")
        case mi.VarTupleType(item_type=item):
            return f"list, each {_type_name(item)}"
        case mi.UnionType(types=types):
            return " or ".join(_type_name(item) for item in types)
        case mi.StructType(fields=fields):
            return "group of " + ", ".join(field.name for field in fields)
        case other:
            raise TypeError(f"a parameter cannot be of type {other}")


def _bounds(info: mi.Type) -> str:
    match info:
        case mi.UnionType(types=types):
            return next(filter(None, (_bounds(_declared(item).type) for item in types)), "")
        case mi.StrType() | mi.VarTupleType():
            low, high = info.min_length, info.max_length
            text = f"from {low} to {high} long" if low and high is not None else ""
            text = text or (f"at least {low} long" if low else f"at most {high} long" if high is not None else "")
            pattern = getattr(info, "pattern", None)
            return f"{text} matching {pattern}".strip() if pattern else text
        case mi.FloatType() | mi.IntType():
            if info.ge is not None and info.le is not None:
                return f"from {info.ge:.12g} to {info.le:.12g}"
            words = {"at least": info.ge, "above": info.gt, "at most": info.le, "below": info.lt}
            return " and ".join(f"{word} {bound:.12g}" for word, bound in words.items() if bound is not None)
    return ""


def _wanted(declared: _Declared) -> str:
    """What would be right, in words: ``a number from 0.03 to 0.15 m (outer radius)``."""
    kind = declared.type
    if isinstance(kind, mi.TupleType | mi.VarTupleType):
        items = _items(kind)
        same = all(item == items[0] for item in items) and not isinstance(_declared(items[0]).type, mi.StructType)
        size = f" of {len(items)}" if isinstance(kind, mi.TupleType) else f" {_bounds(kind)}".rstrip()
        return f"a list{size}" + (f", each {_wanted(declared.inner(items[0]))}" if same else "")
    name = _type_name(kind)
    article = "a " if name.startswith(("number", "whole", "group")) else ""
    words = [article + name, _bounds(kind), declared.unit if declared.unit != "1" else ""]
    return " ".join([*filter(None, words), *([f"({declared.doc})"] if declared.doc else [])])


# --- checking ---------------------------------------------------------------------------------------------------------

_BAD: Any = object()


def load(struct_type: type[S], values: Any, source: str | Where) -> S:
    """Check plain values against the declarations and build the struct.

    ``source`` names where they came from, as text or per path. Raises ConfigError with every error at once.
    """
    reader = _Reader(struct_type, (lambda _: source) if isinstance(source, str) else source)
    result = reader.read(_Declared(_struct_info(struct_type)), values, ())
    if reader.errors:
        raise ConfigError(reader.errors)
    assert isinstance(result, struct_type)
    return result


class _Reader:
    """One walk over values and declarations; collects the errors."""

    def __init__(self, root: type[Struct], where: Where) -> None:
        self.root = root
        self.where = where
        self.errors: list[str] = []

    def fail(self, path: Key, text: str) -> Any:
        self.errors.append(f"{self.where(path)}: {dotted(path)}{text}")
        return _BAD

    def read(self, declared: _Declared, value: Any, path: Key, default: Struct | None = None) -> Any:
        """The checked value, or _BAD after noting why."""
        result = self._read(declared, value, path, default)
        if result is NODEFAULT:
            return self.fail(path, f" = {_show(value)}: must be {_wanted(declared)}")
        return result

    def _read(self, declared: _Declared, value: Any, path: Key, default: Struct | None) -> Any:
        """As read, but NODEFAULT where the value is not of the declared kind."""
        match declared.type:
            case mi.StructType() as info:
                return self._struct(info, value, path, default) if isinstance(value, Mapping) else NODEFAULT
            case mi.TupleType(item_types=items):
                if not isinstance(value, list | tuple) or len(value) != len(items):
                    return NODEFAULT
                return self._tuple(declared, items, value, path)
            case mi.VarTupleType(item_type=item) as info:
                if not isinstance(value, list | tuple) or not _length_ok(info, value):
                    return NODEFAULT
                return self._tuple(declared, (item,) * len(value), value, path)
            case mi.UnionType(types=types):
                return self._union(declared, types, value, path, default)
            case kind:
                return _scalar(kind, value)

    def _struct(self, info: mi.StructType, values: Mapping[str, Any], path: Key, default: Struct | None) -> Any:
        known = {field.name for field in info.fields}
        bad = False
        for key in values:
            if key not in known:
                bad = True
                self._unknown((*path, str(key)), values[key], sorted(known))
        found: dict[str, Any] = {}
        for field in info.fields:
            here, declared, fallback = (*path, field.name), _declared(field.type), _default(field, default)
            if field.name in values:
                nested = fallback if isinstance(fallback, Struct) else None
                found[field.name] = self.read(declared, values[field.name], here, nested)
            elif fallback is NODEFAULT:
                found[field.name] = self.fail(here, f": missing; must be {_wanted(declared)}")
            else:
                found[field.name] = fallback
        if bad or any(value is _BAD for value in found.values()):
            return _BAD
        try:
            return info.cls(**found)
        except (ValueError, TypeError) as error:  # What a __post_init__ says about fields that do not fit together.
            return self.fail(path, f": {error}")

    def _tuple(self, declared: _Declared, items: Sequence[mi.Type], values: Sequence[Any], path: Key) -> Any:
        pairs = enumerate(zip(items, values, strict=True))
        result = tuple(self.read(declared.inner(item), value, (*path, str(i))) for i, (item, value) in pairs)
        return _BAD if any(value is _BAD for value in result) else result

    def _union(
        self, declared: _Declared, types: Sequence[mi.Type], value: Any, path: Key, default: Struct | None
    ) -> Any:
        others = [item for item in types if not isinstance(_declared(item).type, mi.NoneType)]
        if value is None and len(others) < len(types):
            return None
        for item in others:
            kind = declared.inner(item)
            if isinstance(kind.type, mi.StructType) == isinstance(value, Mapping):
                result = self._read(kind, value, path, default)
                if result is not NODEFAULT:
                    return result
        return NODEFAULT

    def _unknown(self, path: Key, value: Any, siblings: Sequence[str]) -> None:
        """Note a key that is not declared, with the nearest that are."""
        near = {dotted((*path[:-1], name)) for name in siblings}
        depth = len(path)
        while isinstance(value, Mapping) and len(value) == 1:  # An option: all of its name is what was meant.
            ((key, value),) = value.items()
            path = (*path, key)
        wrong, leaf, deep = dotted(path), path[-1], len(path) > depth

        def likeness(name: str) -> tuple[float, float, str]:
            whole = _ratio(wrong, name)
            last = _ratio(leaf, name.rpartition(".")[2]) * (1.0 if name in near else 0.95)
            return max(last, whole if deep else _ratio(leaf, name)), whole, name

        indexed = any(part.isdecimal() for part in path)
        names = near | {name for name in _names(self.root) if not (indexed and ".N." in name)}
        best = [name for score, _, name in sorted(map(likeness, names), reverse=True)[:3] if score >= 0.6]
        hint = f"nearest: {', '.join(best)}" if best else f"known here: {', '.join(siblings)}"
        self.fail(path, f": no such parameter; {hint}")


def _ratio(a: str, b: str) -> float:
    return SequenceMatcher(None, a, b, autojunk=False).ratio()


@functools.cache
def _names(struct_type: type[Struct]) -> tuple[str, ...]:
    """All parameters and all groups, dotted."""
    paths = [parameter.path.split(".") for parameter in describe(struct_type)]
    return tuple(sorted({".".join(path[: n + 1]) for path in paths for n in range(len(path))}))


def _length_ok(info: mi.VarTupleType | mi.StrType, value: Sequence[Any]) -> bool:
    return (info.min_length or 0) <= len(value) and (info.max_length is None or len(value) <= info.max_length)


def _scalar(kind: mi.Type, value: Any) -> Any:
    """The value as the declared kind, or NODEFAULT."""
    match kind:
        case mi.BoolType():
            return value if isinstance(value, bool) else NODEFAULT
        case mi.IntType():
            return value if type(value) is int and _in_bounds(kind, value) else NODEFAULT
        case mi.FloatType():
            if isinstance(value, bool) or not isinstance(value, int | float):
                return NODEFAULT
            try:
                number = float(value)
            except OverflowError:
                return NODEFAULT
            return number if math.isfinite(number) and _in_bounds(kind, number) else NODEFAULT
        case mi.StrType():
            fits = isinstance(value, str) and _length_ok(kind, value)
            return value if fits and (kind.pattern is None or re.search(kind.pattern, value)) else NODEFAULT
        case mi.EnumType(cls=cls):
            return _same(list(cls), [member.value for member in cls], value)
        case mi.LiteralType(values=values):
            return _same(values, values, value)
    raise TypeError(f"a parameter cannot be of type {kind}")


def _same(members: Sequence[Any], values: Sequence[Any], value: Any) -> Any:
    """The member whose value is equal and of the same type (True is not 1)."""
    plain = value.value if isinstance(value, Enum) else value
    pairs = zip(members, values, strict=True)
    return next((member for member, v in pairs if type(v) is type(plain) and v == plain), NODEFAULT)


def _in_bounds(kind: mi.FloatType | mi.IntType, value: float) -> bool:
    return (
        (kind.ge is None or value >= kind.ge)
        and (kind.gt is None or value > kind.gt)
        and (kind.le is None or value <= kind.le)
        and (kind.lt is None or value < kind.lt)
    )


def _show(value: Any) -> str:
    text = " ".join(
        ("null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)).split()
    )
    return text if len(text) <= 60 else text[:57] + "..."


# --- writing and comparing --------------------------------------------------------------------------------------------


def to_mapping(struct: Struct) -> dict[str, Any]:
    """The set as plain values: mappings, lists, numbers, text."""
    return {name: _plain(getattr(struct, name)) for name in struct.__struct_fields__}


def _plain(value: Any) -> Any:
    if isinstance(value, Struct):
        return to_mapping(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.value if isinstance(value, Enum) else value


def dump_yaml(struct: Struct) -> str:
    """YAML text that reads back to the same set, to the bit."""
    return yaml.dump(to_mapping(struct), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)


def diff(old: S, new: S) -> list[Change]:
    """The parameters that differ. Lists of different length, and groups that come or go, differ as a whole."""
    return list(_changes(_Declared(_struct_info(type(old))), old, new, ()))


def refused_in_flight(old: S, new: S) -> list[str]:
    """Paths of the parameters that differ and may not change in flight."""
    return [change.path for change in diff(old, new) if not change.in_flight]


def _changes(declared: _Declared, old: Any, new: Any, path: Key) -> Iterator[Change]:
    kind = declared.type
    if isinstance(kind, mi.UnionType) and isinstance(old, Struct) and type(old) is type(new):
        kind = _struct_info(type(old))
    if isinstance(kind, mi.StructType):
        for field in kind.fields:
            a, b = getattr(old, field.name), getattr(new, field.name)
            yield from _changes(_declared(field.type), a, b, (*path, field.name))
    elif isinstance(kind, mi.TupleType | mi.VarTupleType) and len(old) == len(new):
        items = kind.item_types if isinstance(kind, mi.TupleType) else (kind.item_type,) * len(old)
        for i, (item, a, b) in enumerate(zip(items, old, new, strict=True)):
            yield from _changes(declared.inner(item), a, b, (*path, str(i)))
    elif old != new:
        yield Change(dotted(path), _plain(old), _plain(new), declared.in_flight)
