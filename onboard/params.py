"""Parameter sets: plain values checked against their declarations, all errors at once; written, and compared."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import SequenceMatcher
from enum import Enum
from typing import Any, TypeVar

from msgspec import NODEFAULT, Struct
from msgspec import inspect as mi

from onboard.declared import (
    Declared,
    declared_as,
    default_of,
    defaults,
    describe,
    plain,
    struct_info,
    to_mapping,
    wanted,
)
from onboard.layers import ConfigError, Key, Layer, dotted, dump_text, merge, origin, show

S = TypeVar("S", bound=Struct)
Where = Callable[[Key], str]


class Change(Struct, frozen=True):
    """One parameter that differs between two sets."""

    path: str
    old: Any
    new: Any
    in_flight: bool


def compose(struct_type: type[S], layers: Sequence[Layer]) -> S:
    """Lay the layers over the defaults, in order, and check the whole. Raises ConfigError with every error."""
    values: Any = defaults(struct_type)
    for layer in layers:
        values = merge(values, layer.values)
    return load(struct_type, values, lambda path: origin(layers, path))


_BAD: Any = object()


def load(struct_type: type[S], values: Any, source: str | Where) -> S:
    """Check plain values against the declarations and build the struct.

    ``source`` names where they came from, as text or per path. Raises ConfigError with every error at once.
    """
    reader = _Reader(struct_type, (lambda _: source) if isinstance(source, str) else source)
    result = reader.read(Declared(struct_info(struct_type)), values, ())
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

    def read(self, declared: Declared, value: Any, path: Key, default: Struct | None = None) -> Any:
        """The checked value, or _BAD after noting why."""
        result = self._read(declared, value, path, default)
        if result is NODEFAULT:
            return self.fail(path, f" = {show(value)}: must be {wanted(declared)}")
        return result

    def _read(self, declared: Declared, value: Any, path: Key, default: Struct | None) -> Any:
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
            here, declared, fallback = (*path, field.name), declared_as(field.type), default_of(field, default)
            if field.name in values:
                nested = fallback if isinstance(fallback, Struct) else None
                found[field.name] = self.read(declared, values[field.name], here, nested)
            elif fallback is NODEFAULT:
                found[field.name] = self.fail(here, f": missing; must be {wanted(declared)}")
            else:
                found[field.name] = fallback
        if bad or any(value is _BAD for value in found.values()):
            return _BAD
        try:
            return info.cls(**found)
        except (ValueError, TypeError) as error:  # What a __post_init__ says about fields that do not fit together.
            return self.fail(path, f": {error}")

    def _tuple(self, declared: Declared, items: Sequence[mi.Type], values: Sequence[Any], path: Key) -> Any:
        pairs = enumerate(zip(items, values, strict=True))
        result = tuple(self.read(declared.inner(item), value, (*path, str(i))) for i, (item, value) in pairs)
        return _BAD if any(value is _BAD for value in result) else result

    def _union(
        self, declared: Declared, types: Sequence[mi.Type], value: Any, path: Key, default: Struct | None
    ) -> Any:
        others = [item for item in types if not isinstance(declared_as(item).type, mi.NoneType)]
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
        near = [dotted((*path[:-1], name)) for name in siblings]
        depth = len(path)
        while isinstance(value, Mapping) and len(value) == 1:  # An option: all of its name is what was meant.
            ((key, value),) = value.items()
            path = (*path, key)
        best = nearest(self.root, path, near, deep=len(path) > depth)
        hint = f"nearest: {', '.join(best)}" if best else f"known here: {', '.join(siblings)}"
        self.fail(path, f": no such parameter; {hint}")


def nearest(root: type[Struct], path: Key, near: Sequence[str] = (), *, deep: bool = True) -> list[str]:
    """Up to three declared names that a wrong one may have meant, the likeliest first.

    near: names beside the wrong one, which are likelier. deep: the wrong part may stand anywhere in the path, and not
    only at its end.
    """
    wrong, leaf = dotted(path), path[-1]

    def likeness(name: str) -> tuple[float, float, str]:
        whole = _ratio(wrong, name)
        last = _ratio(leaf, name.rpartition(".")[2]) * (1.0 if name in near else 0.95)
        return max(last, whole if deep else _ratio(leaf, name)), whole, name

    indexed = any(part.isdecimal() for part in path)
    names = {*near, *(name for name in _names(root) if not (indexed and ".N." in name))}
    return [name for score, _, name in sorted(map(likeness, names), reverse=True)[:3] if score >= 0.6]


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


def dump_yaml(struct: Struct) -> str:
    """YAML text that reads back to the same set, to the bit."""
    return dump_text(to_mapping(struct))


def diff(old: S, new: S) -> list[Change]:
    """The parameters that differ. Lists of different length, and groups that come or go, differ as a whole."""
    return list(_changes(Declared(struct_info(type(old))), old, new, ()))


def refused_in_flight(old: S, new: S) -> list[str]:
    """Paths of the parameters that differ and may not change in flight."""
    return [change.path for change in diff(old, new) if not change.in_flight]


def _changes(declared: Declared, old: Any, new: Any, path: Key) -> Iterator[Change]:
    kind = declared.type
    if isinstance(kind, mi.UnionType) and isinstance(old, Struct) and type(old) is type(new):
        kind = struct_info(type(old))
    if isinstance(kind, mi.StructType):
        for field in kind.fields:
            a, b = getattr(old, field.name), getattr(new, field.name)
            yield from _changes(declared_as(field.type), a, b, (*path, field.name))
    elif isinstance(kind, mi.TupleType | mi.VarTupleType) and len(old) == len(new):
        items = kind.item_types if isinstance(kind, mi.TupleType) else (kind.item_type,) * len(old)
        for i, (item, a, b) in enumerate(zip(items, old, new, strict=True)):
            yield from _changes(declared.inner(item), a, b, (*path, str(i)))
    elif old != new:
        yield Change(dotted(path), plain(old), plain(new), declared.in_flight)
