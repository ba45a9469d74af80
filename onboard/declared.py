"""What is declared about parameters: type, default, unit, bounds, meaning, and whether it may change in flight.

A field of a msgspec Struct says it all: ``name: Annotated[float, Meta(ge=.., le=.., description="..",
extra={"unit": "m", "in_flight": True})] = default``. This module knows no concrete parameter.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from enum import Enum
from typing import Any, NamedTuple

from msgspec import NODEFAULT, Struct
from msgspec import inspect as mi

from onboard.layers import Key, dotted


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


class Declared(NamedTuple):
    """A type and what its metadata say."""

    type: mi.Type
    unit: str = ""
    in_flight: bool = False
    doc: str = ""

    def inner(self, item: mi.Type) -> Declared:
        """What is declared about an element: its own metadata before those of the whole."""
        own = declared_as(item)
        return Declared(own.type, own.unit or self.unit, own.in_flight or self.in_flight, own.doc or self.doc)


def declared_as(info: mi.Type) -> Declared:
    """The bare type, and what the metadata around it say; the outermost wins, then those of a union's first kind."""
    extra: dict[str, Any] = {}
    doc = ""
    while isinstance(info, mi.Metadata):
        extra = {**(info.extra or {}), **extra}
        doc = doc or (info.extra_json_schema or {}).get("description", "")
        info = info.type
    if isinstance(info, mi.UnionType) and not doc:
        return declared_as(info.types[0])._replace(type=info)
    return Declared(info, extra.get("unit", ""), extra.get("in_flight", False), doc)


@functools.cache
def struct_info(struct_type: type[Struct]) -> mi.StructType:
    """The fields of a struct type."""
    info = mi.type_info(struct_type)
    assert isinstance(info, mi.StructType)
    return info


def default_of(field: mi.Field, instance: Struct | None = None) -> Any:
    """The field's value in ``instance``, else its default, else NODEFAULT."""
    if instance is not None:
        return getattr(instance, field.name)
    if field.default is not NODEFAULT:
        return field.default
    return NODEFAULT if field.default_factory is NODEFAULT else field.default_factory()


def defaults(struct_type: type[Struct]) -> dict[str, Any]:
    """All defaults as a mapping; what must be given is left out."""
    result: dict[str, Any] = {}
    for field in struct_info(struct_type).fields:
        default, kind = default_of(field), declared_as(field.type).type
        if default is not NODEFAULT:
            result[field.name] = plain(default)
        elif isinstance(kind, mi.StructType) and (nested := defaults(kind.cls)):
            result[field.name] = nested
    return result


def describe(struct_type: type[Struct]) -> list[Parameter]:
    """Every parameter below ``struct_type``; elements of a list of groups stand once, with the index ``N``."""
    return list(_describe(struct_info(struct_type), (), None))


def _describe(info: mi.StructType, path: Key, instance: Struct | None) -> Iterator[Parameter]:
    for field in info.fields:
        declared = declared_as(field.type)
        here = (*path, field.name)
        default = default_of(field, instance)
        match declared.type:
            case mi.StructType():
                yield from _describe(declared.type, here, default if isinstance(default, Struct) else None)
            case mi.VarTupleType(item_type=mi.StructType() as item):
                yield from _describe(item, (*here, "N"), None)
            case _:
                leaves = [declared]
                for kind in declared.type.types if isinstance(declared.type, mi.UnionType) else (declared.type,):
                    if isinstance(kind, mi.TupleType | mi.VarTupleType):
                        leaves = [declared.inner(item) for item in _items(kind)] or leaves
                yield Parameter(
                    dotted(here),
                    _type_name(declared.type),
                    default if default is NODEFAULT else plain(default),
                    leaves[0].unit,
                    _told(_bounds(leaf.type) for leaf in leaves),
                    all(leaf.in_flight for leaf in leaves),
                    _told(leaf.doc for leaf in leaves),
                )


def _told(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(filter(None, texts)))


def _items(info: mi.TupleType | mi.VarTupleType) -> tuple[mi.Type, ...]:
    return info.item_types if isinstance(info, mi.TupleType) else (info.item_type,)


def _type_name(info: mi.Type) -> str:
    match declared_as(info).type:
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
            return next(filter(None, (_bounds(declared_as(item).type) for item in types)), "")
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


def wanted(declared: Declared) -> str:
    """What would be right, in words: ``a number from 0.03 to 0.15 m (outer radius)``."""
    kind = declared.type
    if isinstance(kind, mi.TupleType | mi.VarTupleType):
        items = _items(kind)
        same = all(item == items[0] for item in items) and not isinstance(declared_as(items[0]).type, mi.StructType)
        size = f" of {len(items)}" if isinstance(kind, mi.TupleType) else f" {_bounds(kind)}".rstrip()
        return f"a list{size}" + (f", each {wanted(declared.inner(items[0]))}" if same else "")
    name = _type_name(kind)
    article = "a " if name.startswith(("number", "whole", "group")) else ""
    words = [article + name, _bounds(kind), declared.unit if declared.unit != "1" else ""]
    return " ".join([*filter(None, words), *([f"({declared.doc})"] if declared.doc else [])])


def to_mapping(struct: Struct) -> dict[str, Any]:
    """The set as plain values: mappings, lists, numbers, text."""
    return {name: plain(getattr(struct, name)) for name in struct.__struct_fields__}


def plain(value: Any) -> Any:
    """Structs as mappings, tuples as lists, enum members as their values."""
    if isinstance(value, Struct):
        return to_mapping(value)
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.value if isinstance(value, Enum) else value
