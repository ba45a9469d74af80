"""What is written to the servos in flight: goals, operating modes, torque on and off.

A change of the operating mode needs torque off, and then the arm is limp. So the whole change is four short packets to
all servos at once, written one behind the other, and nothing is waited for in between
(docs/decisions/0012-a-short-limp.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from drivers import xc330
from drivers.dynamixel_bus import Bus, Corrupt, NoAnswer, Refused
from drivers.dynamixel_settings import DynamixelSettings
from drivers.dynamixel_setup import SHUT_DOWN, WRITE, WRITE_AT, Servo, SetUp
from drivers.mailbox import Level, Teller
from drivers.samples import JointMode, ServoCommand
from drivers.xc330 import Item, Mode

_JOINTS = 3
_FAR = 0.05  # rad that a servo has to go back for its arrival to be told


class Goals:
    """Brings the servos to what a command asks for. Calls raise BusError."""

    def __init__(self, settings: DynamixelSettings, servos: Sequence[Servo], set_up: SetUp, teller: Teller) -> None:
        self._settings = settings
        self._servos = servos
        self._set_up = set_up
        self._teller = teller
        self._goals_ns = 0
        self._away: list[Servo] = []

    def apply(self, bus: Bus, command: ServoCommand, now: int) -> None:
        """Write what ``command`` asks for; ``now`` in nanoseconds."""
        if command.mode is JointMode.OFF:
            if any(servo.engaged or servo.torque_on for servo in self._servos):
                self.relax(bus)
            return
        joint = Mode.CURRENT if command.mode is JointMode.TORQUE else Mode.CURRENT_BASED_POSITION
        late = [servo for servo in self._servos if _is_late(servo, joint)]
        if late:
            self._engage(bus, late, joint, now)
        dt = min((now - self._goals_ns) * 1e-9, 0.1)
        self._goals_ns = now
        goals = {
            servo.settings.id: self._goal(servo, command, now, dt)
            for servo in self._servos
            if (servo.engaged and servo.answers) or servo in late
        }
        if goals:
            bus.sync_write(WRITE_AT, WRITE.size, goals)
        if self._away and not any(servo.homing is not None for servo in self._servos):
            names = ", ".join(servo.name for servo in self._away)
            self._teller.tell(Level.INFO, f"{names} {'is' if len(self._away) == 1 else 'are'} back at the goal")
            self._away.clear()

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
            else:
                if servo not in self._away and servo.answers and abs(goal - servo.homing) > _FAR:
                    self._away.append(servo)
                goal = servo.homing
        limit = command.current_limit if servo.index < _JOINTS else servo.settings.current_limit
        return WRITE.pack(abs(servo.limited(limit)), servo.counts(goal))

    def _engage(self, bus: Bus, servos: Sequence[Servo], joint: Mode, now: int) -> None:
        """Bring servos to the mode of the command with torque on and the watchdog armed; no goal is given yet."""
        switched = [servo for servo in servos if servo.mode is not _mode_of(servo, joint)]
        idle = [servo for servo in servos if not servo.engaged]
        units = round(self._settings.watchdog / xc330.S_PER_WATCHDOG_UNIT)
        # A watchdog that has tripped locks the goals. That of a servo at work stays armed throughout.
        _all(bus, idle, xc330.BUS_WATCHDOG, lambda servo: 0)
        if switched:
            _all(bus, switched, xc330.TORQUE_ENABLE, lambda servo: 0)
            for servo in switched:
                servo.engaged, servo.mode = False, None
            _all(bus, switched, xc330.OPERATING_MODE, lambda servo: _mode_of(servo, joint))
            self._set_up.shape(bus, switched)
        # A servo enters current mode with its current limit as the goal, and its place may have changed since.
        rest = {servo.settings.id: WRITE.pack(0, servo.counts(servo.position)) for servo in servos}
        bus.sync_write(WRITE_AT, WRITE.size, rest)
        _all(bus, idle, xc330.BUS_WATCHDOG, lambda servo: units)
        _all(bus, servos, xc330.TORQUE_ENABLE, lambda servo: 1)
        self._see_mode(bus, switched, joint)
        for servo in servos:
            servo.mode = _mode_of(servo, joint)
            servo.engaged = servo.answers
            servo.homing = servo.position if servo.interrupted and servo.mode is not Mode.CURRENT else None
            servo.ramp_ns = now if servo.interrupted and servo.mode is Mode.CURRENT else None
            servo.interrupted = not servo.answers

    def _see_mode(self, bus: Bus, switched: Sequence[Servo], joint: Mode) -> None:
        """Make sure of the mode before strength is given: in the wrong one, a limit would be a goal.

        Those that are not heard are taken to have understood: it is for them that an arm is left to hold by itself.
        """
        asked = [servo for servo in switched if servo.answers and not servo.suspect]
        if not asked:
            return
        item = xc330.OPERATING_MODE
        try:
            answers = bus.sync_read(item.address, item.size, [servo.settings.id for servo in asked], self._set_up.fast)
        except (NoAnswer, Corrupt):
            return
        for servo, answer in zip(asked, answers, strict=True):
            if item.decode(answer.data) != _mode_of(servo, joint):
                raise Refused(servo.settings.id, "it did not take the operating mode")

    def relax(self, bus: Bus) -> None:
        """Torque off on all servos."""
        _all(bus, self._servos, xc330.TORQUE_ENABLE, lambda servo: 0)
        _all(bus, self._servos, xc330.BUS_WATCHDOG, lambda servo: 0)
        for servo in self._servos:
            servo.engaged = servo.interrupted = False

    def stop_current(self, bus: Bus) -> None:
        """The 330 size was seen to run on after the watchdog's trip: take the torque of those in current mode."""
        servos = [servo for servo in self._servos if servo.engaged and servo.mode is Mode.CURRENT]
        _all(bus, servos, xc330.TORQUE_ENABLE, lambda servo: 0)
        for servo in servos:
            servo.engaged, servo.interrupted = False, True


def _is_late(servo: Servo, joint: Mode) -> bool:
    """It is to be brought to the mode of the command: if it can be, or must be though nobody hears it."""
    if servo.error & SHUT_DOWN:
        return False
    if servo.answers and not servo.suspect:
        return not (servo.engaged and servo.mode is _mode_of(servo, joint))
    return servo.mode is Mode.CURRENT and joint is not Mode.CURRENT


def _mode_of(servo: Servo, joint: Mode) -> Mode:
    return joint if servo.index < _JOINTS else Mode.CURRENT_BASED_POSITION


def _all(bus: Bus, servos: Iterable[Servo], item: Item, value: Callable[[Servo], int]) -> None:
    if data := {servo.settings.id: item.encode(value(servo)) for servo in servos}:
        bus.sync_write(item.address, item.size, data)
