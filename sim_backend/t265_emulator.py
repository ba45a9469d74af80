"""A T265 that is not there: a software device of librealsense, fed with what the tracker of a world measures.

``T265Emulator.find`` gives the device to the real driver. One ``step`` sends the newest measurement as the camera would
tell it: through the mounting, in the camera's axes, from where it was when the stream was opened. ``start`` paces steps
on the wall clock in a thread of its own; a test may call ``step`` instead. Noise, drift and delay are those of the
world's sensors; what goes wrong beyond them is declared in ``Faults``.

Alone, it flies a circle and records it: ``python -m sim_backend.t265_emulator --record circle.bag --duration 10``
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections import deque
from collections.abc import Sequence
from math import atan2, cos, hypot, nan, pi, radians, sin
from pathlib import Path
from random import Random
from threading import Event, Thread
from typing import Any

import msgspec
import yaml

from drivers.frames import tracker_from, tracker_from_attitude
from drivers.protocols import DeviceError
from drivers.rotation import about_z, from_euler, heading, multiply, rotate
from drivers.samples import AutopilotCommand, Engage, Interface, Odometry, Quat, Vec3
from drivers.t265 import T265, T265Settings, library
from drivers.tracking import CameraPose, Mount
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.faults import Fault, Faults, Kind, read_fault_file, read_faults
from sim_backend.mock_devices import Clock, MockAutopilot
from sim_backend.world import World

DEVICE = "odometry"
KINDS = (
    Kind.DROP, Kind.DELAY, Kind.FREEZE, Kind.JUMP, Kind.DRIFT, Kind.NAN, Kind.CONFIDENCE, Kind.SILENT, Kind.UNPLUGGED,
    Kind.REBOOT,
)  # fmt: skip
PERIOD = 0.005
_LATE_STEPS = 20  # so many periods behind, the pace starts anew instead of catching up
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


class T265Emulator:
    """The emulated camera on a vehicle of ``world``. Raises DeviceError where pyrealsense2 is absent.

    The camera's clock is the world's, passed through ``clock`` as with the mock devices: where the world is moved in
    real time by a thread that may fall behind, it must not look as if the camera's clock did.
    JUMP and DRIFT (m, m/s) lead along the camera's view at the start of its stream. After UNPLUGGED and REBOOT nothing
    comes until the stream is opened again.
    """

    def __init__(
        self,
        world: World,
        mount: Mount | None = None,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        clock: Clock | None = None,
    ) -> None:
        self.world = world
        self._clock = clock
        self.faults = Faults(DEVICE, KINDS, faults)
        #: Frames that were sent so far.
        self.sent = 0
        #: Periods that were given up because the machine could not keep pace.
        self.slipped = 0
        self._mount = mount or Mount()
        self._q_BC = self._mount.q_BC()
        self._random = Random(seed)
        self._rs = library()
        self._device, self._sensor, self._profile = _software_device(self._rs)
        self._open = False
        self._dead = False
        self._seen: Odometry | None = None
        self._frozen: CameraPose | None = None
        self._waiting: deque[tuple[int, CameraPose]] = deque()
        self._origin: tuple[Vec3, Quat] | None = None
        self._moved = 0.0
        self._jumped: set[Fault] = set()
        self._stopping = Event()
        self._thread: Thread | None = None

    def find(self) -> Any:
        """The device, for the driver to open; raises DeviceError while it is unplugged or boots."""
        if self._gone(self.world.time):
            raise DeviceError("tracker: no T265 found (seen: nothing); unplug it and plug it in again")
        return self._device

    @property
    def streaming(self) -> bool:
        """Somebody has opened the stream of poses."""
        return bool(self._sensor.get_active_streams())

    def start(self) -> None:
        """Step on the wall clock, in a thread of its own."""
        self._stopping.clear()
        self._thread = Thread(target=self._run, name="t265 emulator", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread. Safe to call twice."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stopping.is_set():
            self.step()
            due += PERIOD
            rest = due - time.monotonic()
            if rest > 0.0:
                time.sleep(rest)
            elif -rest > _LATE_STEPS * PERIOD:
                self.slipped += int(-rest / PERIOD)
                due = time.monotonic()

    def step(self) -> None:
        """Send the newest measurement, unless it was sent before or a fault keeps it."""
        now = self.world.snapshot
        t = now.t_ns * 1e-9
        self._look_at_stream(t)
        sample = self.world.sensors.odometry(now)
        if sample is not None and (self._seen is None or sample.t_ns != self._seen.t_ns):
            self._creep(sample, t)
            self._seen = sample
            delay = self.faults.find(Kind.DELAY, t)
            later = round(delay.value * 1e9) if delay else 0
            self._waiting.append(
                (now.t_ns + later, self._pose(sample, (now.x[at.RATE], now.x[at.RATE + 1], now.x[at.RATE + 2])))
            )
        while self._waiting and self._waiting[0][0] <= now.t_ns:
            self._tell(self._waiting.popleft()[1], t)

    # -- what the camera would tell -------------------------------------------------------------------------------

    def _gone(self, t: float) -> bool:
        return self.faults.find(Kind.UNPLUGGED, t) is not None or self.faults.find(Kind.REBOOT, t) is not None

    def _look_at_stream(self, t: float) -> None:
        """A stream that was opened begins a new V; one whose camera went away is dead until it is opened again."""
        is_open = self.streaming
        if is_open and not self._open:
            self._origin, self._moved, self._dead, self._seen = None, 0.0, False, None
            self._waiting.clear()
        self._open = is_open
        self._dead = self._dead or self._gone(t)

    def _creep(self, sample: Odometry, t: float) -> None:
        for fault in self.faults.active(t):
            if fault.kind is Kind.JUMP and fault not in self._jumped:
                self._jumped.add(fault)
                self._moved += fault.value
            elif fault.kind is Kind.DRIFT and self._seen is not None:
                self._moved += fault.value * (sample.t_ns - self._seen.t_ns) * 1e-9

    def _pose(self, sample: Odometry, w_WB_B: Vec3) -> CameraPose:
        """The camera's pose and velocity in V, of the body's in W."""
        q_WB = sample.q_WB
        arm, w = rotate(q_WB, self._mount.offset), rotate(q_WB, w_WB_B)
        p_WC = (sample.p_WB[0] + arm[0], sample.p_WB[1] + arm[1], sample.p_WB[2] + arm[2])
        v_WC = (
            sample.v_WB[0] + w[1] * arm[2] - w[2] * arm[1],
            sample.v_WB[1] + w[2] * arm[0] - w[0] * arm[2],
            sample.v_WB[2] + w[0] * arm[1] - w[1] * arm[0],
        )
        if self._origin is None:
            self._origin = (p_WC, about_z(-heading(q_WB) - radians(self._mount.rotation_deg[2])))
        o, q_VW = self._origin
        p = rotate(q_VW, (p_WC[0] - o[0], p_WC[1] - o[1], p_WC[2] - o[2]))
        return CameraPose(
            t_ns=sample.t_ns,
            p_VC=(p[0] + self._moved, p[1], p[2]),
            q_VC=multiply(q_VW, multiply(q_WB, self._q_BC)),
            v_VC=rotate(q_VW, v_WC),
            w_VC=rotate(q_VW, w),
            confidence=sample.confidence,
        )

    def _tell(self, pose: CameraPose, t: float) -> None:
        faults = self.faults
        if self._dead or faults.find(Kind.SILENT, t):
            return
        drop = faults.find(Kind.DROP, t)
        if drop is not None and self._random.random() < drop.value:
            return
        if faults.find(Kind.FREEZE, t):
            self._frozen = self._frozen or pose
            pose = msgspec.structs.replace(self._frozen, t_ns=pose.t_ns)
        else:
            self._frozen = None
        if faults.find(Kind.NAN, t):
            pose = msgspec.structs.replace(pose, p_VC=(nan, nan, nan))
        confidence = faults.find(Kind.CONFIDENCE, t)
        if confidence is not None:
            pose = msgspec.structs.replace(pose, confidence=round(confidence.value))
        self._send(pose)

    def _send(self, pose: CameraPose) -> None:
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


# -- alone, from the command line ---------------------------------------------------------------------------------


def circle(world: World) -> AutopilotCommand:
    """Take off, then a circle of 0.5 m in 8 s at 1 m height, nose along the way."""
    truth, vehicle = world.truth(), world.vehicle
    mass = vehicle.base.mass + vehicle.arm.sleeve.mass + sum(part.mass for part in vehicle.arm.parts)
    angle = 2.0 * pi * max(0.0, world.time - 4.0) / 8.0
    goal = (0.5 * sin(angle), 0.5 - 0.5 * cos(angle), min(1.0, max(0.0, 0.5 * (world.time - 1.5))))
    force = [mass * (2.0 * (g - p) - 2.0 * v) for g, p, v in zip(goal, truth.p_WB, truth.v_WB, strict=True)]
    force[2] += mass * vehicle.gravity
    level = rotate(about_z(-angle), (force[0], force[1], force[2]))
    thrust = hypot(*force)
    q_WB = multiply(about_z(angle), from_euler(-atan2(level[1], thrust), atan2(level[0], level[2]), 0.0))
    return AutopilotCommand(Engage.OFFBOARD, Interface.ATTITUDE, thrust, (0.0, 0.0, 0.0), q_WB, (0.0, 0.0, 0.0))


async def _fly(world: World, emulator: T265Emulator, driver: T265, duration: float) -> None:
    loop = asyncio.get_running_loop()
    autopilot = MockAutopilot(world)
    starting = loop.create_task(driver.start())
    due = loop.time()
    while world.time < duration:
        autopilot.command(circle(world))
        world.advance(PERIOD)
        emulator.step()
        for notice in driver.notices():
            sys.stdout.write(f"{world.time:7.3f} s  {notice.text}\n")
        due += PERIOD
        await asyncio.sleep(max(0.0, due - loop.time()))
    await starting
    await driver.stop()


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly a circle before the emulated camera, with faults on demand, through the real driver, and record it."""
    parser = argparse.ArgumentParser(prog="t265_emulator", description=main.__doc__)
    here = Path(__file__).resolve().parent.parent / "configs" / "vehicle.yaml"
    parser.add_argument("--vehicle", type=Path, default=here, help="vehicle file")
    parser.add_argument("--record", default="", help="file (.bag) to record to")
    parser.add_argument("--duration", type=float, default=10.0, help="seconds")
    parser.add_argument("--offset", type=float, nargs=3, default=(0.0, 0.0, 0.0), help="of the camera in B, m")
    parser.add_argument("--rotation", type=float, nargs=3, default=(0.0, 0.0, 0.0), help="roll, pitch, yaw, deg")
    parser.add_argument(
        "--fault", action="append", default=[], help="as YAML: '{device: odometry, kind: nan, start: 3}'"
    )
    parser.add_argument("--faults", type=Path, help="YAML file with a list of faults")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    try:
        faults = [fault for text in given.fault for fault in read_faults(text, f"--fault {text}")]
        faults += read_fault_file(given.faults) if given.faults else ()
        vehicle = msgspec.convert(yaml.safe_load(given.vehicle.read_text(encoding="utf-8")), Vehicle)
        mount = Mount(tuple(given.offset), tuple(given.rotation))
        world = World(vehicle, seed=given.seed)
        emulator = T265Emulator(world, mount, faults, given.seed)
        settings = T265Settings(start=(0.0, 0.0, vehicle.base.gear_height), mount=mount, record=given.record)
        driver = T265(settings, emulator.find)
        asyncio.run(_fly(world, emulator, driver, given.duration))
    except (DeviceError, ValueError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    poses, newest = driver.counts()["POSE"], driver.latest()
    sys.stdout.write(f"{poses.received} poses at {poses.rate:.0f} Hz; the last: {newest}\n")
    if given.record:
        sys.stdout.write(f"recorded to {given.record}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
