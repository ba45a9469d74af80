"""The world with its autopilot, through the mock devices: arming, modes, failsafe, delay, servos, determinism."""

from __future__ import annotations

import asyncio
from math import inf

import msgspec
import numpy as np
import pytest

from drivers.protocols import AutopilotDevice, OdometryDevice, ServoDevice
from drivers.samples import Engage, FlightMode, Interface, JointMode, Landed, ServoCommand, Vec3
from drivers.vehicle import Vehicle
from sim_backend.array_plant import PlantParams
from sim_backend.autopilot import AutopilotParams, SetPoint
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import TICK, Hand, mass_of, world_at_pipe
from tests.sim_backend.noisy import NOISY

UP = (0.0, 0.0, 1.0)
HOLD = ServoCommand(JointMode.POSITION, (0.0, 0.0, 0.0), (-2.8, -0.35, 0.0, 0.0, 0.0), 1.8)


def engage(hand: Hand, wanted: Engage, seconds: float, target: Vec3 = UP) -> None:
    """Command ``wanted`` every tick."""
    for _ in range(round(seconds / TICK)):
        hand.autopilot.command(msgspec.structs.replace(hand.command(target), engage=wanted))
        hand.world.advance(TICK)


def state(hand: Hand) -> tuple[bool, FlightMode, Landed]:
    told = hand.autopilot.latest()
    assert told is not None
    return told.armed, told.mode, told.landed


@pytest.fixture
def hand(vehicle: Vehicle) -> Hand:
    return Hand(World(vehicle), Interface.ATTITUDE)


def test_mocks_answer_the_device_protocols(vehicle: Vehicle) -> None:
    world = World(vehicle)
    autopilot: AutopilotDevice = MockAutopilot(world)
    odometry: OdometryDevice = MockOdometry(world)
    servos: ServoDevice = MockServos(world)

    async def cycle() -> None:
        for device in (autopilot, odometry, servos):
            await device.start()
            await device.stop()
            await device.stop()

    asyncio.run(cycle())
    for sample in (autopilot.latest(), odometry.latest(), servos.latest()):
        assert sample is not None
        assert sample.t_ns == 0


def test_a_clock_maps_the_sample_times(vehicle: Vehicle) -> None:
    world = World(vehicle)
    world.advance(TICK)

    def clock(t_ns: int) -> int:
        return t_ns + 1_000_000_000_000

    autopilot = MockAutopilot(world, clock).latest()
    assert autopilot is not None
    assert (autopilot.t_ns, autopilot.t_imu_ns) == (1_000_004_000_000, 1_000_004_000_000)
    odometry, servos = MockOdometry(world, clock).latest(), MockServos(world, clock).latest()
    assert odometry is not None
    assert servos is not None
    assert odometry.t_ns == servos.t_ns == 1_000_004_000_000


@pytest.mark.parametrize("interface", list(Interface))
def test_every_interface_takes_off_and_hovers(vehicle: Vehicle, interface: Interface) -> None:
    hand = Hand(World(vehicle), interface)
    hand.fly(UP, 8.0)
    truth = hand.world.truth()
    assert truth.p_WB[2] == pytest.approx(1.0, abs=0.01)
    assert truth.v_WB == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    assert state(hand) == (True, FlightMode.OFFBOARD, Landed.IN_AIR)


@pytest.mark.parametrize("interface", list(Interface))
def test_it_flies_with_nothing_ideal(vehicle: Vehicle, interface: Interface) -> None:
    plant = PlantParams(ideal_motors=False, ideal_servos=False)
    world = World(vehicle, WorldParams(plant=plant, sensors=NOISY), seed=2)
    # The first samples are still on their way.
    world.advance(0.04)
    hand = Hand(world, interface)
    hand.fly(UP, 8.0)
    truth = world.truth()
    assert truth.p_WB[2] == pytest.approx(1.0, abs=0.05)
    assert truth.v_WB == pytest.approx((0.0, 0.0, 0.0), abs=0.05)
    assert truth.crashed == ""


def test_it_arms_after_a_stream_of_set_points(hand: Hand) -> None:
    assert state(hand) == (False, FlightMode.HOLD, Landed.ON_GROUND)
    engage(hand, Engage.OFFBOARD, 0.496)
    assert state(hand)[0] is False
    engage(hand, Engage.OFFBOARD, 0.012)
    assert state(hand)[:2] == (True, FlightMode.OFFBOARD)


def test_a_gap_in_the_stream_starts_the_wait_anew(hand: Hand) -> None:
    engage(hand, Engage.OFFBOARD, 0.4)
    hand.world.advance(0.6)
    engage(hand, Engage.OFFBOARD, 0.4)
    assert state(hand)[0] is False


