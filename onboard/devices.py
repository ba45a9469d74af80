"""The devices of a run: the only file that names concrete ones."""

from __future__ import annotations

from math import radians

from drivers.mailbox import Notice
from drivers.protocols import AutopilotDevice, OdometryDevice, ServoDevice
from drivers.px4 import Px4, Px4Settings
from drivers.thrust import ThrustMap
from onboard.config import Config
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.world import World


class DeviceSet:
    """The three devices of one vehicle."""

    def __init__(self, autopilot: AutopilotDevice, odometry: OdometryDevice, servos: ServoDevice) -> None:
        self.autopilot = autopilot
        self.odometry = odometry
        self.servos = servos


def world_of(config: Config) -> World:
    """The simulated world of a configuration."""
    pipe = config.pipe
    heading = radians(pipe.heading_deg)
    return World(config.vehicle, config.world, pipe.position, heading, pipe.radius, pipe.length, config.seed)


def mock_devices(world: World) -> DeviceSet:
    """All devices in process, on the world's own time."""
    return DeviceSet(MockAutopilot(world), MockOdometry(world), MockServos(world))


class DeskDevices(DeviceSet):
    """The real PX4 driver over UDP on loopback to a stand-in that moves the world on the wall clock; the rest mock."""

    def __init__(self, config: Config) -> None:
        self.world = world_of(config)
        self._stand_in = Px4StandIn(self.world)
        url = f"udpout://127.0.0.1:{self._stand_in.port}"
        self._px4 = Px4(Px4Settings(url=url), thrust=ThrustMap.of(config.vehicle))
        clock = self._stand_in.clock
        super().__init__(self._px4, MockOdometry(self.world, clock), MockServos(self.world, clock))

    async def start(self) -> None:
        """Start the world and connect. Raises DeviceError."""
        self._stand_in.start()
        await self._px4.start()

    async def stop(self) -> None:
        """Disconnect, then stop the world."""
        await self._px4.stop()
        self._stand_in.stop()

    def notices(self) -> tuple[Notice, ...]:
        """What the driver has had to tell since the last call."""
        return self._px4.notices()

    @property
    def slipped(self) -> float:
        """Seconds that the world could not keep pace with the wall clock."""
        return self._stand_in.slipped
