"""Which device is what: real, emulated or mock, one by one, and the settings of its driver."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from msgspec import Meta, Struct

from drivers.dynamixel_settings import DynamixelSettings
from drivers.px4 import Px4Settings
from drivers.t265 import T265Settings


def _note(meaning: str) -> Meta:
    return Meta(description=meaning, extra={"unit": "", "in_flight": False})


class Kind(StrEnum):
    """What stands behind a device."""

    REAL = "real"
    """The device."""
    EMULATED = "emulated"
    """The real driver, and behind it an emulator that speaks the device's bytes."""
    MOCK = "mock"
    """No driver: samples straight from a simulated world."""


What = Annotated[Kind, _note("what stands behind it")]


class AutopilotConfig(Px4Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The autopilot."""

    kind: What = Kind.MOCK


class OdometryConfig(T265Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The tracker."""

    kind: What = Kind.MOCK


class ServosConfig(DynamixelSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The servo bus."""

    kind: What = Kind.MOCK
    port: Annotated[str, _note("serial port: /dev/servos, /dev/ttyUSB0, ...; empty: that of the emulator")] = ""


class DeviceConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """The three devices, and the simulated world behind those that are not real."""

    autopilot: AutopilotConfig = AutopilotConfig()
    odometry: OdometryConfig = OdometryConfig()
    servos: ServosConfig = ServosConfig()
    hitl: Annotated[bool, _note("a real autopilot may arm although other devices are not real")] = False
    agreement: Annotated[
        float,
        Meta(
            ge=0.05,
            le=10.0,
            description="PX4's position estimate may be so far from the tracker's",
            extra={"unit": "m", "in_flight": False},
        ),
    ] = 0.3
    world: Annotated[str, _note("host:port of the process that holds the world; empty: none is needed")] = ""
    simulator: Annotated[
        str,
        _note("how the world reaches a real PX4 as its simulator: tcp://127.0.0.1:4560, serial:///dev/ttyACM0:921600"),
    ] = ""

    def kinds(self) -> dict[str, Kind]:
        """What stands behind each device, by name."""
        return {"autopilot": self.autopilot.kind, "odometry": self.odometry.kind, "servos": self.servos.kind}
