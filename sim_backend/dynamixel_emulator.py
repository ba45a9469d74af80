"""A Dynamixel bus of XC330 servos on a pseudo-terminal: protocol 2.0 as the servos speak it, at the pace of the wire.

``DynamixelBus`` answers packets and knows no clock; ``DynamixelEmulator`` puts it behind a terminal that any client may
open, in a thread of its own. The servos move with a simulated world (``WorldServos``) or by themselves
(``FreeServos``). Alone, from the command line, it takes faults as lines on its standard input::

    python -m sim_backend.dynamixel_emulator --link /tmp/servos --baud 1000000
"""

from __future__ import annotations

import argparse
import fcntl
import os
import select
import struct
import sys
import tty
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from random import Random
from threading import Event, Thread
from time import monotonic, sleep
from typing import Protocol

from drivers import xc330
from drivers.dynamixel_settings import ServoSettings
from drivers.protocols import DeviceError
from drivers.samples import JointMode, ServoCommand
from drivers.xc330 import HardwareError, Mode
from sim_backend import layout as at
from sim_backend.dynamixel_servo import Drive, FreeServos, Motion, Servo
from sim_backend.dynamixel_wire import BROADCAST, STATUS, Instruction, Packet, Parser, Trouble, crc, crc_bytes, status
from sim_backend.world import World

_BITS_PER_BYTE = 10
_TICK = 0.005
# Linux: struct termios2, which has the speed as a number however the client has set it; the last field is for output.
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("4IB19s2I")
_SPEED_TOLERANCE = 0.03
_READS = (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ, Instruction.BULK_READ, Instruction.FAST_BULK_READ)


class Mechanics(Protocol):
    """What the servos turn."""

    def exchange(self, now: float, drives: list[Drive]) -> list[Motion]:
        """Take what each servo's motor is asked for from ``now`` (s) on; tell where each is at ``now``."""


class WorldServos:
    """The five servos of a simulated world, in the order of ``SERVO_NAMES``, mounted as ``mounting`` says.

    The world drives its three joints in one mode and with one current limit: while some are in a position mode, those
    in current mode go limp, and the smallest limit holds for all. Until a servo is first switched on, the world's arm
    rests as it was set up. Currents and velocities carry the world's noise if its sensors are not ideal.
    """

    def __init__(self, world: World, mounting: Sequence[ServoSettings], seed: int = 0) -> None:
        self._world = world
        self._mounting = tuple(mounting)
        self._drives: list[Drive] = []
        self._random = Random(seed)
        sensors = world.params.sensors
        self._temperature = sensors.servos.temperature
        self._velocity_noise = 0.0 if sensors.ideal else sensors.servos.velocity_noise
        self._current_noise = 0.0 if sensors.ideal else sensors.servos.current_noise

    def exchange(self, now: float, drives: list[Drive]) -> list[Motion]:
        """Command the world when something has changed; look at its newest snapshot."""
        del now
        if drives != self._drives and (self._drives or any(drive.mode is not None for drive in drives)):
            self._drives = list(drives)
            self._command(drives)
        x = self._world.snapshot.x
        position = (*x[at.JOINT : at.JOINT + 3], x[at.PUMP], x[at.GRIPPER])
        velocity = (*x[at.JOINT_RATE : at.JOINT_RATE + 3], *x[at.TOOL_SERVO_RATE : at.TOOL_SERVO_RATE + 2])
        current = (*x[at.SERVO_CURRENT : at.SERVO_CURRENT + 3], 0.0, 0.0)
        volts, noise = self._world.vehicle.servo.voltage, self._random.gauss
        return [
            Motion(
                mount.sign * position[k] + mount.zero * xc330.RAD_PER_COUNT,
                mount.sign * velocity[k] + noise(0.0, self._velocity_noise),
                mount.sign * current[k] + noise(0.0, self._current_noise),
                volts,
                self._temperature,
            )
            for k, mount in enumerate(self._mounting)
        ]

    def _command(self, drives: list[Drive]) -> None:
        positioned = [drive for drive in drives[:3] if _held(drive)]
        limp = [
            not (_held(drive) or (k < 3 and drive.mode is Mode.CURRENT and not positioned))
            for k, drive in enumerate(drives)
        ]
        torque = [0.0, 0.0, 0.0]
        goals = [0.0] * 5
        for k, (drive, mount) in enumerate(zip(drives, self._mounting, strict=True)):
            if _held(drive):
                goals[k] = mount.sign * (drive.goal - mount.zero * xc330.RAD_PER_COUNT)
            elif drive.mode is Mode.CURRENT and k < 3:
                torque[k] = mount.sign * drive.goal * mount.torque_constant
        self._world.command_servos(
            ServoCommand(
                mode=JointMode.POSITION if positioned else JointMode.TORQUE,
                torque=(torque[0], torque[1], torque[2]),
                position=(goals[0], goals[1], goals[2], goals[3], goals[4]),
                current_limit=min((drive.limit for drive in positioned), default=0.0),
            ),
            limp=(limp[0], limp[1], limp[2], limp[3], limp[4]),
        )


