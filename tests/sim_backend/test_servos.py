"""The XC330 of the joints: limits, modes, friction and current; pump and gripper; stops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams, constants
from sim_backend.servos import joint_torque, stop_torque, tool_servos
from tests.sim_backend.flying import PIPE

Array = NDArray[np.float64]
STALL, STALL_CURRENT, NO_LOAD = 0.93, 1.8, 8.48


class Bench:
    """One joint servo on a bench."""

    def __init__(self, vehicle: Vehicle, *, ideal: bool = True) -> None:
        self.p = constants(vehicle, PlantParams(ideal_servos=ideal), PIPE)
        self.x, self.u = np.zeros(at.STATE_SIZE), np.zeros(at.DRIVE_SIZE)
        self.u[at.U_TORQUE_ON] = 1.0
        self.u[at.U_CURRENT_LIMIT] = STALL_CURRENT

    def torque(self, demand: float, rate: float = 0.0) -> float:
        self.u[at.U_TORQUE + 1] = demand
        return joint_torque(self.x, self.p, self.u, 1, 0.0, rate)

    def position(self, error: float, rate: float = 0.0, limit: float = STALL_CURRENT) -> float:
        self.u[at.U_POSITION_MODE] = 1.0
        self.u[at.U_GOAL + 1] = error
        self.u[at.U_CURRENT_LIMIT] = limit
        return joint_torque(self.x, self.p, self.u, 1, 0.0, rate)

    @property
    def current(self) -> float:
        return float(self.x[at.SERVO_CURRENT + 1])


def test_torque_is_given_up_to_the_stall_torque(vehicle: Vehicle) -> None:
    bench = Bench(vehicle)
    assert bench.torque(0.4) == 0.4
    assert bench.torque(-0.4) == -0.4
    assert bench.torque(3.0) == STALL
    assert bench.torque(-3.0) == -STALL
    assert bench.current == pytest.approx(-STALL_CURRENT)


def test_driving_torque_falls_along_the_torque_speed_line(vehicle: Vehicle) -> None:
    bench = Bench(vehicle)
    assert bench.torque(3.0, 0.5 * NO_LOAD) == pytest.approx(0.5 * STALL)
    assert bench.torque(3.0, NO_LOAD) == pytest.approx(0.0, abs=1e-12)
    assert bench.torque(3.0, 2.0 * NO_LOAD) == 0.0
    # Braking is limited by the current alone.
    assert bench.torque(-3.0, 0.5 * NO_LOAD) == -STALL
    assert bench.torque(-3.0, -0.5 * NO_LOAD) == pytest.approx(-0.5 * STALL)


def test_position_mode_is_a_spring_damper_under_a_current_limit(vehicle: Vehicle) -> None:
    bench = Bench(vehicle)
    assert bench.position(0.01) == pytest.approx(0.01 * vehicle.servo.stiffness)
    assert bench.position(0.01, 0.2) == pytest.approx(0.01 * vehicle.servo.stiffness - 0.2 * vehicle.servo.damping)
    assert bench.position(1.0, 0.0, 0.6) == pytest.approx(STALL * 0.6 / STALL_CURRENT)
    assert bench.current == pytest.approx(0.6)
    assert bench.position(-1.0, 0.0, 0.0) == 0.0


def test_without_torque_only_friction_is_left(vehicle: Vehicle) -> None:
    bench = Bench(vehicle, ideal=False)
    bench.u[at.U_TORQUE_ON] = 0.0
    servo = vehicle.servo
    assert bench.torque(0.5, 1.0) == pytest.approx(-servo.friction_static - servo.friction_viscous)
    assert bench.torque(0.5, -1.0) == pytest.approx(servo.friction_static + servo.friction_viscous)
    assert bench.torque(0.5, 0.0) == 0.0
    assert bench.current == 0.0


def test_supply_current_is_motor_current_times_duty(vehicle: Vehicle) -> None:
    bench = Bench(vehicle, ideal=False)
    bench.torque(0.5 * STALL)
    assert bench.current == pytest.approx(0.25 * STALL_CURRENT)
    bench.torque(0.5 * STALL, 0.5 * NO_LOAD)
    assert bench.current == pytest.approx(0.5 * STALL_CURRENT)
    ideal = Bench(vehicle)
    ideal.torque(0.5 * STALL)
    assert ideal.current == pytest.approx(0.5 * STALL_CURRENT)


@given(demand=st.floats(-5.0, 5.0), rate=st.floats(-30.0, 30.0), ideal=st.booleans(), position=st.booleans())
def test_no_servo_gives_more_than_it_has(
    vehicle: Vehicle, demand: float, rate: float, ideal: bool, position: bool
) -> None:
    bench = Bench(vehicle, ideal=ideal)
    torque = bench.position(demand, rate) if position else bench.torque(demand, rate)
    friction = 0.0 if ideal else vehicle.servo.friction_static + vehicle.servo.friction_viscous * abs(rate)
    assert abs(torque) <= STALL + friction + 1e-12
    assert abs(bench.current) <= STALL_CURRENT + 1e-12


def test_stops_push_back_and_never_pull(vehicle: Vehicle) -> None:
    p = Bench(vehicle).p
    high, low = vehicle.arm.joint_max[2], vehicle.arm.joint_min[2]
    assert stop_torque(p, 2, 0.5 * (high + low), 5.0) == 0.0
    assert stop_torque(p, 2, high + 0.01, 0.0) == pytest.approx(-0.5)
    assert stop_torque(p, 2, low - 0.01, 0.0) == pytest.approx(0.5)
    assert stop_torque(p, 2, high + 0.01, -100.0) == 0.0
    assert stop_torque(p, 2, low - 0.01, 100.0) == 0.0


def test_pump_and_gripper_follow_no_faster_than_they_can(vehicle: Vehicle) -> None:
    bench = Bench(vehicle)
    bench.u[at.U_GOAL + 3] = 50.0
    bench.u[at.U_GOAL + 4] = 1.0
    for _ in range(1000):
        tool_servos(bench.x, bench.p, bench.u)
    assert bench.x[at.PUMP] == pytest.approx(NO_LOAD * 0.1)
    assert bench.x[at.TOOL_SERVO_RATE] == pytest.approx(NO_LOAD)
    assert 0.5 < bench.x[at.GRIPPER] < NO_LOAD * 0.1
    for _ in range(4000):
        tool_servos(bench.x, bench.p, bench.u)
    assert bench.x[at.GRIPPER] == pytest.approx(1.0, abs=1e-3)
    bench.u[at.U_TORQUE_ON] = 0.0
    held = bench.x[at.PUMP]
    tool_servos(bench.x, bench.p, bench.u)
    assert bench.x[at.PUMP] == held
    assert bench.x[at.TOOL_SERVO_RATE] == 0.0
