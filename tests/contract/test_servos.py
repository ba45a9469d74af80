"""What every servo device owes, whatever is behind it: one suite, run on each face.

``mock`` runs in simulated time. ``dynamixel`` is the real driver over dynamixel-sdk and a pseudo-terminal to the
emulated bus of the same world, in real time; it waits for conditions, never for a guessed time. ``real`` is the bus of
an arm (``tests/contract/hardware.py``), which moves by up to half a turn where it may.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from threading import Thread

import msgspec
import pytest
import pytest_asyncio
import yaml

from drivers.dynamixel import Dynamixel
from drivers.dynamixel_calibrate import FiveServos
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.protocols import ServoDevice
from drivers.samples import Five, JointMode, ServoCommand, ServoState, Vec3
from drivers.vehicle import Vehicle
from sim_backend.dynamixel_emulator import emulate
from sim_backend.mock_devices import MockServos
from sim_backend.world import World
from tests.contract.hardware import REAL, may_move, named, stays_put

pytestmark = pytest.mark.asyncio
moves = pytest.mark.moves

VEHICLE = msgspec.convert(
    yaml.safe_load((Path(__file__).parents[2] / "configs" / "vehicle.yaml").read_text(encoding="utf-8")), Vehicle
)
TICK = 0.004
STILL: Vec3 = (0.0, 0.0, 0.0)
#: As the arm might be put together: zeros anywhere, two servos the other way round.
MOUNTING = (
    ServoSettings(id=1, zero=3300, center=-1.15),
    ServoSettings(id=2, zero=2600, sign=-1),
    ServoSettings(id=3, zero=3000, center=-1.0),
    ServoSettings(id=4, zero=100),
    ServoSettings(id=5, zero=2000, sign=-1),
)


class Rig:
    """One device on one world; every tick advances the world."""

    #: How far angles may be off, rad, and the voltage, V.
    close, volts = 0.03, 0.1

    def __init__(self, device: ServoDevice, world: World | None) -> None:
        self.device = device
        self.world = world
        self.ticks = 0

    async def tick(self) -> None:
        self.ticks += 1
        if self.world is not None:
            self.world.advance(TICK)

    async def until(
        self, condition: Callable[[], bool], what: Callable[[], ServoCommand] | None = None, within: float = 20.0
    ) -> None:
        """Command ``what`` in every tick (nothing: stay silent) until the condition holds."""
        for _ in range(round(within / TICK)):
            if condition():
                return
            if what is not None:
                self.device.command(what())
            await self.tick()
        pytest.fail(f"not within {within} s; the state is {self.device.latest()}, the truth {self.true()}")

    def state(self) -> ServoState:
        state = self.device.latest()
        assert state is not None
        return state

    def true(self) -> Five:
        """Where the servos are; of a real arm only they themselves know."""
        if self.world is None:
            return self.state().position
        truth = self.world.truth()
        return (*truth.joints, truth.pump, truth.gripper)

    def hold(self, *moves: float) -> Callable[[], ServoCommand]:
        """Position goals, from where all stand now."""
        a, b, c, d, e = (angle + move for angle, move in zip(self.true(), moves or (0.0,) * 5, strict=True))
        command = ServoCommand(JointMode.POSITION, STILL, (a, b, c, d, e), 1.5)
        return lambda: command


class RealTimeRig(Rig):
    async def tick(self) -> None:
        await super().tick()
        await asyncio.sleep(TICK)


class RealRig(RealTimeRig):
    close, volts = 0.1, 0.7


@asynccontextmanager
async def running(device: ServoDevice) -> AsyncIterator[None]:
    await device.start()
    try:
        yield
    finally:
        await device.stop()
        await device.stop()


@pytest_asyncio.fixture(params=["mock", "dynamixel", REAL])
async def rig(request: pytest.FixtureRequest) -> AsyncIterator[Rig]:
    if request.param == "real":
        port, _, baud = named("PIPEWRIGHT_SERVO_PORT", "a real servo bus").partition("@")
        if not may_move():
            stays_put(request, "; set PIPEWRIGHT_MAY_MOVE=1 to allow it")
        # Half of what they can, in a test.
        gentle = [ServoSettings(id=each.id, current_limit=0.8) for each in DynamixelSettings("").servos]
        given = DynamixelSettings(port, msgspec.convert(gentle, FiveServos), int(baud or 1_000_000))  # type: ignore[arg-type]
        real = Dynamixel(given)
        async with running(real):
            yield RealRig(real, None)
        return
    world = World(VEHICLE)
    if request.param == "mock":
        mock = MockServos(world)
        async with running(mock):
            yield Rig(mock, world)
        return
    emulator = emulate(MOUNTING, world=world)
    emulator.start()
    # Patient, for machines that are busy with other things.
    settings = DynamixelSettings(
        emulator.path, MOUNTING, reply_margin=0.02, silent_after=0.3, watchdog=0.5, patience=0.3
    )
    device = Dynamixel(settings)
    try:
        async with running(device):
            yield RealTimeRig(device, world)
    finally:
        await asyncio.to_thread(emulator.stop)


async def test_tells_five_servos_at_rest(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    state = rig.state()
    assert state.position == pytest.approx(rig.true(), abs=2e-3)
    assert state.velocity == pytest.approx((0.0,) * 5, abs=0.03)
    assert state.voltage == pytest.approx((5.0,) * 5, abs=rig.volts)
    assert all(15.0 < degrees < 60.0 for degrees in state.temperature)
    assert state.error == (0, 0, 0, 0, 0)


async def test_samples_go_on(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    times: list[int] = []

    def fifty() -> bool:
        times.append(rig.state().t_ns)
        return len(set(times)) == 50

    await rig.until(fifty)
    assert times == sorted(times)


@moves
async def test_joints_and_tools_follow_position_goals(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    start = rig.true()
    go = rig.hold(0.1, 0.1, -0.2, 0.8, 0.5)
    goals = go().position
    await rig.until(lambda: rig.state().position == pytest.approx(goals, abs=rig.close), go)
    assert rig.true() == pytest.approx(goals, abs=rig.close)
    assert rig.state().torque_on
    assert goals != pytest.approx(start, abs=0.05)


@moves
async def test_a_moving_joint_shows_its_velocity_with_its_sign(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    for move in (0.4, -0.4):
        go = rig.hold(0.0, 0.0, 0.0, move, -move)
        seen: list[tuple[float, float]] = []

        def there(go: Callable[[], ServoCommand] = go, seen: list[tuple[float, float]] = seen) -> bool:
            seen.append(rig.state().velocity[3:])
            return rig.state().position == pytest.approx(go().position, abs=rig.close)

        await rig.until(there, go)
        assert max(move * pump for pump, _ in seen) > 0.1
        assert max(-move * gripper for _, gripper in seen) > 0.1


@moves
async def test_torque_turns_the_tool_both_ways_and_shows_as_current(rig: Rig) -> None:
    """The joint of the tool, the others held by what their weight needs of them being little: torque wins."""
    await rig.until(lambda: rig.device.latest() is not None)
    for sign in (1.0, -1.0):
        await turns_the_tool(rig, sign)


async def turns_the_tool(rig: Rig, sign: float) -> None:
    before = rig.true()[2]
    command = ServoCommand(JointMode.TORQUE, (0.0, 0.0, 0.3 * sign), rig.true(), 1.5)
    await rig.until(lambda: sign * (rig.true()[2] - before) > 0.05, lambda: command)
    await rig.until(lambda: sign * rig.state().current[2] > 0.1, lambda: command)


@moves
async def test_pump_and_gripper_keep_their_places_while_the_joints_give_torque(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    a, b, c, d, e = rig.true()
    command = ServoCommand(JointMode.TORQUE, STILL, (a, b, c, d + 0.5, e + 0.3), 1.5)
    await rig.until(
        lambda: rig.state().position[3:] == pytest.approx((d + 0.5, e + 0.3), abs=rig.close), lambda: command
    )


@moves
async def test_off_takes_the_torque_and_position_gives_it_back(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    await rig.until(lambda: rig.state().torque_on, rig.hold())
    off = ServoCommand(JointMode.OFF, STILL, rig.true(), 1.5)
    await rig.until(lambda: not rig.state().torque_on, lambda: off)
    await rig.until(lambda: rig.state().current[:3] == pytest.approx(STILL, abs=0.05), lambda: off)
    await rig.until(lambda: rig.state().torque_on, rig.hold())


@moves
async def test_the_current_limit_holds_the_joints_back(rig: Rig) -> None:
    """With 50 mA an arm with weight cannot be lifted."""
    await rig.until(lambda: rig.device.latest() is not None)
    await rig.until(lambda: rig.state().torque_on, rig.hold())
    a, b, c, d, e = rig.true()
    weak = ServoCommand(JointMode.POSITION, STILL, (a + 0.6, b, c, d, e), 0.05)
    began = rig.ticks
    await rig.until(lambda: rig.ticks > began + 25, lambda: weak)
    currents: list[float] = []

    def half_a_second() -> bool:
        currents.append(abs(rig.state().current[0]))
        return rig.ticks > began + 150

    await rig.until(half_a_second, lambda: weak)
    assert max(currents) < 0.05 + 2e-3
    if rig.world is not None:
        assert rig.true()[0] < a + 0.5


@moves
async def test_what_is_not_finite_changes_nothing(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    await rig.until(lambda: rig.state().torque_on, rig.hold())
    before = rig.true()
    broken = ServoCommand(JointMode.POSITION, STILL, (float("nan"), 0.0, 0.0, 0.0, 0.0), 1.5)
    for _ in range(20):
        rig.device.command(broken)
        await rig.tick()
    assert rig.true() == pytest.approx(before, abs=rig.close)


@moves
async def test_insisting_takes_the_torque_whatever_is_commanded(rig: Rig) -> None:
    await rig.until(lambda: rig.device.latest() is not None)
    await rig.until(lambda: rig.state().torque_on, rig.hold())
    thread = Thread(target=rig.device.insist, args=(True,))
    thread.start()
    thread.join()
    await rig.until(lambda: not rig.state().torque_on, rig.hold())
    go, began = rig.hold(0.1, 0.1, -0.2, 0.8, 0.5), rig.ticks
    while rig.ticks < began + 100:
        rig.device.command(go())
        await rig.tick()
        assert not rig.state().torque_on
    rig.device.insist(False)
    await rig.until(lambda: rig.state().torque_on, rig.hold())


@moves
async def test_insisting_needs_no_command(rig: Rig) -> None:
    """As when the loop hangs."""
    await rig.until(lambda: rig.device.latest() is not None)
    await rig.until(lambda: rig.state().torque_on, rig.hold())
    rig.device.insist(True)
    await rig.until(lambda: not rig.state().torque_on)
    rig.device.insist(False)
