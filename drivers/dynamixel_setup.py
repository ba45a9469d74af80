"""How the servos are made ready: what a cycle reads and writes of each, and everything that is set before the first."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from time import monotonic_ns

from drivers import xc330
from drivers.dynamixel_bus import Bus, BusError, NoAnswer, Port, Refused
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.mailbox import Level
from drivers.protocols import DeviceError
from drivers.samples import SERVO_NAMES
from drivers.xc330 import HardwareError, Item, Mode

# What a cycle reads and writes, laid side by side by the indirect addresses. The status return level is there as a
# mark: it is always 2, and a servo that has rebooted has forgotten its map and shows 0.
MARK = 2
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
READ = struct.Struct("<BBBbhii")
WRITE = struct.Struct("<hi")
READ_AT = xc330.INDIRECT_DATA
WRITE_AT = READ_AT + READ.size
MAP = b"".join(
    (item.address + k).to_bytes(2, "little") for item in (*_READ_ITEMS, *_WRITE_ITEMS) for k in range(item.size)
)
HEALTH = struct.Struct("<HB")

READ_BYTES, WRITTEN_BYTES = READ.size, WRITE.size
"""Of each servo in each cycle."""

SHUT_DOWN = HardwareError.OVERHEATING | HardwareError.SHOCK | HardwareError.OVERLOAD
"""Errors after which only a reboot gives torque back."""

_AWAKE = 2.0  # s: within this a rebooted servo must answer


class Servo:
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
        """rad, of the encoder's counts."""
        return self.settings.sign * (counts - self.offset) * xc330.RAD_PER_COUNT

    def counts(self, angle: float) -> int:
        """The goal position that is this angle."""
        counts = self.offset + round(self.settings.sign * angle / xc330.RAD_PER_COUNT)
        return min(max(counts, -xc330.MULTI_TURN), xc330.MULTI_TURN)

    def limited(self, ampere: float) -> int:
        """The goal current nearest to this one that the servo may have."""
        most = self.settings.current_limit
        return int(min(max(ampere, -most), most) / xc330.AMPERE_PER_UNIT)

    def place(self, counts: int, near: float) -> None:
        """Choose the turn in which the encoder's ``counts`` are nearest to the angle ``near``."""
        self.offset = self.settings.zero
        turns = (self.angle(counts) - near) / (xc330.RAD_PER_COUNT * xc330.COUNTS)
        self.offset += self.settings.sign * round(turns) * xc330.COUNTS
        self.position = self.angle(counts)


class SetUp:
    """Finds the servos and writes what is to be set; ``tell`` hears what was changed.

    Calls raise BusError when a transaction failed or a servo does not show what was written to it.
    """

    def __init__(
        self, settings: DynamixelSettings, servos: Sequence[Servo], tell: Callable[[Level, str], None]
    ) -> None:
        self._settings = settings
        self._servos = servos
        self._tell = tell
        self.fast = True
        """The servos answer fast sync reads."""

    def find(self, bus: Bus) -> None:
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

    def set_up(self, bus: Bus, servo: Servo) -> None:
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
            (xc330.SHUTDOWN, int(SHUT_DOWN)),
        )
        for item, value in wanted:
            self._settle(bus, servo, item, value)
        servo.mode = Mode.CURRENT_BASED_POSITION
        self.prepare(bus, servo, servo.settings.center)

    def _await(self, bus: Bus, name: int) -> None:
        """Wait until a rebooted servo answers."""
        give_up = monotonic_ns() + round(_AWAKE * 1e9)
        while True:
            try:
                bus.read(name, xc330.MODEL_NUMBER)
                return
            except NoAnswer:
                if monotonic_ns() > give_up:
                    raise

    def _settle(self, bus: Bus, servo: Servo, item: Item, value: int) -> None:
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

    def prepare(self, bus: Bus, servo: Servo, near: float) -> None:
        """All that a reboot forgets; then look where the servo stands."""
        name = servo.settings.id
        if bus.read(name, xc330.STATUS_RETURN_LEVEL) != MARK:
            bus.write(name, xc330.STATUS_RETURN_LEVEL, MARK)
        bus.write(name, xc330.BUS_WATCHDOG, 0)
        bus.write_bytes(name, xc330.INDIRECT_ADDRESS, MAP)
        if bus.read_bytes(name, xc330.INDIRECT_ADDRESS, len(MAP)).data != MAP:
            raise Refused(name, "it did not take the indirect addresses")
        self.shape(bus, [servo])
        self._confirm_shape(bus, servo)
        servo.place(bus.read(name, xc330.PRESENT_POSITION), near)
        volts, degrees = HEALTH.unpack(bus.read_bytes(name, xc330.PRESENT_VOLTAGE.address, HEALTH.size).data)
        servo.voltage, servo.temperature = volts * xc330.VOLT_PER_UNIT, float(degrees)
        servo.engaged = False

    def shape(self, bus: Bus, servos: Sequence[Servo]) -> None:
        """Write profile and gains, which a change of the operating mode forgets as well; none are read back."""
        shapes = {servo.settings.id: _shape(servo.settings) for servo in servos}
        for address in sorted({address for shape in shapes.values() for address in shape}):
            data = {name: shape[address] for name, shape in shapes.items() if address in shape}
            bus.sync_write(address, len(next(iter(data.values()))), data)

    def _confirm_shape(self, bus: Bus, servo: Servo) -> None:
        for address, data in _shape(servo.settings).items():
            if bus.read_bytes(servo.settings.id, address, len(data)).data != data:
                raise Refused(servo.settings.id, f"it did not take what was written to address {address}")

    def probe(self, bus: Bus) -> None:
        """Find out whether the servos answer a fast sync read; told if not."""
        ids = [servo.settings.id for servo in self._servos]
        for _ in range(3):
            try:
                bus.sync_read(READ_AT, READ.size, ids, fast=True)
                self.fast = True
                return
            except BusError:
                continue
        self.fast = False
        self._tell(Level.WARNING, "the servos do not answer fast sync reads; plain sync reads are used")


def _shape(settings: ServoSettings) -> dict[int, bytes]:
    """Profile and gains as they lie in the control table, by address."""
    shape = {}
    profile = (
        round(settings.profile_acceleration / xc330.RAD_S2_PER_UNIT),
        round(settings.profile_velocity / xc330.RAD_S_PER_UNIT),
    )
    if any(profile):
        shape[xc330.PROFILE_ACCELERATION.address] = struct.pack("<II", *profile)
    if settings.gains is not None:
        p, i, d = settings.gains
        shape[xc330.POSITION_D.address] = struct.pack("<HHH", d, i, p)
    return shape
