"""What every tracker owes, whatever is behind it: one suite, run on each face.

``mock`` answers in process. ``t265`` is the real driver over an emulated camera that sits askew on the vehicle, on a
software device of librealsense. Both run in simulated time, on a vehicle that flies a circle. ``real`` is a camera that
stands still (``tests/contract/hardware.py``), or a recording of one, in real time.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from time import monotonic_ns

import msgspec
import pytest
import pytest_asyncio
import yaml

from drivers.protocols import OdometryDevice
from drivers.samples import Odometry
from drivers.t265 import T265, T265Settings
from drivers.tracking import Mount
from drivers.vehicle import Vehicle
from sim_backend.mock_devices import MockAutopilot, MockOdometry
from sim_backend.t265_emulator import T265Emulator, circle
from sim_backend.tracker import PERIOD
from sim_backend.world import World
from tests.contract.hardware import REAL, named, stays_put

pytestmark = pytest.mark.asyncio

VEHICLE = msgspec.convert(
    yaml.safe_load((Path(__file__).parents[2] / "configs" / "vehicle.yaml").read_text(encoding="utf-8")), Vehicle
)
MOUNT = Mount(offset=(0.12, -0.03, 0.05), rotation_deg=(10.0, 40.0, -25.0))


class Rig:
    """One device on one world."""

    #: How far it may be off: m, rad, m/s.
    close = 1e-5
    #: How old a sample may be, s.
    age = 0.01

    def __init__(self, world: World) -> None:
        self.world = world
        self.device: OdometryDevice = MockOdometry(world)

    def now(self) -> int:
        return self.world.snapshot.t_ns

    async def tick(self) -> None:
        self.world.advance(PERIOD)

    async def start(self) -> None:
        starting = asyncio.create_task(self.device.start())
        while not starting.done():
            await self.tick()
            await asyncio.sleep(0.0)
        await starting

    def sample(self) -> Odometry:
        sample = self.device.latest()
        assert sample is not None
        return sample

    async def fly(self, duration: float, each: Callable[[], None] = lambda: None) -> None:
        autopilot = MockAutopilot(self.world)
        for _ in range(round(duration / PERIOD)):
            autopilot.command(circle(self.world))
            await self.tick()
            each()


class T265Rig(Rig):
    def __init__(self, world: World) -> None:
        super().__init__(world)
        self.emulator = T265Emulator(world, MOUNT)
        settings = T265Settings(start=world.truth().p_WB, mount=MOUNT)
        self.device = T265(settings, self.emulator.find, lambda: world.snapshot.t_ns)

    async def tick(self) -> None:
        await super().tick()
        self.emulator.step()


class RealRig(Rig):
    """On a world that stands as still as the camera does."""

    close, age = 0.05, 0.25

    def __init__(self, world: World, which: str) -> None:
        super().__init__(world)
        start = world.truth().p_WB
        recording = which if which.endswith(".bag") else ""
        serial = "" if recording or which == "1" else which
        self.device = T265(T265Settings(start=start, serial=serial, replay=recording))

    def now(self) -> int:
        return monotonic_ns()

    async def tick(self) -> None:
        await asyncio.sleep(PERIOD)


@pytest_asyncio.fixture(params=["mock", "t265", REAL])
async def rig(request: pytest.FixtureRequest) -> AsyncIterator[Rig]:
    world = World(VEHICLE)
    if request.param == "real":
        which = named("PIPEWRIGHT_T265", "a real T265 that stands still")
        stays_put(request)
        rig: Rig = RealRig(world, which)
    elif request.param == "t265":
        pytest.importorskip("pyrealsense2", reason="pyrealsense2 cannot be imported here", exc_type=ImportError)
        rig = T265Rig(world)
    else:
        rig = Rig(world)
    await rig.start()
    yield rig
    await rig.device.stop()


async def test_tells_where_the_vehicle_stands(rig: Rig) -> None:
    await rig.tick()
    sample, truth = rig.sample(), rig.world.truth()
    assert sample.p_WB == pytest.approx(truth.p_WB, abs=rig.close)
    assert sample.q_WB == pytest.approx(truth.q_WB, abs=rig.close)
    assert sample.v_WB == pytest.approx((0.0, 0.0, 0.0), abs=rig.close)
    assert sample.confidence > 0
    assert sample.reset_counter == 0


@pytest.mark.moves
async def test_follows_a_flight(rig: Rig) -> None:
    """Up and round a circle, pitching, rolling, turning: pose and velocity of the body origin at every sample."""
    farthest = [0.0, 0.0]

    def compare() -> None:
        sample, truth = rig.sample(), rig.world.truth()
        assert sample.p_WB == pytest.approx(truth.p_WB, abs=1e-5)
        assert sample.v_WB == pytest.approx(truth.v_WB, abs=1e-5)
        assert abs(sum(a * b for a, b in zip(sample.q_WB, truth.q_WB, strict=True))) == pytest.approx(1.0, abs=1e-9)
        assert sample.reset_counter == 0
        farthest[:] = max(farthest[0], abs(sample.p_WB[1])), max(farthest[1], sample.p_WB[2])

    # where on the circle the flight ends depends on how long the camera took to start
    await rig.fly(12.0, compare)
    assert farthest[0] > 0.8
    assert farthest[1] > 0.9


async def test_samples_are_fresh_and_in_order(rig: Rig) -> None:
    times: list[int] = []
    began = rig.now()
    while rig.now() - began < 1_000_000_000:
        await rig.tick()
        times.append(rig.sample().t_ns)
        assert 0 <= rig.now() - times[-1] < rig.age * 1e9
    assert times == sorted(times)
    assert 0.9 * len(times) <= len(set(times)) <= 200


async def test_reading_takes_nothing_away(rig: Rig) -> None:
    assert rig.sample() == rig.sample()


async def test_stop_twice_and_start_again(rig: Rig) -> None:
    await rig.device.stop()
    await rig.device.stop()
    await rig.start()
    before = rig.sample()
    for _ in range(20):
        await rig.tick()
    assert rig.sample().t_ns > before.t_ns


async def test_stop_before_start() -> None:
    world = World(VEHICLE)
    await MockOdometry(world).stop()
    await T265(T265Settings(start=world.truth().p_WB)).stop()