def test_set_points_that_are_not_finite_do_not_count(hand: Hand) -> None:
    for _ in range(300):
        hand.autopilot.command(msgspec.structs.replace(hand.command(UP), thrust=inf))
        hand.world.advance(TICK)
    assert state(hand)[0] is False


def test_idle_disarms_on_the_ground_and_is_ignored_in_the_air(hand: Hand) -> None:
    engage(hand, Engage.OFFBOARD, 1.0, target=(0.0, 0.0, 0.0))
    assert state(hand) == (True, FlightMode.OFFBOARD, Landed.ON_GROUND)
    engage(hand, Engage.IDLE, TICK)
    assert state(hand)[:2] == (False, FlightMode.HOLD)
    hand.fly(UP, 5.0)
    engage(hand, Engage.IDLE, 0.1)
    assert state(hand)[0] is True
    assert hand.world.truth().p_WB[2] > 0.9


def test_loss_of_set_points_lands_and_disarms(hand: Hand) -> None:
    hand.fly(UP, 6.0)
    hand.world.advance(0.48)
    assert state(hand)[1] is FlightMode.OFFBOARD
    hand.world.advance(0.04)
    assert state(hand)[:2] == (True, FlightMode.LAND)
    hand.world.advance(1.0)
    assert -0.6 < hand.world.truth().v_WB[2] < -0.3
    hand.world.advance(3.0)
    assert state(hand) == (False, FlightMode.LAND, Landed.ON_GROUND)
    assert hand.world.truth().crashed == ""
    assert hand.world.truth().rotor_thrust == (0.0, 0.0, 0.0, 0.0)


def test_land_is_the_autopilots_own_and_can_be_taken_back(hand: Hand) -> None:
    hand.fly(UP, 6.0)
    engage(hand, Engage.LAND, 0.4)
    assert state(hand)[1] is FlightMode.LAND
    low = hand.world.truth().p_WB[2]
    assert low < 0.95
    hand.fly(UP, 4.0)
    assert state(hand)[1] is FlightMode.OFFBOARD
    assert hand.world.truth().p_WB[2] > low
    engage(hand, Engage.LAND, 5.0)
    assert state(hand) == (False, FlightMode.LAND, Landed.ON_GROUND)
    engage(hand, Engage.IDLE, TICK)
    hand.fly(UP, 6.0)
    assert state(hand) == (True, FlightMode.OFFBOARD, Landed.IN_AIR)


def test_kill_cuts_the_motors_at_once_and_stays(hand: Hand) -> None:
    hand.fly(UP, 6.0)
    engage(hand, Engage.KILL, TICK)
    assert state(hand)[0] is False
    assert hand.world.truth().rotor_thrust == (0.0, 0.0, 0.0, 0.0)
    engage(hand, Engage.OFFBOARD, 2.0)
    truth = hand.world.truth()
    assert state(hand)[0] is False
    assert truth.crashed.startswith("hit the ground")
    assert truth.on_ground


def test_a_kill_is_cleared_by_idle_on_the_ground(hand: Hand) -> None:
    engage(hand, Engage.KILL, 0.1)
    engage(hand, Engage.OFFBOARD, 1.0)
    assert state(hand)[0] is False
    engage(hand, Engage.IDLE, 0.1)
    engage(hand, Engage.OFFBOARD, 1.0)
    assert state(hand)[0] is True


def reaction_time(vehicle: Vehicle, interface: Interface) -> float:
    """From handing over a stronger thrust to the first rotor that follows, s."""
    hand = Hand(World(vehicle), interface)
    hand.fly(UP, 5.0)
    before = sum(hand.world.truth().rotor_thrust)
    start = hand.world.time
    hand.autopilot.command(msgspec.structs.replace(hand.command(UP), thrust=before + 5.0))
    while sum(hand.world.truth().rotor_thrust) < before + 2.0:
        hand.world.advance(0.001)
    return hand.world.time - start


def test_commands_are_delayed_by_interface(vehicle: Vehicle) -> None:
    # One millisecond is the period of the inner loops.
    assert reaction_time(vehicle, Interface.WRENCH) == pytest.approx(0.001, abs=1e-9)
    assert reaction_time(vehicle, Interface.BODY_RATE) == pytest.approx(0.013, abs=1.1e-3)
    assert reaction_time(vehicle, Interface.ATTITUDE) == pytest.approx(0.013, abs=1.1e-3)


