"""A vehicle that is turned in both hands, as its camera and its autopilot see it: the truth of a mount calibration."""

from __future__ import annotations

from collections.abc import Callable
from math import sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.rotation import about_z, from_euler, inverse, multiply, rotate
from drivers.samples import AutopilotState, FlightMode, Landed, Odometry, Quat, Vec3
from drivers.tracking import CameraPose, JumpLimits, Mount, Tracking

GRAVITY = 9.80665
#: Roll, pitch, yaw (rad) and position (m) at a time (s).
Motion = Callable[[float], tuple[Vec3, Vec3]]
_H = 1e-4


def in_hands(t: float) -> tuple[Vec3, Vec3]:
    """Back and forth about every axis, and a little about the room."""
    rpy = (0.5 * sin(4.1 * t), 0.45 * sin(3.3 * t + 1.0), 0.7 * sin(2.7 * t))
    return rpy, (0.2 * sin(2.0 * t), 0.15 * sin(1.7 * t), 1.0 + 0.1 * sin(2.3 * t))


def about_yaw(t: float) -> tuple[Vec3, Vec3]:
    """On a turntable."""
    return (0.0, 0.0, 2.0 * sin(1.5 * t)), (0.0, 0.0, 0.24)


def slowly(t: float) -> tuple[Vec3, Vec3]:
    """Far enough to see how the camera is turned, but too slowly to feel where it sits."""
    rpy = (0.6 * sin(0.5 * t), 0.6 * sin(0.37 * t + 1.0), 0.8 * sin(0.29 * t))
    return rpy, (0.0, 0.0, 1.0)


class Noise(NamedTuple):
    """Standard deviations of what is measured, and the accelerometer's bias."""

    attitude: float = 0.002
    velocity: float = 0.01
    rate: float = 0.01
    force: float = 0.15
    bias: Vec3 = (0.12, -0.08, 0.1)


SILENT = Noise(0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0))


def moved(
    motion: Motion, mount: Mount, before: Mount, seconds: float, *, lag: float = 0.0, noise: Noise = SILENT
) -> tuple[list[Odometry], list[AutopilotState]]:
    """What the driver of the camera (at 200 Hz, set to ``before``) and that of the autopilot (at 250 Hz) tell.

    lag: by which poses are stamped too late, s.
    """
    random = np.random.default_rng(3)
    q_VW, p_VW = about_z(0.7), (0.4, -0.2, 0.1)
    tracking = Tracking(before, JumpLimits(), (0.0, 0.0, 1.0), 0.0)
    poses = []
    for t in np.arange(0.05, seconds, 0.005).tolist():
        q, w_B, p, v, _ = _body(motion, t)
        q = _shaken(q, noise.attitude, random)
        arm, w_W = rotate(q, mount.offset), rotate(q, w_B)
        p_WC, v_WC = _plus(p, arm), _plus(_plus(v, _cross(w_W, arm)), _gauss(random, noise.velocity))
        told = CameraPose(
            round(1e9 * (t + lag)),
            _plus(p_VW, rotate(q_VW, p_WC)),
            multiply(q_VW, multiply(q, mount.q_BC())),
            rotate(q_VW, v_WC),
            rotate(q_VW, w_W),
            3,
        )
        poses.append(tracking.take(told)[0])
    states = []
    for t in np.arange(0.0, seconds, 0.004).tolist():
        q, w_B, _, _, a = _body(motion, t)
        f_B = rotate(inverse(q), (a[0], a[1], a[2] + GRAVITY))
        states.append(
            AutopilotState(
                round(1e9 * t),
                _shaken(q, 0.5 * noise.attitude, random),
                _plus(w_B, _gauss(random, noise.rate)),
                round(1e9 * t),
                _plus(_plus(f_B, noise.bias), _gauss(random, noise.force)),
                False,
                FlightMode.HOLD,
                Landed.ON_GROUND,
                16.0,
                0.9,
            )
        )
    return poses, states


def _body(motion: Motion, t: float) -> tuple[Quat, Vec3, Vec3, Vec3, Vec3]:
    """q_WB, w_B, p, v, a of the body."""
    (rpy, p), (before, p0), (after, p1) = motion(t), motion(t - _H), motion(t + _H)
    _, x, y, z = multiply(inverse(from_euler(*before)), from_euler(*after))
    v = (np.array(p1) - np.array(p0)) / (2 * _H)
    a = (np.array(p1) - 2 * np.array(p) + np.array(p0)) / _H**2
    return from_euler(*rpy), (x / _H, y / _H, z / _H), p, _three(v), _three(a)


def _shaken(q: Quat, size: float, random: np.random.Generator) -> Quat:
    x, y, z = (0.5 * value for value in _gauss(random, size))
    w, i, j, k = multiply(q, (1.0, x, y, z))
    norm = float(np.sqrt(w * w + i * i + j * j + k * k))
    return (w / norm, i / norm, j / norm, k / norm)


def _gauss(random: np.random.Generator, size: float) -> Vec3:
    return _three(random.normal(0.0, size, 3)) if size else (0.0, 0.0, 0.0)


def _three(v: NDArray[np.float64]) -> Vec3:
    x, y, z = v.tolist()
    return (x, y, z)


def _plus(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _cross(a: Vec3, b: Vec3) -> Vec3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
