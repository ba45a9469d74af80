"""Wrong input of every kind, for whatever reads: bytes, values and YAML; and how it must be taken."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from hypothesis import settings
from hypothesis import strategies as st

T = TypeVar("T")

#: Of the processor, s: what reads one input takes far less, on any machine.
SOON = 5.0
#: How many times the usual number of examples; then they are others in every run.
TIMES = int(os.environ.get("PIPEWRIGHT_FUZZ", "1"))


def examples(number: int) -> settings:
    """So many random examples, or PIPEWRIGHT_FUZZ times as many."""
    return settings(max_examples=number * TIMES, derandomize=TIMES == 1)


def taken(read: Callable[[], T], refusal: type[Exception]) -> T | None:
    """What is read, or None: then it was refused by this very error, in words. It was soon, either way."""
    began = time.thread_time()
    try:
        return read()
    except refusal as error:
        refused = error
    finally:
        took = time.thread_time() - began
        assert took < SOON, f"{took:.1f} s"
    assert type(refused) is refusal, f"{type(refused).__name__} in place of {refusal.__name__}: {refused}"
    assert str(refused).strip(), "refused without a word"
    return None


# --- values -----------------------------------------------------------------------------------------------------------

numbers = st.one_of(
    st.sampled_from([0, -1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1, -(2**63)]),
    st.sampled_from([math.nan, math.inf, -math.inf, -0.0, 5e-324, 1e308, -1e308]),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(),
)
scalars = st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=20), st.just("x" * 5_000))
anything = st.recursive(
    scalars | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)
#: The same without what JSON and YAML have no words for.
plain = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def nested(depth: int, kind: type = list) -> Any:
    """A value within a value, so many times."""
    value: Any = None
    for _ in range(depth):
        value = [value] if kind is list else {"x": value}
    return value


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of each value in a tree of mappings and lists."""
    yield path
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list | tuple) else ()
    for key, child in items:
        yield from places(child, (*path, key))


def put(tree: Any, path: tuple[Any, ...], value: Any) -> Any:
    """The tree with another value there."""
    if not path:
        return value
    key, *rest = path
    copy = dict(tree) if isinstance(tree, dict) else list(tree)
    copy[key] = put(copy[key], tuple(rest), value)
    return copy


@st.composite
def spoilt(draw: st.DrawFn, tree: Any, values: st.SearchStrategy[Any] = anything) -> Any:
    """A right tree of plain values, with one to three things wrong: another value, one too many, or one less."""
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(list(places(tree))))
        node = tree
        for key in path:
            node = node[key]
        if isinstance(node, dict) and node and draw(st.booleans()):
            gone = draw(st.sampled_from(list(node)))
            new = {key: value for key, value in node.items() if key != gone}
            tree = put(tree, path, {**new, draw(st.sampled_from([gone + "x", "", "type", gone])): draw(values)})
        elif isinstance(node, list | tuple) and draw(st.booleans()):
            tree = put(tree, path, [*node, draw(values)] if draw(st.booleans()) else list(node[1:]))
        else:
            tree = put(tree, path, draw(values))
    return tree


# --- bytes ------------------------------------------------------------------------------------------------------------

_LENGTHS = [b"\xff" * 2, b"\xff" * 4, b"\xff" * 8, b"\x00" * 8, b"\x80", b"\x7f\xff\xff\xff", b"\x00\x00\x00\x80"]


@st.composite
def damaged(draw: st.DrawFn, payloads: Sequence[bytes]) -> bytes:
    """One of right payloads, damaged in one to four places: other bytes, some less, some more, or the end cut off."""
    data = bytearray(draw(st.sampled_from(payloads)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        size = draw(st.integers(0, 12))
        match draw(st.sampled_from(["flip", "cut", "more", "less", "twice", "length"])):
            case "flip" if at < len(data):
                data[at] ^= draw(st.integers(1, 255))
            case "cut":
                del data[at:]
            case "more":
                data[at:at] = draw(st.binary(max_size=size))
            case "less":
                del data[at : at + size]
            case "twice":
                data[at:at] = data[at : at + 4 * size]
            case "length":
                new = draw(st.sampled_from(_LENGTHS))
                data[at : at + len(new)] = new
    return bytes(data)


# --- YAML -------------------------------------------------------------------------------------------------------------

_WORDS = [
    "a", "b: ", "- ", "? ", ": ", ", ", "\n", "\n  ", "\n    ", "\t", " ", "[", "]", "{", "}", "#", "# x\n", "&x ",
    "*x", "<<: ", "!!int ", "!!float ", "!!str ", "!!binary ", "!!timestamp ", "!!python/name:os.system ", "!x ",
    "|\n", ">-\n", '"', "'", "---\n", "...\n", "%YAML 1.1\n", "%TAG ! x\n", "null", "true", ".nan", "-.inf", "1e999",
    "0x1F", "1_0", "9" * 5000, "2020-13-45", "12:30:45", "\\U00110000", "\\uD800", '"\\UFFFFFFFF"', "\\x", "\u2028",
    "\ufeff", "\x85", "\x00", "\x07", "\ud800", "@", "`", "%", "~", "é", "=",
]  # fmt: skip

#: Text that looks like YAML, and is, now and then.
yamlish = st.lists(st.sampled_from(_WORDS) | st.text(max_size=4), max_size=25).map("".join)


@st.composite
def misspelt(draw: st.DrawFn, texts: Sequence[str]) -> str:
    """Right YAML text, with one to three lines wrong: another, gone, doubled, moved, or with something in it."""
    lines = draw(st.sampled_from(texts)).splitlines(keepends=True)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(0, len(lines) - 1)))
        line = lines[at] if lines else ""
        column = draw(st.integers(0, len(line)))
        match draw(st.sampled_from(["word", "gone", "twice", "other", "indent", "cut"])):
            case "word":
                lines[at : at + 1] = [line[:column] + draw(st.sampled_from(_WORDS)) + line[column:]]
            case "gone":
                del lines[at : at + 1]
            case "twice":
                lines[at:at] = [line]
            case "other":
                lines[at : at + 1] = [draw(yamlish) + "\n"]
            case "indent":
                lines[at : at + 1] = [" " * draw(st.integers(0, 6)) + line.lstrip()]
            case "cut":
                lines[at : at + 1] = [line[:column] + "\n"]
    return "".join(lines)


def laughs(levels: int = 12) -> str:
    """A short text that stands for 9 ** levels values: each of its lists names the one before nine times."""
    first = "l0: &l0 [x, x, x, x, x, x, x, x, x]\n"
    return first + "".join(f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 9)}]\n" for n in range(1, levels))
