"""One emulated XC330: its register file, and what it does with it (ROBOTIS e-manual, XC330-M288-T and protocol 2.0).

A servo knows no bytes of the wire and no time but what it is told: ``now`` is in seconds, from any origin. Where the
manual is silent, or a servo is known to differ from it, the comment at the place says what was chosen.
"""

from __future__ import annotations

import struct
from math import inf
from typing import NamedTuple

from drivers import xc330 as x
from drivers.xc330 import HardwareError, Item, Mode
from sim_backend.dynamixel_mechanics import POSITIONED, Drive, Motion
from sim_backend.dynamixel_wire import ALERT, Trouble

_GOALS = (x.GOAL_PWM, x.GOAL_CURRENT, x.GOAL_VELOCITY, x.GOAL_POSITION)
_LIMITS = {x.GOAL_PWM: x.PWM_LIMIT, x.GOAL_CURRENT: x.CURRENT_LIMIT, x.GOAL_VELOCITY: x.VELOCITY_LIMIT}
_MODES = tuple(int(mode) for mode in Mode)
#: Gains that a change of the operating mode sets anew.
_GAINS = (x.VELOCITY_I, x.VELOCITY_P, x.POSITION_D, x.POSITION_I, x.POSITION_P, x.FEEDFORWARD_2, x.FEEDFORWARD_1)


#: Realtime tick to present temperature, one behind the other.
_PRESENT = struct.Struct("<HBBhhiiiiHB")


class _Settled(NamedTuple):
    """What follows from the registers until one of them changes."""

    drive: Drive
    shift: int | None
    """In a position mode: counts to take off the trajectory for the encoder's own."""
    offset: int
    """Present position less the encoder's own counts."""
    goal: int
    speed: float
    """Of the profile, counts/s."""
    watchdog: float
    """s; not positive: off."""
    moving: int
    voltage: tuple[int, int]
    temperature: int


