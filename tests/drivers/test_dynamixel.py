"""The servo driver on an emulated bus: what it sets up, what it sends, and how it meets every fault.

The bus answers in a thread; tests wait for conditions, never for a guessed time.
"""

from __future__ import annotations

import asyncio
import os
import select
import struct
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from math import inf, nan
from pathlib import Path
from time import thread_time
from typing import cast

import msgspec
import pytest
import pytest_asyncio
from msgspec.structs import replace

from drivers import xc330
from drivers.dynamixel import Dynamixel
from drivers.dynamixel_bus import (
    Answer,
    Bus,
    BusError,
    Corrupt,
    NoAnswer,
    Port,
    Refused,
    latency_hint,
    latency_timer,
    wire_time,
)
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.dynamixel_setup import READ_AT, READ_BYTES, WRITTEN_BYTES
from drivers.mailbox import Level, Notice
from drivers.protocols import DeviceError
from drivers.samples import JointMode, ServoCommand, ServoState, Vec3
from drivers.xc330 import HardwareError, Mode
from sim_backend.dynamixel_emulator import DynamixelEmulator, emulate
from sim_backend.dynamixel_mechanics import FreeServos
from sim_backend.dynamixel_servo import Servo
from sim_backend.dynamixel_troubles import KINDS
from sim_backend.dynamixel_wire import Instruction, Packet
from sim_backend.faults import Kind

pytestmark = pytest.mark.asyncio

TICK = 0.004
GOALS = (0.5, -0.3, 0.2, 1.0, -1.0)
MOUNTING = (
    ServoSettings(id=3, zero=1500),
    ServoSettings(id=7, zero=2600, sign=-1),
    ServoSettings(id=4, zero=2048),
    ServoSettings(id=9, zero=100, sign=-1),
    ServoSettings(id=12, zero=3000),
)


def command(
    mode: JointMode = JointMode.POSITION,
    torque: Vec3 = (0.0, 0.0, 0.0),
    position: tuple[float, float, float, float, float] = GOALS,
    current_limit: float = 1.0,
) -> ServoCommand:
    return ServoCommand(mode, torque, position, current_limit)


class Rig:
    def __init__(self, link: Path) -> None:
        self.emulator = emulate(MOUNTING, link=link)
        self.emulator.start()
        # Patient, for machines that are busy with other things.
        self.settings = DynamixelSettings(
            str(link), MOUNTING, reply_margin=0.02, silent_after=0.1, watchdog=0.2, retry=0.05, reboot_delay=0.1
        )
        self.driver = Dynamixel(self.settings)
        self.told: list[Notice] = []

    @property
    def free(self) -> FreeServos:
        mechanics = self.emulator.bus._mechanics
        assert isinstance(mechanics, FreeServos)
        return mechanics

    def servo(self, index: int) -> Servo:
        return self.emulator.bus.servos[index]

    def state(self) -> ServoState:
        state = self.driver.latest()
        assert state is not None
        return state

    def texts(self) -> list[str]:
        self.told.extend(self.driver.notices())
        return [notice.text for notice in self.told]

    def heard(self, words: str) -> bool:
        return any(words in text for text in self.texts())

    async def until(
        self, condition: Callable[[], bool], what: Callable[[], ServoCommand] | None = None, within: float = 30.0
    ) -> None:
        """Command ``what`` in every tick (nothing: stay silent) until the condition holds."""
        for _ in range(round(within / TICK)):
            if condition():
                return
            if what is not None:
                self.driver.command(what())
            await asyncio.sleep(TICK)
        pytest.fail(f"not within {within} s: {self.driver.latest()}, {self.texts()}")

    async def ticks(self, count: int, what: Callable[[], ServoCommand] | None = None) -> None:
        for _ in range(count):
            if what is not None:
                self.driver.command(what())
            await asyncio.sleep(TICK)

    async def engaged(self, what: Callable[[], ServoCommand] = command) -> None:
        """Until all have torque, and stand if they are to stand."""
        await self.until(lambda: self.driver.latest() is not None and self.state().torque_on, what)

    async def fresh(self, count: int = 3, what: Callable[[], ServoCommand] | None = None) -> None:
        """Until so many new samples have come."""
        seen = {self.state().t_ns}

        def enough() -> bool:
            seen.add(self.state().t_ns)
            return len(seen) > count

        await self.until(enough, what)


@pytest_asyncio.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Rig]:
    made = Rig(tmp_path / "servos")
    try:
        await made.driver.start()
        await made.until(lambda: made.driver.latest() is not None)
        yield made
        await made.driver.stop()
    finally:
        await asyncio.to_thread(made.emulator.stop)


# -- setting up -----------------------------------------------------------------------------------------------------


async def test_sets_up_what_differs_and_reads_it_back(rig: Rig) -> None:
    wanted = {
        xc330.RETURN_DELAY: 0,
        xc330.OPERATING_MODE: Mode.CURRENT_BASED_POSITION,
        xc330.CURRENT_LIMIT: 1600,
        xc330.HOMING_OFFSET: 0,
        xc330.SHUTDOWN: 52,
        xc330.TORQUE_ENABLE: 0,
        xc330.BUS_WATCHDOG: 0,
    }
    for servo in rig.emulator.bus.servos:
        assert {item: servo.get(item) for item in wanted} == wanted
    assert rig.heard("theta_2 (id 7): return delay time set from 250 to 0")
    assert rig.driver.statistics().fast


