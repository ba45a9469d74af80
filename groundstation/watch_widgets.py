"""The parts of the screen of ``pipewright watch``: each draws lines of words, made anew for its size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from msgspec import Struct
from rich.segment import Segment
from rich.style import Style
from textual.events import Resize
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.widget import Widget

from groundstation.watch_marks import Line, Tone
from groundstation.watch_model import View
from groundstation.watch_orders import Order

#: Grey, red, green and yellow have their like among sixteen colours, and all but grey are bold where it matters.
STYLES: Final = {
    Tone.PLAIN: Style.parse("#d0d4da"),
    Tone.STRONG: Style.parse("bold #ffffff"),
    Tone.LABEL: Style.parse("#8a94a3"),
    Tone.GOOD: Style.parse("#5fd787"),
    Tone.WARN: Style.parse("bold #ffd75f"),
    Tone.BAD: Style.parse("bold #ff6e67"),
    Tone.STALE: Style.parse("#767676"),
    Tone.ESTIMATED: Style.parse("#5fd7ff"),
    Tone.DESIRED: Style.parse("bold #ffd75f"),
    Tone.LOUD: Style.parse("bold"),
}


class Scene(Struct, frozen=True):
    """All that the screen shows at one moment."""

    vehicle: str
    view: View
    orders: tuple[Order, ...] = ()
    question: str = ""


Draw = Callable[[Scene, int, int], tuple[Line, ...]]
"""Lines for a width and a height."""


class Part(Widget):
    """Shows what ``draw`` makes of the scene. Only lines that have changed are sent, for the way may be slow."""

    def __init__(self, draw: Draw, **settings: Any) -> None:
        super().__init__(**settings)
        self._draw = draw
        self._scene: Scene | None = None
        self._lines: tuple[Line, ...] = ()

    def show(self, scene: Scene) -> None:
        """Show this scene from now on."""
        self._scene = scene
        self._redraw()

    def on_resize(self, event: Resize) -> None:
        """Lines are made for a width and a height."""
        self._redraw()

    def get_content_height(self, container: Size, viewport: Size, width: int) -> int:
        """As many rows as there are lines."""
        return len(self._lines)

    def render_line(self, y: int) -> Strip:
        """One row of the content."""
        line = self._lines[y] if y < len(self._lines) else ()
        strip = Strip([Segment(text, self.rich_style + STYLES[tone]) for text, tone in line])
        return strip.adjust_cell_length(self.content_size.width, self.rich_style)

    def _redraw(self) -> None:
        if self._scene is None:
            return
        width, height = self.content_size
        before = self._lines
        self._lines = lines = self._draw(
            self._scene, width or self.app.size.width - 2, height
        )  # hidden, it has no size
        if len(lines) != len(before):
            self.set_class(not lines, "-empty")
            self.refresh(layout=True)
        elif changed := [y for y, (old, new) in enumerate(zip(before, lines, strict=True)) if old != new]:
            self.refresh(*(Region(0, y, width, 1) for y in changed))
