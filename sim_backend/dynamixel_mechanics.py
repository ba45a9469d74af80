"""What the servos of an emulated bus turn: a simulated world's arm, or nothing at all."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, inf
from random import Random
from typing import NamedTuple, Protocol

from drivers import xc330
from drivers.dynamixel_settings import ServoSettings
from drivers.samples import JointMode, ServoCommand
from drivers.xc330 import Mode
from sim_backend import layout as at
from sim_backend.world import World

POSITIONED = (Mode.POSITION, Mode.EXTENDED_POSITION, Mode.CURRENT_BASED_POSITION)


class Drive(NamedTuple):
    """What a servo's electronics ask of its motor. Angles in rad of the servo's own encoder."""

    mode: Mode | None
    """None: torque is off."""
    goal: float = 0.0
    """A, rad/s, rad or share of full PWM, by mode."""
    limit: float = inf
    """Largest current in a position mode, A."""


class Motion(NamedTuple):
    """What a servo's sensors see. Angles in rad of the servo's own encoder."""

    position: float
    velocity: float = 0.0
    current: float = 0.0
    voltage: float = 5.0
    temperature: float = 30.0


class Mechanics(Protocol):
    """What the servos turn."""

    def exchange(self, now: float, drives: list[Drive]) -> list[Motion]:
        """Take what each servo's motor is asked for from ``now`` (s) on; tell where each is at ``now``."""

    def time(self, now: float) -> float:
        """The time by which faults are declared, s."""


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
        self._velocity_noise = sensors.servos.velocity_noise
        self._current_noise = sensors.servos.current_noise

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

    def time(self, now: float) -> float:
        """The world's."""
        del now
        return self._world.time

    def _command(self, drives: list[Drive]) -> None:
        positioned = [drive for drive in drives[:3] if drive.mode in POSITIONED]
        limp = [
            not (drive.mode in POSITIONED or (k < 3 and drive.mode is Mode.CURRENT and not positioned))
            for k, drive in enumerate(drives)
        ]
        torque = [0.0, 0.0, 0.0]
        goals = [0.0] * 5
        for k, (drive, mount) in enumerate(zip(drives, self._mounting, strict=True)):
            if drive.mode in POSITIONED:
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


class FreeServos:
    """Servos that carry nothing: first order towards the goal, no faster than the no-load speed.

    A motor in current mode turns against viscous friction, so that its speed settles; ``start`` are angles in rad of
    the encoders. A servo whose torque is off stays where it is.
    """

    NO_LOAD_SPEED = 8.48
    """rad/s at 5 V (ROBOTIS e-manual)."""
    STALL_CURRENT = 1.80
    """A at 5 V (ROBOTIS e-manual)."""

    def __init__(self, start: tuple[float, ...], time_constant: float = 0.04) -> None:
        self.position = list(start)
        self.velocity = [0.0] * len(start)
        self.voltage = [5.0] * len(start)
        self.temperature = [30.0] * len(start)
        self._time_constant = time_constant
        self._then: float | None = None

    def exchange(self, now: float, drives: list[Drive]) -> list[Motion]:
        """Move on to ``now`` under these drives."""
        dt = now - self._then if self._then is not None else 0.0
        self._then = now
        return [self._move(k, drive, dt) for k, drive in enumerate(drives)]

    def time(self, now: float) -> float:
        """The emulator's own."""
        return now

    def _move(self, k: int, drive: Drive, dt: float) -> Motion:
        share = 1.0 - exp(-dt / self._time_constant)
        before, velocity = self.position[k], 0.0
        current = 0.0
        if drive.mode in POSITIONED:
            error = drive.goal - before
            most = self.NO_LOAD_SPEED * dt
            self.position[k] += min(max(share * error, -most), most)
            velocity = (self.position[k] - before) / dt if dt > 0.0 else self.velocity[k]
            current = min(max(self.STALL_CURRENT * error / 0.1, -drive.limit), drive.limit)
        elif drive.mode is not None:
            aim = {
                Mode.CURRENT: drive.goal / self.STALL_CURRENT * self.NO_LOAD_SPEED,
                Mode.PWM: drive.goal * self.NO_LOAD_SPEED,
                Mode.VELOCITY: drive.goal,
            }[drive.mode]
            velocity = self.velocity[k] + share * (aim - self.velocity[k])
            self.position[k] += velocity * dt
            current = drive.goal if drive.mode is Mode.CURRENT else 0.0
        self.velocity[k] = velocity
        return Motion(self.position[k], velocity, current, self.voltage[k], self.temperature[k])