def _held(drive: Drive) -> bool:
    return drive.mode in (Mode.POSITION, Mode.EXTENDED_POSITION, Mode.CURRENT_BASED_POSITION)


class DynamixelBus:
    """The servos on one wire, and what can go wrong on it.

    The faults of the wire count answers: ``drop``, ``corrupt``, ``wrong_id`` and ``truncate`` spoil so many of the next
    ones; ``delay`` (s) holds back the next ``delayed`` ones.
    """

    def __init__(self, servos: Sequence[Servo], mechanics: Mechanics) -> None:
        self.servos = tuple(servos)
        self._mechanics = mechanics
        self.received: Counter[str] = Counter()
        """Sound instruction packets so far, by instruction."""
        self.goals = 0
        """Writes that reached a goal register of a servo under torque, directly or indirectly."""
        self.drop = 0
        self.corrupt = 0
        self.wrong_id = 0
        self.truncate = 0
        self.delay = 0.0
        self.delayed = 0
        self.update(0.0)

    def servo(self, servo: int) -> Servo:
        """The servo with this id; KeyError if there is none."""
        for each in self.servos:
            if each.servo_id == servo:
                return each
        raise KeyError(f"no servo with id {servo}; there are {[each.servo_id for each in self.servos]}")

    def update(self, now: float) -> None:
        """Let the servos move, look and think."""
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
            return self._spoil(reply), delay
        for servo in awake:
            servo.heard(now)
        with suppress(ValueError):
            self.received[Instruction(packet.instruction).name] += 1
        reply = self._answers(packet, {servo.servo_id: servo for servo in awake}, now)
        if packet.instruction not in (*_READS, Instruction.READ, Instruction.PING):
            self.update(now)
        return self._spoil(reply), delay

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

    def _spoil(self, reply: bytes) -> bytes:
        if not reply:
            return reply
        if self.drop:
            self.drop -= 1
            return b""
        if self.corrupt:
            self.corrupt -= 1
            middle = len(reply) // 2
            return reply[:middle] + bytes((reply[middle] ^ 0x10,)) + reply[middle + 1 :]
        if self.truncate:
            self.truncate -= 1
            return reply[: len(reply) // 2]
        if self.wrong_id:
            self.wrong_id -= 1
            return _renamed(reply)
        return reply

    def hold_back(self) -> float:
        """How long the next answer is held back, s."""
        if not self.delayed:
            return 0.0
        self.delayed -= 1
        return self.delay


def _word(data: bytes, k: int) -> int:
    return data[k] | data[k + 1] << 8


def _renamed(reply: bytes) -> bytes:
    """The answer as if its (first) servo had another id, with a right CRC."""
    spoilt = bytearray(reply)
    length = 7 + _word(reply, 5)
    spoilt[9 if reply[4] == BROADCAST else 4] ^= 0x40
    spoilt[length - 2 : length] = crc(spoilt[: length - 2]).to_bytes(2, "little")
    return bytes(spoilt)


class DynamixelEmulator:
    """A bus behind a pseudo-terminal, answered by a thread of its own.

    ``path`` is the terminal that a client opens; ``link`` a symbolic link to it that comes and goes with ``plug`` and
    ``unplug``, as a udev link does. With ``wire`` an answer comes when its last bit would have; without, at once. A
    client at another baud rate than the servos' is not heard.
    """

    def __init__(self, bus: DynamixelBus, link: Path | None = None, wire: bool = True) -> None:
        self.bus = bus
        self._link = link
        self._wire = wire
        self._parser = Parser()
        self._fds: tuple[int, int] | None = None
        self._free_at = 0.0
        self._orders: SimpleQueue[tuple[Callable[[], None], Event]] = SimpleQueue()
        self._wake_read, self._wake_write = os.pipe()
        self._thread: Thread | None = None
        self._ending = False
        self._path = ""
        self._plug()

    @property
    def path(self) -> str:
        """What a client opens."""
        return str(self._link) if self._link is not None else self._path

    def start(self) -> None:
        """Answer, in a thread of its own."""
        self._thread = Thread(target=self._run, name="dynamixel emulator", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and take the terminal away. Safe to call twice."""
        if self._wake_write < 0:
            return
        if self._thread is not None:
            self._do(self._end)
            self._thread.join()
        else:
            self._unplug()
        os.close(self._wake_read)
        os.close(self._wake_write)
        self._wake_write = -1

    def unplug(self) -> None:
        """Pull the adapter: the terminal hangs up. The servos keep their power."""
        self._do(self._unplug)

    def plug(self) -> None:
        """Put the adapter back: a new terminal, the same link."""
        self._do(self._plug)

    # -- in the emulator's thread ---------------------------------------------------------------------------------

    def _do(self, order: Callable[[], None]) -> None:
        done = Event()
        self._orders.put((order, done))
        os.write(self._wake_write, b"x")
        done.wait()

    def _run(self) -> None:
        while not self._ending:
            fds = [self._wake_read] if self._fds is None else [self._wake_read, self._fds[0]]
            ready, _, _ = select.select(fds, [], [], _TICK)
            if self._wake_read in ready:
                os.read(self._wake_read, 1)
                order, done = self._orders.get()
                order()
                done.set()
            elif ready:
                self._serve(fds[1])
            else:
                self.bus.update(monotonic())

    def _end(self) -> None:
        self._unplug()
        self._ending = True

    def _plug(self) -> None:
        if self._fds is not None:
            return
        master, slave = os.openpty()
        # The slave stays open here too, so that a client may come and go without a hang-up.
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._fds = (master, slave)
        self._path = os.ttyname(slave)
        self._parser.clear()
        if self._link is not None:
            new = self._link.with_name(f"{self._link.name}.{os.getpid()}")
            try:
                new.unlink(missing_ok=True)
                new.symlink_to(self._path)
                new.replace(self._link)
            except OSError as error:
                raise DeviceError(
                    f"servo bus emulator: cannot make the link {self._link} ({error.strerror})"
                ) from error

    def _unplug(self) -> None:
        if self._fds is None:
            return
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        for fd in self._fds:
            os.close(fd)
        self._fds = None

    def _serve(self, master: int) -> None:
        try:
            data = os.read(master, 4096)
        except BlockingIOError:
            return
        arrived = monotonic()
        speed = _line_speed(master)
        per_byte = _BITS_PER_BYTE / speed if self._wire and speed else 0.0
        self._free_at = max(self._free_at, arrived) + per_byte * len(data)
        for packet in self._parser.feed(data):
            reply, delay = self.bus.handle(packet, monotonic(), _baud_number(speed))
            if not reply:
                continue
            self._free_at += per_byte * len(reply) + (delay if self._wire else 0.0) + self.bus.hold_back()
            rest = self._free_at - monotonic()
            if rest > 0.0:
                sleep(rest)
            with suppress(BlockingIOError):  # nobody reads: the bits are gone, as on a wire
                os.write(master, reply)


def _line_speed(master: int) -> int:
    """Bits per second that the client has set."""
    return int(_TERMIOS2.unpack(fcntl.ioctl(master, _TCGETS2, bytes(_TERMIOS2.size)))[-1])


def _baud_number(speed: int) -> int:
    """The baud rate as the servos count them, or -1."""
    for number, baud in enumerate(xc330.BAUDS):
        if abs(speed - baud) <= _SPEED_TOLERANCE * baud:
            return number
    return -1


def emulate(
    mounting: Sequence[ServoSettings],
    *,
    world: World | None = None,
    link: Path | None = None,
    baud: int = 1_000_000,
    firmware: int = 52,
    wire: bool = True,
) -> DynamixelEmulator:
    """An emulator of five servos with these ids and this mounting, not started yet.

    Without a world they carry nothing and stand where the mounting's angles are 0. Raises ValueError for a baud rate
    that the XC330 does not have.
    """
    if baud not in xc330.BAUDS:
        raise ValueError(f"baud {baud}: want one of {', '.join(map(str, xc330.BAUDS))}")
    servos = [Servo(mount.id, firmware) for mount in mounting]
    for servo in servos:
        servo.write(xc330.BAUD_RATE.address, bytes((xc330.BAUDS.index(baud),)))
    if world is not None:
        return DynamixelEmulator(DynamixelBus(servos, WorldServos(world, mounting)), link, wire)
    free = FreeServos(tuple(mount.zero * xc330.RAD_PER_COUNT for mount in mounting))
    return DynamixelEmulator(DynamixelBus(servos, free), link, wire)


_HELP = """lines on standard input:
  drop N | corrupt N | truncate N | wrong-id N     spoil the next N answers
  delay S N                                        hold the next N answers back by S seconds
  silent ID | speak ID                             a servo that neither hears nor answers, and its return
  error ID BITS | overload ID | reboot ID          hardware errors and restarts
  unplug | plug                                    the adapter
  quit"""


def order(emulator: DynamixelEmulator, line: str) -> str:
    """Carry out one line of ``_HELP``; returns what was wrong with it, or nothing."""
    bus = emulator.bus
    words = line.split()
    try:
        match words:
            case []:
                pass
            case ["drop" | "corrupt" | "truncate" as what, count]:
                setattr(bus, what, int(count))
            case ["wrong-id", count]:
                bus.wrong_id = int(count)
            case ["delay", seconds, count]:
                bus.delay, bus.delayed = float(seconds), int(count)
            case ["silent" | "speak" as what, servo]:
                bus.servo(int(servo)).silent = what == "silent"
            case ["error", servo, bits]:
                bus.servo(int(servo)).fail(HardwareError(int(bits, 0)))
            case ["overload", servo]:
                bus.servo(int(servo)).fail(HardwareError.OVERLOAD)
            case ["reboot", servo]:
                bus.servo(int(servo)).reboot(monotonic())
            case ["unplug"]:
                emulator.unplug()
            case ["plug"]:
                emulator.plug()
            case _:
                return f"{line.strip()!r} is not understood\n{_HELP}"
    except (ValueError, KeyError) as error:
        return f"{line.strip()!r}: {error.args[0] if error.args else error}"
    return ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Emulate a bus until standard input says quit, or until the process is stopped. Exit code 2 for a wrong input."""
    parser = argparse.ArgumentParser(
        prog="python -m sim_backend.dynamixel_emulator",
        description="Five emulated XC330 servos on a pseudo-terminal.",
        epilog=_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--link", type=Path, help="symbolic link to make to the terminal")
    parser.add_argument("--baud", type=int, default=1_000_000, choices=xc330.BAUDS, metavar="N", help="of the servos")
    parser.add_argument("--ids", type=int, nargs=5, default=[1, 2, 3, 4, 5], metavar="ID", help="0 to 252")
    parser.add_argument("--firmware", type=int, default=52, help="below 46 there is no fast sync read")
    parser.add_argument("--instant", action="store_true", help="answer at once instead of at the pace of the wire")
    given = parser.parse_args(arguments)
    if len(set(given.ids)) < 5 or not all(0 <= servo <= 252 for servo in given.ids):
        parser.error(f"--ids {given.ids}: want five different numbers from 0 to 252")
    try:
        emulator = emulate(
            [ServoSettings(id=servo) for servo in given.ids],
            link=given.link,
            baud=given.baud,
            firmware=given.firmware,
            wire=not given.instant,
        )
    except DeviceError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    emulator.start()
    try:
        sys.stdout.write(f"{emulator.path}\n")
        sys.stdout.flush()
        for line in sys.stdin:
            if line.strip() == "quit":
                return 0
            if trouble := order(emulator, line):
                sys.stderr.write(f"{trouble}\n")
        # Without a terminal or a pipe, standard input ends at once; then only a signal stops it.
        Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        emulator.stop()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
