"""A servo bus in the time of its bytes: the real driver before emulated servos, without a terminal or a thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

from drivers import xc330
from drivers.dynamixel import Dynamixel
from drivers.dynamixel_bus import Port
from drivers.dynamixel_settings import DynamixelSettings
from drivers.protocols import DeviceError
from drivers.samples import ServoCommand, ServoState
from sim_backend.dynamixel_bus import DynamixelBus
from sim_backend.dynamixel_mechanics import FreeServos, Mechanics
from sim_backend.dynamixel_servo import Servo
from sim_backend.dynamixel_wire import Parser
from sim_backend.faults import Kind

_BITS_PER_BYTE = 10


class Wire:
    """In the place of a ``Port``. ``latency`` (s) is the adapter's, for each answer; ``seen`` hears of each packet."""

    def __init__(self, servos: DynamixelBus, baud: int, margin: float, latency: float) -> None:
        self.is_using = False
        self.margin = margin
        self.unasked = 0
        self.now = 0.0
        self.seen: Callable[[], None] = lambda: None
        self.late: list[bytes] = []
        """Answers that come only when the next question has been asked."""
        self.hold_back = 0
        """So many of the next answers are late."""
        self.plugged = True
        self._servos = servos
        self._baud = baud
        self._latency = latency
        self._parser = Parser()
        self._answer = b""
        self._deadline = 0.0
        self._sent = 0

    def _pass(self, count: int) -> float:
        self.now += count * _BITS_PER_BYTE / self._baud
        return self.now

    def close(self) -> None:
        pass

    def getBaudRate(self) -> int:
        return self._baud

    def clearPort(self) -> None:
        self.unasked += bool(self._answer)
        self._answer = b""

    def writePort(self, packet: Sequence[int]) -> int:
        if not self.plugged:
            raise OSError("the serial adapter is gone")
        self._sent = len(packet)
        now = self._pass(len(packet))
        for each in self._parser.feed(bytes(packet)):
            reply, _ = self._servos.handle(each, now)
            self.seen()
            if reply and self.hold_back:
                self.hold_back -= 1
                self.late.append(reply)
            elif reply:
                self._answer = b"".join(self.late) + reply
                self.late.clear()
                self.now += self._latency
        return len(packet)

    def readPort(self, length: int) -> bytes:
        if not self._answer:
            self.now = max(self.now, self._deadline)
            return b""
        data, self._answer = self._answer[:length], self._answer[length:]
        self._pass(len(data))
        return data

    def setPacketTimeout(self, packet_length: int) -> None:
        self._deadline = self.now + packet_length * _BITS_PER_BYTE / self._baud + self._latency + self.margin

    def isPacketTimeout(self) -> bool:
        return self.now >= self._deadline


class Bench:
    """Driver, servos and the wire between them; the servos turn ``mechanics``, or nothing."""

    def __init__(self, settings: DynamixelSettings, latency: float = 0.0, mechanics: Mechanics | None = None) -> None:
        self.settings = settings
        servos = [Servo(mount.id) for mount in settings.servos]
        self.free = FreeServos(tuple(mount.zero * xc330.RAD_PER_COUNT for mount in settings.servos))
        self.bus = DynamixelBus(servos, mechanics or self.free)
        self.wire = Wire(self.bus, settings.baud, settings.reply_margin, latency)
        self.plugged = True
        self.driver = Dynamixel(settings, lambda: round(self.wire.now * 1e9), self._open)
        self.driver._connect()

    def _open(self, path: str, baud: int, margin: float) -> Port:
        if not self.plugged:
            raise DeviceError("not plugged in")
        return cast(Port, self.wire)

    def once(self, command: ServoCommand | None = None) -> None:
        """What the driver's thread does with this command."""
        self.wire.plugged = self.plugged
        if command is not None:
            self.driver._command = (command, round(self.wire.now * 1e9))
        self.driver._once()

    def cycle(self, command: ServoCommand | None = None) -> ServoState | None:
        """One, 4 ms after the last one or as soon as it is over; its sample if it made one."""
        began = self.wire.now
        self.once(command)
        ended = self.wire.now
        self.wire.now = max(began + 0.004, self.wire.now)
        self.bus.update(self.wire.now)
        state = self.driver.latest()
        return state if state is not None and began * 1e9 <= state.t_ns + 1.0 <= ended * 1e9 + 2.0 else None

    def inject(self, kind: Kind, **fault: float | str | int | None) -> None:
        self.bus.troubles.faults.inject(self.wire.now, kind, **fault)  # type: ignore[arg-type]


class Strength:
    """When each joint servo has been without strength: torque off, or a limit of nothing."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._since: list[float | None] = [None, None, None]
        self.limp: list[float] = []
        """How long each time, s."""
        self.goals: list[float] = []
        """How far the goal lay from where the servo stood when it got its strength back, rad."""
        bench.wire.seen = self._look

    def _look(self) -> None:
        now = self._bench.wire.now
        for k, servo in enumerate(self._bench.bus.servos[:3]):
            drive = servo.drive()
            weak = drive.mode is None or drive.limit == 0.0
            since = self._since[k]
            if weak and since is None:
                self._since[k] = now
            elif not weak and since is not None:
                self.limp.append(now - since)
                self._since[k] = None
                if drive.mode is not xc330.Mode.CURRENT:
                    self.goals.append(abs(drive.goal - self._bench.free.position[k]))
