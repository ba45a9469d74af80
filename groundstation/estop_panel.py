"""What the emergency stop's panel shows."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Final

from rich.align import Align
from rich.console import Group, RenderableType
from rich.panel import Panel as Frame
from rich.text import Text

from groundstation.big_text import big
from groundstation.client import Client
from groundstation.estop_keys import Action, DeadMan, Keys, Pushed
from groundstation.watch_orders import Order, Orders
from onboard.messages import Phase, Request
from onboard.wire import Mission, Outcome, Stop

#: Nothing heard of the vehicle for so long is told, s.
_OLD: Final = 1.0
_SHOWN: Final = 5
_NAMES: Final = {Action.STOP: "stop", Action.KILL: "kill"}
_GROUND: Final = (Phase.PREFLIGHT, Phase.STOPPED)


class Panel:
    """Keys and button in, orders out, and how all of it looks."""

    def __init__(
        self,
        client: Client,
        orders: Orders,
        button: DeadMan | Pushed | None,
        name: str = "",
        clock: Callable[[], float] = monotonic,
    ) -> None:
        self._client, self._orders, self._clock = client, orders, clock
        self._keys = Keys()
        self._button: DeadMan | Pushed | None = button
        self._name = name
        self._unplugged = False
        self.leaving = False

    # -- what a person does -------------------------------------------------------------------------------------------

    def press(self, key: str) -> None:
        """A key has come."""
        self._do(self._keys.press(key, self._clock()))

    def look(self) -> None:
        """Do what is due by time alone."""
        self._do(self._keys.due(self._clock()))

    def changed(self, down: bool) -> None:
        """The button went down, or up."""
        if self._button is not None:
            self._do(self._button.changed(down))

    def gone(self) -> None:
        """The button was unplugged."""
        self._unplugged = True
        if self._button is not None:
            self._do(self._button.gone())

    def left(self) -> None:
        """The panel is closed."""
        if self._button is not None:
            self._do(self._button.left())

    def _do(self, action: Action | None) -> None:
        match action:
            case Action.STOP:
                self._orders.give("stop", Stop())
            case Action.KILL:
                self._orders.give("kill", Mission(Request.KILL))
            case Action.LEAVE:
                self.leaving = True

    @property
    def flying(self) -> bool:
        """As far as was heard."""
        telemetry = self._client.telemetry()
        return telemetry is not None and telemetry.tick.outputs.phase not in _GROUND

    # -- what a person sees -------------------------------------------------------------------------------------------

    def draw(self) -> RenderableType:
        """The whole screen, 80x24 at least."""
        word, colour, hint = self._word()
        return Group(
            Align.center(self._top()),
            Frame(
                Group(Text(), Align.center(Text(big(word))), Text(), Align.center(Text(hint))),
                style=colour,
                padding=(1, 2),
            ),
            *map(_line, self._orders.latest()[-_SHOWN:]),
            Text(),
            Text("space  stop (again: land)      k k  kill: IT FALLS      q  close", style="bold"),
        )

    def _top(self) -> Text:
        contact, telemetry = self._client.contact(), self._client.telemetry()
        parts = [self._client.vehicle]
        if telemetry is not None:
            parts.append(telemetry.tick.outputs.phase.upper())
        parts.append(f"heard {contact.age:.1f} s ago" if contact.age < 1e3 else "not heard")
        if self._button is not None:
            parts.append(f"{self._name}: unplugged" if self._unplugged else self._name)
        return Text("   ".join(parts), style="bold")

    def _word(self) -> tuple[str, str, str]:
        """The big word, its colours, and what to do."""
        now, newest = self._clock(), (self._orders.latest() or (None,))[-1]
        if self._keys.waits(now):
            return "KILL ?", "bold white on red", "k again cuts the motors"
        if self._client.contact().age > _OLD:
            return "LOST", "bold white on red", "no link; what is asked leaves as soon as there is one"
        if newest is not None:
            # an answered order stays in sight: this panel knows no end of a stop but the next order
            again = "press again: land" if newest.name == "stop" and self._keys.land_next(now) else ""
            asked = "asked, no answer yet" if newest.pending else newest.text
            held = isinstance(self._button, DeadMan) and self._button.armed
            if not (held and not newest.pending):
                return newest.name.upper(), "bold white on red", "   ".join(filter(None, (asked, again)))
        if isinstance(self._button, DeadMan) and not self._unplugged:
            if self._button.armed:
                return "HELD", "bold white on green", "letting go is a stop"
            return "PRESS", "bold black on yellow", f"hold the button of {self._name}; it counts from then on"
        return "READY", "bold white on blue", "space stops"


def _line(order: Order) -> Text:
    """One order, and what has become of it."""
    marks = {Outcome.DONE: "✓", Outcome.ACCEPTED: "✓", Outcome.REFUSED: "✗"}
    mark = "…" if order.pending else marks[order.outcome] if order.outcome else "✗"
    return Text(f"  {mark} {order.name}  {order.text}", no_wrap=True, overflow="ellipsis")
