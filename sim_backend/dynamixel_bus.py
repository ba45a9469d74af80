"""The servos on one wire: what they do together with a packet of protocol 2.0 (ROBOTIS e-manual). It knows no clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress

from drivers import xc330
from sim_backend.dynamixel_mechanics import Mechanics
from sim_backend.dynamixel_servo import Servo
from sim_backend.dynamixel_troubles import BusTroubles
from sim_backend.dynamixel_wire import BROADCAST, STATUS, Instruction, Packet, Trouble, crc_bytes, status
from sim_backend.faults import Fault

_READS = (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ, Instruction.BULK_READ, Instruction.FAST_BULK_READ)

#: What the length field of a packet can say.
_LONGEST = 0xFFFF


class DynamixelBus:
    """The servos on one wire, the first of them named as in ``SERVO_NAMES``, and what goes wrong on it."""

    def __init__(
        self, servos: Sequence[Servo], mechanics: Mechanics, faults: Sequence[Fault] = (), seed: int = 0
    ) -> None:
        """Raises ValueError for a fault that a bus cannot show."""
        self.servos = tuple(servos)
        self._mechanics = mechanics
        self.received: Counter[str] = Counter()
        """Sound instruction packets so far, by instruction."""
        self.goals = 0
        """Writes that reached a goal register of a servo under torque, directly or indirectly."""
        self.troubles = BusTroubles(faults, seed)
        self.update(0.0)

    def time(self, now: float) -> float:
        """The time by which faults are declared, s."""
        return self._mechanics.time(now)

    def update(self, now: float) -> None:
        """Let the servos move, look and think."""
        self.troubles.strike(self.servos, self.time(now), now)
        motions = self._mechanics.exchange(now, [servo.drive() for servo in self.servos])
        for servo, motion in zip(self.servos, motions, strict=True):
            servo.update(now, motion)

    def handle(self, packet: Packet, now: float, speed: int | None = None) -> tuple[bytes, float]:
        """What the servos answer, and after what delay of their own (s); ``speed``: baud-rate number of the line."""
        self.update(now)
        awake = [
            servo
            for servo in self.servos
            if servo.hears(now) and (speed is None or servo.get(xc330.BAUD_RATE) == speed)
        ]
        if packet.instruction == STATUS or not awake:
            return b"", 0.0
        delay = awake[0].get(xc330.RETURN_DELAY) * xc330.S_PER_DELAY_UNIT
        if not packet.sound:
            reply = b"".join(
                status(servo.servo_id, Trouble.CRC | servo.alert) for servo in awake if servo.servo_id == packet.target
            )
            return self.troubles.spoilt(reply, self.time(now)), delay
        for servo in awake:
            servo.heard(now)
        with suppress(ValueError):
            self.received[Instruction(packet.instruction).name] += 1
        reply = self._answers(packet, {servo.servo_id: servo for servo in awake}, now)
        if packet.instruction not in (*_READS, Instruction.READ, Instruction.PING):
            self.update(now)
        return self.troubles.spoilt(reply, self.time(now)), delay

    def _answers(self, packet: Packet, awake: dict[int, Servo], now: float) -> bytes:
        code, p = packet.instruction, packet.parameters
        if code in _READS:
            return self._group_read(code, p, awake) if packet.target == BROADCAST else b""
        if code == Instruction.SYNC_WRITE and len(p) >= 4:
            size = _word(p, 2) + 1
            for k in range(4, len(p) - size + 1, size):
                self._write(awake.get(p[k]), _word(p, 0), p[k + 1 : k + size])
            return b""
        if code == Instruction.BULK_WRITE:
            while len(p) > 5:
                size = _word(p, 3)
                self._write(awake.get(p[0]), _word(p, 1), p[5 : 5 + size])
                p = p[5 + size :]
            return b""
        if packet.target != BROADCAST:
            servo = awake.get(packet.target)
            return self._one(servo, code, p, now) if servo is not None else b""
        # Only the ping is answered when it goes to all.
        replies = [self._one(awake[servo], code, p, now, to_all=True) for servo in sorted(awake)]
        return b"".join(replies) if code == Instruction.PING else b""

    def _write(self, servo: Servo | None, address: int, data: bytes) -> int:
        if servo is None:
            return Trouble.NONE
        driven = servo.torque_on
        trouble = servo.write(address, data)
        if not trouble and driven and servo.reaches_goal(address, len(data)):
            self.goals += 1
        return trouble

    def _one(self, servo: Servo, code: int, p: bytes, now: float, to_all: bool = False) -> bytes:
        """Do what was asked of one servo; its status packet, if its status return level has it sent."""
        name, level = servo.servo_id, servo.get(xc330.STATUS_RETURN_LEVEL)
        alert, data, needed = servo.alert, b"", 2
        if code == Instruction.PING:
            data = xc330.MODEL_NUMBER.encode(servo.get(xc330.MODEL_NUMBER)) + bytes((servo.get(xc330.FIRMWARE),))
            trouble, needed = int(Trouble.NONE), 0
        elif code == Instruction.READ and len(p) == 4:
            trouble, data = servo.read(_word(p, 0), _word(p, 2))
            needed = 1
        elif code == Instruction.WRITE and len(p) > 2:
            trouble = self._write(servo, _word(p, 0), p[2:])
        elif code == Instruction.REG_WRITE and len(p) > 2:
            trouble = servo.register(_word(p, 0), p[2:])
        elif code == Instruction.ACTION:
            trouble = servo.act()
        elif code == Instruction.FACTORY_RESET and len(p) == 1:
            # Firmware 42 and later does not reset everything when all are asked at once.
            trouble = servo.factory_reset(p[0], now) if not (to_all and p[0] == 0xFF) else Trouble.RESULT_FAIL
        elif code == Instruction.REBOOT:
            servo.reboot(now)
            trouble = Trouble.NONE
        elif code == Instruction.CLEAR:
            trouble = servo.clear(p)
        else:
            trouble = Trouble.INSTRUCTION
        return status(name, trouble | alert, data) if level >= needed else b""

    def _group_read(self, code: int, p: bytes, awake: dict[int, Servo]) -> bytes:
        if code in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
            asked = [(servo, _word(p, 0), _word(p, 2)) for servo in p[4:]] if len(p) > 4 else []
        else:
            asked = [(p[k], _word(p, k + 1), _word(p, k + 3)) for k in range(0, len(p) - 4, 5)]
        fast = code in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
        if fast and any(servo.get(xc330.FIRMWARE) < xc330.FAST_READ_FIRMWARE for servo in awake.values()):
            return b""
        reply = b""
        if fast and asked:
            # One status packet that the servos build together; nothing in it is stuffed.
            length = 1 + sum(size + 4 for _, _, size in asked)
            if length > _LONGEST:
                return b""
            reply = b"\xff\xff\xfd\x00" + bytes((BROADCAST,)) + length.to_bytes(2, "little") + bytes((STATUS,))
        for name, address, size in asked:
            servo = awake.get(name)
            # Each servo waits for the one before it: behind a silent one there is silence.
            if servo is None or servo.get(xc330.STATUS_RETURN_LEVEL) < 1:
                return reply if name != asked[0][0] else b""
            trouble, data = servo.read(address, size)
            if fast:
                reply += bytes((trouble | servo.alert, name)) + data.ljust(size, b"\0")
                reply += crc_bytes(reply)
            else:
                reply += status(name, trouble | servo.alert, data)
        return reply


def _word(data: bytes, k: int) -> int:
    return data[k] | data[k + 1] << 8
