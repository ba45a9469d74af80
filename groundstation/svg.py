"""Small line charts as SVG text: sharp at any size, themed by the page's style sheet, and made in milliseconds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Range = tuple[float, float]

_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 10, 40, 32
_COLUMNS = 480


def ticks(low: float, high: float, count: int) -> tuple[list[float], float]:
    """About ``count`` round numbers within [low, high], and their distance."""
    raw = (high - low) / max(1, count)
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(m * magnitude for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * magnitude >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)], step


def decades(low: float, high: float) -> list[float]:
    """The powers of ten from ``low`` to ``high``."""
    return [10.0**i for i in range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)]


def number(value: float, step: float) -> str:
    """A tick's label, with just the decimals that the step needs."""
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    if abs(step * 10**decimals - round(step * 10**decimals)) > 1e-6:
        decimals += 1
    return f"{value:.{decimals}f}".replace("-", "\u2212") if abs(value) > 1e-6 * step else "0"


def thin(x: Array, y: Array, columns: int = _COLUMNS) -> tuple[Array, Array]:
    """Keep the lowest and the highest point of each of ``columns`` stretches, so that no peak is lost."""
    if len(x) <= 4 * columns:
        return x, y
    edges = np.linspace(0, len(x), columns + 1).astype(int)
    keep = {0, len(x) - 1}
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        keep.add(a + int(np.argmin(y[a:b])))
        keep.add(a + int(np.argmax(y[a:b])))
    chosen = np.array(sorted(keep))
    return x[chosen], y[chosen]


