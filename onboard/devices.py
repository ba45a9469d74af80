"""The devices of a run: the only file that names concrete ones."""

from __future__ import annotations

from math import radians

from drivers.protocols import AutopilotDevice, OdometryDevice, ServoDevice
from onboard.config import Config
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
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
