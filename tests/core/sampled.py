"""Samples of a vehicle that hovers level and at rest, to be changed by the tests."""

from __future__ import annotations

from math import cos, inf, nan, sin
from typing import Any

from msgspec.structs import replace

from drivers.samples import AutopilotState, FlightMode, Landed, Odometry, Quat, ServoState
from onboard.core.types import Inputs

G = 9.80665
LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
JOINTS = (-1.0, 1.0, 0.0, 0.0, 0.0)
T0 = 5_000_000_000
TICK_NS = 4_000_000


def quat(yaw: float = 0.0, pitch: float = 0.0) -> Quat:
    """q_WB of R_z(yaw) R_y(pitch)."""
    c, s, d, t = cos(0.5 * yaw), sin(0.5 * yaw), cos(0.5 * pitch), sin(0.5 * pitch)
    return (c * d, -s * t, c * t, s * d)


def odometry(t_ns: int = T0, **changes: Any) -> Odometry:
    """Hovering at (1, 0, 1.5) m."""
    return replace(Odometry(t_ns, (1.0, 0.0, 1.5), LEVEL, (0.0, 0.0, 0.0), 3), **changes)


def autopilot(t_ns: int = T0, **changes: Any) -> AutopilotState:
    """Level, at rest, in offboard."""
    rest = AutopilotState(
        t_ns, LEVEL, (0.0, 0.0, 0.0), t_ns, (0.0, 0.0, G), True, FlightMode.OFFBOARD, Landed.IN_AIR, 16.0, 0.9
    )
    return replace(rest, **changes)


def servos(t_ns: int = T0, **changes: Any) -> ServoState:
    """The arm ahead, healthy."""
    zero = (0.0, 0.0, 0.0, 0.0, 0.0)
    rest = ServoState(
        t_ns, JOINTS, zero, zero, (5.0, 5.0, 5.0, 5.0, 5.0), (35.0, 35.0, 35.0, 35.0, 35.0), (0, 0, 0, 0, 0), True
    )
    return replace(rest, **changes)


def inputs(t_ns: int = T0, **changes: Any) -> Inputs:
    """All three, sampled at the tick."""
    return replace(Inputs(t_ns, 0.004, odometry(t_ns), autopilot(t_ns), servos(t_ns)), **changes)


NOT_FINITE = (nan, inf, -inf)


def spoilt(values: tuple[float, ...], index: int, value: float) -> tuple[float, ...]:
    """``values`` with one of them replaced."""
    return (*values[:index], value, *values[index + 1 :])
