"""Mock devices that fail: what comes of each fault, in samples and in what the world is told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from drivers.dynamixel_settings import DynamixelSettings
from drivers.samples import AutopilotCommand, Engage, Interface, JointMode, ServoCommand
from drivers.tracking import JumpLimits, Mount
from drivers.xc330 import HardwareError
from onboard.config import load_config
from onboard.devices import simulated_devices, world_of
from onboard.layers import ConfigError
from sim_backend import dynamixel_troubles, layout, px4_faults, tracker
from sim_backend.faults import Fault, Kind
from sim_backend.faulty_devices import FaultyAutopilot, FaultyOdometry, FaultyServos
from sim_backend.world import World

PERIOD = 0.004
HOLD = ServoCommand(JointMode.POSITION, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0), 1.0)
PUSH = ServoCommand(JointMode.TORQUE, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0, 0.0, 0.0), 1.0)


@pytest.fixture
def world() -> World:
    return world_of(load_config())


def odometry(world: World, **fault: Any) -> FaultyOdometry:
    return FaultyOdometry(world, [Fault("odometry", **fault)], Mount(), JumpLimits(), 0.5, 0)


def autopilot(world: World, **fault: Any) -> FaultyAutopilot:
    return FaultyAutopilot(world, [Fault("autopilot", **fault)], 0)


def servos(world: World, **fault: Any) -> FaultyServos:
    return FaultyServos(world, [Fault("servos", **fault)], DynamixelSettings(port=""), 0)


def run(world: World, device: Any, seconds: float, each: Callable[[], object] = lambda: None) -> list[Any]:
    """The device's samples, tick by tick."""
    samples = []
    for _ in range(round(seconds / PERIOD)):
        samples.append(device.latest())
        each()
        world.advance(PERIOD)
    return samples


def age(world: World, sample: Any) -> float:
    return world.time - float(sample.t_ns) * 1e-9


# --- odometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.NAN])
def test_a_short_silence_only_ages_the_pose(world: World, kind: Kind) -> None:
    device = odometry(world, kind=kind, start=0.1, duration=0.3)
    samples = run(world, device, 0.39)
    assert age(world, samples[-1]) == pytest.approx(0.29, abs=0.02)
    samples = run(world, device, 0.1)
    assert age(world, samples[-1]) < 0.02
    assert {sample.reset_counter for sample in samples} == {0}


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.UNPLUGGED, Kind.REBOOT])
def test_after_a_long_one_the_frame_begins_where_it_was_lost(world: World, kind: Kind) -> None:
    device = odometry(world, kind=kind, start=0.1, duration=0.8)
    before = run(world, device, 0.1)[-1]
    run(world, device, 0.3)
    world.plant.x[layout.POSITION] += 0.5  # carried away meanwhile
    samples = run(world, device, 1.5)
    assert samples[-1].reset_counter >= 1
    assert samples[-1].p_WB == pytest.approx(before.p_WB, abs=0.01)
    assert age(world, samples[-1]) < 0.02


def test_a_jump_is_seen_and_counted(world: World) -> None:
    device = odometry(world, kind=Kind.JUMP, start=0.1, value=0.3)
    samples = run(world, device, 0.3)
    assert samples[-1].p_WB[0] - samples[5].p_WB[0] == pytest.approx(0.3, abs=0.01)
    assert samples[-1].reset_counter == 1


def test_confidence_and_delay(world: World) -> None:
    doubtful = run(world, odometry(world, kind=Kind.CONFIDENCE, start=0.0, value=1), 0.1)
    assert doubtful[-1].confidence == 1
    late = run(world, odometry(world, kind=Kind.DELAY, start=world.time, value=0.1), 0.4)
    assert age(world, late[-1]) == pytest.approx(0.1, abs=0.015)


# --- autopilot --------------------------------------------------------------------------------------------------------


def follow(world: World, device: FaultyAutopilot) -> Callable[[], None]:
    weight = 1.2 * 9.81 * 2.05
    command = AutopilotCommand(
        Engage.OFFBOARD, Interface.ATTITUDE, weight, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    )
    return lambda: device.command(command)


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.UNPLUGGED])
def test_a_cut_link_is_cut_both_ways(world: World, kind: Kind) -> None:
    device = autopilot(world, kind=kind, start=2.5, duration=1.0)
    run(world, device, 2.5, follow(world, device))
    assert device.latest().mode == "offboard"  # type: ignore[union-attr]
    samples = run(world, device, 0.9, follow(world, device))
    assert age(world, samples[-1]) > 0.85
    assert world.autopilot.mode == "land", "it hears nothing either, so it lands"


def test_a_reboot_stops_the_motors_and_forgets(world: World) -> None:
    device = autopilot(world, kind=Kind.REBOOT, start=2.5, duration=0.5)
    states = []
    for seconds in (2.5, 0.1, 0.6):
        run(world, device, seconds, follow(world, device))
        states.append((world.autopilot.armed, world.autopilot.killed))
    assert states == [(True, False), (False, True), (False, False)]


