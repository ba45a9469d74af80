"""Unit quaternions (w, x, y, z) as plain tuples: what the drivers need of them."""

from __future__ import annotations

from math import atan2, cos, sin

from drivers.samples import Quat, Vec3


def multiply(a: Quat, b: Quat) -> Quat:
    """The rotation b followed by a."""
    w, x, y, z = a
    i, j, k, m = b
    return (
        w * i - x * j - y * k - z * m,
        w * j + x * i + y * m - z * k,
        w * k - x * m + y * i + z * j,
        w * m + x * k - y * j + z * i,
    )


def inverse(q: Quat) -> Quat:
    """The rotation undone."""
    return (q[0], -q[1], -q[2], -q[3])


def rotate(q: Quat, v: Vec3) -> Vec3:
    """v turned by q."""
    w, x, y, z = q
    a, b, c = v
    i, j, k = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (a + w * i + y * k - z * j, b + w * j + z * i - x * k, c + w * k + x * j - y * i)


def about_z(angle: float) -> Quat:
    """A turn about z, rad."""
    return (cos(0.5 * angle), 0.0, 0.0, sin(0.5 * angle))


def from_euler(roll: float, pitch: float, yaw: float) -> Quat:
    """ZYX Euler angles, rad: the turn about x, then about y, then about z of the fixed frame."""
    a, b = (cos(0.5 * roll), sin(0.5 * roll), 0.0, 0.0), (cos(0.5 * pitch), 0.0, sin(0.5 * pitch), 0.0)
    return multiply(about_z(yaw), multiply(b, a))


def heading(q: Quat) -> float:
    """The ZYX yaw angle, rad: where x points, seen from above."""
    w, x, y, z = q
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
