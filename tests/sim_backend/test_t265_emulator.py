"""The emulated camera tells what a T265 on the vehicle would, and each of its faults shows in its frames."""

from __future__ import annotations

from collections.abc import Iterator
from math import cos, isnan, pi, sin
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from msgspec.structs import replace

from drivers.protocols import DeviceError
from drivers.samples import Vec3
from drivers.tracking import Mount
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend import t265_emulator
from sim_backend.faults import Fault, Kind
from sim_backend.sensors import OdometryParams, SensorParams
from sim_backend.t265_emulator import T265Emulator
from sim_backend.tracker import PERIOD
from sim_backend.world import World, WorldParams

rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 cannot be imported here", exc_type=ImportError)


def three(v: Any) -> Vec3:
    return (v.x, v.y, v.z)


class Watch:
    """Opens the stream as any librealsense client would, and keeps time and pose of each frame."""

    def __init__(self, world: World, emulator: T265Emulator) -> None:
        self.world = world
        self.emulator = emulator
        self.frames: list[tuple[float, Any]] = []
        self.sensor = emulator.find().query_sensors()[0]

    def open(self) -> None:
        self.sensor.open(self.sensor.get_stream_profiles()[0])
        self.sensor.start(lambda f: self.frames.append((f.get_timestamp(), f.as_pose_frame().get_pose_data())))

    def close(self) -> None:
        self.sensor.stop()
        self.sensor.close()

    def run(self, duration: float) -> list[Any]:
        """Poses that came meanwhile."""
        before = len(self.frames)
        for _ in range(round(duration / PERIOD)):
            self.world.advance(PERIOD)
            self.emulator.step()
        return [pose for _, pose in self.frames[before:]]

    def place(self, p_WB: Vec3, v_WB: Vec3 = (0.0, 0.0, 0.0), yaw: float = 0.0, w_WB_B: Vec3 = (0.0, 0.0, 0.0)) -> Any:
        """Put the vehicle there by hand; the pose that comes of it."""
        x = list(self.world.snapshot.x)
        x[at.POSITION : at.POSITION + 3] = p_WB
        x[at.VELOCITY : at.VELOCITY + 3] = v_WB
        x[at.ATTITUDE : at.ATTITUDE + 4] = (cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw))
        x[at.RATE : at.RATE + 3] = w_WB_B
        self.world.snapshot = self.world.snapshot._replace(t_ns=self.world.snapshot.t_ns + 5_000_000, x=x)
        self.emulator.step()
        return self.frames[-1][1]


@pytest.fixture
def watch(vehicle: Vehicle) -> Iterator[Watch]:
    world = World(vehicle)
    watch = Watch(world, T265Emulator(world))
    watch.open()
    yield watch
    watch.close()


def inject(watch: Watch, kind: Kind, duration: float | None = None, value: float = 0.0) -> None:
    watch.emulator.faults.inject(watch.world.time + PERIOD, kind, duration, value)


def test_it_looks_like_a_t265(watch: Watch) -> None:
    device = watch.emulator.find()
    assert "T265" in device.get_info(rs.camera_info.name)
    profile = watch.sensor.get_stream_profiles()[0]
    assert (profile.stream_type(), profile.format(), profile.fps()) == (rs.stream.pose, rs.format.six_dof, 200)


def test_the_stream_begins_where_the_camera_is(watch: Watch) -> None:
    pose = watch.place((3.0, 4.0, 1.0), yaw=1.0)
    assert three(pose.translation) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert (pose.rotation.w, pose.rotation.x, pose.rotation.y, pose.rotation.z) == pytest.approx((1.0, 0.0, 0.0, 0.0))
    assert pose.tracker_confidence == 3


def test_forward_is_minus_z_left_minus_x_up_y(watch: Watch) -> None:
    watch.place((0.0, 0.0, 1.0))
    pose = watch.place((0.1, 0.2, 1.3), v_WB=(1.0, 2.0, 3.0))
    assert three(pose.translation) == pytest.approx((-0.2, 0.3, -0.1), abs=1e-6)
    assert three(pose.velocity) == pytest.approx((-2.0, 3.0, -1.0), abs=1e-6)


