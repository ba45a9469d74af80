"""The flight process: the configured devices, the core at 250 Hz on the wall clock, everything recorded."""

from __future__ import annotations

import gc
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from msgspec import Struct

from drivers.mailbox import Level, Notice
from onboard import attended
from onboard.clock import WallClock
from onboard.config import Config, dump_config
from onboard.core.params import Params
from onboard.core.step import State
from onboard.core.types import Event, Outputs, Phase, Request, Severity, Tick
from onboard.devices import FlightDevices
from onboard.errand import Errand
from onboard.loop import Loop
from onboard.recorder import Recorder
from onboard.records import Timing
from onboard.simulate import run_info
from sim_backend.world_messages import Look

#: A driver's notice as an event of the log.
_SEVERITY = {Level.INFO: Severity.INFO, Level.WARNING: Severity.WARNING, Level.ERROR: Severity.ERROR}
#: A mission that has not ended by then is broken off, s.
LONGEST = 900.0


class Options(Struct, frozen=True):
    """How a flight is run, beside its configuration."""

    mission: bool = False
    """Ask for the whole mission once preflight passes, and end when it is over."""
    duration: float | None = None
    """Ask for the landing after so many seconds."""
    attended: bool = False
    """Take requests as lines of standard input, and end in order when it closes."""


class _Sink:
    """Where the loop's ticks go: the recorder."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def tick(self, tick: Tick) -> None:
        self._recorder.tick(tick)

    def keyframe(self, index: int, t_ns: int, state: State) -> None:
        self._recorder.keyframe(index, t_ns, state)

    def timing(self, timing: Timing) -> None:
        self._recorder.timing(timing)

    def revision(self, index: int, t_ns: int, revision: int, config: Params) -> None:
        self._recorder.revision(index, t_ns, revision, config)


async def fly(
    config: Config,
    log: Path,
    options: Options,
    watch: Callable[[Outputs, float], None],
    say: Callable[[str], None],
) -> None:
    """Connect, run the loop until the flight is over, and record it to ``log``.

    ``watch`` sees outputs and time (s) of each tick; ``say`` gets sentences for the person at the terminal. Raises
    DeviceError when a device cannot be had, ConfigError for devices that cannot be flown.
    """
    devices = FlightDevices(config)
    try:
        await devices.start(say)
        await _Flight(config, options, devices, watch, say).run(log)
    finally:
        await devices.stop()
        for notice in devices.notices():
            say(notice.text)


class _Flight:
    """From the connected devices to the closed log."""

    def __init__(
        self,
        config: Config,
        options: Options,
        devices: FlightDevices,
        watch: Callable[[Outputs, float], None],
        say: Callable[[str], None],
    ) -> None:
        self._config, self._options, self._devices = config, options, devices
        self._watch, self._say = watch, say
        self._clock = WallClock()
        self._ready = False
        self._over = False

    async def run(self, log: Path) -> None:
        """Tick until the flight is over."""
        config = self._config
        info = run_info(config, realtime=True, started=datetime.now().astimezone().isoformat(timespec="seconds"))
        began = self._clock.now_ns()
        with Recorder(log, info, config, dump_config(config), t_ns=began, background=True) as self._recorder:
            self._devices.on_look = self._look
            self._loop = Loop(self._devices, self._clock, config, _Sink(self._recorder), timed=True)
            self._errand = Errand(self._loop.request, LONGEST) if self._options.mission else None
            self._first = self._clock.now_ns()
            # what lives by now lives to the end: the collector need not look at it in flight
            gc.collect()
            gc.freeze()
            if self._options.attended:
                attended.watch(self._order, self._end)
            try:
                await self._loop.run(self._on_tick)
            finally:
                gc.unfreeze()
                self._devices.on_look = None
        if self._recorder.error is not None:
            self._say(f"the log is incomplete: {self._recorder.error}")
        if self._recorder.dropped:
            self._say(f"{self._recorder.dropped} records were not written")

    def _on_tick(self, outputs: Outputs) -> bool:
        t = (self._clock.now_ns() - self._first) * 1e-9
        self._watch(outputs, t)
        self._devices.tell_phase(outputs.phase.value)
        for event in outputs.events:
            if event.severity is not Severity.INFO:
                self._say(event.text)
        for notice in self._devices.notices():
            self._tell(notice)
        if (
            not self._ready
            and outputs.phase is Phase.PREFLIGHT
            and outputs.estimate.valid
            and not outputs.verdict.reasons
        ):
            self._ready = True
            self._say("ready to fly: preflight passes")
        if self._devices.lost or self._over:
            return False
        return self._errand is None or self._errand.goes_on(outputs, t)

    def _end(self) -> None:
        self._over = True

    def _order(self, line: str) -> None:
        """A request from standard input, in a thread of its own."""
        try:
            self._loop.request(Request(line.strip()))
        except ValueError:
            self._say(f"no such request: {line.strip()!r}; there are: {', '.join(Request)}")

    def _look(self, look: Look) -> None:
        self._recorder.truth(look.t_ns, look.truth)

    def _tell(self, notice: Notice) -> None:
        source = notice.text.partition(":")[0]
        self._recorder.event(Event(notice.t_ns, source, _SEVERITY[notice.level], notice.text))
        self._say(notice.text)