class Servo:
    """The register file of one servo.

    ``reboot_time`` is how long it is silent after a reboot or power-on, s. After a trip of the bus watchdog the goals
    are locked and the servo stops: it holds its place in the position modes and gives no torque in current mode;
    ``runs_on`` makes it do what the 330 size was seen to do instead, and keep its last goal.
    """

    def __init__(self, servo: int, firmware: int = 52, reboot_time: float = 0.15) -> None:
        self._reboot_time = reboot_time
        self._settled: _Settled | None = None
        self._map: tuple[int, ...] | None = None
        self._splits: dict[tuple[int, int], list[Item] | Trouble] = {}
        self._registers = bytearray(x.SIZE)
        for item in x.TABLE.values():
            self._put(item, item.initial)
        self._put(x.ID, servo)
        self._put(x.FIRMWARE, firmware)
        self.silent = False
        """Answers nothing and hears nothing."""
        self.runs_on = False
        self._registered: tuple[int, bytes] | None = None
        self._asleep_until = -inf
        self._heard = 0.0
        self._turns = 0
        self._trajectory = 0.0
        self._updated = -inf
        self._motion = Motion(0.0)

    # -- what others see ------------------------------------------------------------------------------------------

    @property
    def servo_id(self) -> int:
        """Its id on the bus."""
        return self.get(x.ID)

    @property
    def torque_on(self) -> bool:
        """The motor is driven."""
        return bool(self.get(x.TORQUE_ENABLE))

    @property
    def tripped(self) -> bool:
        """The bus watchdog has stopped it."""
        return self.get(x.BUS_WATCHDOG) == x.TRIPPED

    @property
    def alert(self) -> int:
        """The alert bit of its status packets."""
        return ALERT if self.get(x.HARDWARE_ERROR) else 0

    def get(self, item: Item) -> int:
        """Value of an item."""
        return item.decode(self._registers[item.address : item.address + item.size])

    def hears(self, now: float) -> bool:
        """It is powered, awake and connected."""
        return not self.silent and now >= self._asleep_until

    def drive(self) -> Drive:
        """What the motor is asked for."""
        settled = self._settled
        if settled is None:
            settled = self._settled = self._settle()
        return settled.drive if settled.shift is None else self._positioned(settled)

    def _positioned(self, settled: _Settled) -> Drive:
        return settled.drive._replace(goal=(self._trajectory - (settled.shift or 0)) * x.RAD_PER_COUNT)

    def _settle(self) -> _Settled:
        """What follows from the registers as they are now."""
        mode = Mode(self.get(x.OPERATING_MODE))
        shift: int | None = None
        if not self.torque_on:
            drive = Drive(None)
        elif mode is Mode.CURRENT:
            drive = Drive(mode, self.get(x.GOAL_CURRENT) * x.AMPERE_PER_UNIT)
        elif mode is Mode.VELOCITY:
            drive = Drive(mode, self.get(x.GOAL_VELOCITY) * x.RAD_S_PER_UNIT)
        elif mode is Mode.PWM:
            drive = Drive(mode, self.get(x.GOAL_PWM) / x.GOAL_PWM.high)
        else:
            limited = x.GOAL_CURRENT if mode is Mode.CURRENT_BASED_POSITION else x.CURRENT_LIMIT
            drive = Drive(mode, 0.0, abs(self.get(limited)) * x.AMPERE_PER_UNIT)
            shift = self.get(x.HOMING_OFFSET) + self._turns * x.COUNTS
        speed = self.get(x.PROFILE_VELOCITY) * x.RAD_S_PER_UNIT / x.RAD_PER_COUNT
        return _Settled(
            drive,
            shift,
            self.get(x.HOMING_OFFSET) + self._turns * x.COUNTS,
            self.get(x.GOAL_POSITION),
            speed or inf,
            self.get(x.BUS_WATCHDOG) * x.S_PER_WATCHDOG_UNIT if self.torque_on else 0.0,
            self.get(x.MOVING_THRESHOLD),
            (self.get(x.MIN_VOLTAGE), self.get(x.MAX_VOLTAGE)),
            self.get(x.TEMPERATURE_LIMIT),
        )

    # -- time -----------------------------------------------------------------------------------------------------

    def update(self, now: float, motion: Motion) -> None:
        """Take what the sensors see, move the profile on, and let the watchdog look at the time."""
        self._motion = motion
        settled = self._settled
        if settled is None:
            settled = self._settled = self._settle()
        counts = round(motion.position / x.RAD_PER_COUNT) + settled.offset
        rate = round(motion.velocity / x.RAD_S_PER_UNIT)
        tenths = round(motion.voltage / x.VOLT_PER_UNIT)
        if settled.speed == inf:
            self._trajectory = settled.goal
        else:
            most = settled.speed * (now - self._updated)
            self._trajectory += min(max(settled.goal - self._trajectory, -most), most)
        self._updated = now
        _PRESENT.pack_into(
            self._registers,
            x.REALTIME_TICK.address,
            int(max(now, 0.0) * 1e3) % 32_768,
            abs(rate) > settled.moving,
            0,
            0,
            min(max(round(motion.current / x.AMPERE_PER_UNIT), -32_767), 32_767),
            rate,
            counts,
            0,
            round(self._trajectory),
            tenths,
            round(motion.temperature),
        )
        if not settled.voltage[0] <= tenths <= settled.voltage[1]:
            self.fail(HardwareError.VOLTAGE)
        if motion.temperature > settled.temperature:
            self.fail(HardwareError.OVERHEATING)
        if 0.0 < settled.watchdog < now - self._heard:
            self._trip(counts)

    def heard(self, now: float) -> None:
        """An instruction packet has passed on the bus: the watchdog counts from here, whomever it was for."""
        self._heard = now

    def _trip(self, counts: int) -> None:
        self._put(x.BUS_WATCHDOG, x.TRIPPED)
        if self.runs_on:
            return
        self._put(x.PROFILE_ACCELERATION, 0)
        self._put(x.PROFILE_VELOCITY, 0)
        self._put(x.GOAL_VELOCITY, 0)
        self._put(x.GOAL_PWM, 0)
        mode = self.get(x.OPERATING_MODE)
        if mode == Mode.CURRENT:
            self._put(x.GOAL_CURRENT, 0)
        elif mode in POSITIONED:
            self._hold(counts)

    def fail(self, error: HardwareError) -> None:
        """A hardware error: told until the reboot, and torque goes off if the shutdown register says so."""
        self._put(x.HARDWARE_ERROR, self.get(x.HARDWARE_ERROR) | error)
        if self.get(x.SHUTDOWN) & error:
            self._put(x.TORQUE_ENABLE, 0)

    # -- instructions ---------------------------------------------------------------------------------------------

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error number and data. What lies between the items reads as 0."""
        if length < 1 or address + length > x.SIZE:
            return Trouble.ACCESS, b""
        data = bytearray(self._registers[address : address + length])
        if address + length > x.INDIRECT_DATA:
            places = self._behind()
            for k in range(max(address, x.INDIRECT_DATA), address + length):
                data[k - address] = self._registers[places[k - x.INDIRECT_DATA]]
        return Trouble.NONE, bytes(data)

    def write(self, address: int, data: bytes) -> int:
        """Error number; nothing is written unless all of it can be."""
        writes, trouble = self._split(address, data)
        for item, value in writes:
            trouble = trouble or self._refusal(item, value)
        if not trouble:
            for item, value in writes:
                self._set(item, value)
        return trouble

    def reaches_goal(self, address: int, length: int) -> bool:
        """A write there sets a goal, directly or through the indirect addresses."""
        items = self._items(address, length)
        return not isinstance(items, Trouble) and any(item in _GOALS for item in items)

    def register(self, address: int, data: bytes) -> int:
        """Reg write: keep it for the action."""
        _, trouble = self._split(address, data)
        if not trouble:
            self._registered = (address, data)
            self._put(x.REGISTERED, 1)
        return trouble

    def act(self) -> int:
        """Action: do what was registered."""
        if self._registered is None:
            return Trouble.INSTRUCTION
        registered, self._registered = self._registered, None
        self._put(x.REGISTERED, 0)
        return self.write(*registered)

    def reboot(self, now: float) -> None:
        """Forget the RAM, the errors and the turns, and be silent for a moment."""
        for item in x.TABLE.values():
            if item.address >= x.RAM:
                self._put(item, item.initial)
        self._forget_map()
        self._registered = None
        self._turns = 0
        counts = self._counts(self._motion.position)
        # A servo counts from within one turn after it was switched on.
        self._settled = None
        self._turns = -((counts - self.get(x.HOMING_OFFSET)) // x.COUNTS)
        self._reset_mode()
        self._asleep_until = now + self._reboot_time

    def factory_reset(self, option: int, now: float) -> int:
        """0xFF: all, 0x01: all but the id, 0x02: all but id and baud rate."""
        if option not in (0xFF, 0x01, 0x02):
            return Trouble.DATA_RANGE
        kept = {0xFF: (), 0x01: (x.ID,), 0x02: (x.ID, x.BAUD_RATE)}[option]
        values = [(item, self.get(item)) for item in (*kept, x.FIRMWARE)]
        for item in x.TABLE.values():
            self._put(item, item.initial)
        for item, value in values:
            self._put(item, value)
        self.reboot(now)
        return Trouble.NONE

    def clear(self, parameters: bytes) -> int:
        """Clear the turns; the position is then within one turn. Only while it stands."""
        if parameters != b"\x01\x44\x58\x4c\x22":
            return Trouble.DATA_RANGE
        if self.get(x.MOVING):
            return Trouble.RESULT_FAIL
        self._settled = None
        self._turns -= (self._counts(self._motion.position) - self.get(x.HOMING_OFFSET)) // x.COUNTS
        self._hold(self._counts(self._motion.position))
        return Trouble.NONE

    # -- inside ---------------------------------------------------------------------------------------------------

    def _put(self, item: Item, value: int) -> None:
        self._registers[item.address : item.address + item.size] = item.encode(value)
        self._settled = None

    def _counts(self, position: float) -> int:
        return round(position / x.RAD_PER_COUNT) + self._turns * x.COUNTS + self.get(x.HOMING_OFFSET)

    def _behind(self) -> tuple[int, ...]:
        """The addresses that the bytes of the indirect data stand for."""
        if self._map is None:
            self._map = tuple(self.get(x.TABLE[x.INDIRECT_ADDRESS + 2 * k]) for k in range(x.INDIRECT_COUNT))
        return self._map

    def _items(self, address: int, length: int) -> list[Item] | Trouble:
        """The items that a write of so many bytes goes to."""
        split = self._splits.get((address, length))
        if split is None:
            split = self._splits[address, length] = self._find_items(address, length)
        return split

    def _find_items(self, address: int, length: int) -> list[Item] | Trouble:
        end = address + length
        if not length:
            return Trouble.DATA_LENGTH
        if end > x.SIZE:
            return Trouble.ACCESS
        behind = self._behind()
        places = [behind[k - x.INDIRECT_DATA] if k >= x.INDIRECT_DATA else k for k in range(address, end)]
        items: list[Item] = []
        while places:
            item = x.TABLE.get(places[0])
            if item is None or not item.writable:
                return Trouble.ACCESS
            if places[: item.size] != list(range(item.address, item.address + item.size)):
                return Trouble.DATA_LENGTH
            items.append(item)
            del places[: item.size]
        return items

    def _split(self, address: int, data: bytes) -> tuple[list[tuple[Item, int]], int]:
        """The items that a write goes to, with their values; or an error number."""
        items = self._items(address, len(data))
        if isinstance(items, Trouble):
            return [], items
        writes, k = [], 0
        for item in items:
            writes.append((item, item.decode(data[k : k + item.size])))
            k += item.size
        return writes, Trouble.NONE

    def _refusal(self, item: Item, value: int) -> int:
        if item.address < x.RAM and self.torque_on:
            return Trouble.ACCESS
        if item in _GOALS and self.tripped:
            return Trouble.DATA_RANGE
        if not item.low <= value <= item.high or (item is x.OPERATING_MODE and value not in _MODES):
            return Trouble.DATA_RANGE
        limit = _LIMITS.get(item)
        if limit is not None and abs(value) > self.get(limit):
            return Trouble.DATA_LIMIT
        if item is x.GOAL_POSITION and self.get(x.OPERATING_MODE) == Mode.POSITION:
            low, high = self.get(x.MIN_POSITION), self.get(x.MAX_POSITION)
            return Trouble.NONE if low <= value <= high else Trouble.DATA_LIMIT
        # The manual says that only a reboot brings torque back after a shutdown, not how the attempt is answered.
        if item is x.TORQUE_ENABLE and value and self.get(x.HARDWARE_ERROR) & self.get(x.SHUTDOWN):
            return Trouble.RESULT_FAIL
        return Trouble.NONE

    def _set(self, item: Item, value: int) -> None:
        before = self.get(item)
        if value == before:
            return
        self._put(item, value)
        if item is x.OPERATING_MODE:
            self._reset_mode()
        elif item is x.TORQUE_ENABLE and value:
            self._hold(self._counts(self._motion.position))
        elif item.address >= x.INDIRECT_ADDRESS:
            self._forget_map()

    def _forget_map(self) -> None:
        self._map = None
        self._splits.clear()

    def _reset_mode(self) -> None:
        for gain in _GAINS:
            self._put(gain, gain.initial)
        self._put(x.PROFILE_ACCELERATION, 0)
        self._put(x.PROFILE_VELOCITY, 0)
        self._put(x.GOAL_VELOCITY, 0)
        self._put(x.GOAL_PWM, self.get(x.PWM_LIMIT))
        self._put(x.GOAL_CURRENT, self.get(x.CURRENT_LIMIT))
        self._hold(self._counts(self._motion.position))

    def _hold(self, counts: int) -> None:
        self._put(x.GOAL_POSITION, counts)
        self._trajectory = float(counts)
