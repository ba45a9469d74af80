"""What every autopilot device owes, whatever is behind it: one suite, run on each face.

``mock`` runs in simulated time. ``px4`` is the real driver over MAVSDK and UDP to the stand-in, in real time; it waits
for conditions, never for a guessed time. ``real`` is a vehicle that stands, its propellers off
(``tests/contract/hardware.py``): it is listened to, and given nothing that turns a motor.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from math import hypot
from pathlib import Path
from threading import Thread

import msgspec
import pytest
import pytest_asyncio
import yaml

from drivers.protocols import AutopilotDevice, DeviceError
from drivers.px4 import Px4, Px4Settings
from drivers.samples import AutopilotCommand, AutopilotState, Engage, FlightMode, Interface, Landed, Quat, Vec3
from drivers.thrust import ThrustMap
from drivers.vehicle import Vehicle
from sim_backend.autopilot import SetPoint
from sim_backend.mock_devices import MockAutopilot
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.world import World
from tests.contract.hardware import REAL, named, stays_put
from tests.waiting import LONG, seconds_until

pytestmark = pytest.mark.asyncio
moves = pytest.mark.moves

VEHICLE = msgspec.convert(
    yaml.safe_load((Path(__file__).parents[2] / "configs" / "vehicle.yaml").read_text(encoding="utf-8")), Vehicle
)
WEIGHT = ThrustMap.of(VEHICLE).hover_force
TICK = 0.004
LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
STILL: Vec3 = (0.0, 0.0, 0.0)


def command(
    engage: Engage,
    thrust: float = 0.3 * WEIGHT,
    interface: Interface = Interface.BODY_RATE,
    w_WB_B: Vec3 = STILL,
    q_WB: Quat = LEVEL,
) -> AutopilotCommand:
    return AutopilotCommand(engage, interface, thrust, STILL, q_WB, w_WB_B)


class Rig:
    """One device on one world, with time that passes in ticks."""

    #: How far attitude (rad), rate (rad/s) and specific force (m/s^2) may be off.
    tilt, rate, force = 1e-3, 1e-3, 0.05

    def __init__(self, device: AutopilotDevice, world: World) -> None:
        self.device = device
        self.world = world
        self.commanded = 0

    async def tick(self) -> None:
        raise NotImplementedError

    def set_points(self) -> int:
        """Set-points that have reached the far end."""
        raise NotImplementedError

    async def run(
        self,
        until: Callable[[], bool],
        what: Callable[[], AutopilotCommand] | None = None,
        within: float = 20.0,
    ) -> None:
        """Command ``what`` in every tick (nothing: stay silent) until the condition holds."""
        for _ in range(round(within / TICK)):
            if until():
                return
            if what is not None:
                given = what()
                self.commanded += given.engage is Engage.OFFBOARD
                self.device.command(given)
            await self.tick()
        pytest.fail(f"not within {within} s; the state is {self.device.latest()}")

    async def ticks(self, count: int, engage: Engage) -> None:
        for _ in range(count):
            self.device.command(command(engage))
            await self.tick()

    def state(self) -> AutopilotState:
        state = self.device.latest()
        assert state is not None
        return state

    def height(self) -> float:
        return self.world.truth().p_WB[2]

    def climb(self) -> AutopilotCommand:
        """Climb at about 0.5 m/s, level."""
        return command(Engage.OFFBOARD, WEIGHT * (1.0 + 0.4 * (0.5 - self.world.truth().v_WB[2])))

    def hover(self) -> AutopilotCommand:
        return command(Engage.OFFBOARD, WEIGHT * (1.0 - 0.4 * self.world.truth().v_WB[2]))

    async def engage(self) -> None:
        await self.run(
            lambda: self.state().armed and self.state().mode is FlightMode.OFFBOARD,
            lambda: command(Engage.OFFBOARD),
        )

    async def take_off(self) -> None:
        await self.engage()
        await self.run(lambda: self.height() > 0.5, self.climb)
        await self.run(lambda: abs(self.world.truth().v_WB[2]) < 0.1, self.hover)


class MockRig(Rig):
    def __init__(self, world: World) -> None:
        super().__init__(MockAutopilot(world), world)
        self._offers = 0
        offer = world.autopilot.offer

        def counted(t: float, setpoint: SetPoint) -> None:
            self._offers += 1
            offer(t, setpoint)

        world.autopilot.offer = counted  # type: ignore[method-assign]

    async def tick(self) -> None:
        self.world.advance(TICK)

    def set_points(self) -> int:
        return self._offers


class Px4Rig(Rig):
    def __init__(self, world: World) -> None:
        self.stand_in = Px4StandIn(world)
        url = f"udpout://127.0.0.1:{self.stand_in.port}"
        super().__init__(Px4(Px4Settings(thrust=ThrustMap.of(VEHICLE), url=url, stream_time=0.6)), world)

    async def tick(self) -> None:
        await asyncio.sleep(TICK)

    def set_points(self) -> int:
        return self.stand_in.received["SET_ATTITUDE_TARGET"]


class RealRig(Rig):
    """On a world that stands as the vehicle does."""

    tilt, rate, force = 0.1, 0.1, 0.7

    def __init__(self, world: World, url: str) -> None:
        self.px4 = Px4(Px4Settings(thrust=ThrustMap.of(VEHICLE), url=url))
        super().__init__(self.px4, world)

    async def tick(self) -> None:
        await asyncio.sleep(TICK)

    def set_points(self) -> int:
        return self.px4.sent()


@pytest_asyncio.fixture(params=["mock", "px4", REAL])
async def rig(request: pytest.FixtureRequest) -> AsyncIterator[Rig]:
    world = World(VEHICLE)
    if request.param == "real":
        url = named("PIPEWRIGHT_AUTOPILOT", "a real vehicle, its propellers off")
        stays_put(request)
        vehicle = RealRig(world, url)
        await vehicle.device.start()
        yield vehicle
        await vehicle.device.stop()
        return
    if request.param == "mock":
        mock = MockRig(world)
        await mock.device.start()
        yield mock
        await mock.device.stop()
        return
    real = Px4Rig(world)
    real.stand_in.start()
    try:
        await real.device.start()
        yield real
        await real.device.stop()
    finally:
        real.stand_in.stop()


async def test_tells_a_level_vehicle_on_the_ground(rig: Rig) -> None:
    await rig.run(lambda: rig.device.latest() is not None)
    state = rig.state()
    w, x, y, z = state.q_WB
    assert hypot(w, x, y, z) == pytest.approx(1.0, abs=1e-3)
    assert 2.0 * hypot(w * x + y * z, w * y - x * z) < rig.tilt
    assert state.f_B == pytest.approx((0.0, 0.0, 9.80665), abs=rig.force)
    assert state.w_WB_B == pytest.approx(STILL, abs=rig.rate)
    assert (state.armed, state.landed) == (False, Landed.ON_GROUND)


async def test_faces_where_the_world_begins_and_is_charged(rig: Rig) -> None:
    if isinstance(rig, RealRig):
        pytest.skip("which way a real vehicle faces, and how full its battery is, is not known here")
    await rig.run(lambda: rig.device.latest() is not None)
    state = rig.state()
    assert state.q_WB == pytest.approx(LEVEL, abs=1e-3)
    assert state.battery_voltage == pytest.approx(VEHICLE.battery.full_voltage, abs=0.3)
    assert state.battery_remaining == pytest.approx(1.0, abs=0.02)


async def test_samples_go_on(rig: Rig) -> None:
    await rig.run(lambda: rig.device.latest() is not None)
    times: list[int] = []

    def fifty() -> bool:
        times.append(rig.state().t_ns)
        return len(set(times)) == 50

    await rig.run(fifty)
    assert times == sorted(times)


async def test_idle_does_not_arm(rig: Rig) -> None:
    await rig.ticks(250, Engage.IDLE)
    assert not rig.state().armed
    assert rig.set_points() == 0


async def test_landing_and_killing_what_stands_changes_nothing(rig: Rig) -> None:
    await rig.run(lambda: rig.device.latest() is not None)
    for engage in (Engage.LAND, Engage.IDLE, Engage.KILL, Engage.IDLE):
        await rig.ticks(50, engage)
        assert not rig.state().armed
        assert rig.state().landed is Landed.ON_GROUND
    assert rig.set_points() == 0


async def test_body_torques_are_refused_in_words(rig: Rig) -> None:
    """The mock alone takes them."""
    if isinstance(rig, MockRig):
        pytest.skip("the mock takes body torques")
    await rig.run(lambda: rig.device.latest() is not None)
    with pytest.raises(DeviceError, match="PX4 accepts no body torques; set the interface to attitude or body_rate"):
        rig.device.command(command(Engage.OFFBOARD, interface=Interface.WRENCH))
    assert not rig.state().armed


@moves
async def test_arms_and_takes_off_in_offboard(rig: Rig) -> None:
    await rig.take_off()
    await rig.run(lambda: rig.state().landed is Landed.IN_AIR, rig.hover)
    assert rig.state().armed
    assert rig.state().mode is FlightMode.OFFBOARD


@moves
async def test_follows_a_body_rate(rig: Rig) -> None:
    """A roll rate of 0.5 rad/s, for as long as it takes to reach 0.2 rad, is told with its sign."""
    await rig.take_off()
    rates: list[float] = []

    def rolled() -> bool:
        rates.append(rig.state().w_WB_B[0])
        return 2.0 * rig.state().q_WB[1] > 0.2

    await rig.run(rolled, lambda: command(Engage.OFFBOARD, WEIGHT, w_WB_B=(0.5, 0.0, 0.0)), within=5.0)
    assert max(rates) == pytest.approx(0.5, abs=0.1)


@moves
async def test_follows_an_attitude(rig: Rig) -> None:
    """Nose down by 0.1 rad (positive pitch) speeds the vehicle up along +x."""
    await rig.take_off()
    pitched: Quat = (0.99875, 0.0, 0.04998, 0.0)
    await rig.run(
        lambda: rig.state().q_WB[2] > 0.045 and rig.world.truth().v_WB[0] > 0.2,
        lambda: command(Engage.OFFBOARD, WEIGHT, Interface.ATTITUDE, q_WB=pitched),
        within=5.0,
    )


@moves
async def test_a_set_point_is_sent_once(rig: Rig) -> None:
    """So many commands, so many set-points, and none after the last: a hung process falls silent."""
    await rig.engage()
    await rig.run(lambda: rig.set_points() == rig.commanded, within=2.0)
    before, t = rig.set_points(), rig.world.time
    await rig.run(lambda: rig.world.time > t + 1.0)
    assert rig.set_points() == before == rig.commanded


@moves
async def test_silence_lands(rig: Rig) -> None:
    await rig.take_off()
    t = rig.world.time
    await rig.run(lambda: rig.state().mode is FlightMode.LAND, within=3.0)
    assert rig.world.time - t < 1.5
    await rig.run(lambda: not rig.state().armed and rig.state().landed is Landed.ON_GROUND)
    assert not rig.world.truth().crashed


@moves
async def test_lands_when_told(rig: Rig) -> None:
    await rig.take_off()
    await rig.run(
        lambda: not rig.state().armed and rig.state().landed is Landed.ON_GROUND, lambda: command(Engage.LAND)
    )
    assert not rig.world.truth().crashed


@moves
async def test_idle_disarms_on_the_ground_only(rig: Rig) -> None:
    await rig.take_off()
    await rig.ticks(75, Engage.IDLE)
    assert rig.state().armed
    await rig.run(lambda: not rig.state().armed, lambda: command(Engage.LAND))
    await rig.engage()
    await rig.run(lambda: not rig.state().armed, lambda: command(Engage.IDLE), within=5.0)


@moves
async def test_kill_cuts_the_motors_at_once(rig: Rig) -> None:
    await rig.take_off()
    t = rig.world.time
    await rig.run(lambda: not rig.world.autopilot.armed, lambda: command(Engage.KILL), within=2.0)
    assert rig.world.time - t < 0.3
    await rig.run(lambda: not rig.state().armed, lambda: command(Engage.KILL), within=2.0)
    await rig.run(lambda: sum(rig.world.truth().rotor_thrust) < 0.1, within=2.0)


def from_elsewhere(rig: Rig, engage: Engage | None) -> None:
    """Insist in a thread of its own, while the event loop stands still."""
    thread = Thread(target=rig.device.insist, args=(engage,))
    thread.start()
    thread.join(LONG)
    assert not thread.is_alive()


@moves
async def test_insisting_on_a_kill_needs_no_event_loop(rig: Rig) -> None:
    await rig.engage()
    from_elsewhere(rig, Engage.KILL)
    seconds_until(lambda: not rig.world.autopilot.armed)


@moves
async def test_what_is_insisted_on_outranks_what_is_commanded(rig: Rig) -> None:
    await rig.engage()
    from_elsewhere(rig, Engage.KILL)
    await rig.run(lambda: not rig.state().armed, lambda: command(Engage.OFFBOARD))
    await rig.run(lambda: rig.world.truth().on_ground)
    before = rig.set_points()
    await rig.ticks(300, Engage.OFFBOARD)
    assert not rig.state().armed
    assert rig.set_points() == before


@moves
async def test_flies_again_once_nobody_insists_any_more(rig: Rig) -> None:
    await rig.engage()
    rig.device.insist(Engage.KILL)
    await rig.run(lambda: not rig.state().armed, lambda: command(Engage.OFFBOARD))
    rig.device.insist(None)
    await rig.ticks(10, Engage.IDLE)
    await rig.take_off()


@moves
async def test_insisting_on_a_landing_lands_and_offboard_is_not_taken_back(rig: Rig) -> None:
    await rig.take_off()
    from_elsewhere(rig, Engage.LAND)
    await rig.run(lambda: rig.state().mode is FlightMode.LAND, rig.hover, within=2.0)
    before = rig.set_points()
    await rig.ticks(25, Engage.OFFBOARD)
    assert rig.set_points() == before
    rig.device.insist(None)
    await rig.run(lambda: not rig.state().armed and rig.state().landed is Landed.ON_GROUND, rig.hover)
    assert not rig.world.truth().crashed


@moves
async def test_a_commanded_kill_outranks_an_insisted_landing(rig: Rig) -> None:
    await rig.take_off()
    rig.device.insist(Engage.LAND)
    await rig.run(lambda: not rig.world.autopilot.armed, lambda: command(Engage.KILL), within=2.0)
    assert not rig.world.truth().on_ground
