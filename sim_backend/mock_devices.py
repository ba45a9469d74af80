"""The device protocols answered in process, from a simulated world. Nothing here waits.

Sample times are the world's simulated nanoseconds, passed through ``clock`` (for a world that a thread advances in
real time: the offset to the process's clock).
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.samples import (
    AutopilotCommand,
    AutopilotState,
    Engage,
    Five,
    FlightMode,
    Odometry,
    ServoCommand,
    ServoState,
)
from sim_backend import layout as at
from sim_backend.autopilot import SetPoint
from sim_backend.world import World

Clock = Callable[[int], int]


def simulated(t_ns: int) -> int:
    """The clock of a process that lives in simulated time."""
    return t_ns


class _Mock:
    """What the three mocks share."""

    def __init__(self, world: World, clock: Clock = simulated) -> None:
        self._world = world
        self._clock = clock

    async def start(self) -> None:
        """Nothing to connect to."""

    async def stop(self) -> None:
        """Nothing to release."""


class MockAutopilot(_Mock):
    """The autopilot of the world; works towards the commanded ``Engage`` as the real driver does."""

    def latest(self) -> AutopilotState | None:
        """Attitude, inertial data and status."""
        world = self._world
        x = world.state
        share = 1.0 / world.last_steps
        t_ns = self._clock(world.t_ns)
        autopilot = world.autopilot
        return AutopilotState(
            t_ns=t_ns,
            q_WB=(x[at.ATTITUDE], x[at.ATTITUDE + 1], x[at.ATTITUDE + 2], x[at.ATTITUDE + 3]),
            w_WB_B=(x[at.RATE], x[at.RATE + 1], x[at.RATE + 2]),
            t_imu_ns=t_ns,
            f_B=(
                x[at.SPECIFIC_FORCE_SUM] * share,
                x[at.SPECIFIC_FORCE_SUM + 1] * share,
                x[at.SPECIFIC_FORCE_SUM + 2] * share,
            ),
            armed=autopilot.armed,
            mode=autopilot.mode,
            landed=autopilot.landed,
            battery_voltage=x[at.VOLTAGE],
            battery_remaining=x[at.CHARGE],
        )

    def command(self, command: AutopilotCommand) -> None:
        """Hand over one fresh set-point."""
        autopilot, t = self._world.autopilot, self._world.time
        if command.engage is Engage.KILL:
            autopilot.kill()
        elif command.engage is Engage.IDLE:
            if autopilot.armed or autopilot.killed:
                autopilot.disarm()
        elif command.engage is Engage.LAND:
            if autopilot.armed:
                autopilot.switch(FlightMode.LAND, t)
        else:
            autopilot.setpoint(
                t, SetPoint(command.interface, command.thrust, command.torque_B, command.q_WB, command.w_WB_B)
            )
            engaged = autopilot.armed and autopilot.mode is FlightMode.OFFBOARD
            if not engaged and autopilot.streaming(t) and autopilot.arm():
                autopilot.switch(FlightMode.OFFBOARD, t)


class MockOdometry(_Mock):
    """The visual-inertial tracker of the world."""

    def latest(self) -> Odometry | None:
        """Pose and velocity of the body origin."""
        x = self._world.state
        return Odometry(
            t_ns=self._clock(self._world.t_ns),
            p_WB=(x[at.POSITION], x[at.POSITION + 1], x[at.POSITION + 2]),
            q_WB=(x[at.ATTITUDE], x[at.ATTITUDE + 1], x[at.ATTITUDE + 2], x[at.ATTITUDE + 3]),
            v_WB=(x[at.VELOCITY], x[at.VELOCITY + 1], x[at.VELOCITY + 2]),
            confidence=3,
        )


class MockServos(_Mock):
    """The servo bus of the world."""

    def latest(self) -> ServoState | None:
        """Positions, velocities, currents and health of the five servos."""
        world = self._world
        x = world.state
        voltage = world.vehicle.servo.voltage
        ambient = 25.0
        voltages: Five = (voltage, voltage, voltage, voltage, voltage)
        temperatures: Five = (ambient, ambient, ambient, ambient, ambient)
        return ServoState(
            t_ns=self._clock(world.t_ns),
            position=(x[at.JOINT], x[at.JOINT + 1], x[at.JOINT + 2], x[at.PUMP], x[at.GRIPPER]),
            velocity=(x[at.JOINT_RATE], x[at.JOINT_RATE + 1], x[at.JOINT_RATE + 2], 0.0, 0.0),
            current=(x[at.SERVO_CURRENT], x[at.SERVO_CURRENT + 1], x[at.SERVO_CURRENT + 2], 0.0, 0.0),
            voltage=voltages,
            temperature=temperatures,
            error=(0, 0, 0, 0, 0),
            torque_on=world.servo_torque_on,
        )

    def command(self, command: ServoCommand) -> None:
        """Hand over the goals for the next cycle."""
        self._world.command_servos(command)
