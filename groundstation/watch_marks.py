"""Words with a tone, and what is drawn of them: bars, trends, short numbers. Knows no toolkit, and no vehicle."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from enum import StrEnum
from typing import Final

from groundstation.watch_model import Force


class Tone(StrEnum):
    """How words are meant."""

    PLAIN = "plain"
    STRONG = "strong"
    LABEL = "label"
    GOOD = "good"
    WARN = "warn"
    BAD = "bad"
    STALE = "stale"
    ESTIMATED = "estimated"
    DESIRED = "desired"
    LOUD = "loud"
    """In the colours of the box it stands in."""


Span = tuple[str, Tone]
Line = tuple[Span, ...]
T = Tone

_BLOCKS: Final = " ▁▂▃▄▅▆▇█"
_BARS: Final = " ▏▎▍▌▋▊▉█"


def bar(desired: float, estimated: float, scale: float, width: int) -> Line:
    """Blocks up to the estimated force, a mark at the desired one, the end of the scale beyond."""
    end = f" {scale:g} N"
    room = max(width - len(end), 1)
    share = min(max(estimated / scale, 0.0), 1.0) if math.isfinite(estimated) else 0.0
    eighths = round(share * room * 8)
    cells: list[Span] = [(_BARS[min(max(eighths - 8 * i, 0), 8)], T.ESTIMATED) for i in range(room)]
    cells = [("·", T.LABEL) if cell[0] == " " else cell for cell in cells]
    if desired > 0.0:
        cells[min(round(desired / scale * room), room - 1)] = ("┃", T.DESIRED)
    return joined([*cells, (end, T.LABEL)])


def plot(
    trend: Sequence[Force], scale: float, now_ns: int, seconds: float, columns: int, rows: int
) -> tuple[Line, ...]:
    """Columns of blocks up to the estimated force, the newest on the right; a line at the desired one.

    The columns end now, so that what is missing stays empty. ``scale`` N fill all rows.
    """
    slots = _slots(trend, now_ns, seconds, columns)
    return tuple(joined([_cell(slot, scale, row, rows) for slot in slots]) for row in range(rows - 1, -1, -1))


def _slots(trend: Sequence[Force], now_ns: int, seconds: float, columns: int) -> list[Force | None]:
    """The newest force of each column's time; columns end now."""
    slots: list[Force | None] = [None] * columns
    step = seconds / columns if columns else 1.0
    for force in trend:
        column = columns - 1 - math.floor((now_ns - force.seen_ns) * 1e-9 / step)
        if 0 <= column < columns:
            slots[column] = force
    return slots


def _cell(force: Force | None, scale: float, row: int, rows: int) -> Span:
    """One character of the trend; row 0 is the lowest."""
    if force is None:
        return " ", T.PLAIN
    if force.desired > 0.0 and row == min(math.floor(force.desired / scale * rows), rows - 1):
        return "━", T.DESIRED
    level = force.estimated / scale * rows * 8 if math.isfinite(force.estimated) else 0.0
    return _BLOCKS[min(max(round(level) - 8 * row, 1 if row == 0 else 0), 8)], T.ESTIMATED


def faded(line: Line) -> Line:
    """All of it old."""
    return tuple((text, T.STALE) for text, _ in line)


def joined(cells: Sequence[Span]) -> Line:
    """Neighbours of one tone become one span."""
    spans: list[Span] = []
    for text, tone in cells:
        if spans and spans[-1][1] is tone:
            spans[-1] = (spans[-1][0] + text, tone)
        else:
            spans.append((text, tone))
    return tuple(spans)


def length(line: Line) -> int:
    """In characters."""
    return sum(len(text) for text, _ in line)


def cut(line: Line, width: int) -> Line:
    """As much of a line as there is room for, an ellipsis for the rest."""
    if length(line) <= width:
        return line
    kept: list[Span] = []
    room = max(width - 1, 0)
    for text, tone in line:
        kept.append((text[:room], tone))
        room -= len(text[:room])
    return (*kept, ("…", T.PLAIN))


def wrapped(text: str, width: int, rows: int, indent: str = "") -> list[str]:
    """Lines of a text, ``rows`` at most, at least one."""
    return textwrap.wrap(text, max(width, 10), subsequent_indent=indent, max_lines=max(rows, 1), placeholder=" …") or [
        ""
    ]


def duration(seconds: float) -> str:
    """A length of time, short."""
    if not math.isfinite(seconds):
        return "never"
    for limit, factor, form, unit in ((0.0995, 1000.0, ".0f", "ms"), (9.95, 1.0, ".1f", "s"), (120.0, 1.0, ".0f", "s")):
        if seconds < limit:
            return f"{seconds * factor:{form}} {unit}"
    return f"{seconds / 60:.0f} min"


def within(seconds: float) -> str:
    """A bound of an age, up to the next tenth of a second, so that what jitters below is not shown anew each time."""
    return duration(max(math.ceil(seconds * 10 - 1e-6), 1) / 10) if math.isfinite(seconds) else duration(seconds)


def ago(seconds: float) -> str:
    """A bound of an age in words."""
    return f"{within(seconds)} ago" if math.isfinite(seconds) else "never"


def number(value: float, form: str) -> str:
    """Two dashes for one that is not finite."""
    return f"{value:{form}}" if math.isfinite(value) else "--"
