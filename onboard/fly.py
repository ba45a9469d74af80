"""The flight process: the configured devices, the core at 250 Hz on the wall clock, everything recorded."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from datetime import datetime
from math import inf
from pathlib import Path
from threading import Event as Flag
from threading import Thread

from msgspec import Struct

from onboard import attended
from onboard.clock import WallClock
from onboard.config import Config, dump_config
from onboard.core.params import Params
from onboard.core.types import Event, LinkState, Outputs, Phase, Request, Severity, Tick
from onboard.cpu import CpuMeter
from onboard.devices import FlightDevices
from onboard.ending import Ending, hand_over, signals
from onboard.errand import Errand
from onboard.logs import Logs
from onboard.loop import Loop
from onboard.params import Change
from onboard.preflight import Lateness
from onboard.recorder import Recorder
from onboard.records import DeviceReport, Timing
from onboard.reload import Reloader
from onboard.scheduling import Collector, ask
from onboard.shown import Shown
from onboard.simulate import run_info
from onboard.stations import Stations
from onboard.systemd import Notifier
from sim_backend.world_messages import Look

#: A driver's notice as an event of the log.
#: A mission that has not ended by then is broken off, s.
LONGEST = 900.0
_REPORT_NS = 1_000_000_000
_JOIN = 2.0
_GB, _PRUNE_PERIOD = 1e9, 600.0


class Options(Struct, frozen=True):
    """How a flight is run, beside its configuration."""

    mission: bool = False
    """Ask for the whole mission once preflight passes, and end when it is over."""
    duration: float | None = None
    """Ask for the landing after so many seconds."""
    attended: bool = False
    """Take requests as lines of standard input, and end in order when it closes."""


async def fly(
    config: Config,
    prepare: Callable[[], Path],
    options: Options,
    load: Callable[[], Config],
    save: Callable[[Params], Sequence[Change]],
    watch: Callable[[Outputs, float], None],
    say: Callable[[str], None],
) -> bool:
    """Connect, run the loop until the flight is over, and record it; False: broken off before it began.

    ``prepare`` gives the path of the log, once there is something to record; ``load`` reads the configuration again,
    when a reload is asked for, and ``save`` writes parameters into its files; ``watch`` sees outputs and time (s) of
    each tick; ``say`` gets sentences for the person at the terminal. Raises DeviceError when a device, or the link,
    cannot be had, ConfigError for devices that cannot be flown.
    """
    devices = FlightDevices(config)
    with Notifier() as notifier:
        flight = _Flight(config, options, devices, notifier, watch, say)
        with signals(flight.ending, flight.reload) as end:
            try:
                notifier.status("connecting")
                if options.attended:
                    attended.watch(flight.order, lambda: end("standard input has closed"))
                await devices.start(say)
                await flight.run(prepare(), load, save)
            finally:
                notifier.stopping()
                await devices.stop()
                for _, notice in devices.notices():
                    say(notice.text)
    return flight.began


class _Flight:
    """From the connected devices to the closed log."""

    def __init__(
        self,
        config: Config,
        options: Options,
        devices: FlightDevices,
        notifier: Notifier,
        watch: Callable[[Outputs, float], None],
        say: Callable[[str], None],
    ) -> None:
        self._config, self._options, self._devices, self._notifier = config, options, devices, notifier
        self._watch, self._say = watch, say
        self._clock = WallClock()
        self._loop: Loop | None = None
        self._reloader: Reloader | None = None
        self._stations: Stations | None = None
        self._shown: Shown | None = None
        self._lateness = Lateness()
        self._over = Flag()
        self._sentences: deque[str] = deque()
        self.began = False
        self._ready = self._reload_first = False
        self._errand: Errand | None = None
        self._report_ns = 0
        self._until = inf if options.duration is None else options.duration
        self.ending = Ending(self._request)

    def _request(self, request: Request) -> None:
        if self._loop is not None:
            self._loop.request(request)

    def order(self, line: str) -> None:
        """A request from standard input, in a thread of its own: its name, and after ``go`` that of a phase."""
        name, _, where = line.partition(" ")
        try:
            request, go = Request(name), Phase(where) if where else None
        except ValueError:
            self._say(f"no such request: {line!r}; there are: {', '.join(Request)}, and with go a phase")
            return
        if self._loop is not None:
            self._loop.request(request, go=go)

    def reload(self) -> None:
        """Read the configuration again; once there is a loop to put it into force."""
        self._notifier.reloading()
        if self._reloader is not None:
            self._reloader.ask()
        else:
            self._reload_first = True

    async def run(self, log: Path, load: Callable[[], Config], save: Callable[[Params], Sequence[Change]]) -> None:
        """Tick until the flight is over."""
        config, clock, devices = self._config, self._clock, self._devices
        info = run_info(config, realtime=True, started=datetime.now().astimezone().isoformat(timespec="seconds"))
        with Recorder(log, info, config, dump_config(config), t_ns=clock.now_ns(), background=True) as recorder:
            self._recorder = recorder
            sink = _Tee(recorder, self._tick, self._lateness.add)
            self._loop = loop = Loop(devices, clock, config, sink, timed=True, link=self._link)
            self._reloader = reloader = Reloader(lambda: self._read_again(load), loop)
            if self._reload_first:
                reloader.ask()
            logs = Logs(log.parent.absolute().parent, log.parent.name)
            if config.link.listen:
                self._shown = shown = Shown(loop, recorder, logs, self._lateness, self._link, clock.now_ns)
                stations = Stations(
                    config.link, loop, reloader, devices.autopilot, devices.servos, save, shown.by_order()
                )
                await asyncio.to_thread(stations.start)
                self._stations = stations
            Thread(target=self._prune, args=(logs, config.logs.budget), name="prune", daemon=True).start()
            if self._options.mission:
                self._errand = Errand(loop.request, LONGEST, lambda: bool(self._link().commander))
            devices.on_look = self._look
            self._cpu = CpuMeter()
            for sentence in ask(config.process):
                self._tell(Event(clock.now_ns(), "process", Severity.WARNING, sentence))
            self._first_ns = clock.now_ns()
            try:
                with Collector(config.process) as self._collector:
                    await loop.run(self._on_tick)
                self._notifier.stopping()  # from here on no tick tells systemd that we live
                if (command := self.ending.handed_over) is not None:
                    sentence = await hand_over(devices.autopilot, command, clock)
                    self._tell(Event(clock.now_ns(), "handed_over", Severity.WARNING, sentence))
            finally:
                devices.on_look = None
                self._over.set()
                self._cpu.stop()
                if self._stations is not None:
                    await asyncio.to_thread(self._stations.stop)
                self._reloader.close()
                self._reloader.join(_JOIN)
        if recorder.error is not None:
            self._say(f"the log is incomplete: {recorder.error}")
        if recorder.dropped:
            self._say(f"{recorder.dropped} records were not written")

    def _read_again(self, load: Callable[[], Config]) -> Config:
        config = load()
        if self._stations is not None:
            self._stations.renew()
        return config

    def _link(self) -> LinkState:
        return LinkState() if self._stations is None else self._stations.state()

    def _tick(self, tick: Tick) -> None:
        if self._stations is not None:
            self._stations.tick(tick)
        if self._shown is not None:
            self._shown.tick = tick

    def _prune(self, logs: Logs, budget: float) -> None:
        """Make room for logs, now and as this one grows, however long that takes."""
        while True:
            self._sentences.extend(logs.prune(budget * _GB))
            if self._over.wait(_PRUNE_PERIOD):
                return

    def _on_tick(self, outputs: Outputs) -> bool:
        now = self._clock.now_ns()
        t = (now - self._first_ns) * 1e-9
        self._notifier.tick(now)
        self._watch(outputs, t)
        self._devices.tell_phase(outputs.phase.value)
        goes_on = self._goes_on(outputs, t)
        self._tell_what_there_is(outputs, now)
        if now >= self._report_ns:
            self._report_ns = now + _REPORT_NS
            shares = {f"cpu.{part}": share for part, share in self._cpu.latest().items()}
            statistics = self._devices.statistics() | shares
            self._recorder.devices(DeviceReport(now, statistics))
            if self._shown is not None:
                self._shown.statistics = statistics
        self._collector.tick(outputs.phase)
        return goes_on

    def _goes_on(self, outputs: Outputs, t: float) -> bool:
        if t >= self._until:
            self._until = inf
            self.ending.ask(f"{t:.0f} s are over")
        if self._errand is not None and not self._errand.goes_on(outputs, t):
            self._errand = None
            self.ending.ask("the errand is over")
        return self.ending.goes_on(outputs, t) and not self._devices.lost

    def _tell_what_there_is(self, outputs: Outputs, now: int) -> None:
        if not self.began:
            self.began = True
            self._notifier.ready()
        for event in outputs.events:  # the recorder has these from the tick
            if event.severity is not Severity.INFO:
                self._say(event.text)
        notices = self._devices.notices()
        if self._stations is not None:
            self._stations.after(outputs)
            notices += [("link", notice) for notice in self._stations.notices()]
            for event in self._stations.cries():
                self._note(event)
        for device, notice in notices:
            self._tell(Event(notice.t_ns, device, Severity(notice.level), notice.text))
        assert self._reloader is not None
        if changes := self._reloader.events(now):
            self._notifier.ready()
        for event in (*self.ending.events(now), *changes):
            self._tell(event)
        while self._sentences:
            self._tell(Event(now, "log", Severity.WARNING, self._sentences.popleft()))
        for code, trouble in (("log", self._recorder.trouble()), ("systemd", self._notifier.trouble())):
            if trouble:
                self._tell(Event(now, code, Severity.ERROR, trouble))
        if outputs.phase is not Phase.PREFLIGHT:
            self._ready = False
        elif not self._ready and _passes(outputs):
            self._ready = True
            self._say("ready to fly: preflight passes")
        self._notifier.status(outputs.phase.value)

    def _tell(self, event: Event) -> None:
        if self._stations is not None:
            self._stations.event(event)
        self._note(event)

    def _note(self, event: Event) -> None:
        self._recorder.event(event)
        self._say(event.text)

    def _look(self, look: Look) -> None:
        self._recorder.truth(look.t_ns, look.truth)


class _Tee:
    """The recorder; of each tick, somebody else hears too."""

    def __init__(self, recorder: Recorder, hear: Callable[[Tick], None], hear_late: Callable[[float], None]) -> None:
        self._recorder, self._hear, self._hear_late = recorder, hear, hear_late
        self.keyframe, self.revision = recorder.keyframe, recorder.revision

    def tick(self, tick: Tick) -> None:
        self._recorder.tick(tick)
        self._hear(tick)

    def timing(self, timing: Timing) -> None:
        self._recorder.timing(timing)
        self._hear_late(timing.late)


def _passes(outputs: Outputs) -> bool:
    return outputs.estimate.valid and not outputs.verdict.reasons
