"""What a log holds beside ticks, and on which topics.

Topics: ``/tick`` (``Tick``), ``/truth`` (``Truth``, simulated worlds only), ``/event`` (``Event``), ``/keyframe``
(the core's state before a tick), ``/params`` (a parameter revision), ``/timing`` and ``/devices`` (wall-clock runs
only) and ``/nonfinite`` (what JSON cannot say). Log times are on the clock of the ticks' ``t_ns``.
"""

from __future__ import annotations

from typing import Generic, TypeVar

from msgspec import Struct

TICK = "/tick"
TRUTH = "/truth"
EVENT = "/event"
KEYFRAME = "/keyframe"
PARAMS = "/params"
TIMING = "/timing"
DEVICES = "/devices"
NONFINITE = "/nonfinite"

#: Name of the attachment that holds the configuration in force at the start.
CONFIG_NAME = "config.yaml"
#: Name of the metadata record that holds ``RunInfo``.
INFO_NAME = "run"

S = TypeVar("S")


class RunInfo(Struct, frozen=True):
    """What a run was. A simulated run tells nothing of clock, folder or host, so that equal runs give equal logs."""

    version: str
    """Of Pipewright."""
    scenario: str
    law: str
    seed: int
    realtime: bool = False
    """Paced by the wall clock."""
    started: str = ""
    """Wall-clock start, ISO 8601 with offset; empty for a simulated run."""


class Keyframe(Struct, Generic[S], frozen=True):
    """The core's state just before the tick of the same index was computed."""

    index: int
    t_ns: int
    state: S


class Revision(Struct, Generic[S], frozen=True):
    """The parameter set in force from the tick of this index on."""

    index: int
    t_ns: int
    revision: int
    config: S


class Timing(Struct, frozen=True, gc=False):
    """How punctual one tick was."""

    index: int
    t_ns: int
    late: float
    """Start of the tick against its schedule, s."""
    busy: float
    """Time from the start of the tick to its last command, s."""
    sent: float
    """Time from the start of the tick until the autopilot's set-point had left, s."""


class DeviceReport(Struct, frozen=True):
    """How devices, drivers and processor do, once a second."""

    t_ns: int
    values: dict[str, float]
    """By dotted name: ``autopilot.ATTITUDE_QUATERNION.rate`` (Hz), ``autopilot.setpoints`` (a count),
    ``servos.cycle.p99`` (s), ``cpu.loop`` (share of one core), ... The first part is the device, or ``cpu``."""


class NonFinite(Struct, frozen=True):
    """Values of the next message of a topic that JSON can only write as null."""

    topic: str
    sequence: int
    values: dict[str, str]
    """Path, its parts joined by "/" since names may hold dots, to "nan", "inf" or "-inf"."""
