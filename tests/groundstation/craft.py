"""A vehicle at the other end of a real link, that does what it is asked in a moment, and the command line to ask it."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from msgspec.structs import replace

from groundstation import completion, events, lease, orders, params, status
from groundstation.client import Client, StationSettings
from groundstation.parsing import Parser
from onboard.admission import Security
from onboard.config import Config, dump_config, load_config
from onboard.core.types import Event, Phase, Request, Severity, Tick
from onboard.declared import to_mapping
from onboard.layers import ConfigError, Layer, parse_set
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.params import compose
from onboard.wire import Ack, Ask, Go, Mission, ReloadParams, SaveParams, SetParams, ShowParams, Stop
from tests.synthetic import mission
from tests.waiting import LONG, seconds_until
from tests.zenoh_sessions import free_port

TICK: Tick = next(tick for tick, _ in mission())
P = Phase
#: What becomes of an order: the phases that follow, each with the code of the event that tells it.
COURSES: dict[Ask, list[tuple[Phase, str]]] = {
    Mission(Request.TAKEOFF): [(P.TAKEOFF, "takeoff"), (P.HOLD, "hover")],
    Mission(Request.START): [
        (P.TAKEOFF, "start"),
        (P.APPROACH, "approach"),
        (P.LAND, "land"),
        (P.STOPPED, "completed"),
    ],
    Mission(Request.HOLD): [(P.HOLD, "hold")],
    Mission(Request.RETREAT): [(P.RETREAT_HOLD, "retreat_hold"), (P.HOLD, "hold")],
    Mission(Request.LAND): [(P.LAND, "land"), (P.STOPPED, "stopped")],
    Mission(Request.KILL): [(P.STOPPED, "killed")],
    Mission(Request.RESET): [(P.PREFLIGHT, "reset")],
    Go(P.TARE): [(P.TARE, "tare"), (P.ADVANCE, "advance")],
    Stop(): [(P.HOLD, "hold")],
}
_STEP = 0.06
_PERIOD = 0.01


class Craft:
    """A link, and what has come of it. ``answer`` may be replaced."""

    def __init__(self, vehicle: str, endpoint: str, security: Security | None = None, *, ticks: bool = True) -> None:
        self.vehicle, self.endpoint = vehicle, endpoint
        self.asked: list[Ask] = []
        self.answer: Callable[[Asked], Ack] = self.obey
        self.phase = P.PREFLIGHT
        self.courses = dict(COURSES)
        self._ticks, self._rounds = ticks, 0
        self.freezes = False
        """The loop stands still after the next order."""
        self.config = load_config("paper")
        self.files = self.config
        """What the files make."""
        self._course: deque[tuple[Phase, str]] = deque()
        self._due = 0.0
        self._waiting: deque[Asked] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._fly)
        settings = LinkSettings(vehicle=vehicle, listen=(endpoint,), plain=security is None)
        self.link = Link(settings, self._hear, security)

    def __enter__(self) -> Craft:
        self.link.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self.link.stop()

    def tell(self, code: str, severity: Severity = Severity.INFO) -> None:
        """Tell an event."""
        self.link.event(Event(time.monotonic_ns(), code, severity, f"This is {code}."))

    def stand_still(self) -> None:
        """Make no tick any more; the last is known to who listens now, and to nobody who comes later."""
        with Client(StationSettings(self.vehicle, (self.endpoint,), "witness", plain=True), timeout=LONG) as witness:
            self._ticks = False
            self._rounds = 0
            seconds_until(lambda: self._rounds > 1)
            seconds_until(lambda: _newest(witness) == self.link._newest)

    def commander(self) -> str:
        return self.link.state().commander

    def obey(self, asked: Asked) -> Ack:
        """Take on what is known, and do it in the next tick."""
        match asked.ask:
            case ShowParams():
                return asked.done(data=dump_config(self.config).encode())
            case SetParams(values=values):
                base = Layer("parameters in force", to_mapping(self.config))
                return self._swap(asked, lambda: compose(Config, [base, *map(parse_set, values)]))
            case ReloadParams():
                return self._swap(asked, lambda: self.files)
            case SaveParams():
                self.files = self.config
                return asked.done("the files make these parameters already")
        self._waiting.append(asked)
        return asked.accepted()

    def _swap(self, asked: Asked, make: Callable[[], Config]) -> Ack:
        try:
            self.config = make()
        except ConfigError as error:
            return asked.refused(str(error))
        return asked.done("revision 1")

    def _hear(self, asked: Asked) -> Ack:
        self.asked.append(asked.ask)
        return self.answer(asked)

    def _fly(self) -> None:
        index = 0
        while not self._ended.wait(_PERIOD):
            index += 1
            self._rounds += 1
            while self._waiting:
                asked = self._waiting.popleft()
                self._course = deque(self.courses.get(asked.ask, []))
                self._due = 0.0
                self._go_on()
                self.link.settle(asked, asked.done(f"Now in {self.phase}."))
            if self._course and time.monotonic() > self._due:
                self._go_on()
            if self._ticks and not (self.freezes and self.asked):
                now = time.monotonic_ns()
                outputs = replace(TICK.outputs, phase=self.phase, phase_time=1.0)
                self.link.tick(replace(TICK, index=index, inputs=replace(TICK.inputs, t_ns=now), outputs=outputs))

    def _go_on(self) -> None:
        if self._course:
            self.phase, code = self._course.popleft()
            self._due = time.monotonic() + _STEP
            self.tell(code)


def _newest(client: Client) -> Tick | None:
    telemetry = client.telemetry()
    return telemetry.tick if telemetry is not None else None


@contextmanager
def craft(vehicle: str = "x500") -> Iterator[Craft]:
    """A vehicle in plain mode at a free port."""
    with Craft(vehicle, f"tcp/127.0.0.1:{free_port()}") as flying:
        yield flying


def command(*arguments: str) -> int:
    """Run one command of a station in this process; gives its exit code."""
    parser = Parser(prog="pipewright")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (status, orders, lease, events, params, completion):
        group.add_parser(commands)
    options = parser.parse_args(arguments)
    code: int = options.run(options)
    return code


def process(*arguments: str, **more: object) -> subprocess.Popen[str]:
    """Run one command in a process of its own, as a person would."""
    program = "import sys; from groundstation.cli import main; sys.exit(main())"
    whole = [sys.executable, "-c", program, *arguments]
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | more
    return subprocess.Popen(whole, text=True, **streams)  # type: ignore[call-overload,no-any-return]


@contextmanager
def keeper(craft: Craft, *arguments: str, **more: object) -> Iterator[subprocess.Popen[str]]:
    """``lease take`` in a process of its own, until it commands; it is ended afterwards."""
    taking = process("lease", "take", *arguments, **more)
    try:
        seconds_until(lambda: craft.commander() != "" or taking.poll() is not None)
        assert taking.poll() is None, taking.communicate()
        yield taking
    finally:
        taking.kill()
        taking.communicate(timeout=LONG)
