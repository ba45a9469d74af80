"""The parts of the screen of ``pipewright watch``: each draws lines of words, made anew for its size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from msgspec import Struct
from rich.text import Text
from textual.events import Resize
from textual.widgets import Static

from groundstation.watch_marks import Line, Tone
from groundstation.watch_model import View
from groundstation.watch_orders import Order

#: Grey, red, green and yellow have their like among sixteen colours, and all but grey are bold where it matters.
STYLES: Final = {
    Tone.PLAIN: "#d0d4da",
    Tone.STRONG: "bold #ffffff",
    Tone.LABEL: "#8a94a3",
    Tone.GOOD: "#5fd787",
    Tone.WARN: "bold #ffd75f",
    Tone.BAD: "bold #ff6e67",
    Tone.STALE: "#767676",
    Tone.ESTIMATED: "#5fd7ff",
    Tone.DESIRED: "bold #ffd75f",
    Tone.LOUD: "bold",
}


class Scene(Struct, frozen=True):
    """All that the screen shows at one moment."""

    vehicle: str
    view: View
    orders: tuple[Order, ...] = ()
    question: str = ""


Draw = Callable[[Scene, int, int], tuple[Line, ...]]
"""Lines for a width and a height."""


class Part(Static):
    """Shows what ``draw`` makes of the scene. Sent anew only when it has changed, for the line may be slow."""

    def __init__(self, draw: Draw, **settings: Any) -> None:
        super().__init__(markup=False, **settings)
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

    def _redraw(self) -> None:
        if self._scene is None:
            return
        width, height = self.content_size
        lines = self._draw(self._scene, width or self.app.size.width - 2, height)  # hidden, it has no size
        if lines != self._lines:
            grown = len(lines) != len(self._lines)
            self._lines = lines
            self.set_class(not lines, "-empty")
            self.update(_text(lines), layout=grown)


def _text(lines: tuple[Line, ...]) -> Text:
    text = Text()
    for i, line in enumerate(lines):
        text.append("\n" if i else "")
        for words, tone in line:
            text.append(words, STYLES[tone])
    return text