class Chart:
    """A chart of lines over one horizontal axis.

    Args:
        title: what is shown, in words.
        unit: of the vertical axis.
        x: range of the horizontal axis.
        y: range of the vertical axis; by default fitted to what is drawn.
        x_label: text under the horizontal axis.
        equal: one unit is as long on both axes (a drawing, not a plot); ``height`` then follows from the ranges.
        thinned: keep only the extremes of long lines; not for lines that run back and forth.
        log: axes that are logarithmic, "x", "y" or "xy"; what is not positive is left out there.
    """

    def __init__(
        self,
        title: str,
        unit: str,
        x: Range,
        *,
        y: Range | None = None,
        x_label: str = "time, s",
        width: int = 470,
        height: int = 240,
        equal: bool = False,
        thinned: bool = True,
        log: str = "",
    ) -> None:
        self._title, self._unit, self._x, self._y, self._x_label = title, unit, x, y, x_label
        self._thinned = thinned
        self._log = log
        self.equal = equal
        self._width, self._height = width, height
        if equal and y is not None:
            inner = (width - _LEFT - _RIGHT) * (y[1] - y[0]) / (x[1] - x[0])
            self._height = round(inner + _TOP + _BOTTOM)
        self._lines: list[tuple[Array, Array, str, str]] = []
        self._bands: list[tuple[float, float, str]] = []
        self._limits: list[tuple[float, str]] = []
        self._circles: list[tuple[float, float, float, str]] = []
        self._marks: list[tuple[float, str]] = []
        self._bars: list[tuple[float, float, float, str]] = []

    def line(self, x: Array, y: Array, label: str, style: str) -> Chart:
        """Draw a line; ``style`` names classes of the style sheet. Values that are not finite are left out."""
        shown = (x >= self._x[0]) & (x <= self._x[1]) & np.isfinite(y)
        if "y" in self._log:
            shown &= y > 0.0
        if shown.any():
            self._lines.append((x[shown], y[shown], label, style))
        return self

    def band(self, start: float, end: float, label: str) -> Chart:
        """Shade a stretch of the horizontal axis."""
        low, high = max(start, self._x[0]), min(end, self._x[1])
        if low < high:
            self._bands.append((low, high, label))
        return self

    def limit(self, y: float, label: str) -> Chart:
        """Draw a horizontal limit, which the range then includes."""
        self._limits.append((y, label))
        return self

    def mark(self, x: float, label: str) -> Chart:
        """Draw a vertical line with words beside it."""
        self._marks.append((x, label))
        return self

    def bar(self, start: float, end: float, height: float, label: str) -> Chart:
        """Draw a bar over a stretch of the horizontal axis; ``label`` shows where one points at it."""
        if height > 0.0:
            self._bars.append((max(start, self._x[0]), min(end, self._x[1]), height, label))
        return self

    def circle(self, x: float, y: float, radius: float, style: str) -> Chart:
        """Draw a circle (round only in an ``equal`` chart)."""
        self._circles.append((x, y, radius, style))
        return self

    def svg(self) -> str:
        """The chart as an ``<svg>`` element."""
        return "".join(self._parts())

    def _parts(self) -> Iterator[str]:
        x0, x1 = self._scaled("x", np.array(self._x)).tolist()
        y0, y1 = self._scaled("y", np.array(self._range())).tolist()
        right, bottom = self._width - _RIGHT, self._height - _BOTTOM
        sx, sy = (right - _LEFT) / (x1 - x0), (bottom - _TOP) / (y1 - y0)

        def px(x: float) -> float:
            return float(_LEFT + (self._scaled("x", np.array(x)) - x0) * sx)

        def py(y: float) -> float:
            return float(bottom - (self._scaled("y", np.array(y)) - y0) * sy)

        yield (
            f'<svg class="chart" viewBox="0 0 {self._width} {self._height}" role="img" '
            f'aria-label="{escape(self._title)}" data-frame="{_LEFT} {_TOP} {right} {bottom}" '
            f'data-range="{x0:.9g} {x1:.9g} {y0:.9g} {y1:.9g}" data-log="{self._log}" '
            f'data-unit="{escape(self._unit)}">'
        )
        yield f'<text class="title" x="{_LEFT}" y="13">{escape(self._title)}</text>'
        yield from self._legend()
        for low, high, label in self._bands:
            yield (
                f'<rect class="band" x="{px(low):.1f}" y="{_TOP}" width="{px(high) - px(low):.1f}" '
                f'height="{bottom - _TOP}"><title>{escape(label)}</title></rect>'
            )
        for value, words in self._ticks("y", max(3, (bottom - _TOP) // 34)):
            yield f'<path class="grid" d="M{_LEFT} {py(value):.1f}H{right}"/>'
            yield f'<text class="tick end" x="{_LEFT - 5}" y="{py(value) + 3:.1f}">{words}</text>'
        for value, words in self._ticks("x", max(2, (right - _LEFT) // 70)):
            yield f'<path class="grid" d="M{px(value):.1f} {_TOP}V{bottom}"/>'
            yield f'<text class="tick mid" x="{px(value):.1f}" y="{bottom + 13}">{words}</text>'
        middle = (_LEFT + right) / 2
        yield f'<text class="tick mid" x="{middle:.0f}" y="{self._height - 4}">{escape(self._x_label)}</text>'
        yield f'<text class="tick end" x="{_LEFT - 5}" y="{_TOP - 8}">{escape(self._unit)}</text>'
        # A nested svg of the same coordinates clips what leaves the frame.
        frame = f"{_LEFT} {_TOP} {right - _LEFT} {bottom - _TOP}"
        yield (
            f'<svg x="{_LEFT}" y="{_TOP}" width="{right - _LEFT}" height="{bottom - _TOP}" viewBox="{frame}" '
            'overflow="hidden">'
        )
        for low, high, height, label in self._bars:
            yield (
                f'<rect class="bar" x="{px(low):.1f}" y="{py(height):.1f}" width="{px(high) - px(low):.1f}" '
                f'height="{bottom - py(height):.1f}"><title>{escape(label)}</title></rect>'
            )
        for x, y, radius, style in self._circles:
            yield f'<ellipse class="{style}" cx="{px(x):.2f}" cy="{py(y):.2f}" rx="{radius * sx:.2f}" '
            yield f'ry="{radius * sy:.2f}"/>'
        for level, label in self._limits:
            yield f'<path class="limit" d="M{_LEFT} {py(level):.1f}H{right}"/>'
            yield f'<text class="limit-label" x="{right - 4}" y="{py(level) + 12:.1f}">{escape(label)}</text>'
        for x, label in self._marks:
            yield f'<path class="limit" d="M{px(x):.1f} {_TOP}V{bottom}"/>'
            yield f'<text class="mark-label" x="{px(x) + 5:.1f}" y="{_TOP + 12}">{escape(label)}</text>'
        for xs, ys, label, style in self._lines:
            if self._thinned:
                xs, ys = thin(xs, ys)
            across, down = _LEFT + (self._scaled("x", xs) - x0) * sx, bottom - (self._scaled("y", ys) - y0) * sy
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across.tolist(), down.tolist(), strict=True))
            yield f'<polyline class="line {style}" data-label="{escape(label)}" points="{points}"/>'
        yield "</svg>"
        yield f'<path class="frame" d="M{_LEFT} {_TOP}V{bottom}H{right}"/>'
        yield "</svg>"

    def _scaled(self, axis: str, values: Array) -> Array:
        """Values as they are laid out along an axis."""
        return np.log10(values) if axis in self._log else values

    def _ticks(self, axis: str, count: int) -> Iterator[tuple[float, str]]:
        low, high = self._x if axis == "x" else self._range()
        if axis in self._log:
            yield from ((value, f"{value:,g}") for value in decades(low, high))
            return
        values, step = ticks(low, high, count)
        yield from ((value, number(value, step)) for value in values)

    def _legend(self) -> Iterator[str]:
        x = float(_LEFT)
        for _, _, label, style in self._lines:
            if label:
                yield f'<path class="line {style}" d="M{x:.0f} 26h18"/>'
                yield f'<text class="tick" x="{x + 23:.0f}" y="29">{escape(label)}</text>'
                x += 38 + 6.3 * len(label)

    def _range(self) -> Range:
        if self._y is not None:
            return self._y
        values = [v for _, y, _, _ in self._lines for v in (float(y.min()), float(y.max()))]
        values += [level for level, _ in self._limits]
        values += [height for _, _, height, _ in self._bars]
        if not values:
            return (0.0, 1.0)
        low, high = min(values), max(values)
        if "y" in self._log:
            return (0.6 * low, 1.7 * high)
        # A line that only rounding moves is drawn flat.
        flat = high - low < 1e-9 * max(1.0, abs(low), abs(high))
        margin = 0.1 * max(abs(high), 1e-3) if flat else 0.06 * (high - low)
        return (low - margin, high + margin)
