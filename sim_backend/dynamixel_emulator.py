"""A Dynamixel bus of XC330 servos on a pseudo-terminal: protocol 2.0 as the servos speak it, at the pace of the wire.

``DynamixelEmulator`` puts a ``DynamixelBus`` behind a terminal that any client may open, in a thread of its own. The
servos move with a simulated world, or by themselves. Alone, from the command line, it takes faults as options, and
as lines on its standard input::

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
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from time import monotonic

from msgspec.structs import replace

from drivers import xc330
from drivers.dynamixel_settings import ServoSettings
from drivers.protocols import DeviceError
from sim_backend.dynamixel_bus import DynamixelBus
from sim_backend.dynamixel_mechanics import FreeServos, WorldServos
from sim_backend.dynamixel_servo import Servo
from sim_backend.dynamixel_wire import Parser
from sim_backend.faults import Fault, Faults, Kind, add_fault_options, given_faults, read_faults
from sim_backend.world import World

_BITS_PER_BYTE = 10
_TICK = 0.005
# Linux: struct termios2, which has the speed as a number however the client has set it; the last field is for output.
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("4IB19s2I")
_SPEED_TOLERANCE = 0.03


class DynamixelEmulator:
    """A bus behind a pseudo-terminal, answered by a thread of its own.

    ``path`` is the terminal that a client opens; ``link`` a symbolic link to it that comes and goes with ``plug`` and
    ``unplug``, as a udev link does. With ``wire`` an answer comes when its last bit would have; without, at once. A
    client at another baud rate than the servos' is not heard. Times of faults are the world's, or without one, seconds
    since the emulator was made.
    """

    def __init__(self, bus: DynamixelBus, link: Path | None = None, wire: bool = True) -> None:
        self.bus = bus
        self._link = link
        self._wire = wire
        self._parser = Parser()
        self._fds: tuple[int, int] | None = None
        self._began = monotonic()
        self._free_at = 0.0
        self._on_the_way: deque[tuple[float, bytes]] = deque()
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

    @property
    def faults(self) -> Faults:
        """What goes wrong."""
        return self.bus.troubles.faults

    @property
    def time(self) -> float:
        """The time by which faults are declared, s."""
        return self.bus.time(self._now())

    def inject(
        self,
        kind: Kind,
        duration: float | None = None,
        value: float = 0.0,
        part: str = "",
        count: int | None = None,
    ) -> None:
        """A fault that begins now."""
        self.faults.inject(self.time, kind, duration, value, part, count)

    def unplug(self) -> None:
        """Pull the adapter: the terminal hangs up. The servos keep their power."""
        self.inject(Kind.UNPLUGGED)
        self._do(self._look_at_adapter)

    def plug(self) -> None:
        """Put the adapter back: a new terminal, the same link."""
        self.faults.clear(Kind.UNPLUGGED)
        self._do(self._look_at_adapter)

    # -- in the emulator's thread ---------------------------------------------------------------------------------

    def _do(self, order: Callable[[], None]) -> None:
        done = Event()
        self._orders.put((order, done))
        os.write(self._wake_write, b"x")
        done.wait()

    def _now(self) -> float:
        return monotonic() - self._began

    def _run(self) -> None:
        while not self._ending:
            self._look_at_adapter()
            fds = [self._wake_read] if self._fds is None else [self._wake_read, self._fds[0]]
            rest = self._on_the_way[0][0] - self._now() if self._on_the_way else _TICK
            ready, _, _ = select.select(fds, [], [], min(max(rest, 0.0), _TICK))
            if self._wake_read in ready:
                os.read(self._wake_read, 1)
                order, done = self._orders.get()
                order()
                done.set()
            elif ready:
                self._serve(fds[1])
            elif rest >= _TICK:
                self.bus.update(self._now())
            self._deliver()

    def _look_at_adapter(self) -> None:
        if self.bus.troubles.unplugged(self.bus.time(self._now())):
            self._unplug()
        else:
            self._plug()

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
        self._on_the_way.clear()

    def _serve(self, master: int) -> None:
        try:
            data = os.read(master, 4096)
        except BlockingIOError:
            return
        arrived = self._now()
        speed = _line_speed(master)
        per_byte = _BITS_PER_BYTE / speed if self._wire and speed else 0.0
        self._free_at = max(self._free_at, arrived) + per_byte * len(data)
        for packet in self._parser.feed(data):
            reply, delay = self.bus.handle(packet, self._now(), _baud_number(speed))
            if not reply:
                continue
            self._free_at += per_byte * len(reply) + (delay if self._wire else 0.0)
            late = self.bus.troubles.delay(self.bus.time(self._now()))
            self._on_the_way.append((self._free_at + late, reply))

    def _deliver(self) -> None:
        """Send what has come through the wire by now."""
        while self._on_the_way and self._on_the_way[0][0] <= self._now():
            _, reply = self._on_the_way.popleft()
            if self._fds is not None:
                with suppress(BlockingIOError):  # nobody reads: the bits are gone, as on a wire
                    os.write(self._fds[0], reply)


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
    faults: Sequence[Fault] = (),
    seed: int = 0,
) -> DynamixelEmulator:
    """An emulator of five servos with these ids and this mounting, not started yet.

    Without a world they carry nothing and stand where the mounting's angles are 0. Raises ValueError for a baud rate
    that the XC330 does not have, and for a fault that a bus cannot show.
    """
    if baud not in xc330.BAUDS:
        raise ValueError(f"baud {baud}: want one of {', '.join(map(str, xc330.BAUDS))}")
    servos = [Servo(mount.id, firmware) for mount in mounting]
    for servo in servos:
        servo.write(xc330.BAUD_RATE.address, bytes((xc330.BAUDS.index(baud),)))
    mechanics = (
        FreeServos(tuple(mount.zero * xc330.RAD_PER_COUNT for mount in mounting))
        if world is None
        else WorldServos(world, mounting)
    )
    return DynamixelEmulator(DynamixelBus(servos, mechanics, faults, seed), link, wire)


_HELP = """lines on standard input:
  {device: servos, kind: silent, part: theta_2, duration: 2}
               a fault in YAML that begins now; its kind is drop, corrupt, truncate or wrong_id (value: share of the
               answers; count: how many at most), delay (s), silent, error_bit (value: bits; 32 is overload), reboot or
               unplugged; its part theta_1, theta_2, theta_3, pump, gripper, or nothing for all
  clear        no more faults
  quit"""


def order(emulator: DynamixelEmulator, line: str) -> str:
    """Carry out one line of ``_HELP``; returns what was wrong with it, or nothing."""
    if line.strip() == "clear":
        emulator.faults.clear()
        return ""
    try:
        for fault in read_faults(line, "standard input"):
            emulator.faults.add(replace(fault, start=fault.start + emulator.time))
    except ValueError as error:
        return str(error)
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
    add_fault_options(parser)
    parser.add_argument("--seed", type=int, default=0)
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
            faults=given_faults(given),
            seed=given.seed,
        )
    except (DeviceError, ValueError) as error:
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
