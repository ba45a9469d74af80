"""The Dynamixel XC330-M288-T: control table, units, hardware errors (ROBOTIS e-manual, XC330-M288-T).

Addresses below ``RAM`` lie in the EEPROM, which is locked while torque is on. Numbers are little-endian.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from math import pi

from msgspec import Struct

MODEL = 1240
#: First firmware of the 330 size that answers fast sync read (ROBOTIS e-manual, protocol 2.0).
FAST_READ_FIRMWARE = 46

COUNTS = 4096
"""Encoder counts per turn."""
RAD_PER_COUNT = 2.0 * pi / COUNTS
RAD_S_PER_UNIT = 0.229 * 2.0 * pi / 60.0
RAD_S2_PER_UNIT = 214.577 * 2.0 * pi / 3600.0
AMPERE_PER_UNIT = 1e-3
VOLT_PER_UNIT = 0.1
S_PER_WATCHDOG_UNIT = 0.02
S_PER_DELAY_UNIT = 2e-6

#: Bits per second, by the number in the baud-rate register.
BAUDS = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)

RAM = 64
SIZE = 228
"""Bytes of the control table."""
MULTI_TURN = 256 * COUNTS - 1
"""Largest |goal position| in extended and current-based position mode, counts."""
TRIPPED = -1
"""Value of the bus watchdog once it has stopped the servo; write 0 to clear it."""


class Mode(IntEnum):
    """Operating modes."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


class HardwareError(IntFlag):
    """Bits of the hardware-error register; all but SILENT are cleared by a reboot alone."""

    VOLTAGE = 1
    OVERHEATING = 4
    ENCODER = 8
    SHOCK = 16
    OVERLOAD = 32
    SILENT = 128
    """Not the servo's (its bit 7 is always 0): the driver's own, for a servo that does not answer."""


_WORDS = {
    HardwareError.VOLTAGE: "supply voltage out of its limits",
    HardwareError.OVERHEATING: "overheating",
    HardwareError.ENCODER: "encoder fault",
    HardwareError.SHOCK: "electrical shock or too little power",
    HardwareError.OVERLOAD: "overload",
    HardwareError.SILENT: "no answer",
}


def error_words(bits: int) -> str:
    """The set bits in words; empty when there are none."""
    words = [text for bit, text in _WORDS.items() if bits & bit]
    rest = bits & ~sum(_WORDS)
    return ", ".join([*words, *([f"unknown bits {rest:#04x}"] if rest else [])])


class Item(Struct, frozen=True, gc=False):
    """One entry of the control table."""

    name: str
    address: int
    size: int
    initial: int = 0
    low: int = 0
    """Least and largest value that may be written; equal: read only."""
    high: int = 0
    signed: bool = False

    @property
    def writable(self) -> bool:
        """It may be written."""
        return self.low != self.high

    def encode(self, value: int) -> bytes:
        """Bytes of ``value``; OverflowError when it does not fit the item."""
        return value.to_bytes(self.size, "little", signed=self.signed or value < 0)

    def decode(self, data: bytes | bytearray) -> int:
        """The number in ``data``."""
        return int.from_bytes(data, "little", signed=self.signed)