def test_a_turn_to_the_left_is_one_about_y(watch: Watch) -> None:
    watch.place((0.0, 0.0, 1.0))
    pose = watch.place((0.0, 0.0, 1.0), yaw=0.5 * pi, w_WB_B=(0.0, 0.0, 2.0))
    assert (pose.rotation.w, pose.rotation.y) == pytest.approx((cos(0.25 * pi), sin(0.25 * pi)))
    assert three(pose.angular_velocity) == pytest.approx((0.0, 2.0, 0.0), abs=1e-6)


def test_a_camera_ahead_is_swung_by_a_turn(vehicle: Vehicle) -> None:
    """0.1 m ahead and turned by a quarter at 2 rad/s: 0.1 m back and left, moving back, in the first heading."""
    world = World(vehicle)
    watch = Watch(world, T265Emulator(world, Mount(offset=(0.1, 0.0, 0.0))))
    watch.open()
    watch.place((0.0, 0.0, 1.0))
    pose = watch.place((0.0, 0.0, 1.0), yaw=0.5 * pi, w_WB_B=(0.0, 0.0, 2.0))
    assert three(pose.translation) == pytest.approx((-0.1, 0.0, 0.1), abs=1e-6)
    assert three(pose.velocity) == pytest.approx((0.0, 0.0, 0.2), abs=1e-6)
    watch.close()


def test_times_are_the_measurements(watch: Watch) -> None:
    watch.run(0.1)
    times = [t for t, _ in watch.frames]
    assert len(times) == 20
    assert times == pytest.approx([watch.world.time * 1e3 - 5.0 * k for k in reversed(range(20))])


def test_times_go_through_the_clock_of_who_moves_the_world(vehicle: Vehicle) -> None:
    world = World(vehicle)
    watch = Watch(world, T265Emulator(world, clock=lambda t_ns: t_ns + 7_000_000_000))
    watch.open()
    watch.run(0.01)
    assert [t for t, _ in watch.frames] == pytest.approx([7005.0, 7010.0])
    watch.close()


def test_nothing_is_sent_twice(watch: Watch) -> None:
    watch.run(0.05)
    watch.emulator.step()
    watch.emulator.step()
    assert len(watch.frames) == 10


def test_the_worlds_noise_and_delay_are_the_cameras(vehicle: Vehicle) -> None:
    noisy = SensorParams(odometry=OdometryParams(period=0.005, delay=0.02, position_noise=0.01))
    world = World(vehicle, WorldParams(sensors=noisy))
    watch = Watch(world, T265Emulator(world))
    watch.open()
    poses = watch.run(1.0)
    assert 150 < len(poses) <= 200
    assert watch.frames[-1][0] == pytest.approx(world.time * 1e3 - 20.0, abs=5.1)
    assert 0.02 < max(abs(pose.translation.x) for pose in poses) < 0.1
    watch.close()


def test_a_measurement_from_before_the_stream_is_its_first(vehicle: Vehicle) -> None:
    world = World(vehicle)
    watch = Watch(world, T265Emulator(world))
    watch.emulator.step()
    watch.open()
    watch.emulator.step()
    watch.emulator.step()
    assert len(watch.frames) == 1
    watch.close()


def test_opened_again_it_begins_anew(watch: Watch) -> None:
    inject(watch, Kind.JUMP, value=2.0)
    assert watch.run(0.1)[-1].translation.z == pytest.approx(-2.0, abs=1e-3)
    watch.close()
    watch.run(0.1)
    watch.open()
    assert watch.run(0.1)[-1].translation.z == pytest.approx(0.0, abs=1e-3)


# -- faults -----------------------------------------------------------------------------------------------------------


def test_nan(watch: Watch) -> None:
    inject(watch, Kind.NAN, 0.05)
    assert [isnan(pose.translation.x) for pose in watch.run(0.1)] == [True] * 10 + [False] * 10


def test_silent(watch: Watch) -> None:
    inject(watch, Kind.SILENT, 0.05)
    assert len(watch.run(0.05)) == 0
    assert len(watch.run(0.05)) == 10


def test_drop(watch: Watch) -> None:
    inject(watch, Kind.DROP, value=0.3)
    assert 120 < len(watch.run(1.0)) < 160