def test_a_delay_that_no_tick_divides_is_kept(vehicle: Vehicle) -> None:
    params = WorldParams(autopilot=AutopilotParams(wrench_delay=0.0103))
    world = World(vehicle, params)
    each = mass_of(vehicle) * vehicle.gravity / 8.0
    for _ in range(200):
        world.autopilot.offer(world.time, SetPoint(Interface.WRENCH, 4.0))
        world.advance(TICK)
    assert world.autopilot.arm()
    assert world.autopilot.switch(FlightMode.OFFBOARD, world.time)
    world.advance(0.02)
    start = world.time
    world.autopilot.offer(start, SetPoint(Interface.WRENCH, 4.0 * each))
    world.advance(0.010)
    assert world.truth().rotor_thrust[0] == pytest.approx(1.0)
    world.advance(0.002)
    assert world.truth().rotor_thrust[0] == pytest.approx(each)


def test_modes_that_the_autopilot_refuses(vehicle: Vehicle) -> None:
    autopilot = World(vehicle).autopilot
    assert not autopilot.switch(FlightMode.OFFBOARD, 0.0)
    assert not autopilot.switch(FlightMode.OTHER, 0.0)
    assert autopilot.mode is FlightMode.HOLD


def test_joints_follow_torque_and_position_and_go_limp(vehicle: Vehicle) -> None:
    hand = world_at_pipe(vehicle, gap=0.5)
    world, servos = hand.world, hand.servos
    hover = world.truth().p_WB

    def tick(command: ServoCommand, count: int) -> None:
        for _ in range(count):
            hand.autopilot.command(hand.command(hover))
            servos.command(command)
            world.advance(TICK)

    held = world.truth().joint_torque
    tick(ServoCommand(JointMode.TORQUE, held, (0.0,) * 5, 0.0), 50)
    assert world.truth().joint_torque == pytest.approx(held)
    assert world.truth().joints == pytest.approx((-1.0, 1.0, 0.0), abs=0.1)
    tick(ServoCommand(JointMode.TORQUE, (held[0], held[1], held[2] + 0.1), (0.0,) * 5, 0.0), 20)
    assert world.truth().joint_rates[2] > 0.5
    tick(ServoCommand(JointMode.POSITION, (0.0, 0.0, 0.0), (-1.0, 1.0, 0.0, 2.0, 0.0), 1.8), 250)
    assert world.truth().joints == pytest.approx((-1.0, 1.0, 0.0), abs=0.05)
    assert world.truth().pump == pytest.approx(2.0, abs=0.01)
    tick(ServoCommand(JointMode.OFF, (0.5, 0.5, 0.5), (0.0,) * 5, 1.8), 20)
    told = servos.latest()
    assert told is not None
    assert told.torque_on is False
    assert world.truth().joint_torque == (0.0, 0.0, 0.0)
    assert world.truth().pump == pytest.approx(2.0, abs=0.01)


def test_a_servo_goal_that_is_not_finite_is_ignored(hand: Hand) -> None:
    hand.servos.command(HOLD)
    hand.world.advance(0.5)
    before = hand.world.truth().joints
    hand.servos.command(msgspec.structs.replace(HOLD, position=(float("nan"), 0.0, 0.0, 0.0, 0.0)))
    hand.world.advance(0.5)
    assert hand.world.truth().joints == pytest.approx(before, abs=1e-6)


def test_same_calls_same_bits(vehicle: Vehicle) -> None:
    def run(seed: int, step: float = 1e-4) -> list[list[float]]:
        params = WorldParams(plant=PlantParams(step=step, ideal_motors=False, ideal_servos=False), sensors=NOISY)
        world = World(vehicle, params, seed=seed)
        hand = Hand(world)
        for _ in range(20):
            world.advance(TICK)
        states = []
        for _ in range(400):
            hand.tick((0.1, 0.0, 0.8))
            states.append(world.snapshot.x)
        return states

    first = run(7)
    assert first == run(7)
    assert first != run(8)


def test_the_world_does_not_depend_on_how_it_is_cut_into_calls(vehicle: Vehicle) -> None:
    def run(parts: tuple[float, ...]) -> list[float]:
        hand = world_at_pipe(vehicle)
        hand.press(2.0)
        for part in parts:
            hand.world.advance(part)
        return hand.world.snapshot.x

    whole, cut = np.array(run((0.06,))), np.array(run((0.0203, 0.0004, 0.0193, 0.02)))
    assert cut[:19] == pytest.approx(whole[:19], abs=2e-5)


def test_the_peak_is_of_the_last_advance(vehicle: Vehicle) -> None:
    hand = world_at_pipe(vehicle)
    rows = hand.press(5.0)
    assert (rows[:, 1] >= rows[:, 0]).all()
    assert rows[:, 1].max() > 1.5 * rows[-1, 1]


def test_time_is_counted_in_steps(vehicle: Vehicle) -> None:
    world = World(vehicle)
    for _ in range(1000):
        world.advance(TICK)
    assert world.snapshot.t_ns == 4_000_000_000
    assert world.truth().t == 4.0
    with pytest.raises(ValueError, match="whole number"):
        world.advance(0.00405)
