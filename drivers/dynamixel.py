"""Five XC330 servos on one bus, driven by a thread of their own.

A fresh command makes one cycle: a sync write of the goals, then a (fast) sync read of everything that a cycle tells.
Both go through the servos' indirect addresses, so that each is one short packet. Goals leave only from a fresh
command; when commands stop, the bus is left silent, because the servos' own watchdog counts every packet, reads too.

The servos' homing offset stays 0 and angles are shifted here: with an offset in the servo, a trip of the bus watchdog
was seen to set the motor off (ROBOTIS-GIT/DynamixelSDK #584).
"""

from __future__ import annotations

import asyncio
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from math import isfinite
from threading import Event, Thread
from time import monotonic_ns
from typing import Annotated, Literal

from msgspec import Meta, Struct

from drivers import xc330
from drivers.dynamixel_bus import Bus, BusError, Corrupt, NoAnswer, Port, Refused, latency_hint
from drivers.mailbox import Level, Mailbox, MailboxCounts, Notice, Notices
from drivers.protocols import DeviceError
from drivers.samples import SERVO_NAMES, Five, JointMode, ServoCommand, ServoState
from drivers.spread import Spread, Summary
from drivers.xc330 import HardwareError, Item, Mode


def _meta(unit: str, doc: str, low: float, high: float) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


Gain = Annotated[int, _meta("1", "of the position loop, in the control table's scale", 0, 16_383)]


class ServoSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """One servo: where it is on the bus, how it is mounted, what it may do."""

    id: Annotated[int, _meta("1", "on the bus", 0, 252)]
    zero: Annotated[int, _meta("counts", "encoder reading at angle 0", -1_000_000, 1_000_000)] = 2048
    sign: Annotated[Literal[1, -1], Meta(description="1: the angle grows with the encoder's counts")] = 1
    center: Annotated[float, _meta("rad", "when switched on, the angle is within half a turn of this", -6.3, 6.3)] = 0.0
    torque_constant: Annotated[
        float, _meta("N m/A", "torque at the output per supply current; stall 0.93 N m at 1.80 A", 0.05, 5.0)
    ] = 0.93 / 1.80
    current_limit: Annotated[
        float, _meta("A", "no goal exceeds it; below what trips the overload shutdown", 0, 2.352)
    ] = 1.6
    profile_velocity: Annotated[float, _meta("rad/s", "in position mode; 0: no profile", 0.0, 49.0)] = 0.0
    profile_acceleration: Annotated[float, _meta("rad/s^2", "in position mode; 0: no profile", 0.0, 12_000.0)] = 0.0
    gains: tuple[Gain, Gain, Gain] | None = None
    """P, I, D of the position loop; None leaves those of the firmware."""


class DynamixelSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The bus, its servos in the order of ``SERVO_NAMES``, and how faults are met."""

    port: Annotated[str, Meta(description="serial port: /dev/servos, /dev/ttyUSB0, ...")]
    servos: tuple[ServoSettings, ServoSettings, ServoSettings, ServoSettings, ServoSettings] = (
        ServoSettings(1),
        ServoSettings(2),
        ServoSettings(3),
        ServoSettings(4),
        ServoSettings(5),
    )
    baud: Annotated[int, Meta(description="57600, 115200 or 1 to 4 million, as set in the servos")] = 1_000_000
    period: Annotated[float, _meta("s", "between cycles while nothing is commanded", 0.001, 0.1)] = 0.004
    patience: Annotated[float, _meta("s", "without a command the bus is left silent after this", 0.005, 1.0)] = 0.030
    watchdog: Annotated[float, _meta("s", "silence that makes the servos stop; steps of 0.02", 0.02, 2.54)] = 0.10
    reply_margin: Annotated[float, _meta("s", "answers may be late by this", 0.0005, 0.05)] = 0.004
    silent_after: Annotated[float, _meta("s", "without an answer until a servo counts as silent", 0.01, 1.0)] = 0.05
    retry: Annotated[float, _meta("s", "between attempts to find a lost servo or adapter", 0.05, 10.0)] = 0.25
    health: Annotated[float, _meta("s", "between looks at one servo's voltage and temperature", 0.01, 5.0)] = 0.05
    temperature_limit: Annotated[int, _meta("degC", "the servo shuts down above it", 0, 100)] = 70
    reboot_delay: Annotated[float, _meta("s", "from an overload shutdown to the reboot", 0.1, 60.0)] = 1.0
    reboots: Annotated[int, _meta("1", "after overload, for each servo and start", 0, 100)] = 3
    homing_speed: Annotated[float, _meta("rad/s", "back to the goal after an interruption", 0.01, 5.0)] = 0.5
    homing_time: Annotated[float, _meta("s", "torque grows back in this time after an interruption", 0.01, 10.0)] = 1.0


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


# What a cycle reads and writes, laid side by side by the indirect addresses. The status return level is there as a
# mark: it is always 2, and a servo that has rebooted has forgotten its map and shows 0.
_MARK = 2
_READ_ITEMS = (
    xc330.STATUS_RETURN_LEVEL,
    xc330.HARDWARE_ERROR,
    xc330.TORQUE_ENABLE,
    xc330.BUS_WATCHDOG,
    xc330.PRESENT_CURRENT,
    xc330.PRESENT_VELOCITY,
    xc330.PRESENT_POSITION,
)
_WRITE_ITEMS = (xc330.GOAL_CURRENT, xc330.GOAL_POSITION)
_READ = struct.Struct("<BBBbhii")
_WRITE = struct.Struct("<hi")
_READ_AT = xc330.INDIRECT_DATA
_WRITE_AT = _READ_AT + _READ.size
_MAP = b"".join(
    (item.address + k).to_bytes(2, "little") for item in (*_READ_ITEMS, *_WRITE_ITEMS) for k in range(item.size)
)
_HEALTH = struct.Struct("<HB")

READ_BYTES, WRITTEN_BYTES = _READ.size, _WRITE.size
"""Of each servo in each cycle."""

_SHUT_DOWN = HardwareError.OVERHEATING | HardwareError.SHOCK | HardwareError.OVERLOAD
_JOINTS = 3
# Where time does not press: attempts, and how late an answer may be, s.
_ATTEMPTS, _PATIENCE = 3, 0.05
_AFTER_TRIP = 0.06  # s: the servos look at their watchdog every 20 ms
_TELL_AGAIN_NS = 10_000_000_000
_WAKING = 0.3  # s that a servo needs to restart, generously


class _Servo:
    """What is known of one servo."""

    def __init__(self, index: int, settings: ServoSettings) -> None:
        self.index = index
        self.settings = settings
        self.name = f"{SERVO_NAMES[index]} (id {settings.id})"
        self.answers = True
        self.suspect = False
        """It has missed an answer: it is asked by itself until it answers or counts as silent."""
        self.asked = 0
        self.heard_ns = 0
        self.retry_ns = 0
        self.offset = settings.zero
        """Counts at angle 0, in the turn that the servo counts now."""
        self.mode: Mode | None = None
        """Operating mode of the servo, as far as known."""
        self.engaged = False
        """Torque is on and the watchdog armed, in the right mode."""
        self.interrupted = False
        """It was engaged and lost its torque: it goes back slowly."""
        self.homing: float | None = None
        """The goal that creeps from where the servo was to what is commanded, rad."""
        self.ramp_ns: int | None = None
        """Since when its torque grows back."""
        self.reboot_ns: int | None = None
        self.reboots = 0
        self.position = settings.center
        self.velocity = 0.0
        self.current = 0.0
        self.voltage = 0.0
        self.temperature = 0.0
        self.error = 0
        self.torque_on = False

    def angle(self, counts: int) -> float:
        return self.settings.sign * (counts - self.offset) * xc330.RAD_PER_COUNT

    def counts(self, angle: float) -> int:
        counts = self.offset + round(self.settings.sign * angle / xc330.RAD_PER_COUNT)
        return min(max(counts, -xc330.MULTI_TURN), xc330.MULTI_TURN)

    def limited(self, ampere: float) -> int:
        most = self.settings.current_limit
        return int(min(max(ampere, -most), most) / xc330.AMPERE_PER_UNIT)

    def place(self, counts: int, near: float) -> None:
        """Choose the turn in which the encoder's ``counts`` are nearest to the angle ``near``."""
        self.offset = self.settings.zero
        turns = (self.angle(counts) - near) / (xc330.RAD_PER_COUNT * xc330.COUNTS)
        self.offset += self.settings.sign * round(turns) * xc330.COUNTS
        self.position = self.angle(counts)


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
        self._servos = tuple(_Servo(index, servo) for index, servo in enumerate(settings.servos))
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
        self._find(bus)
        for servo in self._servos:
            try:
                self._set_up(bus, servo)
            except BusError as error:
                raise DeviceError(f"servo bus: {servo.name}, while it was being set up: {error}") from error
        self._fast = self._probe(bus)
        bus.patient(1, settings.reply_margin)

    def _find(self, bus: Bus) -> None:
        """Make sure that every servo is there and is what it should be."""
        missing, wrong, old = [], [], []
        for servo in self._servos:
            try:
                model = bus.read(servo.settings.id, xc330.MODEL_NUMBER)
                firmware = bus.read(servo.settings.id, xc330.FIRMWARE)
            except BusError:
                missing.append(servo)
                continue
            if model != xc330.MODEL:
                wrong.append(f"{servo.name} is model {model}, want {xc330.MODEL} (XC330-M288-T)")
            if firmware < xc330.FAST_READ_FIRMWARE:
                old.append(f"{servo.name} has firmware {firmware}")
        if len(missing) == len(self._servos):
            raise DeviceError(self._nobody(bus))
        if missing:
            names = ", ".join(servo.name for servo in missing)
            raise DeviceError(
                f"servo bus: no answer from {names} on {self._settings.port} at {self._settings.baud} baud; "
                f"ids that answer: {', '.join(map(str, bus.answering())) or 'none'}"
            )
        if wrong:
            raise DeviceError(f"servo bus: {'; '.join(wrong)}")
        if old:
            self._tell(
                Level.WARNING,
                f"{', '.join(old)}: fast sync read needs {xc330.FAST_READ_FIRMWARE} (Dynamixel Wizard updates it)",
            )

    def _nobody(self, bus: Bus) -> str:
        """What to say when no servo answers; looks for them at the other baud rates."""
        settings = self._settings
        bus.close()
        for baud in xc330.BAUDS:
            if baud == settings.baud:
                continue
            try:
                other = Bus(Port(settings.port, baud, settings.reply_margin))
            except DeviceError:
                continue
            try:
                self._bus = other
                other.read(settings.servos[0].id, xc330.MODEL_NUMBER)
                return (
                    f"servo bus: no servo answers on {settings.port} at {settings.baud} baud, but servo "
                    f"{settings.servos[0].id} does at {baud}: set baud to that, or the servos to {settings.baud}"
                )
            except BusError:
                continue
            finally:
                other.close()
        return (
            f"servo bus: no servo answers on {settings.port}, at {settings.baud} baud or any other; "
            "is the 5 V supply on, and is the data cable plugged in?"
        )

    def _set_up(self, bus: Bus, servo: _Servo) -> None:
        """Torque off, healthy, everything written that differs, everything read back."""
        name, mine, settings = servo.settings.id, servo.settings, self._settings
        error = bus.read(name, xc330.HARDWARE_ERROR)
        if error:
            self._tell(Level.WARNING, f"{servo.name}: {xc330.error_words(error)}; rebooting it")
            bus.reboot(name)
            self._await(bus, name)
            if error := bus.read(name, xc330.HARDWARE_ERROR):
                raise DeviceError(f"servo bus: {servo.name}: {xc330.error_words(error)}, even after a reboot")
        if bus.read(name, xc330.TORQUE_ENABLE):
            bus.write(name, xc330.TORQUE_ENABLE, 0)
        wanted = (
            # First of all, for the answers to what follows.
            (xc330.RETURN_DELAY, 0),
            (xc330.DRIVE_MODE, 0),
            (xc330.OPERATING_MODE, int(Mode.CURRENT_BASED_POSITION)),
            (xc330.SHADOW_ID, 255),
            (xc330.HOMING_OFFSET, 0),
            (xc330.TEMPERATURE_LIMIT, settings.temperature_limit),
            (xc330.CURRENT_LIMIT, round(mine.current_limit / xc330.AMPERE_PER_UNIT)),
            (xc330.STARTUP, 0),
            (xc330.SHUTDOWN, int(_SHUT_DOWN)),
        )
        for item, value in wanted:
            self._settle(bus, servo, item, value)
        servo.mode = Mode.CURRENT_BASED_POSITION
        self._prepare(bus, servo, servo.settings.center)

    def _await(self, bus: Bus, name: int) -> None:
        """Wait until a rebooted servo answers."""
        give_up = self._clock() + 2_000_000_000
        while True:
            try:
                bus.read(name, xc330.MODEL_NUMBER)
                return
            except NoAnswer:
                if self._clock() > give_up:
                    raise

    def _settle(self, bus: Bus, servo: _Servo, item: Item, value: int) -> None:
        """Write an item if it differs, and see that it took it."""
        name = servo.settings.id
        before = bus.read(name, item)
        if before == value:
            return
        bus.write(name, item, value)
        after = bus.read(name, item)
        if after != value:
            raise Refused(name, f"it did not take {item.name} {value}, and shows {after}")
        self._tell(Level.INFO, f"{servo.name}: {item.name} set from {before} to {value}")

    def _prepare(self, bus: Bus, servo: _Servo, near: float) -> None:
        """All that a reboot forgets; then look where the servo stands."""
        name = servo.settings.id
        if bus.read(name, xc330.STATUS_RETURN_LEVEL) != _MARK:
            bus.write(name, xc330.STATUS_RETURN_LEVEL, _MARK)
        bus.write(name, xc330.BUS_WATCHDOG, 0)
        bus.write_bytes(name, xc330.INDIRECT_ADDRESS, _MAP)
        if bus.read_bytes(name, xc330.INDIRECT_ADDRESS, len(_MAP)).data != _MAP:
            raise Refused(name, "it did not take the indirect addresses")
        self._shape(bus, servo)
        servo.place(bus.read(name, xc330.PRESENT_POSITION), near)
        volts, degrees = _HEALTH.unpack(bus.read_bytes(name, xc330.PRESENT_VOLTAGE.address, _HEALTH.size).data)
        servo.voltage, servo.temperature = volts * xc330.VOLT_PER_UNIT, float(degrees)
        servo.engaged = False
        servo.heard_ns = self._clock()

    def _shape(self, bus: Bus, servo: _Servo) -> None:
        """Profile and gains, which a change of the operating mode forgets as well."""
        mine = servo.settings
        profile = (
            round(mine.profile_acceleration / xc330.RAD_S2_PER_UNIT),
            round(mine.profile_velocity / xc330.RAD_S_PER_UNIT),
        )
        if any(profile):
            self._confirm(bus, servo, xc330.PROFILE_ACCELERATION.address, struct.pack("<II", *profile))
        if mine.gains is not None:
            p, i, d = mine.gains
            self._confirm(bus, servo, xc330.POSITION_D.address, struct.pack("<HHH", d, i, p))

    def _confirm(self, bus: Bus, servo: _Servo, address: int, data: bytes) -> None:
        bus.write_bytes(servo.settings.id, address, data)
        if bus.read_bytes(servo.settings.id, address, len(data)).data != data:
            raise Refused(servo.settings.id, f"it did not take what was written to address {address}")

    def _probe(self, bus: Bus) -> bool:
        """Whether the servos answer a fast sync read; told if not."""
        ids = [servo.settings.id for servo in self._servos]
        for _ in range(3):
            try:
                bus.sync_read(_READ_AT, _READ.size, ids, fast=True)
                return True
            except BusError:
                continue
        self._tell(Level.WARNING, "the servos do not answer fast sync reads; plain sync reads are used")
        return False

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
            and not servo.error & _SHUT_DOWN
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
            bus.sync_write(_WRITE_AT, _WRITE.size, goals)

    def _mode_of(self, servo: _Servo, joint: Mode) -> Mode:
        return joint if servo.index < _JOINTS else Mode.CURRENT_BASED_POSITION

    def _goal(self, servo: _Servo, command: ServoCommand, now: int, dt: float) -> bytes:
        if servo.mode is Mode.CURRENT:
            torque = command.torque[servo.index]
            if servo.ramp_ns is not None:
                share = (now - servo.ramp_ns) * 1e-9 / self._settings.homing_time
                torque *= min(share, 1.0)
                if share >= 1.0:
                    servo.ramp_ns = None
            current = servo.settings.sign * torque / servo.settings.torque_constant
            return _WRITE.pack(servo.limited(current), servo.counts(servo.position))
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
        return _WRITE.pack(abs(servo.limited(limit)), servo.counts(goal))

    def _engage(self, bus: Bus, servos: Sequence[_Servo], joint: Mode, now: int) -> None:
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
                self._shape(bus, servo)
                servo.mode = self._mode_of(servo, joint)
        # A watchdog that has tripped locks the goals.
        self._all(bus, servos, xc330.BUS_WATCHDOG, lambda servo: 0)
        # A servo enters current mode with its current limit as the goal.
        rest = {servo.settings.id: _WRITE.pack(0, servo.counts(servo.position)) for servo in servos}
        bus.sync_write(_WRITE_AT, _WRITE.size, rest)
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

    def _all(self, bus: Bus, servos: Iterable[_Servo], item: Item, value: Callable[[_Servo], int]) -> None:
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

    def _read_together(self, bus: Bus, servos: Sequence[_Servo]) -> list[bool]:
        if not servos:
            return []
        try:
            answers = bus.sync_read(_READ_AT, _READ.size, [servo.settings.id for servo in servos], self._fast)
        except BusError as error:
            # Who is at fault shows when each is asked by itself, in the next cycle.
            self._one_by_one = True
            self._tell_once("read", Level.WARNING, f"a reading of the servos failed: {error}")
            raise
        return [self._take(servo, answer.data) for servo, answer in zip(servos, answers, strict=True)]

    def _read_alone(self, bus: Bus, servo: _Servo) -> bool:
        servo.asked += 1
        try:
            answer = bus.read_bytes(servo.settings.id, _READ_AT, _READ.size)
        except BusError as error:
            self._count(error)
            return False
        return self._take(servo, answer.data)

    def _miss(self, lost: Sequence[_Servo]) -> None:
        for servo in lost:
            self._give_up(servo)
        names = ", ".join(servo.name for servo in lost)
        self._tell(
            Level.ERROR,
            f"{names} does not answer any more; the others go on"
            if any(servo.answers for servo in self._servos)
            else "no servo answers any more: is the 5 V supply on, and is the data cable plugged in?",
        )

    def _give_up(self, servo: _Servo) -> None:
        servo.answers = False
        servo.interrupted = servo.interrupted or servo.engaged
        servo.engaged = servo.suspect = False
        servo.velocity = servo.current = 0.0
        servo.error |= HardwareError.SILENT
        servo.torque_on = False
        servo.retry_ns = self._clock() + round(self._settings.retry * 1e9)

    def _take(self, servo: _Servo, data: bytes) -> bool:
        """Take what a servo told; False if it has forgotten what it is to tell."""
        mark, error, torque, watchdog, current, velocity, counts = _READ.unpack(data)
        if mark != _MARK:
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

    def _judge(self, servo: _Servo, error: int) -> None:
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

    def _look_at_health(self, bus: Bus, servo: _Servo) -> None:
        try:
            answer = bus.read_bytes(servo.settings.id, xc330.PRESENT_VOLTAGE.address, _HEALTH.size)
        except BusError as error:
            self._count(error)
            return
        volts, degrees = _HEALTH.unpack(answer.data)
        servo.voltage, servo.temperature = volts * xc330.VOLT_PER_UNIT, float(degrees)

    def _reboot(self, bus: Bus, servo: _Servo, now: int) -> None:
        servo.reboot_ns = None
        servo.reboots += 1
        self._tell(Level.WARNING, f"{servo.name}: reboot {servo.reboots} of {self._settings.reboots}")
        bus.reboot(servo.settings.id)
        self._give_up(servo)
        servo.interrupted = True
        servo.retry_ns = now + round(_WAKING * 1e9)

    def _revive(self, bus: Bus, servo: _Servo) -> None:
        """Take a lost servo back if it answers; its place is the one nearest to where it was last seen."""
        name = servo.settings.id
        mark = bus.read_bytes(name, _READ_AT, 1).data[0]
        if mark != _MARK:
            self._prepare(bus, servo, servo.position)
        servo.answers = True
        servo.heard_ns = self._clock()
        servo.error = 0
        self._tell(Level.INFO, f"{servo.name} answers again{', restarted' if mark != _MARK else ''}")

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
