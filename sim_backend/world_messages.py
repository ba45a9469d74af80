"""What passes between the process that holds a simulated world and one that flies in it: one struct a datagram.

UDP on loopback, MessagePack. Here pass only things that have no wire of their own: what is true, for the log; what the
camera would see, since a software device of librealsense lives in the process of its driver; samples and commands of
mock devices; and the mission's phase, so that faults which are declared for a phase begin.
"""

from __future__ import annotations

import msgspec
from msgspec import Struct

from drivers.samples import (
    AutopilotCommand,
    AutopilotState,
    Engage,
    FlightMode,
    Odometry,
    ServoCommand,
    ServoState,
)
from drivers.tracking import CameraPose
from sim_backend.plant import Truth

Address = tuple[str, int]

#: A client says hello no less often than this, s.
HELLO = 0.1
#: Largest datagram, bytes.
LARGEST = 65_507


class Look(Struct, frozen=True, tag=True, gc=False):
    """The world at one instant."""

    t_ns: int
    """On the machine's monotonic clock."""
    truth: Truth
    armed: bool
    mode: FlightMode
    torque_on: bool
    received: dict[str, int]
    """Messages that the emulated autopilot has taken so far, by name."""
    slipped: float
    """Seconds that the world could not keep pace with the wall clock."""
    phase: str = ""
    """Of the mission, as the process that flies has told it last; empty: nobody flies yet."""
    autopilot: AutopilotState | None = None
    odometry: Odometry | None = None
    servos: ServoState | None = None
    """Samples of the mock devices that were asked for."""


class Camera(Struct, frozen=True, tag=True, gc=False):
    """What the camera tells, and whether it is there at all."""

    gone: bool
    poses: tuple[CameraPose, ...]


class Hello(Struct, frozen=True, tag=True, gc=False):
    """Who listens, and what the world must know of it."""

    streaming: bool = False
    """The camera's stream is open."""
    phase: str = ""
    """Of the mission; empty: nobody flies."""
    mocks: tuple[str, ...] = ()
    """Devices whose samples are wanted: autopilot, odometry, servos."""
    insisted: Engage | None = None
    """What the mock autopilot is to do whatever is commanded."""
    off: bool = False
    """The mock servos have no torque whatever is commanded."""


class Bye(Struct, frozen=True, tag=True, gc=False):
    """The last word of a client."""


class Command(Struct, frozen=True, tag=True, gc=False):
    """For the mock devices."""

    autopilot: AutopilotCommand | None = None
    servos: ServoCommand | None = None


#: What the two below raise for a datagram that is none of these.
FOREIGN = (ValueError, RecursionError)

encode = msgspec.msgpack.Encoder().encode
from_world = msgspec.msgpack.Decoder(Look | Camera).decode
to_world = msgspec.msgpack.Decoder(Hello | Command | Bye).decode
