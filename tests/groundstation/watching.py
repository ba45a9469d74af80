"""A vehicle and a client of it that only say what a test has them say, on a clock that the test moves."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from threading import Lock

import msgspec
from msgspec.structs import replace

from groundstation.client import Contact
from groundstation.watch_model import Bounds, Known, Model, View
from onboard.config import dump_config, load_config
from onboard.core.safety import Params as SafetyParams
from onboard.core.types import Event, Phase, Severity, Tick
from onboard.wire import Ack, Ask, Heard, Outcome, ShowEvents, ShowParams, Telemetry, Told, VehiclePulse
from tests.synthetic import PIPE, mission

S = 1_000_000_000
TICKS = [tick for tick, _ in mission()]
#: Our monotonic clock at the start, and how much the vehicle's is behind it.
START, BEHIND = 5_000 * S, 4_321 * S
KNOWN = Known(PIPE, msgspec.convert(SafetyParams(), Bounds, from_attributes=True))


def first(phase: Phase, after: int = 0) -> Tick:
    """The first tick of a phase, or one some ticks after it."""
    return TICKS[next(i for i, tick in enumerate(TICKS) if tick.outputs.phase is phase) + after]


class Puppet:
    """Stands for a client with its vehicle. Each ``later`` lets both talk, as far as they do."""

    vehicle, station, session = "falcon", "alice", "a1"

    def __init__(self) -> None:
        self.now_ns = START
        self.tick: Tick | None = None
        self.commander = ""
        self.present, self.talks, self.hears, self.ticks = True, True, True, True
        self.delay = 0.02
        """One way, s."""
        self.dt = 0.004
        """Between two ticks, as a tick says, s."""
        self.events: deque[Told] = deque()
        self.others: tuple[Heard, ...] = (Heard("bob", "b1", 1, 0, True),)
        self.remembered: tuple[Told, ...] = ()
        self.missed = 0
        self.asked: list[Ask] = []
        self.answer: Callable[[Ask], Ack] = lambda ask: Ack("a", Outcome.DONE, "So be it.")
        self._echo_ns = 0
        self._tick_ns = 0
        self._index = 0
        self._pulse: VehiclePulse | None = None
        self._telemetry: Telemetry | None = None
        self._lock = Lock()

    def clock(self) -> int:
        return self.now_ns

    def later(self, seconds: float, tick: Tick | None = None) -> None:
        """Move the clock; what was said up to then has come."""
        if tick is not None:
            self.tick = tick
        self.now_ns += round(seconds * S)
        self._index += round(seconds * 250)
        sent = self.now_ns - round(self.delay * S) - BEHIND
        if self.ticks and self.tick is not None:
            self._tick_ns = sent
        if not self.talks:
            return
        heard = self.now_ns - round(2 * self.delay * S)
        if self.hears:
            self._echo_ns = heard
        held = heard - self._echo_ns
        stations = (Heard("alice", "a1", self._echo_ns, held, True), *self.others)
        self._pulse = VehiclePulse(sent, sent + 1_700_000_000 * S, self._tick_ns, self.commander, stations, 0, 0)
        if self.tick is not None and self.ticks:
            inputs = replace(self.tick.inputs, t_ns=sent, dt=self.dt)
            self._telemetry = Telemetry(sent, replace(self.tick, index=self._index, inputs=inputs))

    def stall(self, seconds: float) -> None:
        """The loop makes no tick for so long; nobody looks meanwhile."""
        self.now_ns += round(seconds * S)

    def tell(self, code: str, text: str, severity: Severity = Severity.INFO) -> Told:
        """An event now."""
        told = Told(len(self.events) + 1, Event(self.now_ns - BEHIND, code, severity, text))
        self.events.append(told)
        return told

    def contact(self) -> Contact:
        age = (self.now_ns - self._echo_ns) * 1e-9 if self._echo_ns else math.inf
        return Contact(self.present, age, 2 * self.delay, 0.0, self.missed, self._pulse)

    def telemetry(self) -> Telemetry | None:
        return self._telemetry

    def ask(self, ask: Ask, *, timeout: float = 5.0, settled: bool = False) -> Ack:
        with self._lock:
            if isinstance(ask, ShowParams):
                return Ack("a", Outcome.DONE, "", dump_config(load_config("paper")).encode())
            if isinstance(ask, ShowEvents):
                return Ack("a", Outcome.DONE, "", msgspec.json.encode(self.remembered))
            self.asked.append(ask)
        return self.answer(ask)


class Eye:
    """A model that looks at a puppet."""

    def __init__(self, puppet: Puppet, known: Known | None = KNOWN) -> None:
        self._puppet, self._known = puppet, known
        self._model = Model(puppet.station, puppet.session)

    def look(self) -> View:
        puppet = self._puppet
        return self._model.look(puppet.now_ns, puppet.contact(), puppet.telemetry(), tuple(puppet.events), self._known)

    def after(self, seconds: float, tick: Tick | None = None) -> View:
        """What is seen after this time, with a look every 0.1 s."""
        view = self.look()
        for _ in range(round(seconds * 10)):
            self._puppet.later(0.1, tick)
            view = self.look()
        return view
