"""Five XC330 servos on one bus, driven by a thread of their own.

A fresh command makes one cycle: a sync write of the goals, then a (fast) sync read of everything that a cycle tells.
Both go through the servos' indirect addresses, so that each is one short packet. Goals leave only from a fresh
command; when commands stop, the bus is left silent, because the servos' own watchdog counts every packet, reads too.

The servos' homing offset stays 0 and angles are shifted here: with an offset in the servo, a trip of the bus watchdog
was seen to set the motor off (ROBOTIS-GIT/DynamixelSDK #584).
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from math import isfinite
from threading import Event, Thread
from time import monotonic_ns

from msgspec import Struct

from drivers import xc330
from drivers.dynamixel_bus import Bus, BusError, Corrupt, NoAnswer, Port, Refused, latency_hint
from drivers.dynamixel_settings import DynamixelSettings
from drivers.dynamixel_setup import HEALTH, MARK, READ, READ_AT, SHUT_DOWN, WRITE, WRITE_AT, Servo, SetUp
from drivers.mailbox import Level, Mailbox, MailboxCounts, Notice, Notices
from drivers.protocols import DeviceError
from drivers.samples import Five, JointMode, ServoCommand, ServoState
from drivers.spread import Spread, Summary
from drivers.xc330 import HardwareError, Item, Mode


class BusStatistics(Struct, frozen=True, gc=False):
    """How the bus has run since the start."""

    period: Summary
    """Between the beginnings of two cycles."""
    cycle: Summary
    """Length of a cycle: write and read."""
    histogram: tuple[tuple[float, int], ...]
    """Of the cycles' lengths: lower edge of each bin (s) and its count."""
    errors: dict[str, int]
    """Failed transactions by kind: no answer, corrupt, refused, adapter lost, and by servo."""
    fast: bool
    """The servos answer fast sync reads."""
    samples: MailboxCounts


_ATTEMPTS, _PATIENCE = 3, 0.05  # where time does not press: attempts, and how late an answer may be, s
_JOINTS = 3
_AFTER_TRIP = 0.06  # s: the servos look at their watchdog every 20 ms
_TELL_AGAIN_NS = 10_000_000_000
_WAKING = 0.3  # s that a servo needs to restart, generously