MODEL_NUMBER = Item("model number", 0, 2, MODEL)
MODEL_INFORMATION = Item("model information", 2, 4)
FIRMWARE = Item("firmware version", 6, 1, 52)
ID = Item("id", 7, 1, 1, 0, 252)
BAUD_RATE = Item("baud rate", 8, 1, 1, 0, 6)
RETURN_DELAY = Item("return delay time", 9, 1, 250, 0, 254)
DRIVE_MODE = Item("drive mode", 10, 1, 0, 0, 13)
OPERATING_MODE = Item("operating mode", 11, 1, Mode.POSITION, 0, 16)
SHADOW_ID = Item("secondary id", 12, 1, 255, 0, 255)
PROTOCOL = Item("protocol type", 13, 1, 2, 2, 22)
HOMING_OFFSET = Item("homing offset", 20, 4, 0, -1_044_479, 1_044_479, signed=True)
MOVING_THRESHOLD = Item("moving threshold", 24, 4, 10, 0, 1023)
TEMPERATURE_LIMIT = Item("temperature limit", 31, 1, 70, 0, 100)
MAX_VOLTAGE = Item("max voltage limit", 32, 2, 70, 31, 70)
MIN_VOLTAGE = Item("min voltage limit", 34, 2, 35, 31, 70)
PWM_LIMIT = Item("PWM limit", 36, 2, 885, 0, 885)
CURRENT_LIMIT = Item("current limit", 38, 2, 2352, 0, 2352)
VELOCITY_LIMIT = Item("velocity limit", 44, 4, 350, 0, 2047)
MAX_POSITION = Item("max position limit", 48, 4, 4095, 0, 4095)
MIN_POSITION = Item("min position limit", 52, 4, 0, 0, 4095)
STARTUP = Item("startup configuration", 60, 1, 0, 0, 3)
PWM_SLOPE = Item("PWM slope", 62, 1, 140, 1, 255)
SHUTDOWN = Item("shutdown", 63, 1, 52, 0, 255)
TORQUE_ENABLE = Item("torque enable", 64, 1, 0, 0, 1)
LED = Item("LED", 65, 1, 0, 0, 1)
STATUS_RETURN_LEVEL = Item("status return level", 68, 1, 2, 0, 2)
REGISTERED = Item("registered instruction", 69, 1)
HARDWARE_ERROR = Item("hardware error status", 70, 1)
VELOCITY_I = Item("velocity I gain", 76, 2, 1600, 0, 16_383)
VELOCITY_P = Item("velocity P gain", 78, 2, 50, 0, 16_383)
POSITION_D = Item("position D gain", 80, 2, 500, 0, 16_383)
POSITION_I = Item("position I gain", 82, 2, 0, 0, 16_383)
POSITION_P = Item("position P gain", 84, 2, 1100, 0, 16_383)
FEEDFORWARD_2 = Item("feedforward 2nd gain", 88, 2, 0, 0, 16_383)
FEEDFORWARD_1 = Item("feedforward 1st gain", 90, 2, 0, 0, 16_383)
BUS_WATCHDOG = Item("bus watchdog", 98, 1, 0, 0, 127, signed=True)
GOAL_PWM = Item("goal PWM", 100, 2, 885, -885, 885, signed=True)
GOAL_CURRENT = Item("goal current", 102, 2, 2352, -2352, 2352, signed=True)
GOAL_VELOCITY = Item("goal velocity", 104, 4, 0, -2047, 2047, signed=True)
PROFILE_ACCELERATION = Item("profile acceleration", 108, 4, 0, 0, 32_767)
PROFILE_VELOCITY = Item("profile velocity", 112, 4, 0, 0, 32_767)
GOAL_POSITION = Item("goal position", 116, 4, 0, -MULTI_TURN, MULTI_TURN, signed=True)
REALTIME_TICK = Item("realtime tick", 120, 2)
MOVING = Item("moving", 122, 1)
MOVING_STATUS = Item("moving status", 123, 1)
PRESENT_PWM = Item("present PWM", 124, 2, signed=True)
PRESENT_CURRENT = Item("present current", 126, 2, signed=True)
PRESENT_VELOCITY = Item("present velocity", 128, 4, signed=True)
PRESENT_POSITION = Item("present position", 132, 4, signed=True)
VELOCITY_TRAJECTORY = Item("velocity trajectory", 136, 4, signed=True)
POSITION_TRAJECTORY = Item("position trajectory", 140, 4, signed=True)
PRESENT_VOLTAGE = Item("present input voltage", 144, 2, 50)
PRESENT_TEMPERATURE = Item("present temperature", 146, 1, 25)
BACKUP_READY = Item("backup ready", 147, 1)

#: Twenty bytes of the RAM can be laid side by side, in any order, from INDIRECT_DATA on.
INDIRECT_COUNT = 20
INDIRECT_ADDRESS = 168
INDIRECT_DATA = 208
_INDIRECT = tuple(
    Item(f"indirect address {k + 1}", INDIRECT_ADDRESS + 2 * k, 2, INDIRECT_DATA + k, RAM, SIZE - 1)
    for k in range(INDIRECT_COUNT)
) + tuple(Item(f"indirect data {k + 1}", INDIRECT_DATA + k, 1, 0, 0, 255) for k in range(INDIRECT_COUNT))

#: Every item, by address.
TABLE: dict[int, Item] = {
    item.address: item
    for item in (*(value for value in list(globals().values()) if isinstance(value, Item)), *_INDIRECT)
}
