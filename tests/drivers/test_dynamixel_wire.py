"""What the driver does in the time of the wire: how long the arm is limp, and answers that come after their time."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from drivers import xc330
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.samples import JointMode, ServoCommand
from drivers.xc330 import Mode
from sim_backend.faults import Kind
from tests.drivers.on_the_wire import Bench, Strength

SETTINGS = DynamixelSettings("")
TORQUE = ServoCommand(JointMode.TORQUE, (0.05, -0.05, 0.05), (0.0,) * 5, 1.0)
HOLD = replace(TORQUE, mode=JointMode.POSITION)
BAUDS = (1_000_000, 4_000_000)


def at_work(settings: DynamixelSettings, latency: float = 0.0) -> Bench:
    """In torque mode, for a while."""
    bench = Bench(settings, latency)
    for _ in range(10):
        bench.cycle(TORQUE)
    state = bench.driver.latest()
    assert state is not None
    assert state.torque_on
    assert state.current[0] > 0.0
    return bench


def hold(bench: Bench, limp: Strength) -> None:
    """Hold where the servos stand now."""
    state = bench.driver.latest()
    assert state is not None
    for _ in range(5):
        bench.cycle(replace(HOLD, position=state.position))
    for servo in bench.bus.servos[:3]:
        assert servo.get(xc330.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION
        assert servo.get(xc330.GOAL_CURRENT) == 1000
        assert servo.torque_on
    assert len(limp.limp) == 3


@pytest.mark.parametrize(("baud", "longest"), [(1_000_000, 1.7e-3), (4_000_000, 0.5e-3)])
def test_from_torque_to_hold_the_arm_is_limp_for_a_moment_only(baud: int, longest: float) -> None:
    bench = at_work(replace(SETTINGS, baud=baud))
    limp = Strength(bench)
    hold(bench, limp)
    assert max(limp.limp) < longest
    # Within the way that the free servos have gone since they were last read, in one cycle.
    assert max(limp.goals) < 0.02


def test_an_adapter_adds_its_latency_once() -> None:
    bench = at_work(SETTINGS, latency=1e-3)
    limp = Strength(bench)
    hold(bench, limp)
    assert max(limp.limp) < 2.7e-3


def test_gains_and_profiles_are_set_before_the_servos_have_strength() -> None:
    shaped = ServoSettings(id=1, gains=(900, 10, 300), profile_velocity=2.0, profile_acceleration=20.0)
    bench = at_work(replace(SETTINGS, servos=(shaped, *SETTINGS.servos[1:])))
    limp = Strength(bench)
    hold(bench, limp)
    assert bench.bus.servos[0].get(xc330.POSITION_P) == 900
    assert bench.bus.servos[0].get(xc330.PROFILE_VELOCITY) == 83
    assert max(limp.limp) < 2.5e-3


def test_servos_that_are_not_heard_are_made_to_hold_all_the_same() -> None:
    """They hear: only their answers are lost. It costs one answer's time more."""
    bench = at_work(SETTINGS)
    bench.inject(Kind.DROP, value=1.0)
    limp = Strength(bench)
    hold(bench, limp)
    assert max(limp.limp) < 2e-3 + SETTINGS.reply_margin


def test_servos_that_have_long_been_given_up_are_made_to_hold_where_they_were_last_seen() -> None:
    bench = at_work(replace(SETTINGS, retry=10.0))
    bench.inject(Kind.DROP, value=1.0)
    while any(servo.answers for servo in bench.driver._servos):
        bench.cycle(TORQUE)
    last = bench.driver.latest()
    assert last is not None
    bench.cycle(replace(HOLD, position=last.position))
    for k, servo in enumerate(bench.bus.servos[:3]):
        assert servo.torque_on
        assert servo.get(xc330.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION
        assert servo.get(xc330.GOAL_CURRENT) == 1000
        assert servo.drive().goal - SETTINGS.servos[k].zero * xc330.RAD_PER_COUNT == pytest.approx(
            last.position[k], abs=0.01
        )


def test_a_servo_that_keeps_its_mode_gets_no_strength() -> None:
    """In current mode the limit of a hold would be a goal."""
    bench = at_work(SETTINGS)
    stubborn = bench.bus.servos[1]
    write = stubborn.write
    stubborn.write = lambda address, data: 0 if address == xc330.OPERATING_MODE.address else write(address, data)  # type: ignore[method-assign]
    for _ in range(5):
        bench.cycle(HOLD)
        assert stubborn.get(xc330.OPERATING_MODE) == Mode.CURRENT
        assert stubborn.get(xc330.GOAL_CURRENT) == 0
    told = [notice.text for notice in bench.driver.notices()]
    assert "servo bus: a command did not reach servo 2: it did not take the operating mode" in told
    stubborn.write = write  # type: ignore[method-assign]
    bench.cycle(HOLD)
    assert stubborn.get(xc330.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION


def test_the_watchdog_of_a_servo_at_work_is_never_off() -> None:
    bench = at_work(SETTINGS)
    seen: list[int] = []
    bench.wire.seen = lambda: seen.extend(
        servo.get(xc330.BUS_WATCHDOG) for servo in bench.bus.servos if servo.torque_on
    )
    for command in (HOLD, TORQUE, HOLD):
        for _ in range(3):
            bench.cycle(command)
    assert set(seen) == {5}


# -- answers after their time -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2])
def test_a_late_answer_is_known_and_counted(count: int) -> None:
    """What it tells is older than what was asked: it costs its cycle, and no sample is made of it."""
    bench = at_work(SETTINGS)
    samples = []
    bench.wire.hold_back = count
    for _ in range(20):
        state = bench.cycle(TORQUE)
        samples.append(state)
        if state is not None and count == 1:  # of two, the second was for one servo, which keeps its last place
            # Torque turns the free servo: a place of the cycle before would be behind.
            told = SETTINGS.servos[0].zero + state.position[0] / xc330.RAD_PER_COUNT
            now = bench.free.position[0] / xc330.RAD_PER_COUNT
            assert now - told < 0.7 * bench.free.velocity[0] * 0.004 / xc330.RAD_PER_COUNT + 3
    assert samples.count(None) == 1
    statistics = bench.driver.statistics()
    assert statistics.errors["no answer"] == count
    assert statistics.late == count
    assert not any(servo.suspect for servo in bench.driver._servos)
    state = bench.driver.latest()
    assert state is not None
    assert state.error == (0,) * 5


def test_what_comes_before_a_question_is_late_too() -> None:
    bench = at_work(SETTINGS)
    bench.wire._answer = b"\xff\xff\xfd\x00"
    assert bench.cycle(TORQUE) is not None
    assert bench.driver.statistics().late == 1
