"""What declared faults do to an emulated servo bus: to its servos, to its answers, and to its adapter."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

from drivers.samples import SERVO_NAMES
from drivers.xc330 import HardwareError
from sim_backend.dynamixel_servo import Servo
from sim_backend.dynamixel_wire import BROADCAST, crc
from sim_backend.faults import Fault, Faults, Kind

DEVICE = "servos"
KINDS = (
    Kind.DROP, Kind.CORRUPT, Kind.TRUNCATE, Kind.WRONG_ID, Kind.DELAY, Kind.SILENT, Kind.ERROR_BIT, Kind.REBOOT,
    Kind.UNPLUGGED,
)  # fmt: skip


class BusTroubles:
    """The faults of one bus. DROP, CORRUPT, TRUNCATE, WRONG_ID and DELAY strike answers; SILENT, ERROR_BIT and REBOOT
    one servo, or all; UNPLUGGED is the adapter, whose servos keep their power.

    An error comes back after a reboot while its fault lasts. A reboot takes at least what a servo's own does.
    """

    def __init__(self, declared: Sequence[Fault], seed: int) -> None:
        self.faults = Faults(DEVICE, KINDS, declared, SERVO_NAMES)
        self._random = Random(seed)

    def strike(self, servos: Sequence[Servo], t: float, now: float) -> None:
        """Let what is in force at ``t`` befall the servos; ``now`` is their own time."""
        rebooted = self.faults.begun(Kind.REBOOT, t)
        failed = [*self.faults.begun(Kind.ERROR_BIT, t), *self.faults.active(t)]
        for name, servo in zip(SERVO_NAMES, servos, strict=False):
            if any(fault.part in ("", name) for fault in rebooted):
                servo.reboot(now)
            servo.silent = False
            for fault in failed:
                if fault.part in ("", name):
                    if fault.kind is Kind.ERROR_BIT and servo.hears(now):
                        servo.fail(HardwareError(round(fault.value)))
                    servo.silent = servo.silent or fault.kind in (Kind.SILENT, Kind.REBOOT)

    def spoilt(self, reply: bytes, t: float) -> bytes:
        """What is left of an answer."""
        if not reply:
            return reply
        if self._struck(Kind.DROP, t):
            return b""
        if self._struck(Kind.CORRUPT, t):
            middle = len(reply) // 2
            return reply[:middle] + bytes((reply[middle] ^ 0x10,)) + reply[middle + 1 :]
        if self._struck(Kind.TRUNCATE, t):
            return reply[: len(reply) // 2]
        return _renamed(reply) if self._struck(Kind.WRONG_ID, t) else reply

    def delay(self, t: float) -> float:
        """How long the next answer is held back, s."""
        fault = self.faults.strike(Kind.DELAY, t)
        return 0.0 if fault is None else fault.value

    def unplugged(self, t: float) -> bool:
        """The adapter is pulled."""
        return self.faults.find(Kind.UNPLUGGED, t) is not None

    def _struck(self, kind: Kind, t: float) -> bool:
        return self.faults.strike(kind, t, chance=self._random.random()) is not None


def _renamed(reply: bytes) -> bytes:
    """The answer as if its (first) servo had another id, with a right CRC."""
    spoilt = bytearray(reply)
    length = 7 + (reply[5] | reply[6] << 8)
    spoilt[9 if reply[4] == BROADCAST else 4] ^= 0x40
    spoilt[length - 2 : length] = crc(spoilt[: length - 2]).to_bytes(2, "little")
    return bytes(spoilt)
