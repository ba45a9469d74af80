"""All that the ground station knows of the onboard side: the messages, and how to read a log of them."""

from __future__ import annotations

from onboard.core.repair import Pipe, Repair
from onboard.core.types import Event, Phase, Severity, Tick
from onboard.logfile import LogError, LogReader
from onboard.records import (
    DEVICES,
    EVENT,
    KEYFRAME,
    PARAMS,
    TICK,
    TIMING,
    TRUTH,
    DeviceReport,
    Keyframe,
    Revision,
    RunInfo,
    Timing,
)
from sim_backend.plant import Truth

__all__ = [
    "DEVICES",
    "EVENT",
    "KEYFRAME",
    "PARAMS",
    "TICK",
    "TIMING",
    "TRUTH",
    "DeviceReport",
    "Event",
    "Keyframe",
    "LogError",
    "LogReader",
    "Phase",
    "Pipe",
    "Repair",
    "Revision",
    "RunInfo",
    "Severity",
    "Tick",
    "Timing",
    "Truth",
]
