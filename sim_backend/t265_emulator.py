"""A T265 on a vehicle of a simulated world, for the real driver: the world's tracker before a software camera.

``T265Emulator.find`` gives the device to the driver. One ``step`` sends the newest measurement; ``start`` paces steps
on the wall clock in a thread of its own; a test may call ``step`` instead.

Alone, it flies a circle and records it: ``python -m sim_backend.t265_emulator --record circle.bag --duration 10``
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Sequence
from math import atan2, cos, hypot, pi, sin
from pathlib import Path
from threading import Event, Thread
from typing import Any

import msgspec
import yaml

from drivers.protocols import DeviceError
from drivers.rotation import about_z, from_euler, multiply, rotate
from drivers.samples import AutopilotCommand, Engage, Interface
from drivers.t265 import T265, T265Settings
from drivers.tracking import Mount
from drivers.vehicle import Vehicle
from sim_backend.faults import Fault, add_fault_options, given_faults
from sim_backend.mock_devices import Clock, MockAutopilot
from sim_backend.software_camera import SoftwareCamera
from sim_backend.tracker import PERIOD, Tracker
from sim_backend.world import World

_LATE_STEPS = 20  # so many periods behind, the pace starts anew instead of catching up


class T265Emulator:
    """Tracker and software camera in one process. Raises DeviceError where pyrealsense2 is absent."""

    def __init__(
        self,
        world: World,
        mount: Mount | None = None,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        clock: Clock | None = None,
    ) -> None:
        self.world = world
        self.tracker = Tracker(world, mount, faults, seed)
        self.camera = SoftwareCamera(clock)
        self.faults = self.tracker.faults
        #: Periods that were given up because the machine could not keep pace.
        self.slipped = 0
        self._stopping = Event()
        self._thread: Thread | None = None

    @property
    def sent(self) -> int:
        """Frames that were sent so far."""
        return self.camera.sent

    @property
    def streaming(self) -> bool:
        """Somebody has opened the stream of poses."""
        return self.camera.streaming

    def find(self) -> Any:
        """The device, for the driver to open; raises DeviceError while it is unplugged or boots."""
        self.camera.gone = self.tracker.gone
        return self.camera.find()

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
        for pose in self.tracker.step(self.camera.streaming):
            self.camera.tell(pose)


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
    add_fault_options(parser)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    try:
        vehicle = msgspec.convert(yaml.safe_load(given.vehicle.read_text(encoding="utf-8")), Vehicle)
        mount = Mount(tuple(given.offset), tuple(given.rotation))
        world = World(vehicle, seed=given.seed)
        emulator = T265Emulator(world, mount, given_faults(given), given.seed)
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
