"""What the camera of a world tells, and the software camera that it is told to, apart from each other."""

from __future__ import annotations

from itertools import pairwise
from math import isnan

import msgspec
import pytest

from drivers.protocols import DeviceError
from drivers.tracking import CameraPose
from drivers.vehicle import Vehicle
from sim_backend.faults import Kind
from sim_backend.software_camera import SoftwareCamera
from sim_backend.tracker import Tracker
from sim_backend.world import World


def told(world: World, tracker: Tracker, step: float, duration: float) -> list[CameraPose]:
    poses: list[CameraPose] = []
    for _ in range(round(duration / step)):
        world.advance(step)
        poses.extend(tracker.step(True))
    return poses


@pytest.mark.parametrize("step", [0.001, 0.002, 0.004, 0.005])
def test_200_a_second_however_the_world_is_advanced(vehicle: Vehicle, step: float) -> None:
    world = World(vehicle)
    poses = told(world, Tracker(world), step, 1.0)
    assert len(poses) == pytest.approx(200, abs=1)
    times = [pose.t_ns for pose in poses]
    gaps = {later - earlier for earlier, later in pairwise(times)}
    assert max(gaps) < 10_000_000


def test_a_pose_can_be_carried_between_processes(vehicle: Vehicle) -> None:
    world = World(vehicle)
    tracker = Tracker(world)
    tracker.faults.inject(0.05, Kind.NAN)
    poses = told(world, tracker, 0.005, 0.1)
    carried = msgspec.msgpack.decode(msgspec.msgpack.encode(poses), type=list[CameraPose])
    assert carried[:5] == poses[:5]
    assert isnan(carried[-1].p_VC[0])


def test_it_is_gone_as_long_as_it_is_unplugged(vehicle: Vehicle) -> None:
    world = World(vehicle)
    tracker = Tracker(world)
    tracker.faults.inject(0.05, Kind.UNPLUGGED, 0.05)
    seen = []
    for _ in range(3):
        seen.append(tracker.gone)
        world.advance(0.05)
    assert seen == [False, True, False]


def test_a_camera_that_is_gone_cannot_be_found() -> None:
    pytest.importorskip("pyrealsense2", reason="pyrealsense2 cannot be imported here", exc_type=ImportError)
    camera = SoftwareCamera()
    camera.gone = True
    with pytest.raises(DeviceError, match="no T265 found"):
        camera.find()
    camera.gone = False
    assert camera.find().query_sensors()


def test_what_nobody_listens_to_is_sent_all_the_same(vehicle: Vehicle) -> None:
    pytest.importorskip("pyrealsense2", reason="pyrealsense2 cannot be imported here", exc_type=ImportError)
    world, camera = World(vehicle), SoftwareCamera()
    for pose in told(world, Tracker(world), 0.005, 0.02):
        camera.tell(pose)
    assert camera.sent == 4
    assert not camera.streaming
