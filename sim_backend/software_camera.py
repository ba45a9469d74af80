"""A T265 that is not there: a software device of librealsense that tells the poses which it is given.

``SoftwareCamera.find`` gives the device to the real driver, in whose process it has to live.
"""

from __future__ import annotations

from typing import Any

from drivers.frames import tracker_from, tracker_from_attitude
from drivers.protocols import DeviceError
from drivers.samples import Vec3
from drivers.t265 import library
from drivers.threads import named
from drivers.tracking import CameraPose
from sim_backend.mock_devices import Clock
from sim_backend.tracker import PERIOD

#: What a T265 tells about itself; a recording cannot be read without most of it.
_INFO = {
    "name": "Intel RealSense T265",
    "serial_number": "000000000000",
    "firmware_version": "0.2.0.951",
    "firmware_update_id": "000000000000",
    "physical_port": "emulated",
    "product_id": "0B37",
    "product_line": "T200",
}


class SoftwareCamera:
    """The device. Raises DeviceError where pyrealsense2 is absent.

    The camera's clock is that of the poses, passed through ``clock`` as with the mock devices: where the world is moved
    in real time by a thread that may fall behind, it must not look as if the camera's clock did.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock
        #: It is unplugged, or boots: it cannot be found.
        self.gone = False
        #: Frames that were sent so far.
        self.sent = 0
        self._rs = library()
        with named("realsense"):
            self._device, self._sensor, self._profile = _software_device(self._rs)

    def find(self) -> Any:
        """The device, for the driver to open; raises DeviceError while it is gone."""
        if self.gone:
            raise DeviceError("tracker: no T265 found (seen: nothing); unplug it and plug it in again")
        return self._device

    @property
    def streaming(self) -> bool:
        """Somebody has opened the stream of poses."""
        return bool(self._sensor.get_active_streams())

    def tell(self, pose: CameraPose) -> None:
        """Send one pose, in the camera's axes; whoever has opened the stream is called back in this thread."""
        rs = self._rs
        data = rs.pose()
        data.translation = _vector(rs, tracker_from(pose.p_VC))
        data.velocity = _vector(rs, tracker_from(pose.v_VC))
        data.angular_velocity = _vector(rs, tracker_from(pose.w_VC))
        q = rs.quaternion()
        q.w, q.x, q.y, q.z = tracker_from_attitude(pose.q_VC)
        data.rotation = q
        data.tracker_confidence = data.mapper_confidence = pose.confidence
        # A frame that is sent twice is freed twice, and one whose data was never set is no frame.
        frame = rs.software_pose_frame()
        frame.data = data
        frame.profile = self._profile
        frame.domain = rs.timestamp_domain.hardware_clock
        frame.timestamp = (pose.t_ns if self._clock is None else self._clock(pose.t_ns)) * 1e-6
        frame.frame_number = self.sent
        self._sensor.on_pose_frame(frame)
        self.sent += 1


def _vector(rs: Any, v: Vec3) -> Any:
    vector = rs.vector()
    vector.x, vector.y, vector.z = v
    return vector


def _software_device(rs: Any) -> tuple[Any, Any, Any]:
    """A device, its sensor and the profile of its poses, as a T265's, with the options that it has switched on."""
    device = rs.software_device()
    for name, value in _INFO.items():
        device.register_info(getattr(rs.camera_info, name), value)
    sensor = device.add_sensor("Tracking Module")
    stream = rs.pose_stream()
    stream.type, stream.fmt, stream.fps = rs.stream.pose, rs.format.six_dof, round(1.0 / PERIOD)
    stream.index, stream.uid = 0, 1
    profile = sensor.add_pose_stream(stream, True).as_pose_stream_profile()
    span = rs.option_range()
    span.min, span.max, span.default, span.step = 0.0, 1.0, 1.0, 1.0
    for option in (rs.option.enable_relocalization, rs.option.enable_pose_jumping):
        sensor.add_option(option, span, True)
    return device, sensor, profile
