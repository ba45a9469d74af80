"""What the processes of this bench are given, and what they have noted. Times: the monotonic clock, ns."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

Kind = Literal["kill", "stop"]


class Frames(Struct):
    """What came to the autopilot's socket, by the kernel's stamps, and to the servos' port."""

    kills: list[int] = []
    """COMMAND_LONG that disarms by force."""
    lands: list[int] = []
    """COMMAND_LONG that sets the land mode."""
    marks: dict[int, int] = {}
    """Time of the first set-point after so many stops, which the vehicle marks with their number."""
    limp: list[int] = []
    """Sync writes that switch all torque off."""


class Order(Struct, frozen=True):
    """One order, as the vehicle heard it."""

    id: str
    t_ns: int


class Vehicle(Struct):
    """All that a vehicle has noted."""

    orders: list[Order]
    marks: dict[str, int]
    """Which mark the set-points bear after a stop, by id of the order."""
    puts: dict[int, int]
    """When the raw message of this number came."""
    frames: Frames


class VehicleOptions(Struct, frozen=True):
    """Where the vehicle listens, and how it does."""

    listen: str
    keys: str = ""
    """Folder of the vehicle's keys; empty: plain."""
    stuck: bool = False
    """The thread of the loop spins in Python, as long as anything is asked."""


class Trial(Struct, frozen=True):
    """One order, as the station gave it."""

    kind: Kind
    id: str
    """Empty: there was no answer."""
    asked_ns: int
    answered_ns: int


class StationOptions(Struct, frozen=True):
    """What the stations ask, and how."""

    connect: str
    trials: int
    """Of each kind, all stations together."""
    stations: int = 1
    rest: tuple[float, float] = (0.08, 0.12)
    """Between two orders of a station, s: from, to."""
    keys: str = ""
    """Folder with a folder of keys for each station; empty: plain."""


class Stations(Struct):
    """All that the stations have noted."""

    trials: list[Trial]
    puts: dict[int, int]
    """When the raw message of this number was put."""
    gets: list[int | None]
    """How long raw queries took, ns; None: no reply."""
