"""Five XC330 servos on one bus, driven by a thread of their own.

A fresh command makes one cycle: a sync write of the goals, then a (fast) sync read of everything that a cycle tells.
Both go through the servos' indirect addresses, so that each is one short packet. Goals leave only from a fresh
command; when commands stop, the bus is left silent, because the servos' own watchdog counts every packet, reads too.

The servos' homing offset stays 0 and angles are shifted here: with an offset in the servo, a trip of the bus watchdog
was seen to set the motor off (ROBOTIS-GIT/DynamixelSDK #584).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from threading import Event, Thread
from time import monotonic_ns

from msgspec import Struct

from drivers import xc330
from drivers.dynamixel_bus import Bus, BusError, Port, latency_hint
from drivers.dynamixel_goals import Goals
from drivers.dynamixel_settings import DynamixelSettings
from drivers.dynamixel_setup import Servo, SetUp
from drivers.dynamixel_watch import Watch
from drivers.mailbox import Level, Mailbox, MailboxCounts, Notice, Notices, Teller
from drivers.protocols import DeviceError
from drivers.samples import ServoCommand, ServoState
from drivers.spread import Spread, Summary


class BusStatistics(Struct, frozen=True, gc=False):
    """How the bus has run since the start."""

    period: Summary
    """Between the beginnings of two cycles."""
    cycle: Summary
    """Length of a cycle: write and read."""
    histogram: tuple[tuple[float, int], ...]
    """Of the cycles' lengths: lower edge of each bin (s) and its count."""
    errors: dict[str, int]
    """Failed transactions by kind: no answer, corrupt, refused, adapter lost."""
    blamed: dict[str, int]
    """Those of them that one servo was asked for, by servo."""
    late: int
    """Answers that came after their time; each was counted as missing."""
    fast: bool
    """The servos answer fast sync reads."""
    samples: MailboxCounts


_ATTEMPTS, _PATIENCE = 3, 0.05  # where time does not press: attempts, and how late an answer may be, s
_AFTER_TRIP = 0.06  # s: the servos look at their watchdog every 20 ms


