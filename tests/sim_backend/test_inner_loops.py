"""The autopilot's inner loops: mixer, attitude law, rate loop, and flight by velocity."""

from __future__ import annotations

from math import acos, cos, pi, sin, sqrt

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.samples import FlightMode, Interface, Quat
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams, constants
from sim_backend.autopilot import AutopilotParams, SetPoint
from sim_backend.inner_loops import LoopParams, airframe_inertia, attitude_rate, mix, put_loops
from sim_backend.pipe import Pipe
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import PIPE, mass_of

Array = NDArray[np.float64]
LIMIT = 13.0


@pytest.fixture(scope="module")
def p(vehicle: Vehicle) -> Array:
    p = constants(vehicle, PlantParams(), PIPE)
    put_loops(p, vehicle, LoopParams(), 1e-4)
    return p


def wrench_of(rotors: tuple[float, ...], vehicle: Vehicle) -> tuple[float, float, float, float]:
    fr, rl, fl, rr = rotors
    a, k = vehicle.rotors, vehicle.rotors.torque_per_thrust
    return (fr + rl + fl + rr, a.arm_y * (fl + rl - fr - rr), a.arm_x * (rl + rr - fr - fl), k * (fl + rr - fr - rl))


@given(thrust=st.floats(20.0, 28.0), tx=st.floats(-0.5, 0.5), ty=st.floats(-0.5, 0.5), tz=st.floats(-0.05, 0.05))
def test_a_wrench_within_reach_is_met(
    vehicle: Vehicle, p: Array, thrust: float, tx: float, ty: float, tz: float
) -> None:
    assert wrench_of(mix(p, LIMIT, thrust, tx, ty, tz), vehicle) == pytest.approx((thrust, tx, ty, tz), abs=1e-9)


@given(thrust=st.floats(-20.0, 80.0), tx=st.floats(-20.0, 20.0), ty=st.floats(-20.0, 20.0), tz=st.floats(-5.0, 5.0))
def test_any_wrench_is_mixed_within_the_limits_and_yaw_yields_first(
    vehicle: Vehicle, p: Array, thrust: float, tx: float, ty: float, tz: float
) -> None:
    rotors = mix(p, LIMIT, thrust, tx, ty, tz)
    assert all(-1e-9 <= rotor <= LIMIT + 1e-9 for rotor in rotors)
    without = wrench_of(mix(p, LIMIT, thrust, tx, ty, 0.0), vehicle)
    total, roll, pitch, yaw = wrench_of(rotors, vehicle)
    assert (total, roll, pitch) == pytest.approx(without[:3], abs=1e-9)
    assert yaw * tz >= -1e-12
    assert abs(yaw) <= abs(tz) + 1e-9
    assert total <= max(thrust, 0.0) + 1e-9
    # Roll and pitch shrink together.
    assert roll * ty == pytest.approx(pitch * tx, abs=1e-6)


def test_full_thrust_makes_room_for_roll_and_pitch(vehicle: Vehicle, p: Array) -> None:
    total, roll, pitch, _ = wrench_of(mix(p, LIMIT, 4.0 * LIMIT, 1.0, -0.5, 0.1), vehicle)
    assert (roll, pitch) == pytest.approx((1.0, -0.5))
    assert total < 4.0 * LIMIT
    assert wrench_of(mix(p, LIMIT, 0.0, 1.0, -0.5, 0.1), vehicle) == pytest.approx((0.0, 0.0, 0.0, 0.0))


def turn(angle: float, axis: tuple[float, float, float]) -> Quat:
    s = sin(angle / 2)
    return (cos(angle / 2), s * axis[0], s * axis[1], s * axis[2])


def times(a: Quat, b: Quat) -> Quat:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def rates(p: Array, q: Quat, d: Quat) -> tuple[float, float, float]:
    return attitude_rate(p, q[0], q[1], q[2], q[3], d[0], d[1], d[2], d[3])


def test_small_errors_give_the_gains_of_each_axis(p: Array) -> None:
    at_rest = turn(0.4, (0.0, 0.6, 0.8))
    for axis, gain in (((1.0, 0.0, 0.0), 6.5), ((0.0, 1.0, 0.0), 6.5), ((0.0, 0.0, 1.0), 2.8)):
        wanted = rates(p, at_rest, times(at_rest, turn(0.01, axis)))
        assert wanted == pytest.approx(tuple(0.01 * gain * a for a in axis), rel=1e-3, abs=1e-9)
    assert rates(p, at_rest, at_rest) == pytest.approx((0.0, 0.0, 0.0), abs=1e-7)
    assert rates(p, at_rest, tuple(-v for v in at_rest)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-7)  # type: ignore[arg-type]