class Dynamixel:
    """ServoDevice on five XC330, real or emulated.

    ``clock`` gives nanoseconds and stamps the samples. ``command`` and ``latest`` may be called from any one thread.
    A servo that is lost in flight keeps its last values in the samples and shows ``HardwareError.SILENT``.
    """

    def __init__(self, settings: DynamixelSettings, clock: Callable[[], int] = monotonic_ns) -> None:
        ids = [servo.id for servo in settings.servos]
        if len(set(ids)) < len(ids):
            raise DeviceError(f"servo bus: the ids {ids} are not all different")
        if settings.baud not in xc330.BAUDS:
            raise DeviceError(f"servo bus: baud {settings.baud}; want one of {', '.join(map(str, xc330.BAUDS))}")
        self._settings = settings
        self._clock = clock
        self._servos = tuple(Servo(index, servo) for index, servo in enumerate(settings.servos))
        self._set_up = SetUp(settings, self._servos, self._tell)
        self._bus: Bus | None = None
        self._fast = True
        self._thread: Thread | None = None
        self._stopping = False
        self._wake = Event()
        self._command: tuple[ServoCommand, int] | None = None
        self._commanded_ns = 0
        self._goals_ns = 0
        self._left_silent = False
        self._one_by_one = False
        self._reopen_ns = 0
        self._health_ns = 0
        self._health_turn = 0
        self._reading_ns = 0
        self._began_ns: int | None = None
        self._box: Mailbox[ServoState] = Mailbox()
        self._notices = Notices()
        self._told: dict[str, tuple[int, int]] = {}
        self._period, self._cycle = Spread(), Spread()
        self._errors: Counter[str] = Counter()

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
            self._tell_once("finite", Level.ERROR, "a command that is not finite was not sent")
            return
        self._command = (command, self._clock())
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
            dict(self._errors),
            self._fast,
            self._box.counts(self._clock()),
        )

    # -- connecting -----------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        settings = self._settings
        self._bus = bus = Bus(Port(settings.port, settings.baud, settings.reply_margin))
        bus.patient(_ATTEMPTS, _PATIENCE)
        if hint := latency_hint(settings.port):
            self._tell(Level.WARNING, hint)
        self._set_up.find(bus)
        for servo in self._servos:
            try:
                self._set_up.set_up(bus, servo)
                servo.heard_ns = self._clock()
            except BusError as error:
                raise DeviceError(f"servo bus: {servo.name}, while it was being set up: {error}") from error
        self._fast = self._set_up.probe(bus)
        bus.patient(1, settings.reply_margin)

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    # -- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:
            # Nothing more is sent, so that the servos' watchdog stops them.
            self._tell(Level.ERROR, f"the servo driver has failed: {error!r}")
            raise

    def _work(self) -> None:
        while not self._stopping:
            self._wake.wait(self._rest())
            self._wake.clear()
            command = self._fresh()
            try:
                if self._bus is None:
                    self._reopen()
                else:
                    self._turn(self._bus, command)
            except OSError as error:
                self._lose(error)
        if self._bus is not None:
            with suppress(OSError):
                self._relax(self._bus)

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
        rest = self._settings.period - (self._clock() - self._reading_ns) * 1e-9
        return max(rest, 0.0)

    def _expecting(self) -> bool:
        return any(servo.engaged for servo in self._servos)

    def _turn(self, bus: Bus, command: ServoCommand | None) -> None:
        now = self._clock()
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
                self._make_sure(bus)
        if self._began_ns is not None:
            self._period.add(now - self._began_ns)
        self._began_ns = now
        try:
            if command is not None:
                self._apply(bus, command, now)
        except BusError as error:
            self._tell_once("apply", Level.WARNING, f"a command did not reach servo {error.servo}: {error}")
            self._count(error)
        try:
            self._read(bus)
        except BusError as error:
            self._count(error)
        self._cycle.add(self._clock() - now)
        self._tend(bus, now)

    def _leave_silent(self, quiet: float) -> None:
        if self._left_silent:
            return
        self._left_silent = True
        # The next cycle's period would tell of the pause, not of the bus.
        self._began_ns = None
        self._tell(
            Level.ERROR,
            f"no command for {quiet * 1e3:.0f} ms: the bus is left silent so that the servos' watchdog stops them",
        )

    def _make_sure(self, bus: Bus) -> None:
        """The 330 size was seen to run on after the watchdog's trip: take the torque of those in current mode."""
        servos = [servo for servo in self._servos if servo.engaged and servo.mode is Mode.CURRENT]
        self._all(bus, servos, xc330.TORQUE_ENABLE, lambda servo: 0)
        for servo in servos:
            servo.engaged, servo.interrupted = False, True

    # -- commands -------------------------------------------------------------------------------------------------

    def _apply(self, bus: Bus, command: ServoCommand, now: int) -> None:
        if command.mode is JointMode.OFF:
            if any(servo.engaged or servo.torque_on for servo in self._servos):
                self._relax(bus)
            return
        joint = Mode.CURRENT if command.mode is JointMode.TORQUE else Mode.CURRENT_BASED_POSITION
        late = [
            servo
            for servo in self._servos
            if servo.answers
            and not servo.suspect
            and not servo.error & SHUT_DOWN
            and not (servo.engaged and servo.mode is self._mode_of(servo, joint))
        ]
        if late:
            self._engage(bus, late, joint, now)
        dt = min((now - self._goals_ns) * 1e-9, 0.1)
        self._goals_ns = now
        goals = {
            servo.settings.id: self._goal(servo, command, now, dt)
            for servo in self._servos
            if servo.engaged and servo.answers
        }
        if goals:
            bus.sync_write(WRITE_AT, WRITE.size, goals)

    def _mode_of(self, servo: Servo, joint: Mode) -> Mode:
        return joint if servo.index < _JOINTS else Mode.CURRENT_BASED_POSITION

    def _goal(self, servo: Servo, command: ServoCommand, now: int, dt: float) -> bytes:
        if servo.mode is Mode.CURRENT:
            torque = command.torque[servo.index]
            if servo.ramp_ns is not None:
                share = (now - servo.ramp_ns) * 1e-9 / self._settings.homing_time
                torque *= min(share, 1.0)
                if share >= 1.0:
                    servo.ramp_ns = None
            current = servo.settings.sign * torque / servo.settings.torque_constant
            return WRITE.pack(servo.limited(current), servo.counts(servo.position))
        goal = command.position[servo.index]
        if servo.homing is not None:
            most = self._settings.homing_speed * dt
            servo.homing += min(max(goal - servo.homing, -most), most)
            if servo.homing == goal:
                servo.homing = None
                self._tell(Level.INFO, f"{servo.name} is back at its goal")
            else:
                goal = servo.homing
        limit = command.current_limit if servo.index < _JOINTS else servo.settings.current_limit
        return WRITE.pack(abs(servo.limited(limit)), servo.counts(goal))

    def _engage(self, bus: Bus, servos: Sequence[Servo], joint: Mode, now: int) -> None:
        """Bring servos to the mode of the command with torque on and the watchdog armed; no goal is given yet."""
        switched = [servo for servo in servos if servo.mode is not self._mode_of(servo, joint)]
        if switched:
            self._all(bus, switched, xc330.TORQUE_ENABLE, lambda servo: 0)
            for servo in switched:
                servo.engaged = False
                servo.mode = None
            self._all(bus, switched, xc330.OPERATING_MODE, lambda servo: self._mode_of(servo, joint))
            for servo in switched:
                if bus.read(servo.settings.id, xc330.OPERATING_MODE) != self._mode_of(servo, joint):
                    raise Refused(servo.settings.id, "it did not take the operating mode")
                self._set_up.shape(bus, servo)
                servo.mode = self._mode_of(servo, joint)
        # A watchdog that has tripped locks the goals.
        self._all(bus, servos, xc330.BUS_WATCHDOG, lambda servo: 0)
        # A servo enters current mode with its current limit as the goal.
        rest = {servo.settings.id: WRITE.pack(0, servo.counts(servo.position)) for servo in servos}
        bus.sync_write(WRITE_AT, WRITE.size, rest)
        self._all(bus, servos, xc330.TORQUE_ENABLE, lambda servo: 1)
        units = round(self._settings.watchdog / xc330.S_PER_WATCHDOG_UNIT)
        self._all(bus, servos, xc330.BUS_WATCHDOG, lambda servo: units)
        for servo in servos:
            servo.engaged = True
            servo.homing = servo.position if servo.interrupted and servo.mode is not Mode.CURRENT else None
            servo.ramp_ns = now if servo.interrupted and servo.mode is Mode.CURRENT else None
            servo.interrupted = False

    def _relax(self, bus: Bus) -> None:
        """Torque off on all servos."""
        self._all(bus, self._servos, xc330.TORQUE_ENABLE, lambda servo: 0)
        self._all(bus, self._servos, xc330.BUS_WATCHDOG, lambda servo: 0)
        for servo in self._servos:
            servo.engaged = servo.interrupted = False

    def _all(self, bus: Bus, servos: Iterable[Servo], item: Item, value: Callable[[Servo], int]) -> None:
        if data := {servo.settings.id: item.encode(value(servo)) for servo in servos}:
            bus.sync_write(item.address, item.size, data)

    # -- samples --------------------------------------------------------------------------------------------------

    def _read(self, bus: Bus) -> None:
        self._reading_ns = now = self._clock()
        asked = [servo for servo in self._servos if servo.answers]
        if self._one_by_one:
            self._one_by_one = False
            heard = [self._read_alone(bus, servo) for servo in asked]
        else:
            heard = self._read_together(bus, [servo for servo in asked if not servo.suspect])
            # One of them in a cycle, so that a cycle waits for one missing answer at most.
            suspects = [servo for servo in asked if servo.suspect]
            if suspects:
                heard.append(self._read_alone(bus, min(suspects, key=lambda servo: servo.asked)))
        lost = [servo for servo in asked if servo.suspect and now - servo.heard_ns > self._settings.silent_after * 1e9]
        if lost:
            self._miss(lost)
        if any(heard):
            self._publish()

    def _read_together(self, bus: Bus, servos: Sequence[Servo]) -> list[bool]:
        if not servos:
            return []
        try:
            answers = bus.sync_read(READ_AT, READ.size, [servo.settings.id for servo in servos], self._fast)
        except BusError as error:
            # Who is at fault shows when each is asked by itself, in the next cycle.
            self._one_by_one = True
            self._tell_once("read", Level.WARNING, f"a reading of the servos failed: {error}")
            raise
        return [self._take(servo, answer.data) for servo, answer in zip(servos, answers, strict=True)]

    def _read_alone(self, bus: Bus, servo: Servo) -> bool:
        servo.asked += 1
        try:
            answer = bus.read_bytes(servo.settings.id, READ_AT, READ.size)
        except BusError as error:
            self._count(error)
            return False
        return self._take(servo, answer.data)

    def _miss(self, lost: Sequence[Servo]) -> None:
        for servo in lost:
            self._give_up(servo)
        names = ", ".join(servo.name for servo in lost)
        self._tell(
            Level.ERROR,
            f"{names} does not answer any more; the others go on"
            if any(servo.answers for servo in self._servos)
            else "no servo answers any more: is the 5 V supply on, and is the data cable plugged in?",
        )

    def _give_up(self, servo: Servo) -> None:
        servo.answers = False
        servo.interrupted = servo.interrupted or servo.engaged
        servo.engaged = servo.suspect = False
        servo.velocity = servo.current = 0.0
        servo.error |= HardwareError.SILENT
        servo.torque_on = False
        servo.retry_ns = self._clock() + round(self._settings.retry * 1e9)

    def _take(self, servo: Servo, data: bytes) -> bool:
        """Take what a servo told; False if it has forgotten what it is to tell."""
        mark, error, torque, watchdog, current, velocity, counts = READ.unpack(data)
        if mark != MARK:
            self._tell(Level.ERROR, f"{servo.name} has restarted by itself: is its supply steady?")
            self._give_up(servo)
            servo.retry_ns = 0
            return False
        servo.suspect, servo.heard_ns = False, self._reading_ns
        sign = servo.settings.sign
        servo.position = servo.angle(counts)
        servo.velocity = sign * velocity * xc330.RAD_S_PER_UNIT
        servo.current = sign * current * xc330.AMPERE_PER_UNIT
        servo.torque_on = bool(torque)
        if error != servo.error:
            self._judge(servo, error)
        if servo.engaged and watchdog == xc330.TRIPPED:
            self._tell_once(
                "watchdog", Level.WARNING, "the bus watchdog has stopped the servos; the next command starts them again"
            )
            servo.engaged, servo.interrupted = False, True
        elif servo.engaged and not torque:
            if not error:
                self._tell_once(f"torque {servo.index}", Level.ERROR, f"{servo.name} has lost its torque")
            servo.engaged, servo.interrupted = False, True
        return True

    def _judge(self, servo: Servo, error: int) -> None:
        new = error & ~servo.error
        servo.error = error
        if not new:
            return
        words = f"{servo.name}: {xc330.error_words(new)}"
        if not error & HardwareError.OVERLOAD:
            self._tell(Level.ERROR, words)
        elif servo.reboots < self._settings.reboots:
            servo.reboot_ns = self._clock() + round(self._settings.reboot_delay * 1e9)
            self._tell(Level.ERROR, f"{words}; its torque is off, it is rebooted in {self._settings.reboot_delay:g} s")
        else:
            self._tell(Level.ERROR, f"{words}; its torque stays off after {servo.reboots} reboots")

    def _publish(self) -> None:
        servos = self._servos
        now = self._reading_ns
        self._box.put(
            ServoState(
                t_ns=now,
                position=_five(servo.position for servo in servos),
                velocity=_five(servo.velocity for servo in servos),
                current=_five(servo.current for servo in servos),
                voltage=_five(servo.voltage for servo in servos),
                temperature=_five(servo.temperature for servo in servos),
                error=(servos[0].error, servos[1].error, servos[2].error, servos[3].error, servos[4].error),
                torque_on=all(servo.torque_on for servo in servos),
            ),
            now,
        )

    # -- now and then ---------------------------------------------------------------------------------------------

    def _tend(self, bus: Bus, now: int) -> None:
        """At most one thing beside the cycle: reboot, look for a lost servo, or look at the health of one."""
        for servo in self._servos:
            try:
                if servo.reboot_ns is not None and servo.answers and now >= servo.reboot_ns:
                    self._reboot(bus, servo, now)
                    return
                if not servo.answers and now >= servo.retry_ns:
                    servo.retry_ns = now + round(self._settings.retry * 1e9)
                    self._revive(bus, servo)
                    return
            except Refused as error:
                self._tell_once(f"set up {servo.index}", Level.ERROR, f"{servo.name}: {error}")
                return
            except BusError:
                return
        if now >= self._health_ns:
            self._health_ns = now + round(self._settings.health * 1e9)
            self._health_turn = (self._health_turn + 1) % len(self._servos)
            servo = self._servos[self._health_turn]
            if servo.answers and not servo.suspect and not self._one_by_one:
                self._look_at_health(bus, servo)

    def _look_at_health(self, bus: Bus, servo: Servo) -> None:
        try:
            answer = bus.read_bytes(servo.settings.id, xc330.PRESENT_VOLTAGE.address, HEALTH.size)
        except BusError as error:
            self._count(error)
            return
        volts, degrees = HEALTH.unpack(answer.data)
        servo.voltage, servo.temperature = volts * xc330.VOLT_PER_UNIT, float(degrees)

    def _reboot(self, bus: Bus, servo: Servo, now: int) -> None:
        servo.reboot_ns = None
        servo.reboots += 1
        self._tell(Level.WARNING, f"{servo.name}: reboot {servo.reboots} of {self._settings.reboots}")
        bus.reboot(servo.settings.id)
        self._give_up(servo)
        servo.interrupted = True
        servo.retry_ns = now + round(_WAKING * 1e9)

    def _revive(self, bus: Bus, servo: Servo) -> None:
        """Take a lost servo back if it answers; its place is the one nearest to where it was last seen."""
        name = servo.settings.id
        mark = bus.read_bytes(name, READ_AT, 1).data[0]
        if mark != MARK:
            self._set_up.prepare(bus, servo, servo.position)
        servo.answers = True
        servo.heard_ns = self._clock()
        servo.error = 0
        self._tell(Level.INFO, f"{servo.name} answers again{', restarted' if mark != MARK else ''}")

    def _lose(self, error: OSError) -> None:
        self._errors["adapter lost"] += 1
        self._tell(Level.ERROR, f"the servo bus adapter on {self._settings.port} is gone ({error.strerror or error})")
        self._close()
        self._began_ns = None
        for servo in self._servos:
            self._give_up(servo)
            servo.retry_ns = 0

    def _reopen(self) -> None:
        now = self._clock()
        if now < self._reopen_ns:
            return
        settings = self._settings
        self._reopen_ns = now + round(settings.retry * 1e9)
        try:
            self._bus = Bus(Port(settings.port, settings.baud, settings.reply_margin))
        except DeviceError:
            return
        self._tell(Level.INFO, f"the servo bus adapter on {settings.port} is back")

    # -- telling --------------------------------------------------------------------------------------------------

    def _count(self, error: BusError) -> None:
        kinds = {NoAnswer: "no answer", Corrupt: "corrupt"}
        self._errors[kinds.get(type(error), "refused")] += 1
        for servo in self._servos:
            if servo.settings.id == error.servo:
                self._errors[servo.name] += 1
                servo.suspect = True

    def _tell(self, level: Level, text: str) -> None:
        self._notices.tell(self._clock(), level, text)

    def _tell_once(self, key: str, level: Level, text: str) -> None:
        """Tell it, unless the same was told within the last ten seconds; then count it for the next time."""
        now = self._clock()
        since, more = self._told.get(key, (now - _TELL_AGAIN_NS, 0))
        if now - since < _TELL_AGAIN_NS:
            self._told[key] = (since, more + 1)
            return
        self._told[key] = (now, 0)
        self._tell(level, f"{text} (and {more} times since it was last told)" if more else text)


def _five(values: Iterable[float]) -> Five:
    a, b, c, d, e = values
    return (a, b, c, d, e)