class Dynamixel:
    """ServoDevice on five XC330, real or emulated.

    ``clock`` gives nanoseconds and stamps the samples; ``port`` opens the port, now and after each loss. ``command``
    and ``latest`` may be called from any one thread, ``insist`` and ``latest`` from any.
    A servo that is lost in flight keeps its last values in the samples and shows ``HardwareError.SILENT``.
    """

    def __init__(
        self,
        settings: DynamixelSettings,
        clock: Callable[[], int] = monotonic_ns,
        port: Callable[[str, int, float], Port] = Port,
    ) -> None:
        ids = [servo.id for servo in settings.servos]
        if len(set(ids)) < len(ids):
            raise DeviceError(f"servo bus: the ids {ids} are not all different")
        if settings.baud not in xc330.BAUDS:
            raise DeviceError(f"servo bus: baud {settings.baud}; want one of {', '.join(map(str, xc330.BAUDS))}")
        self._settings = settings
        self._clock = clock
        self._port = port
        self._servos = tuple(Servo(index, servo) for index, servo in enumerate(settings.servos))
        self._notices = Notices()
        self._teller = Teller(self._notices, clock, "servo bus")
        self._set_up = SetUp(settings, self._servos, self._teller.tell)
        self._goals = Goals(settings, self._servos, self._set_up, self._teller)
        self._watch = Watch(settings, self._servos, self._set_up, self._teller, clock, lambda: self._off_due)
        self._bus: Bus | None = None
        self._thread: Thread | None = None
        self._stopping = False
        self._wake = Event()
        self._late = 0
        self._command: tuple[ServoCommand, int] | None = None
        self._off = False
        self._off_due = False
        self._commanded_ns = 0
        self._left_silent = False
        self._reopen_ns = 0
        self._began_ns: int | None = None
        self._box: Mailbox[ServoState] = Mailbox()
        self._period, self._cycle = Spread(), Spread()

    # -- life cycle -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Open the port, find and set up the servos, and begin to read them.

        Raises DeviceError: no port, no permission, in use; servos that do not answer, are no XC330-M288-T, or do not
        take a setting.
        """
        try:
            await asyncio.to_thread(self._connect)
        except BaseException:
            self._close()
            raise
        self._stopping = False
        self._thread = Thread(target=self._run, name="dynamixel", daemon=True)
        self._thread.start()

    async def stop(self) -> None:
        """Switch torque off and release the port. Safe to call twice."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._stopping = True
            self._wake.set()
            await asyncio.to_thread(thread.join)
        self._close()

    # -- what never waits -----------------------------------------------------------------------------------------

    def latest(self) -> ServoState | None:
        """Newest cycle, or None before the first."""
        return self._box.latest()

    def command(self, command: ServoCommand) -> None:
        """Hand over the goals for one cycle; it begins at once. What is not finite is not sent, and told.

        Raises DeviceError before ``start`` and after ``stop``.
        """
        if self._thread is None:
            raise DeviceError("servo bus: command() before start() or after stop()")
        if not isfinite(sum(command.torque) + sum(command.position) + command.current_limit):
            self._teller.once("finite", Level.ERROR, "a command that is not finite was not sent")
            return
        self._command = (command, self._clock())
        self._wake.set()

    def insist(self, off: bool) -> None:
        """From any thread: torque off in the bus's next packet, and off whatever is commanded, until False is given.

        With each call the packet is sent again, whatever the servos tell: nothing answers it. Raises DeviceError
        before ``start`` and after ``stop``.
        """
        if self._thread is None:
            raise DeviceError("servo bus: insist() before start() or after stop()")
        self._off_due = self._off = off
        self._wake.set()

    def notices(self) -> tuple[Notice, ...]:
        """Sentences since the last call."""
        return self._notices.take()

    def statistics(self) -> BusStatistics:
        """How the bus has run since the start."""
        return BusStatistics(
            self._period.summary(),
            self._cycle.summary(),
            self._cycle.histogram(),
            dict(self._watch.errors),
            dict(self._watch.blamed),
            self._late + (bus.late if (bus := self._bus) is not None else 0),
            self._set_up.fast,
            self._box.counts(self._clock()),
        )

    # -- connecting -----------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        settings = self._settings
        self._bus = bus = Bus(self._port(settings.port, settings.baud, settings.reply_margin))
        bus.patient(_ATTEMPTS, _PATIENCE)
        if hint := latency_hint(settings.port):
            self._teller.tell(Level.WARNING, hint)
        self._set_up.find(bus)
        for servo in self._servos:
            try:
                self._set_up.set_up(bus, servo)
                servo.heard_ns = self._clock()
            except BusError as error:
                raise DeviceError(f"servo bus: {servo.name}, while it was being set up: {error}") from error
        self._set_up.probe(bus)
        bus.patient(1, settings.reply_margin)

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            self._late += bus.late
            bus.close()

    # -- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:
            # Nothing more is sent, so that the servos' watchdog stops them.
            self._teller.tell(Level.ERROR, f"the servo driver has failed: {error!r}")
            raise

    def _work(self) -> None:
        while not self._stopping:
            self._wake.wait(self._rest())
            self._wake.clear()
            self._once()
        if self._bus is not None:
            with suppress(OSError):
                self._goals.relax(self._bus)

    def _once(self) -> None:
        command = self._fresh()
        try:
            if self._bus is None:
                self._reopen()
            else:
                self._turn(self._bus, command)
        except OSError as error:
            self._lose(error)

    def _fresh(self) -> ServoCommand | None:
        """The command that waits, if it is not from before this process was stopped."""
        given, self._command = self._command, None
        if given is None or self._clock() - given[1] > self._settings.patience * 1e9:
            return None
        return given[0]

    def _rest(self) -> float:
        """How long to wait for a command, s."""
        if self._bus is None:
            return self._settings.retry
        if self._expecting():
            return 1.5 * self._settings.period
        rest = self._settings.period - (self._clock() - self._watch.reading_ns) * 1e-9
        return max(rest, 0.0)

    def _expecting(self) -> bool:
        return any(servo.engaged for servo in self._servos)

    def _turn(self, bus: Bus, command: ServoCommand | None) -> None:
        now = self._clock()
        if self._off:
            command = None
            self._let_go(bus)
        if command is not None:
            self._commanded_ns = now
            self._left_silent = False
        elif self._expecting():
            quiet = (now - self._commanded_ns) * 1e-9
            until = self._settings.patience + 1.5 * self._settings.period + self._settings.watchdog + _AFTER_TRIP
            if self._settings.patience < quiet < until:
                self._leave_silent(quiet)
                return
            if quiet >= until and self._left_silent:
                self._left_silent = False
                self._goals.stop_current(bus)
        if self._began_ns is not None:
            self._period.add(now - self._began_ns)
        self._began_ns = now
        try:
            if command is not None:
                self._goals.apply(bus, command, now)
        except BusError as error:
            self._teller.once("apply", Level.WARNING, f"a command did not reach servo {error.servo}: {error}")
            self._watch.count(error)
        try:
            sample = self._watch.read(bus)
            if sample is not None:
                self._box.put(sample, sample.t_ns)
        except BusError as error:
            self._watch.count(error)
        self._cycle.add(self._clock() - now)
        self._watch.tend(bus, now)

    def _let_go(self, bus: Bus) -> None:
        """Torque off, if it is due or any servo has not taken it."""
        if self._off_due or any(servo.engaged or servo.torque_on for servo in self._servos):
            self._off_due = False
            try:
                self._goals.relax(bus)
            except BusError as error:
                self._off_due = True
                self._teller.once("off", Level.ERROR, f"torque could not be switched off: {error}; trying again")

    def _leave_silent(self, quiet: float) -> None:
        if self._left_silent:
            return
        self._left_silent = True
        # The next cycle's period would tell of the pause, not of the bus.
        self._began_ns = None
        self._teller.tell(
            Level.ERROR,
            f"no command for {quiet * 1e3:.0f} ms: the bus is left silent so that the servos' watchdog stops them",
        )

    def _lose(self, error: OSError) -> None:
        self._watch.errors["adapter lost"] += 1
        self._teller.tell(
            Level.ERROR, f"the adapter on {self._settings.port} is gone ({error.strerror or error}); plug it in again"
        )
        self._close()
        self._began_ns = None
        self._watch.adapter_lost()

    def _reopen(self) -> None:
        now = self._clock()
        if now < self._reopen_ns:
            return
        settings = self._settings
        self._reopen_ns = now + round(settings.retry * 1e9)
        try:
            self._bus = Bus(self._port(settings.port, settings.baud, settings.reply_margin))
        except DeviceError:
            return
        self._off_due = self._off
        self._teller.tell(Level.INFO, f"the adapter on {settings.port} is back")