async def test_a_second_start_writes_nothing_to_the_eeprom(rig: Rig) -> None:
    await rig.driver.stop()
    rig.texts()
    rig.told.clear()
    # With torque on, any write to the EEPROM would be refused, and none would be told as set.
    await rig.driver.start()
    assert not [text for text in rig.texts() if " set from " in text]


async def test_angles_are_seen_through_zero_and_sign(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    for k, mount in enumerate(MOUNTING):
        rig.free.position[k] = (mount.zero + 300) * xc330.RAD_PER_COUNT
    await rig.driver.start()
    await rig.until(lambda: rig.driver.latest() is not None)
    expected = [mount.sign * 300 * xc330.RAD_PER_COUNT for mount in MOUNTING]
    assert rig.state().position == pytest.approx(expected)
    assert rig.state().voltage == pytest.approx((5.0,) * 5)
    assert rig.state().temperature == pytest.approx((30.0,) * 5)
    await rig.driver.stop()
    rig.emulator.stop()


async def test_the_turn_is_the_one_nearest_to_the_centre(tmp_path: Path) -> None:
    """Zero at 100 counts and sign -1: 3414 counts are -5.08 rad, or 1.2 rad a turn on."""
    rig = Rig(tmp_path / "servos")
    k, mount = 3, MOUNTING[3]
    servos = (*MOUNTING[:3], replace(mount, center=1.0), MOUNTING[4])
    rig.free.position[k] = 3414 * xc330.RAD_PER_COUNT
    driver = Dynamixel(replace(rig.settings, servos=servos))
    rig.driver = driver
    await driver.start()
    await rig.until(lambda: driver.latest() is not None)
    assert rig.state().position[k] == pytest.approx((100 - 3414 + 4096) * xc330.RAD_PER_COUNT)
    await rig.engaged(lambda: command(position=(0.0, 0.0, 0.0, 1.0, 0.0)))
    await rig.until(
        lambda: abs(rig.state().position[k] - 1.0) < 0.01, lambda: command(position=(0.0, 0.0, 0.0, 1.0, 0.0))
    )
    assert rig.free.position[k] == pytest.approx((100 + 4096) * xc330.RAD_PER_COUNT - 1.0, abs=0.02)
    await driver.stop()
    rig.emulator.stop()


async def refusal(rig: Rig, settings: DynamixelSettings | None = None) -> str:
    with pytest.raises(DeviceError) as caught:
        await Dynamixel(settings or rig.settings).start()
    rig.emulator.stop()
    return str(caught.value)


async def test_names_the_servos_that_are_missing_and_the_ids_that_answer(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    rig.emulator.inject(Kind.SILENT, part="theta_2")
    rig.emulator.inject(Kind.SILENT, part="gripper")
    text = await refusal(rig)
    assert "no answer from theta_2 (id 7), gripper (id 12)" in text
    assert "ids that answer: 3, 4, 9" in text


async def test_finds_the_baud_rate_that_the_servos_have(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    text = await refusal(rig, replace(rig.settings, baud=57_600))
    assert "servo 3 does at 1000000" in text


async def test_nobody_there(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    rig.emulator.inject(Kind.SILENT)
    assert "is the 5 V supply on" in await refusal(rig, replace(rig.settings, reply_margin=0.003))


async def test_another_model(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    rig.servo(2)._put(xc330.MODEL_NUMBER, 1200)
    assert "theta_3 (id 4) is model 1200, want 1240 (XC330-M288-T)" in await refusal(rig)


async def test_no_port(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="it is not there; is the adapter plugged in"):
        await Dynamixel(DynamixelSettings(str(tmp_path / "nothing"))).start()


async def test_a_port_in_use(rig: Rig) -> None:
    with pytest.raises(DeviceError, match="another process uses it"):
        await Dynamixel(rig.settings).start()


async def test_what_is_no_serial_port(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="servo bus: cannot open"):
        await Dynamixel(DynamixelSettings(str(tmp_path / "file"))).start()


async def test_settings_that_cannot_be() -> None:
    with pytest.raises(DeviceError, match="not all different"):
        Dynamixel(DynamixelSettings("x", (*MOUNTING[:4], MOUNTING[0])))
    with pytest.raises(DeviceError, match="baud 250000; want one of"):
        Dynamixel(DynamixelSettings("x", baud=250_000))  # type: ignore[arg-type]
    with pytest.raises(msgspec.ValidationError, match=r"sign"):
        msgspec.convert({"id": 1, "sign": 2}, ServoSettings)


async def test_a_servo_in_error_is_rebooted_at_the_start(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    rig.servo(0).fail(HardwareError.OVERLOAD)
    await rig.driver.start()
    assert rig.heard("theta_1 (id 3): overload; rebooting it")
    await rig.until(lambda: rig.driver.latest() is not None)
    assert rig.state().error == (0, 0, 0, 0, 0)
    await rig.driver.stop()
    rig.emulator.stop()


async def test_without_fast_sync_read_plain_reads_do(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    for servo in rig.emulator.bus.servos:
        servo._put(xc330.FIRMWARE, 44)
    await rig.driver.start()
    assert not rig.driver.statistics().fast
    assert rig.heard("theta_1 (id 3) has firmware 44")
    assert rig.heard("plain sync reads are used")
    await rig.until(lambda: rig.driver.latest() is not None)
    await rig.fresh()
    assert rig.emulator.bus.received["SYNC_READ"] >= 3
    await rig.driver.stop()
    rig.emulator.stop()


async def test_profile_and_gains_are_written_and_survive_a_change_of_mode(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    shaped = replace(MOUNTING[0], profile_velocity=2.0, profile_acceleration=20.0, gains=(900, 10, 300))
    rig.driver = Dynamixel(replace(rig.settings, servos=(shaped, *MOUNTING[1:])))
    await rig.driver.start()
    items = (
        xc330.PROFILE_VELOCITY, xc330.PROFILE_ACCELERATION, xc330.POSITION_P, xc330.POSITION_I, xc330.POSITION_D,
    )  # fmt: skip
    expected = [83, 53, 900, 10, 300]
    assert [rig.servo(0).get(item) for item in items] == expected
    assert [rig.servo(1).get(item) for item in items] == [0, 0, 1100, 0, 500]
    await rig.until(lambda: rig.driver.latest() is not None)
    await rig.engaged(lambda: command(JointMode.TORQUE))
    assert [rig.servo(0).get(item) for item in items] == expected
    await rig.driver.stop()
    rig.emulator.stop()


async def test_the_latency_timer_of_the_adapter(tmp_path: Path) -> None:
    device = tmp_path / "dev" / "ttyUSB3"
    device.parent.mkdir()
    device.write_text("")
    link = tmp_path / "servos"
    link.symlink_to(device)
    assert latency_hint(str(link), tmp_path / "sys") is None
    assert latency_timer(str(link), tmp_path / "sys") == 0.0
    timer = tmp_path / "sys" / "ttyUSB3" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    hint = latency_hint(str(link), tmp_path / "sys")
    assert hint is not None
    assert latency_timer(str(link), tmp_path / "sys") == pytest.approx(0.016)
    assert "16 ms" in hint
    assert f"echo 1 | sudo tee {timer}" in hint
    timer.write_text("1\n")
    assert latency_hint(str(link), tmp_path / "sys") is None


# -- commands -------------------------------------------------------------------------------------------------------


async def test_position_goals_of_all_five(rig: Rig) -> None:
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    for servo in rig.emulator.bus.servos[:3]:
        assert servo.get(xc330.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION
        assert servo.get(xc330.GOAL_CURRENT) == 1000
        assert servo.get(xc330.BUS_WATCHDOG) == 10
    assert rig.servo(3).get(xc330.GOAL_CURRENT) == 1600  # the tools have their own limit


async def test_torque_becomes_current_by_constant_and_sign(rig: Rig) -> None:
    def twist() -> ServoCommand:
        return command(JointMode.TORQUE, (0.05, 0.05, -0.05))

    await rig.engaged(twist)
    await rig.until(lambda: rig.servo(0).get(xc330.GOAL_CURRENT) != 0, twist)
    milliamperes = int(0.05 / (0.93 / 1.80) / xc330.AMPERE_PER_UNIT)
    assert [rig.servo(k).get(xc330.GOAL_CURRENT) for k in range(3)] == [milliamperes, -milliamperes, -milliamperes]
    assert [rig.servo(k).get(xc330.OPERATING_MODE) for k in range(4)] == [0, 0, 0, 5]
    # What is pushed forward goes forward, whatever the sign of its mounting.
    await rig.until(lambda: rig.state().velocity[0] > 0.2 and rig.state().velocity[1] > 0.2, twist)
    assert rig.state().velocity[2] < -0.2
    await rig.until(lambda: rig.state().current[:3] == pytest.approx((0.096, 0.096, -0.096)), twist)


async def test_no_goal_exceeds_the_servo_s_current_limit(rig: Rig) -> None:
    await rig.engaged(lambda: command(JointMode.TORQUE, (100.0, -100.0, 0.0)))
    await rig.until(
        lambda: rig.servo(0).get(xc330.GOAL_CURRENT) == 1600 and rig.servo(1).get(xc330.GOAL_CURRENT) == 1600,
        lambda: command(JointMode.TORQUE, (100.0, -100.0, 0.0)),
    )
    await rig.until(
        lambda: rig.servo(0).get(xc330.OPERATING_MODE) == 5 and rig.servo(0).get(xc330.GOAL_CURRENT) == 1600,
        lambda: command(current_limit=50.0),
    )


async def test_entering_current_mode_gives_no_kick(rig: Rig) -> None:
    """A servo enters current mode with its current limit as the goal; it is set to 0 before torque comes."""
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    before = list(rig.free.position)
    await rig.until(
        lambda: all(rig.servo(k).get(xc330.OPERATING_MODE) == 0 and rig.servo(k).torque_on for k in range(3)),
        lambda: command(JointMode.TORQUE),
    )
    await rig.fresh(5, lambda: command(JointMode.TORQUE))
    assert rig.free.position[:3] == pytest.approx(before[:3], abs=0.01)


async def test_off_takes_the_torque_of_all_and_disarms_the_watchdog(rig: Rig) -> None:
    await rig.engaged()
    await rig.until(lambda: not rig.state().torque_on, lambda: command(JointMode.OFF))
    await rig.until(lambda: not any(servo.torque_on for servo in rig.emulator.bus.servos))
    assert [servo.get(xc330.BUS_WATCHDOG) for servo in rig.emulator.bus.servos] == [0] * 5
    before = rig.emulator.bus.goals
    await rig.ticks(20, lambda: command(JointMode.OFF))
    await rig.fresh()
    assert rig.emulator.bus.goals == before


async def test_what_is_not_finite_is_not_sent(rig: Rig) -> None:
    await rig.engaged()
    await rig.until(lambda: rig.heard("not finite"), lambda: command(torque=(nan, 0.0, 0.0)))
    rig.driver.command(command(position=(inf, 0.0, 0.0, 0.0, 0.0)))
    assert sum("not finite" in text for text in rig.texts()) == 1


async def test_command_before_start_and_after_stop(rig: Rig) -> None:
    await rig.driver.stop()
    await rig.driver.stop()
    with pytest.raises(DeviceError, match="before start"):
        rig.driver.command(command())
    assert not any(servo.torque_on for servo in rig.emulator.bus.servos)


async def test_one_write_and_one_read_a_cycle(rig: Rig) -> None:
    await rig.engaged()
    await rig.fresh(5, command)
    before = rig.emulator.bus.received.copy()
    cycles = rig.driver.statistics().cycle.count
    await rig.until(lambda: rig.driver.statistics().cycle.count >= cycles + 50, command)
    after, count = rig.emulator.bus.received, rig.driver.statistics().cycle.count - cycles
    assert after["SYNC_WRITE"] - before["SYNC_WRITE"] <= count + 1
    assert after["FAST_SYNC_READ"] - before["FAST_SYNC_READ"] <= count + 1
    assert after["WRITE"] == before["WRITE"]


# -- silence --------------------------------------------------------------------------------------------------------


async def test_no_goal_leaves_after_the_last_command_and_the_servos_stop_themselves(rig: Rig) -> None:
    far = (3.0, -3.0, 3.0, 3.0, -3.0)
    for servo in rig.emulator.bus.servos:
        servo._put(xc330.PROFILE_VELOCITY, 10)  # so that they are still on their way
    await rig.engaged(lambda: command(position=far))
    await rig.fresh(3, lambda: command(position=far))
    await rig.until(lambda: rig.driver._command is None)
    written = rig.emulator.bus.goals
    await rig.until(lambda: all(servo.tripped for servo in rig.emulator.bus.servos))
    assert rig.emulator.bus.goals == written
    await rig.until(lambda: rig.heard("the bus watchdog has stopped the servos"))
    assert rig.heard("the bus is left silent")
    await rig.until(lambda: rig.state().velocity == pytest.approx((0.0,) * 5, abs=0.03))
    assert rig.state().position != pytest.approx(far, abs=0.5)
    assert rig.emulator.bus.goals == written


async def test_the_next_command_starts_them_again_slowly(rig: Rig) -> None:
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    await rig.until(lambda: rig.heard("the bus watchdog has stopped"))
    home = (0.0, 0.0, 0.0, 0.0, 0.0)
    speeds = []

    def there() -> bool:
        speeds.append(max(abs(each) for each in rig.state().velocity))
        return rig.state().position == pytest.approx(home, abs=0.01)

    await rig.until(there, lambda: command(position=home))
    everybody = "theta_1 (id 3), theta_2 (id 7), theta_3 (id 4), pump (id 9), gripper (id 12)"
    await rig.until(lambda: rig.heard(f"{everybody} are back at the goal"), lambda: command(position=home))
    # The emulated servos themselves would run at 8.5 rad/s; a late cycle makes one larger step.
    assert sorted(speeds)[len(speeds) // 2] < 2.0 * rig.settings.homing_speed


async def test_a_servo_that_runs_on_after_the_trip_loses_its_torque(rig: Rig) -> None:
    for servo in rig.emulator.bus.servos:
        servo.runs_on = True
    await rig.engaged(lambda: command(JointMode.TORQUE, (0.05, 0.0, 0.0)))
    await rig.until(lambda: rig.state().velocity[0] > 0.2, lambda: command(JointMode.TORQUE, (0.05, 0.0, 0.0)))
    await rig.until(lambda: not any(rig.servo(k).torque_on for k in range(3)))
    await rig.until(lambda: rig.state().velocity[0] == 0.0)


async def test_a_command_from_before_a_pause_is_not_sent_after_it(tmp_path: Path) -> None:
    """As after SIGSTOP and SIGCONT: the clock has jumped while a command waited."""
    rig = Rig(tmp_path / "servos")
    clock = [0]
    driver = Dynamixel(rig.settings, clock=lambda: clock[0])
    driver._thread = threading.current_thread()  # as if it were running, to be stepped by hand
    driver.command(command())
    assert driver._fresh() is not None
    driver.command(command())
    clock[0] = 10_000_000_000
    assert driver._fresh() is None
    rig.emulator.stop()


# -- faults ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", [Kind.DROP, Kind.CORRUPT, Kind.TRUNCATE, Kind.WRONG_ID])
async def test_a_spoilt_answer_costs_a_cycle_and_is_told_once(rig: Rig, fault: Kind) -> None:
    await rig.engaged()
    for _ in range(3):
        before = sum(rig.driver.statistics().errors.values())
        rig.emulator.inject(fault, value=1.0, count=1)
        await rig.until(lambda: sum(rig.driver.statistics().errors.values()) > before, command)  # noqa: B023
        await rig.fresh(3, command)
    assert sum("a reading of the servos failed" in text for text in rig.texts()) <= 1
    assert not rig.heard("does not answer")
    assert rig.state().error == (0, 0, 0, 0, 0)
    assert rig.state().torque_on


async def test_a_silent_servo_is_told_once_the_others_go_on_and_its_return_is_told(rig: Rig) -> None:
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    rig.emulator.inject(Kind.SILENT, part="theta_2")
    await rig.until(lambda: rig.state().error[1] == HardwareError.SILENT, command)
    await rig.fresh(20, command)
    assert rig.state().position == pytest.approx(GOALS, abs=0.01)
    assert not rig.state().torque_on
    assert sum("theta_2 (id 7) does not answer any more" in text for text in rig.texts()) == 1
    new = (0.1, -0.3, 0.1, 0.9, -0.9)
    await rig.until(lambda: rig.state().position == pytest.approx(new, abs=0.01), lambda: command(position=new))
    rig.emulator.faults.clear()
    await rig.until(lambda: rig.state().error == (0,) * 5 and rig.state().torque_on, lambda: command(position=new))
    await rig.until(lambda: rig.heard("theta_2 (id 7) answers again"), lambda: command(position=new))
    assert sum("theta_2 (id 7) answers again" in text for text in rig.texts()) == 1


#: Each fault of the bus: for how long (None: until it was told), how much and where, and what of it is told.
FAULTS: dict[Kind, tuple[float | None, float, str, tuple[str, ...]]] = {
    Kind.DROP: (None, 0.1, "", ("a reading of the servos failed",)),
    Kind.CORRUPT: (None, 0.1, "", ("a reading of the servos failed",)),
    Kind.TRUNCATE: (None, 0.1, "", ("a reading of the servos failed",)),
    Kind.WRONG_ID: (None, 0.1, "", ("a reading of the servos failed",)),
    Kind.DELAY: (None, 0.06, "", ("no servo answers any more",)),
    Kind.SILENT: (0.5, 0.0, "theta_2", ("theta_2 (id 7) does not answer any more", "theta_2 (id 7) answers again")),
    Kind.ERROR_BIT: (
        0.0, HardwareError.OVERLOAD, "pump", ("pump (id 9): overload", "reboot 1 of 3", "answers again, restarted"),
    ),
    Kind.REBOOT: (0.5, 0.0, "theta_3", ("theta_3 (id 4) does not answer any more", "answers again, restarted")),
    Kind.UNPLUGGED: (0.5, 0.0, "", ("servo bus: the adapter on", "is back")),
}  # fmt: skip


async def test_every_fault_of_the_bus_is_here() -> None:
    assert set(FAULTS) == set(KINDS)


@pytest.mark.parametrize("kind", FAULTS)
async def test_each_fault_is_survived_told_and_recovered_from(rig: Rig, kind: Kind) -> None:
    """Told once, or while it comes and goes, no more than once for each servo and way."""
    duration, value, part, expected = FAULTS[kind]
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    rig.texts()
    rig.told.clear()
    rig.emulator.inject(kind, duration, value, part)
    over = rig.emulator.time + (duration or 0.0)
    await rig.until(lambda: rig.emulator.time > over and all(rig.heard(text) for text in expected), command)
    rig.emulator.faults.clear()
    await rig.until(lambda: rig.state().torque_on and rig.state().error == (0,) * 5, command)
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    last = rig.state().t_ns
    await rig.until(lambda: rig.state().t_ns > last, command)
    assert sum(expected[0] in text and "is back" not in text for text in rig.texts()) == 1
    assert len(rig.texts()) < 20


async def test_all_silent_is_one_sentence_and_no_samples(rig: Rig) -> None:
    await rig.engaged()
    rig.emulator.inject(Kind.SILENT)
    await rig.until(lambda: rig.heard("no servo answers any more"), command)
    last = rig.state().t_ns
    await rig.ticks(30, command)
    assert rig.state().t_ns == last
    assert not rig.heard("the others go on")
    rig.emulator.faults.clear()
    await rig.until(lambda: rig.state().t_ns > last and rig.state().error == (0,) * 5, command)
    await rig.engaged()


async def test_the_adapter_unplugged_and_put_back(rig: Rig) -> None:
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    await asyncio.to_thread(rig.emulator.unplug)
    await rig.until(lambda: rig.heard("adapter on"), command)
    last = rig.state().t_ns
    await rig.ticks(30, command)
    assert rig.state().t_ns == last
    await rig.until(lambda: all(servo.tripped for servo in rig.emulator.bus.servos), command)
    await asyncio.to_thread(rig.emulator.plug)
    await rig.until(lambda: rig.state().t_ns > last and rig.state().torque_on, command)
    assert sum("is gone" in text for text in rig.texts()) == 1
    assert sum("is back" in text and "adapter" in text for text in rig.texts()) == 1
    assert rig.driver.statistics().errors["adapter lost"] == 1
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)


async def test_insisting_is_the_next_packet_each_time(rig: Rig) -> None:
    """And then the readings go on."""
    await rig.engaged()
    seen: list[bytes] = []
    handle = rig.emulator.bus.handle

    def noted(packet: Packet, now: float, speed: int | None = None) -> tuple[bytes, float]:
        if packet.instruction == Instruction.SYNC_WRITE:
            seen.append(packet.parameters)
        return handle(packet, now, speed)

    rig.emulator.bus.handle = noted  # type: ignore[method-assign]
    off = xc330.TORQUE_ENABLE.address.to_bytes(2, "little") + b"\1\0" + b"".join(bytes((m.id, 0)) for m in MOUNTING)
    for _ in range(3):
        before = seen.count(off)
        rig.driver.insist(True)
        await rig.until(lambda before=before: seen.count(off) > before)  # type: ignore[misc]
    await rig.fresh(10, command)
    before = seen.count(off)
    await rig.fresh(10, command)
    assert seen.count(off) == before
    assert not any(servo.torque_on for servo in rig.emulator.bus.servos)
    assert not rig.state().torque_on


async def test_insisting_does_not_wait_for_a_round_of_silent_servos(rig: Rig) -> None:
    await rig.engaged()
    seen: list[int] = []
    handle = rig.emulator.bus.handle

    def noted(packet: Packet, now: float, speed: int | None = None) -> tuple[bytes, float]:
        alone = packet.instruction == Instruction.READ and packet.parameters[:2] == READ_AT.to_bytes(2, "little")
        if not seen and alone:  # the first of a round
            rig.driver.insist(True)
            seen.append(packet.instruction)
        elif seen:
            seen.append(packet.instruction)
        return handle(packet, now, speed)

    rig.emulator.bus.handle = noted  # type: ignore[method-assign]
    rig.emulator.inject(Kind.SILENT)
    await rig.until(lambda: len(seen) > 1, command)
    assert seen[:2] == [Instruction.READ, Instruction.SYNC_WRITE]


async def test_torque_stays_off_behind_a_new_adapter(rig: Rig) -> None:
    await rig.engaged()
    await asyncio.to_thread(rig.emulator.unplug)
    await rig.until(lambda: rig.heard("adapter on"), command)
    rig.driver.insist(True)
    await asyncio.to_thread(rig.emulator.plug)
    await rig.until(lambda: not any(servo.torque_on for servo in rig.emulator.bus.servos), command)
    last = rig.state().t_ns
    await rig.until(lambda: rig.state().t_ns > last, command)
    assert not rig.state().torque_on
    rig.driver.insist(False)
    await rig.until(lambda: rig.state().torque_on, command)


async def test_insisting_outside_of_start_and_stop(rig: Rig) -> None:
    with pytest.raises(DeviceError, match=r"insist\(\) before start\(\) or after stop\(\)"):
        Dynamixel(rig.settings).insist(True)


async def test_hardware_errors_are_told_in_words_and_the_readings_go_on(rig: Rig) -> None:
    await rig.engaged()
    rig.servo(2).fail(HardwareError.VOLTAGE)
    await rig.until(lambda: rig.state().error[2] == HardwareError.VOLTAGE, command)
    await rig.fresh(10, command)
    assert rig.state().torque_on
    assert sum("theta_3 (id 4): supply voltage out of its limits" in text for text in rig.texts()) == 1


async def test_overload_is_rebooted_and_the_servo_comes_back_slowly(rig: Rig) -> None:
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    rig.servo(0).fail(HardwareError.OVERLOAD)
    rig.free.position[0] += 0.4  # it has given way
    await rig.until(lambda: rig.state().error[0] & HardwareError.OVERLOAD != 0, command)
    assert not rig.state().torque_on
    await rig.until(lambda: rig.heard("theta_1 (id 3): reboot 1 of 3"), command)
    await rig.until(lambda: rig.state().torque_on, command)
    assert rig.state().position[0] > GOALS[0] + 0.2  # not at once
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)
    assert rig.heard("overload; its torque is off, it is rebooted in 0.1 s")
    await rig.until(lambda: rig.heard("theta_1 (id 3) answers again, restarted"), command)
    assert rig.state().error == (0, 0, 0, 0, 0)


async def test_after_so_many_reboots_it_stays_off(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "servos")
    rig.driver = Dynamixel(replace(rig.settings, reboots=0))
    await rig.driver.start()
    await rig.until(lambda: rig.driver.latest() is not None)
    await rig.engaged()
    rig.servo(0).fail(HardwareError.OVERLOAD)
    await rig.until(lambda: rig.heard("its torque stays off after 0 reboots"), command)
    await rig.fresh(20, command)
    assert rig.state().error[0] == HardwareError.OVERLOAD
    assert not rig.servo(0).torque_on
    await rig.driver.stop()
    rig.emulator.stop()


async def test_a_servo_that_restarts_by_itself_is_set_up_again(rig: Rig) -> None:
    """The turn is kept, though the servo has forgotten it."""
    goals = (0.5, -0.3, 0.2, 1.0, -6.0)
    await rig.until(lambda: rig.state().position == pytest.approx(goals, abs=0.01), lambda: command(position=goals))
    # A dip of the supply, shorter than anybody asks.
    rig.servo(4)._reboot_time = 0.0
    rig.servo(4).reboot(0.0)
    await rig.until(lambda: rig.heard("gripper (id 12) has restarted by itself"), lambda: command(position=goals))
    await rig.until(lambda: rig.state().torque_on and rig.state().error == (0,) * 5, lambda: command(position=goals))
    assert rig.state().position == pytest.approx(goals, abs=0.02)
    assert rig.servo(4).get(xc330.GOAL_CURRENT) == 1600


async def test_torque_switched_off_by_somebody_else_is_told_and_comes_back(rig: Rig) -> None:
    await rig.engaged()
    rig.servo(1).write(xc330.TORQUE_ENABLE.address, b"\0")
    await rig.until(lambda: rig.heard("theta_2 (id 7) has lost its torque"), command)
    await rig.engaged()


async def test_late_answers_are_lived_with(rig: Rig) -> None:
    await rig.engaged()
    rig.emulator.inject(Kind.DELAY, value=0.03, count=5)
    await rig.until(lambda: not rig.emulator.faults.active(rig.emulator.time), command)
    await rig.fresh(10, command)
    assert rig.state().position == pytest.approx(rig.state().position)
    await rig.until(lambda: rig.state().position == pytest.approx(GOALS, abs=0.01), command)


# -- what a fault costs, cycle by cycle ------------------------------------------------------------------------------


class Scripted:
    """In the place of a Bus: five servos at rest, of which some transactions fail."""

    def __init__(self) -> None:
        self.fails: list[BusError] = []
        self.absent: set[int] = set()
        self.asked: list[int] = []

    def sync_read(self, address: int, length: int, servos: Sequence[int], fast: bool) -> list[Answer]:
        self.asked.extend(servos)
        if self.fails:
            raise self.fails.pop()
        if self.absent & set(servos):
            raise NoAnswer(None, "no answer")
        return [self.read_bytes(servo, address, length) for servo in servos]

    def read_bytes(self, servo: int, address: int, length: int) -> Answer:
        if servo in self.absent:
            raise NoAnswer(servo, "no answer")
        return Answer(struct.pack("<BBBbhii", 2, 0, 0, 0, 0, 0, 2048)[:length], False)


class Steps:
    """A driver whose thread is this test: one cycle a call, 4 ms each."""

    def __init__(self) -> None:
        self.now = 1_000_000_000
        self.bus = Scripted()
        self.driver = Dynamixel(DynamixelSettings("", health=5.0), clock=lambda: self.now)
        for servo in self.driver._servos:
            servo.heard_ns = self.now
        self.driver._watch._health_ns = self.now + 10**10
        self.cycle()

    def cycle(self) -> bool:
        """Whether it made a sample."""
        self.now += 4_000_000
        self.driver._turn(cast(Bus, self.bus), None)
        state = self.driver.latest()
        return state is not None and state.t_ns == self.now

    def told(self) -> list[str]:
        """What the driver has told since the last call."""
        return [notice.text for notice in self.driver.notices()]


@pytest.mark.parametrize("error", [NoAnswer(None, "x"), Corrupt(None, "x"), Corrupt(2, "x"), Refused(5, "x")])
async def test_one_failure_costs_one_sample(error: BusError) -> None:
    steps = Steps()
    steps.bus.fails.append(error)
    assert [steps.cycle() for _ in range(6)] == [False, True, True, True, True, True]
    assert not any(servo.suspect for servo in steps.driver._servos)
    assert (
        steps.driver.statistics().errors[{NoAnswer: "no answer", Corrupt: "corrupt"}.get(type(error), "refused")] == 1
    )
    assert all(steps.cycle() for _ in range(400))
    assert steps.told() == [
        "servo bus: a reading of the servos failed: x",
        "servo bus: every reading of the servos succeeds again; 1 failed",
    ]


async def test_a_servo_that_falls_silent_costs_one_sample_and_is_told_once() -> None:
    steps = Steps()
    steps.bus.absent = {3}
    assert [steps.cycle() for _ in range(60)] == [False] + [True] * 59
    state = steps.driver.latest()
    assert state is not None
    assert state.error == (0, 0, HardwareError.SILENT, 0, 0)
    assert steps.told() == ["servo bus: theta_3 (id 3) does not answer any more; the others go on"]
    # From then on it is not asked with the others.
    steps.bus.asked.clear()
    steps.cycle()
    assert steps.bus.asked == [1, 2, 4, 5]
    steps.bus.absent.clear()
    assert all(steps.cycle() for _ in range(400))
    assert steps.told() == ["servo bus: theta_3 (id 3) answers again"]
    state = steps.driver.latest()
    assert state is not None
    assert state.error == (0, 0, 0, 0, 0)


async def test_a_servo_that_comes_and_goes_is_told_once() -> None:
    steps = Steps()
    for _ in range(20):
        steps.bus.absent = {2}
        for _ in range(60):
            steps.cycle()
        steps.bus.absent.clear()
        for _ in range(100):
            steps.cycle()
    assert steps.told() == ["servo bus: theta_2 (id 2) does not answer any more; the others go on"]
    for _ in range(300):
        steps.cycle()
    assert steps.told() == ["servo bus: theta_2 (id 2) answers again"]


async def test_servos_that_come_back_are_told_together() -> None:
    steps = Steps()
    steps.bus.absent = {1, 2, 3, 4, 5}
    for _ in range(60):
        steps.cycle()
    steps.bus.absent.clear()
    for _ in range(400):
        steps.cycle()
    assert steps.told() == [
        "servo bus: no servo answers any more: is the 5 V supply on, and is the data cable plugged in?",
        "servo bus: theta_1 (id 1), theta_2 (id 2), theta_3 (id 3), pump (id 4), gripper (id 5) answer again",
    ]


async def test_two_silent_servos_are_waited_for_one_at_a_time() -> None:
    steps = Steps()
    steps.bus.absent = {1, 4}
    assert not steps.cycle()
    assert steps.cycle()  # each was asked by itself: these two are the ones
    before = sum(steps.driver.statistics().errors.values())
    assert all(steps.cycle() for _ in range(5))
    assert sum(steps.driver.statistics().errors.values()) - before == 5
    assert set(steps.driver.statistics().blamed) == {"theta_1 (id 1)", "pump (id 4)"}


# -- the bus itself -------------------------------------------------------------------------------------------------


@pytest.fixture
def emulator() -> DynamixelEmulator:
    made = emulate(MOUNTING)
    made.start()
    return made


async def test_refusals_have_words(emulator: DynamixelEmulator) -> None:
    bus = Bus(Port(emulator.path, 1_000_000, 0.05))
    with pytest.raises(Refused, match="value out of range") as caught:
        bus.write(3, xc330.TORQUE_ENABLE, 2)
    assert caught.value.servo == 3
    with pytest.raises(Refused, match="read only"):
        bus.write(3, xc330.PRESENT_POSITION, 2)
    with pytest.raises(NoAnswer):
        bus.read(99, xc330.TORQUE_ENABLE)
    emulator.inject(Kind.CORRUPT, value=1.0, count=1)
    with pytest.raises((Corrupt, NoAnswer)):
        bus.read(3, xc330.TORQUE_ENABLE)
    assert bus.read(3, xc330.MODEL_NUMBER) == xc330.MODEL
    assert bus.answering() == (3, 4, 7, 9, 12)
    bus.close()
    emulator.stop()


async def test_a_late_answer_is_not_taken_for_the_next_one(emulator: DynamixelEmulator) -> None:
    bus = Bus(Port(emulator.path, 1_000_000, 0.2))
    emulator.inject(Kind.DELAY, value=0.21, count=1)
    with pytest.raises(NoAnswer):
        bus.read(3, xc330.POSITION_P)
    # Two bytes as well, from the same servo.
    assert bus.read(3, xc330.POSITION_D) == 500
    bus.close()
    emulator.stop()


async def test_waiting_costs_no_processor_time() -> None:
    """A servo that is not there: dynamixel-sdk alone would spin for the whole time."""
    emulator = emulate(MOUNTING)  # not started: nobody answers
    bus = Bus(Port(emulator.path, 1_000_000, 0.3))
    began = thread_time()
    with pytest.raises(NoAnswer):
        bus.read(3, xc330.TORQUE_ENABLE)
    assert thread_time() - began < 0.05
    bus.close()
    emulator.stop()


async def test_the_bytes_of_a_cycle(emulator: DynamixelEmulator) -> None:
    """What ``wire_time`` reckons is what goes over the wire."""
    emulator.stop()
    master, slave = os.openpty()
    port = Port(os.ttyname(slave), 1_000_000, 0.001)
    bus = Bus(port)
    ids = (1, 2, 3, 4, 5)

    def sent() -> int:
        count = 0
        while select.select([master], [], [], 0.0)[0]:
            count += len(os.read(master, 4096))
        return count

    bus.sync_write(222, WRITTEN_BYTES, dict.fromkeys(ids, bytes(WRITTEN_BYTES)))
    write = sent()
    with pytest.raises(NoAnswer):
        bus.sync_read(208, READ_BYTES, ids, fast=True)
    ask = sent()
    bus.close()
    os.close(master)
    os.close(slave)
    assert (write, ask) == (49, 19)
    assert wire_time(1_000_000, 5, READ_BYTES, WRITTEN_BYTES) == pytest.approx((49 + 19 + 98) * 1e-5)
    plain = wire_time(1_000_000, 5, READ_BYTES, WRITTEN_BYTES, fast=False, return_delay=500e-6)
    assert plain == pytest.approx((49 + 19 + 5 * 25) * 1e-5 + 5 * 500e-6)


async def test_statistics(rig: Rig) -> None:
    await rig.engaged()
    await rig.fresh(20, command)
    told = rig.driver.statistics()
    assert told.cycle.count >= 20
    assert wire_time(1_000_000, 5, READ_BYTES, 0) <= told.cycle.p50 <= told.cycle.max
    assert sum(count for _, count in told.histogram) == told.cycle.count
    assert told.samples.received >= 20
    assert all(notice.level in tuple(Level) for notice in rig.told)