def test_delay(watch: Watch) -> None:
    watch.run(0.05)
    inject(watch, Kind.DELAY, value=0.05)
    assert len(watch.run(0.05)) == 0
    assert len(watch.run(0.05)) == 10
    assert watch.world.time * 1e3 - watch.frames[-1][0] == pytest.approx(50.0)


def test_freeze_repeats_the_pose_with_fresh_times(watch: Watch) -> None:
    inject(watch, Kind.DRIFT, value=1.0)
    watch.run(0.05)
    inject(watch, Kind.FREEZE, 0.05)
    frozen = {three(pose.translation) for pose in watch.run(0.05)}
    assert len(frozen) == 1
    assert len({t for t, _ in watch.frames[-10:]}) == 10
    assert len({three(pose.translation) for pose in watch.run(0.05)} - frozen) == 10


def test_jump_stays(watch: Watch) -> None:
    inject(watch, Kind.JUMP, 0.05, 0.4)
    assert [pose.translation.z for pose in watch.run(0.2)] == pytest.approx([-0.4] * 40, abs=1e-3)


def test_drift_gathers_and_stays(watch: Watch) -> None:
    watch.run(0.05)
    inject(watch, Kind.DRIFT, 1.0, 0.1)
    watch.run(1.0)
    assert watch.run(0.5)[-1].translation.z == pytest.approx(-0.1, abs=2e-3)


def test_confidence(watch: Watch) -> None:
    inject(watch, Kind.CONFIDENCE, 0.05, 1.0)
    assert [pose.tracker_confidence for pose in watch.run(0.1)] == [1] * 10 + [3] * 10


@pytest.mark.parametrize("kind", [Kind.UNPLUGGED, Kind.REBOOT])
def test_gone_and_dead_until_opened_again(watch: Watch, kind: Kind) -> None:
    inject(watch, kind, 0.05)
    assert len(watch.run(0.05)) == 0
    with pytest.raises(DeviceError, match="no T265 found"):
        watch.emulator.find()
    assert len(watch.run(0.1)) == 0
    watch.emulator.find()
    watch.close()
    watch.run(0.05)
    watch.open()
    assert len(watch.run(0.05)) == 10


def test_declared_with_a_phase(vehicle: Vehicle) -> None:
    world = World(vehicle)
    fault = Fault("odometry", Kind.SILENT, 0.1, 0.1, phase="press")
    watch = Watch(world, T265Emulator(world, faults=[fault, replace(fault, device="servos")]))
    watch.open()
    assert len(watch.run(0.5)) == 100
    watch.emulator.faults.enter("press", world.time)
    assert len(watch.run(0.3)) == 40
    watch.close()


# -- on its own -------------------------------------------------------------------------------------------------------


def test_it_paces_itself(vehicle: Vehicle) -> None:
    """Its thread sends what the world, moved by another, measures."""
    world = World(vehicle)
    emulator = T265Emulator(world)
    watch = Watch(world, emulator)
    watch.open()
    emulator.start()
    pause = Event()
    for _ in range(5000):
        if len(watch.frames) >= 50:
            break
        world.advance(0.004)
        pause.wait(0.002)
    emulator.stop()
    emulator.stop()
    watch.close()
    assert len(watch.frames) >= 50


def test_alone_it_records_a_circle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "circle.bag"
    arguments = ["--record", str(path), "--duration", "1.5", "--rotation", "0", "45", "0"]
    assert t265_emulator.main([*arguments, "--fault", "{device: odometry, kind: jump, start: 1, value: 0.2}"]) == 0
    told = capsys.readouterr().out
    assert "its pose has jumped by 0.20 m" in told
    assert f"recorded to {path}" in told
    playback = rs.context().load_device(str(path)).as_playback()
    assert 1.0 < playback.get_duration().total_seconds() < 3.0


def test_alone_it_tells_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert t265_emulator.main(["--fault", "{device: odometry, kind: hiccup}"]) == 1
    assert "fault 1: Invalid enum value 'hiccup'" in capsys.readouterr().err
    assert t265_emulator.main(["--faults", str(tmp_path / "none.yaml")]) == 1
    assert "want a YAML list of faults" in capsys.readouterr().err