@given(
    q=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
    d=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
)
def test_any_attitude_error_shrinks(p: Array, q: Quat, d: Quat) -> None:
    size_q, size_d = sqrt(sum(v * v for v in q)), sqrt(sum(v * v for v in d))
    assume(size_q > 0.1 and size_d > 0.1)
    now: Quat = tuple(v / size_q for v in q)  # type: ignore[assignment]
    goal: Quat = tuple(v / size_d for v in d)  # type: ignore[assignment]
    error = 2.0 * acos(min(1.0, abs(sum(a * b for a, b in zip(now, goal, strict=True)))))
    assume(0.05 < error < 3.0)
    w = rates(p, now, goal)
    assert all(np.isfinite(w))
    for _ in range(4000):
        w = rates(p, now, goal)
        size = sqrt(sum(v * v for v in w))
        if size > 0.0:
            now = times(now, turn(1e-3 * size, (w[0] / size, w[1] / size, w[2] / size)))
    assert 2.0 * acos(min(1.0, abs(sum(a * b for a, b in zip(now, goal, strict=True))))) < 0.02


def aloft(vehicle: Vehicle, params: WorldParams | None = None) -> World:
    """A world whose vehicle hovers by itself, 20 m up and far from the pipe."""
    world = World(vehicle, params, Pipe((50.0, 0.0, 1.5)))
    world.plant.x[at.POSITION + 2] = 20.0
    world.autopilot.armed = True
    world.advance(4.0)
    return world


def fly(world: World, setpoint: SetPoint, seconds: float) -> None:
    """Fly a set-point."""
    world.autopilot.offer(world.time, setpoint)
    world.autopilot.mode = FlightMode.OFFBOARD
    for _ in range(round(seconds / 0.001)):
        world.autopilot.offer(world.time, setpoint)
        world.advance(0.001)


def test_the_rate_loop_has_its_bandwidth(vehicle: Vehicle) -> None:
    weight = mass_of(vehicle) * vehicle.gravity
    autopilot = AutopilotParams(command_delay=0.0)
    for bandwidth in (25.0, 40.0):
        params = WorldParams(loops=LoopParams(bandwidth=bandwidth), autopilot=autopilot)
        world = aloft(vehicle, params)
        fly(world, SetPoint(Interface.BODY_RATE, weight, w_WB_B=(0.5, 0.0, 0.0)), 1.0 / bandwidth)
        # About roll, where the joints' springs do not give way.
        assert world.truth().w_WB_B[0] == pytest.approx(0.5 * (1.0 - np.exp(-1.0)), rel=0.12)


def test_attitude_and_rates_are_reached(vehicle: Vehicle) -> None:
    weight = mass_of(vehicle) * vehicle.gravity
    goal = times(turn(0.3, (0.0, 0.0, 1.0)), turn(0.1, (0.6, 0.8, 0.0)))
    world = aloft(vehicle)
    fly(world, SetPoint(Interface.ATTITUDE, weight, q_WB=goal), 4.0)
    assert world.truth().q_WB == pytest.approx(goal, abs=0.005)
    world = aloft(vehicle)
    fly(world, SetPoint(Interface.BODY_RATE, weight, w_WB_B=(0.0, 0.0, 0.4)), 3.0)
    assert world.truth().w_WB_B == pytest.approx((0.0, 0.0, 0.4), abs=0.01)


def test_it_hovers_and_descends_by_itself(vehicle: Vehicle) -> None:
    world = aloft(vehicle)
    assert world.truth().v_WB == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    world.autopilot.mode = FlightMode.LAND
    world.advance(3.0)
    assert world.truth().v_WB[2] == pytest.approx(-0.6, abs=0.05)


def test_inertia_of_the_airframe_is_about_its_centre_of_mass(vehicle: Vehicle) -> None:
    base = msgspec.structs.replace(vehicle.base, inertia=(0.03, 0.03, 0.05))
    bare = msgspec.structs.replace(
        vehicle,
        base=base,
        arm=msgspec.structs.replace(
            vehicle.arm, parts=(), sleeve=msgspec.structs.replace(vehicle.arm.sleeve, mass=0.0, inertia=(0.0, 0.0, 0.0))
        ),
    )
    assert airframe_inertia(bare, (0.0, 0.0, 0.0)) == pytest.approx((0.03, 0.03, 0.05))
    stretched = airframe_inertia(vehicle, (-pi / 2, -pi / 2, -pi / 2))
    folded = airframe_inertia(vehicle, (-2.8, -0.35, 0.0))
    assert stretched[1] > folded[1] > 0.03
    assert stretched[2] < stretched[1]


def test_a_period_that_the_step_does_not_divide_is_refused(vehicle: Vehicle) -> None:
    with pytest.raises(ValueError, match=r"loops\.period 0\.00105 s is not a whole number of physics steps"):
        World(vehicle, WorldParams(loops=LoopParams(period=1.05e-3)))
