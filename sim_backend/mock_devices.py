"""The device protocols answered in process, from a simulated world. Nothing here waits.

Sample times are the world's simulated nanoseconds, passed through ``clock``: where a thread advances the world in
real time, the map from simulated time to the process's clock.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from drivers.samples import (
    AutopilotCommand,
    AutopilotState,
    Engage,
    FlightMode,
    JointMode,
    Odometry,
    ServoCommand,
    ServoState,
)
from sim_backend.autopilot import SetPoint
from sim_backend.world import World

Clock = Callable[[int], int]

_LIMP = ServoCommand(JointMode.OFF, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0), 0.0)


class _Mock:
    """What the three mocks share: the world, its clock, and a life cycle with nothing to connect to."""

    def __init__(self, world: World, clock: Clock | None = None) -> None:
        self._world = world
        self._clock = clock

    async def start(self) -> None:
        """Nothing to connect to."""

    async def stop(self) -> None:
        """Nothing to release."""

    def notices(self) -> tuple[()]:
        """Nothing to tell."""
        return ()


class MockAutopilot(_Mock):
    """The autopilot of the world; works towards the commanded ``Engage`` as the real driver does.

    Offboard that was reached and then left (by a pilot, or a failsafe) is not taken back until something else has been
    wanted in between.
    """

    _reached = False
    _insisted: Engage | None = None

    def latest(self) -> AutopilotState | None:
        """Newest attitude, inertial data and status."""
        sample = self._world.sensors.autopilot(self._world.snapshot)
        if sample is None or self._clock is None:
            return sample
        return replace(sample, t_ns=self._clock(sample.t_ns), t_imu_ns=self._clock(sample.t_imu_ns))

    def command(self, command: AutopilotCommand) -> None:
        """Hand over one fresh set-point."""
        if self._insisted is not None and command.engage is not Engage.KILL:
            return
        autopilot, t = self._world.autopilot, self._world.time
        if command.engage is not Engage.OFFBOARD:
            self._reached = False
        if command.engage is Engage.KILL:
            autopilot.kill()
        elif command.engage is Engage.IDLE:
            if autopilot.armed or autopilot.killed:
                autopilot.disarm()
        elif command.engage is Engage.LAND:
            if autopilot.armed:
                autopilot.switch(FlightMode.LAND, t)
        else:
            autopilot.offer(
                t, SetPoint(command.interface, command.thrust, command.torque_B, command.q_WB, command.w_WB_B)
            )
            engaged = autopilot.armed and autopilot.mode is FlightMode.OFFBOARD
            if engaged:
                self._reached = True
            elif not self._reached and autopilot.streaming(t) and autopilot.arm():
                autopilot.switch(FlightMode.OFFBOARD, t)

    def insist(self, engage: Engage | None) -> None:
        """KILL or LAND now, and nothing else but a commanded KILL until None is given."""
        self._insisted = engage
        autopilot = self._world.autopilot
        if engage is Engage.KILL:
            autopilot.kill()
        elif engage is Engage.LAND and autopilot.armed:
            autopilot.switch(FlightMode.LAND, self._world.time)


class MockOdometry(_Mock):
    """The visual-inertial tracker of the world."""

    def latest(self) -> Odometry | None:
        """Newest pose and velocity of the body origin."""
        sample = self._world.sensors.odometry(self._world.snapshot)
        return sample if sample is None or self._clock is None else replace(sample, t_ns=self._clock(sample.t_ns))


class MockServos(_Mock):
    """The servo bus of the world."""

    _off = False

    def latest(self) -> ServoState | None:
        """Newest cycle: positions, velocities, currents and health of the five servos."""
        sample = self._world.sensors.servos(self._world.snapshot)
        return sample if sample is None or self._clock is None else replace(sample, t_ns=self._clock(sample.t_ns))

    def command(self, command: ServoCommand) -> None:
        """Hand over the goals for the next cycle."""
        self._world.command_servos(_LIMP if self._off else command)

    def insist(self, off: bool) -> None:
        """Torque off, and off whatever is commanded, until False is given."""
        self._off = off
        if off:
            self._world.command_servos(_LIMP)
