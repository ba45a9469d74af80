"""The T265 driver over a software device: what it refuses, what it survives, what it tells once, what it records."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import yaml

from drivers.mailbox import Level
from drivers.protocols import DeviceError
from drivers.samples import Odometry
from drivers.t265 import T265, T265Settings, Variances
from drivers.vehicle import Vehicle
from sim_backend.faults import Kind
from sim_backend.t265_emulator import T265Emulator
from sim_backend.tracker import KINDS, PERIOD
from sim_backend.world import World

rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 cannot be imported here", exc_type=ImportError)

pytestmark = pytest.mark.asyncio

VEHICLE = msgspec.convert(
    yaml.safe_load((Path(__file__).parents[2] / "configs" / "vehicle.yaml").read_text(encoding="utf-8")), Vehicle
)
START = (0.0, 0.0, VEHICLE.base.gear_height)
SETTINGS = T265Settings(start=START, timeout=5.0, silence=0.2, retry=0.2)
MS = 1_000_000


class Bench:
    """An emulated camera on a vehicle that stands, and the driver, in the world's time: 5 ms a turn of the loop."""

    def __init__(self, settings: T265Settings = SETTINGS, wrap: Callable[[Any], Any] = lambda device: device) -> None:
        self.world = World(VEHICLE)
        self.emulator = T265Emulator(self.world)
        self.driver = T265(settings, lambda: wrap(self.emulator.find()), lambda: self.world.snapshot.t_ns)
        self.told: list[tuple[Level, str]] = []

    def tick(self) -> None:
        self.world.advance(PERIOD)
        self.emulator.step()
        self.told.extend((n.level, n.text) for n in self.driver.notices())

    async def until(self, condition: Callable[[], bool], within: float = 15.0) -> None:
        loop = asyncio.get_running_loop()
        end = loop.time() + within
        while not condition():
            assert loop.time() < end, f"the condition never held; told: {self.told}"
            self.tick()
            await asyncio.sleep(PERIOD)

    async def start(self) -> None:
        starting = asyncio.create_task(self.driver.start())
        await self.until(starting.done)
        await starting

    def inject(self, kind: Kind, duration: float | None = None, value: float = 0.0) -> None:
        self.emulator.faults.inject(self.world.time, kind, duration, value)

    def count(self, text: str) -> int:
        return sum(text in told for _, told in self.told)

    def sample(self) -> Odometry:
        sample = self.driver.latest()
        assert sample is not None
        return sample


async def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(DeviceError, match=r"pyrealsense2 cannot be imported .*pip install 'pipewright\[vision\]'"):
        await T265(SETTINGS).start()


async def test_without_a_camera() -> None:
    settings = msgspec.structs.replace(SETTINGS, serial="1234")
    with pytest.raises(DeviceError, match=r"no T265 1234 found \(seen: .*\); unplug it .*librealsense 2\.53\.1"):
        await T265(settings).start()


async def test_a_device_without_poses() -> None:
    with pytest.raises(DeviceError, match="has no pose stream; want a T265"):
        await T265(SETTINGS, rs.software_device).start()


async def test_no_pose_comes() -> None:
    bench = Bench(msgspec.structs.replace(SETTINGS, timeout=0.2))
    with pytest.raises(DeviceError, match=r"no usable pose within 0\.2 s \(0 unusable ones\); let it see light"):
        await bench.driver.start()
    assert bench.driver.latest() is None


async def test_only_unusable_poses_come() -> None:
    bench = Bench(msgspec.structs.replace(SETTINGS, timeout=0.3))
    bench.inject(Kind.NAN)
    with pytest.raises(DeviceError, match=r"no usable pose within 0\.3 s \([1-9]\d* unusable ones\)"):
        await bench.start()


async def test_a_camera_that_hangs_at_the_start() -> None:
    release = Event()
    bench = Bench(msgspec.structs.replace(SETTINGS, timeout=0.2), lambda device: release.wait() and device)
    try:
        with pytest.raises(DeviceError, match=r"opening it has hung for 0\.2 s; unplug it"):
            await bench.driver.start()
    finally:
        release.set()
    # what opens at last is closed again
    await bench.until(lambda: not bench.emulator.streaming)
    assert bench.driver.latest() is None