@pytest.mark.parametrize("kind", [Kind.NAN, Kind.FREEZE])
def test_what_cannot_be_used_is_not(world: World, kind: Kind) -> None:
    device = autopilot(world, kind=kind, start=3.5, duration=1.0)
    run(world, device, 3.5, follow(world, device))
    told = device.latest()
    samples = run(world, device, 0.2, follow(world, device))
    assert told is not None
    assert samples[-1].q_WB == samples[1].q_WB
    assert age(world, samples[-1]) > 0.18
    assert samples[-1].armed


def test_packets_are_lost_and_late(world: World) -> None:
    samples = run(world, autopilot(world, kind=Kind.DROP, value=0.5), 4.0)
    assert 400 < len({sample.t_ns for sample in samples if sample}) < 600
    world = world_of(load_config())
    late = run(world, autopilot(world, kind=Kind.DELAY, value=0.2), 1.0)
    assert age(world, late[-1]) == pytest.approx(0.2, abs=0.01)


# --- servos -----------------------------------------------------------------------------------------------------------


def test_one_silent_servo_is_told_and_comes_back(world: World) -> None:
    device = servos(world, kind=Kind.SILENT, part="theta_2", start=0.1, duration=0.5)
    samples = run(world, device, 0.4, lambda: device.command(PUSH))
    assert samples[-1].error == (0, HardwareError.SILENT, 0, 0, 0)
    assert not samples[-1].torque_on
    assert world.plant.u[layout.U_LIMP : layout.U_LIMP + 5].tolist() == [0, 1, 0, 0, 0], "its watchdog has stopped it"
    samples = run(world, device, 0.6, lambda: device.command(PUSH))
    assert samples[-1].error == (0, 0, 0, 0, 0)
    assert samples[-1].torque_on
    assert 0.0 < world.plant.u[layout.U_TORQUE + 1] < 0.1, "its torque grows back"


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.UNPLUGGED, Kind.REBOOT])
def test_without_any_servo_nothing_is_told(world: World, kind: Kind) -> None:
    device = servos(world, kind=kind, start=0.1, duration=0.5)
    samples = run(world, device, 0.55, lambda: device.command(HOLD))
    assert age(world, samples[-1]) > 0.4
    samples = run(world, device, 0.6, lambda: device.command(HOLD))
    assert age(world, samples[-1]) < 0.01
    assert samples[-1].torque_on


def test_an_overload_takes_torque_until_the_reboot(world: World) -> None:
    device = servos(world, kind=Kind.ERROR_BIT, part="theta_1", value=32, start=0.1, duration=0.0)
    samples = run(world, device, 1.0, lambda: device.command(HOLD))
    assert samples[-1].error[0] == HardwareError.OVERLOAD
    assert not samples[-1].torque_on
    assert world.plant.u[layout.U_LIMP] == 1.0
    samples = run(world, device, 0.6, lambda: device.command(HOLD))
    assert samples[-1].error[0] == 0
    assert samples[-1].torque_on
    assert world.plant.u[layout.U_LIMP] == 0.0


def test_an_error_that_shuts_nothing_down_is_only_told(world: World) -> None:
    device = servos(world, kind=Kind.ERROR_BIT, part="pump", value=1, start=0.1, duration=0.0)
    samples = run(world, device, 0.3, lambda: device.command(HOLD))
    assert samples[-1].error == (0, 0, 0, 1, 0)
    assert samples[-1].torque_on


@pytest.mark.parametrize("kind", [Kind.DROP, Kind.CORRUPT, Kind.TRUNCATE, Kind.WRONG_ID])
def test_a_spoilt_answer_costs_its_cycle(world: World, kind: Kind) -> None:
    samples = run(world, servos(world, kind=kind, value=0.5), 2.0)
    assert 190 < len({sample.t_ns for sample in samples if sample}) < 310


# --- all of them ------------------------------------------------------------------------------------------------------


def test_every_kind_of_the_emulators_can_be_had(world: World) -> None:
    for device, kinds in (
        ("autopilot", px4_faults.KINDS), ("odometry", tracker.KINDS), ("servos", dynamixel_troubles.KINDS)
    ):  # fmt: skip
        for kind in kinds:
            faults = f"faults=[{{device: {device}, kind: {kind}, value: 1.0, phase: press}}]"
            devices = simulated_devices(world, load_config(sets=[faults]))
            devices.enter("press")
            struck: Any = getattr(devices, device)
            assert [fault.kind for fault in struck.faults.active(world.time)] == [kind]


def test_a_fault_that_cannot_be_is_named(world: World) -> None:
    with pytest.raises(ConfigError, match="no device 'gripper'; there are: autopilot, odometry, servos"):
        simulated_devices(world, load_config(sets=["faults=[{device: gripper, kind: silent}]"]))
    with pytest.raises(ConfigError, match="fault jump of servos: servos can show"):
        simulated_devices(world, load_config(sets=["faults=[{device: servos, kind: jump}]"]))
