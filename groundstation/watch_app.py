"""The screen of ``pipewright watch``: parts put together, looked at five times a second, keys handed on at once."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable, Collection
from typing import ClassVar, Final, Protocol

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.events import Key

from groundstation import watch_words as words
from groundstation.client import Contact
from groundstation.twice import FASTER
from groundstation.watch_keys import QUIT, Hand, Leave
from groundstation.watch_marks import Line
from groundstation.watch_model import TREND, Model, View, gathered
from groundstation.watch_orders import Asker, LeaseKeeper, Orders
from groundstation.watch_shown import Shown, read_events, read_known
from groundstation.watch_widgets import Part, Scene
from onboard.messages import Action
from onboard.wire import ReleaseLease, ShowEvents, ShowParams, Telemetry, Told

_PERIOD: Final = 0.2
#: The answer to an order is shown for this long, ns.
_SHOWN_NS: Final = 60_000_000_000
#: Rows of the force beside the trend, and of answers at most.
_NUMBERS, _ANSWERS = 2, 2


class Source(Asker, Protocol):
    """What the screen needs of a client."""

    vehicle: str
    station: str
    session: str

    @property
    def events(self) -> Collection[Told]:
        """The newest, oldest first."""

    def contact(self) -> Contact:
        """How the vehicle is heard at this moment."""

    def telemetry(self) -> Telemetry | None:
        """The newest tick."""


class WatchApp(App[None]):
    """One vehicle on one screen.

    lease: take command and keep it. timeout: for an answer, s. clock: monotonic, ns.
    """

    TITLE = "pipewright watch"
    ENABLE_COMMAND_PALETTE = False
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (76, "-wide")]  # noqa: RUF012  # declared so in App
    VERTICAL_BREAKPOINTS = [(0, "-short"), (34, "-tall")]  # noqa: RUF012
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("ctrl+q,ctrl+c", "leave", priority=True, show=False),
        Binding("up", "scroll(-1)", show=False),
        Binding("down", "scroll(1)", show=False),
    ]
    CSS = """
    Screen { background: #11151c; color: #d0d4da; }
    #head { height: 1; background: #1f2a3a; }
    #alarm, #question, #verdict, #answers { height: auto; padding: 0 1; }
    #alarm, #question { background: #c01c28; color: #ffffff; text-style: bold; }
    .-empty { display: none; }
    #keys { height: 1; background: #1f2a3a; }
    #body { height: 1fr; scrollbar-size-vertical: 1; scrollbar-color: #3a4658; scrollbar-background: #11151c; }
    .row { height: auto; }
    .panel { border-top: solid #3a4658; border-title-color: #9fb3cc; border-title-style: bold; padding: 0 1; }
    #force, #vehicle, #arm, #link { height: 7; }
    #vehicle, #link { width: 37; }
    #force, #arm { width: 1fr; }
    #events { height: 1fr; min-height: 3; }
    .-tall #force, .-tall #vehicle { height: 12; }
    .-narrow .row { layout: vertical; }
    .-narrow #force, .-narrow #vehicle, .-narrow #arm, .-narrow #link { width: 100%; }
    """

    def __init__(
        self,
        source: Source,
        *,
        lease: bool = False,
        timeout: float = 5.0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__()
        self._source, self._clock = source, clock
        self._model, self._hand = Model(source.station, source.session), Hand()
        self._known = Shown(source, ShowParams(), read_known, clock)
        self._before = Shown(source, ShowEvents(), read_events, clock)
        self._orders = Orders(source, clock, timeout)
        self._lease = LeaseKeeper(self._orders) if lease else None
        self._view = View(clock(), source.station, source.session)
        self._alarmed = False

    def compose(self) -> ComposeResult:
        """The parts, from above."""
        yield Part(_head, id="head")
        yield Part(_alarm, id="alarm", classes="-empty")
        yield Part(lambda scene, width, _: words.verdict(scene.view, width), id="verdict")
        with VerticalScroll(id="body", can_focus=False):
            with Horizontal(classes="row"):
                yield Part(_force, id="force", classes="panel")
                yield Part(lambda scene, _, rows: words.vehicle(scene.view, rows), id="vehicle", classes="panel")
            with Horizontal(classes="row"):
                yield Part(lambda scene, *_: words.arm(scene.view), id="arm", classes="panel")
                yield Part(lambda scene, *_: words.link(scene.view), id="link", classes="panel")
            yield Part(lambda scene, *size: words.events(scene.view, *size), id="events", classes="panel")
        yield Part(_question, id="question", classes="-empty")
        yield Part(_answers, id="answers", classes="-empty")
        yield Part(lambda _, width, __: (words.keys(width),), id="keys")

    def on_mount(self) -> None:
        """Begin to look."""
        for name in ("vehicle", "arm", "link", "events"):
            self.query_one(f"#{name}", Part).border_title = name.capitalize()
        self.query_one("#force", Part).border_title = f"Estimated force, last {TREND:g} s"
        for number in (signal.SIGTERM, signal.SIGHUP):
            asyncio.get_running_loop().add_signal_handler(number, self.exit)
        self.look()
        self.set_interval(_PERIOD, self.look)

    def on_key(self, event: Key) -> None:
        """Hand it on."""
        event.stop()
        self._press("space" if event.character == " " else event.character or event.key)

    def action_leave(self) -> None:
        """As the key for it does."""
        self._press(QUIT)

    def action_scroll(self, rows: int) -> None:
        """On a screen that is too small for all."""
        self.query_one("#body").scroll_relative(y=rows, animate=False)

    def release(self) -> ReleaseLease | None:
        """What is to be asked once the screen is closed."""
        if self._lease is None or not self._view.alone:
            return None
        return self._lease.release(self._view.commander, self._source.station)

    def look(self) -> None:
        """Look at the vehicle once, and show what is seen."""
        source, known = self._source, self._known
        contact, now = source.contact(), self._clock()
        events = gathered(self._before.value or (), tuple(source.events), contact.pulse)
        before, view = self._view, self._model.look(now, contact, source.telemetry(), events, known.value, known.why)
        self._view = view
        if view.tick is not None:
            known.look(view.parameters)
        self._before.look((view.parameters[0], contact.missed))
        if self._lease is not None and contact.pulse is not None:
            self._lease.look(view.commander, source.station, now)
        self._ring(before, view)
        orders = [order for order in self._orders.latest() if order.pending or now - order.asked_ns < _SHOWN_NS]
        scene = Scene(source.vehicle, view, tuple(orders), self._hand.question(now))
        for part in self.query(Part):
            part.show(scene)

    def _press(self, key: str) -> None:
        view = self._view
        match self._hand.press(key, self._clock(), needed=view.flying and view.commanding and view.alone):
            case Leave():
                self.exit()
                return
            case None:
                self.set_timer(1.1 * FASTER, self._kill_if_due)
            case order:
                self._orders.give(order.name, order.ask)
        self.look()

    def _kill_if_due(self) -> None:
        if (order := self._hand.due(self._clock())) is not None:
            self._orders.give(order.name, order.ask)
            self.look()

    def _ring(self, before: View, view: View) -> None:
        """Once when the link is lost or the loop stops, and when safety begins to act."""
        alarmed = bool(words.alarm(view))
        acts = view.action >= Action.HOLD > before.action
        if (alarmed and not self._alarmed) or acts:
            self.bell()
        self._alarmed = alarmed


def _head(scene: Scene, width: int, _: int) -> tuple[Line, ...]:
    return (words.head(scene.view, scene.vehicle, width),)


def _alarm(scene: Scene, width: int, _: int) -> tuple[Line, ...]:
    return words.loud(words.alarm(scene.view), width)


def _force(scene: Scene, width: int, height: int) -> tuple[Line, ...]:
    rows = max(height - _NUMBERS, 0)
    return (*words.force(scene.view, width), *words.trend(scene.view, TREND, width, rows))


def _question(scene: Scene, width: int, _: int) -> tuple[Line, ...]:
    return words.loud((scene.question,) if scene.question else (), width)


def _answers(scene: Scene, width: int, _: int) -> tuple[Line, ...]:
    return words.answers(scene.orders, scene.view.now_ns, width, _ANSWERS)