async def test_relocalisation_and_pose_jumping_are_switched_off() -> None:
    bench = Bench()
    sensor = bench.emulator.find().query_sensors()[0]
    options = (rs.option.enable_relocalization, rs.option.enable_pose_jumping)
    assert [sensor.get_option(option) for option in options] == [1.0, 1.0]
    await bench.start()
    assert [sensor.get_option(option) for option in options] == [0.0, 0.0]
    await bench.driver.stop()
    assert bench.told == []


class Stubborn:
    """A device whose sensor takes an option and shows that it did not."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._sensor = device.query_sensors()[0]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device if name == "is_playback" else self._sensor, name)

    def query_sensors(self) -> list[Any]:
        return [self]

    def get_option(self, option: Any) -> float:
        return 1.0 if option == rs.option.enable_pose_jumping else 0.0


async def test_an_option_that_is_not_taken_is_told() -> None:
    bench = Bench(wrap=Stubborn)
    await bench.start()
    await bench.driver.stop()
    assert bench.told == [
        (
            Level.WARNING,
            "tracker: pose jumping cannot be switched off: its poses may jump when it knows a place again",
        )
    ]


async def test_poses_come_at_200_hz_and_are_counted() -> None:
    bench = Bench()
    await bench.start()
    await bench.until(lambda: bench.driver.counts()["POSE"].received > 300)
    assert bench.driver.counts()["POSE"].rate == pytest.approx(200.0, rel=0.01)
    assert bench.driver.counts()["POSE"].rejected == 0
    await bench.driver.stop()
    assert bench.told == []


async def test_nan_is_rejected_and_told_once() -> None:
    bench = Bench()
    await bench.start()
    before = bench.driver.counts()["POSE"].rejected
    bench.inject(Kind.NAN, 0.1)
    await bench.until(lambda: bench.count("usable again") == 1)
    await bench.driver.stop()
    rejected = bench.driver.counts()["POSE"].rejected - before
    assert 15 <= rejected <= 25
    assert bench.told == [
        (Level.WARNING, "tracker: a pose is not used: it is not finite"),
        (Level.INFO, f"tracker: its poses are usable again; {rejected} were not"),
    ]
    assert bench.sample().reset_counter == 0


async def test_nan_that_stays_opens_the_camera_again() -> None:
    """As under vibration: the poses of a T265 stay NaN until it is started anew."""
    bench = Bench()
    await bench.start()
    bench.inject(Kind.NAN, 0.3)
    await bench.until(lambda: bench.count("it is back") == 1)
    assert bench.count("no usable pose for 0.2 s; opening it again") == 1
    await bench.driver.stop()


async def test_a_jump_is_a_reset_and_told() -> None:
    bench = Bench()
    await bench.start()
    bench.inject(Kind.JUMP, value=0.3)
    await bench.until(lambda: bench.sample().reset_counter == 1)
    assert bench.sample().p_WB == pytest.approx((0.3, 0.0, START[2]), abs=1e-3)
    await bench.until(lambda: bench.count("no more jumps; there were 1") == 1)
    assert bench.told[0] == (
        Level.WARNING, "tracker: its pose has jumped by 0.30 m and 0 deg; resets so far: 1"
    )  # fmt: skip
    assert bench.sample().reset_counter == 1
    await bench.driver.stop()


async def test_confidence_comes_through() -> None:
    bench = Bench()
    await bench.start()
    bench.inject(Kind.CONFIDENCE, value=1)
    await bench.until(lambda: bench.sample().confidence == 1)
    await bench.driver.stop()


async def test_silence_is_told_once_and_the_camera_opened_again() -> None:
    bench = Bench()
    await bench.start()
    bench.inject(Kind.DRIFT, 0.5, 0.4)
    await bench.until(lambda: bench.sample().p_WB[0] > 0.19)
    bench.inject(Kind.SILENT, 1.0)
    await bench.until(lambda: bench.count("no usable pose") == 1)
    place = bench.sample()
    await bench.until(lambda: bench.count("it is back") == 1)
    await bench.until(lambda: bench.sample().t_ns > place.t_ns + 1_000 * MS)
    # the camera's own frame began anew at zero; the body's goes on where it was
    assert bench.sample().p_WB == pytest.approx(place.p_WB, abs=1e-4)
    assert bench.sample().reset_counter == 1
    await bench.driver.stop()
    assert [level for level, _ in bench.told] == [Level.ERROR, Level.WARNING]


async def test_an_unplugged_camera_is_told_once_and_comes_back() -> None:
    bench = Bench()
    await bench.start()
    bench.inject(Kind.UNPLUGGED, 1.5)
    await bench.until(lambda: bench.count("it is back") == 1)
    await bench.driver.stop()
    assert [text for _, text in bench.told[:2]] == [
        "tracker: no usable pose for 0.2 s; opening it again",
        "tracker: cannot open it again: no T265 found (seen: nothing); unplug it and plug it in again",
    ]
    assert len(bench.told) == 3
    assert bench.sample().reset_counter == 1


LOST = "no usable pose for 0.2 s; opening it again"
BACK = "it is back after"
#: Each fault of the camera: for how long and how much, and what of it is told, each once.
FAULTS: dict[Kind, tuple[float, float, tuple[str, ...]]] = {
    Kind.DROP: (0.5, 0.5, ()),
    Kind.DELAY: (0.4, 0.05, ()),
    # A frozen pose is finite and fresh: the core knows it by its bits.
    Kind.FREEZE: (0.5, 0.0, ()),
    Kind.JUMP: (0.5, 0.3, ("its pose has jumped by 0.30 m", "no more jumps; there were 1")),
    # Nothing tells slow drift from motion.
    Kind.DRIFT: (0.5, 0.1, ()),
    Kind.NAN: (0.1, 0.0, ("a pose is not used: it is not finite", "its poses are usable again")),
    Kind.CONFIDENCE: (0.5, 1.0, ()),
    Kind.SILENT: (0.4, 0.0, (LOST, BACK)),
    Kind.UNPLUGGED: (1.5, 0.0, (LOST, "cannot open it again: no T265 found", BACK)),
    Kind.REBOOT: (1.5, 0.0, (LOST, "cannot open it again: no T265 found", BACK)),
}


async def test_every_fault_of_the_camera_is_here() -> None:
    assert set(FAULTS) == set(KINDS)


@pytest.mark.parametrize("kind", FAULTS)
async def test_each_fault_is_survived_told_once_and_recovered_from(kind: Kind) -> None:
    duration, value, expected = FAULTS[kind]
    bench = Bench()
    await bench.start()
    bench.inject(kind, duration, value)
    over = bench.world.snapshot.t_ns + round((duration + 0.5) * 1e9)
    await bench.until(lambda: all(bench.count(text) for text in expected))
    await bench.until(lambda: bench.sample().t_ns > over)
    await bench.driver.stop()
    assert [text for _, text in bench.told if not any(each in text for each in expected)] == []
    assert {text: bench.count(text) for text in expected} == dict.fromkeys(expected, 1)
    assert bench.sample().confidence == 3
    lost = kind in (Kind.JUMP, Kind.SILENT, Kind.UNPLUGGED, Kind.REBOOT)
    assert bench.sample().reset_counter == lost


class Hanging:
    """A device whose sensor does not come back from being stopped before it is let go."""

    def __init__(self, device: Any, release: Event) -> None:
        self._device = device
        self._sensor = device.query_sensors()[0]
        self._release = release

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device if name == "is_playback" else self._sensor, name)

    def query_sensors(self) -> list[Any]:
        return [self]

    def stop(self) -> None:
        self._release.wait()
        self._sensor.stop()


async def test_opening_again_that_hangs_is_told_once_and_waited_for() -> None:
    release = Event()
    settings = msgspec.structs.replace(SETTINGS, timeout=0.5)
    bench = Bench(settings, lambda device: Hanging(device, release))
    try:
        await bench.start()
        bench.inject(Kind.SILENT, 0.5)
        await bench.until(lambda: bench.count("opening it again has hung for 0.5 s; land, unplug it") == 1)
        old = bench.sample()
        t = bench.world.time
        await bench.until(lambda: bench.world.time > t + 1.0)
        assert bench.sample() == old  # its age tells
        assert len(bench.told) == 2
        release.set()
        await bench.until(lambda: bench.count("it is back") == 1)
    finally:
        release.set()
        await bench.driver.stop()


async def test_closing_that_hangs_is_left_behind_and_told() -> None:
    release = Event()
    bench = Bench(msgspec.structs.replace(SETTINGS, timeout=0.3), lambda device: Hanging(device, release))
    try:
        await bench.start()
        await bench.driver.stop()
        assert [n.text for n in bench.driver.notices()] == [
            "tracker: closing it hangs; before the next use, unplug it and plug it in again"
        ]
    finally:
        release.set()


async def test_nothing_comes_after_stop() -> None:
    bench = Bench()
    await bench.start()
    await bench.driver.stop()
    last = bench.sample()
    for _ in range(20):
        bench.tick()
    assert bench.sample() == last
    assert not bench.emulator.streaming


# -- time, on frames made by hand -------------------------------------------------------------------------------------


class Script:
    """A device whose frames a test makes by hand, with a clock that the test sets."""

    def __init__(self) -> None:
        self.now = 0
        self.give: Callable[[Any], None] = lambda frame: None
        self.driver = T265(T265Settings(start=START, latency=0.004), lambda: self, lambda: self.now)

    def query_sensors(self) -> list[Script]:
        return [self]

    def get_stream_profiles(self) -> list[Any]:
        return [SimpleNamespace(stream_type=lambda: rs.stream.pose)]

    def supports(self, option: Any) -> bool:
        return True

    def is_option_read_only(self, option: Any) -> bool:
        return True

    def get_option(self, option: Any) -> float:
        return 0.0

    def is_playback(self) -> bool:
        return False

    def open(self, profile: Any) -> None:
        pass

    def start(self, callback: Callable[[Any], None]) -> None:
        self.give = callback

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass

    def frame(self, device_ms: float, arrival_ms: float) -> None:
        self.now = round(arrival_ms * MS)
        zero = SimpleNamespace(x=0.0, y=0.0, z=0.0)
        pose = SimpleNamespace(
            translation=zero,
            velocity=zero,
            angular_velocity=zero,
            rotation=SimpleNamespace(w=1.0, x=0.0, y=0.0, z=0.0),
            tracker_confidence=3,
        )
        whole = SimpleNamespace(get_pose_data=lambda: pose)
        self.give(SimpleNamespace(as_pose_frame=lambda: whole, get_timestamp=lambda: device_ms))

    async def begin(self) -> None:
        starting = asyncio.create_task(self.driver.start())
        while self.driver.latest() is None:
            self.frame(9_000_000.0, 100.0)
            await asyncio.sleep(0.001)
        await starting

    def age(self) -> float:
        """Of the newest sample, ms."""
        sample = self.driver.latest()
        assert sample is not None
        return (self.now - sample.t_ns) / MS


async def test_times_are_of_the_process_and_carry_the_latency() -> None:
    """Frames that were 3 ms longer under way are 3 ms older; 4 ms are the least age."""
    script = Script()
    await script.begin()
    assert script.age() == pytest.approx(4.0)
    script.frame(9_000_005.0, 108.0)
    assert script.age() == pytest.approx(7.0)
    script.frame(9_000_010.0, 110.0)
    assert script.age() == pytest.approx(4.0)
    await script.driver.stop()


async def test_a_clock_that_was_set_is_told() -> None:
    script = Script()
    await script.begin()
    script.frame(1_000.0, 105.0)
    assert script.age() == pytest.approx(4.0)
    assert [n.text for n in script.driver.notices()] == [
        "tracker: its clock was set; the times of its poses are mapped anew"
    ]
    await script.driver.stop()


async def test_a_clock_that_drifts_is_told_once() -> None:
    script = Script()
    await script.begin()
    told: list[str] = []
    for k in range(1, 5000):  # 25 s, 800 ppm slow
        script.frame(9_000_000.0 + 5.0 * k * (1.0 - 8e-4), 100.0 + 5.0 * k)
        if k % 100 == 0:
            await asyncio.sleep(0.06)  # the watchdog looks
            told.extend(n.text for n in script.driver.notices())
    assert told == ["tracker: its clock is slow by 800 ppm"]
    assert script.age() < 10.0
    await script.driver.stop()


async def test_a_frame_that_cannot_be_read_is_rejected() -> None:
    script = Script()
    await script.begin()
    script.give(None)
    assert script.driver.counts()["POSE"].rejected == 1
    told = [n.text for n in script.driver.notices()]
    assert len(told) == 1
    assert "a pose is not used: AttributeError" in told[0]
    await script.driver.stop()


# -- trust ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("confidence", "factor", "quality"), [(3, 1.0, 100), (2, 10.0, 66), (1, 100.0, 33), (0, 1000.0, -1)]
)
async def test_less_confidence_is_ten_times_the_variance(confidence: int, factor: float, quality: int) -> None:
    settings = T265Settings(start=START, variances=Variances(position=1e-4, attitude=2e-4, velocity=3e-4))
    trust = T265(settings).trust(confidence)
    assert trust[:3] == pytest.approx((1e-4 * factor, 2e-4 * factor, 3e-4 * factor))
    assert trust.quality == quality


# -- recording and replaying ------------------------------------------------------------------------------------------


async def test_what_is_recorded_is_replayed(tmp_path: Path) -> None:
    """The same poses, at the same distances in time, and the end is told and no loss."""
    path = tmp_path / "poses.bag"
    bench = Bench(msgspec.structs.replace(SETTINGS, record=str(path)))
    recorded: dict[int, Odometry] = {}
    await bench.start()
    bench.inject(Kind.DRIFT, value=0.2)

    def enough() -> bool:
        sample = bench.sample()
        recorded[sample.t_ns] = sample
        return len(recorded) > 150

    await bench.until(enough)
    await bench.driver.stop()

    driver = T265(msgspec.structs.replace(SETTINGS, replay=str(path), start_heading_deg=90.0))
    replayed: list[Odometry] = []
    put = driver._poses.put

    def keep(value: Odometry, t_ns: int) -> None:
        replayed.append(value)
        put(value, t_ns)

    driver._poses.put = keep  # type: ignore[method-assign]
    await driver.start()
    for _ in range(1000):
        if driver.ended:
            break
        await asyncio.sleep(0.01)
    await asyncio.sleep(2.0 * SETTINGS.silence)  # long enough to take it for lost
    await driver.stop()
    assert len(recorded) <= len(replayed) <= len(recorded) + 10
    assert [n.text for n in driver.notices()] == ["tracker: the recording has ended"]
    # begun facing +y, what crept along +x creeps along +y
    first, last = replayed[0], replayed[-1]
    end = max(recorded.values(), key=lambda sample: sample.t_ns)
    assert last.p_WB[1] == pytest.approx(end.p_WB[0], abs=2e-3)
    assert last.p_WB[0] == pytest.approx(0.0, abs=1e-4)
    assert (last.t_ns - first.t_ns) * 1e-9 == pytest.approx((len(replayed) - 1) * PERIOD, rel=0.05)
    assert abs(2.0 * first.q_WB[3] * first.q_WB[0]) == pytest.approx(1.0, abs=1e-3)


async def test_each_stream_has_a_recording_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "poses.bag"
    bench = Bench(msgspec.structs.replace(SETTINGS, record=str(path)))
    await bench.start()
    bench.inject(Kind.SILENT, 0.3)
    await bench.until(lambda: bench.count("it is back") == 1)
    await bench.driver.stop()
    assert sorted(os.listdir(tmp_path)) == ["poses-2.bag", "poses.bag"]


async def test_a_recording_that_is_not_there(tmp_path: Path) -> None:
    settings = msgspec.structs.replace(SETTINGS, replay=str(tmp_path / "none.bag"))
    with pytest.raises(DeviceError, match=r"cannot replay .*none\.bag .*want a \.bag recorded by librealsense"):
        await T265(settings).start()


async def test_a_place_that_cannot_be_recorded_to(tmp_path: Path) -> None:
    bench = Bench(msgspec.structs.replace(SETTINGS, record=str(tmp_path / "no" / "poses.bag")))
    with pytest.raises(DeviceError, match=r"cannot open it \(.*poses\.bag"):
        await bench.driver.start()
