"""The axes of each device, and how they turn into W and B. No other file names a device's axes.

PX4 tells vectors of the world in NED (x north, y east, z down), vectors of the body in FRD (x forward, y right,
z down), and the attitude as the quaternion that takes FRD to NED. W is ENU and B is FLU. Each of the three
conversions is its own inverse; both directions have a name so that a call reads as what it does.

The T265 tells poses with x right, y up, z backwards, both for its own body and for its world, whose y axis it levels
against gravity. V is that world with x forward, y left, z up, and C is the camera with x along its view, y left, z up.
How V lies in W, and C in B, is no matter of axes (``drivers/tracking.py``).
"""

from __future__ import annotations

from math import sqrt

from drivers.samples import Quat, Vec3

_HALF = sqrt(0.5)


def world_from_px4(v: Vec3) -> Vec3:
    """A vector given in NED, in W."""
    return (v[1], v[0], -v[2])


def px4_from_world(v: Vec3) -> Vec3:
    """A vector given in W, in NED."""
    return (v[1], v[0], -v[2])


def body_from_px4(v: Vec3) -> Vec3:
    """A vector given in FRD, in B."""
    return (v[0], -v[1], -v[2])


def px4_from_body(v: Vec3) -> Vec3:
    """A vector given in B, in FRD."""
    return (v[0], -v[1], -v[2])


def attitude_from_px4(q: Quat) -> Quat:
    """``q_WB`` of the quaternion (w, x, y, z) that takes FRD to NED.

    It is the product of the half turn about (1, 1, 0) that takes NED to ENU, of q, and of the half turn about x
    that takes FLU to FRD; its sign is chosen so that the conversion undoes itself.
    """
    w, x, y, z = q
    return (_HALF * (w + z), _HALF * (x + y), _HALF * (x - y), _HALF * (w - z))


def px4_from_attitude(q_WB: Quat) -> Quat:
    """The quaternion (w, x, y, z) that takes FRD to NED, of ``q_WB``."""
    return attitude_from_px4(q_WB)


def from_tracker(v: Vec3) -> Vec3:
    """A vector given in the T265's axes (world or body), in V or C."""
    return (-v[2], -v[0], v[1])


def tracker_from(v: Vec3) -> Vec3:
    """A vector given in V or C, in the T265's axes."""
    return (-v[1], v[2], -v[0])


def attitude_from_tracker(q: Quat) -> Quat:
    """``q_VC`` of the T265's quaternion (w, x, y, z), which takes its body to its world: the axis changes its name."""
    w, x, y, z = q
    return (w, -z, -x, y)


def tracker_from_attitude(q_VC: Quat) -> Quat:
    """The T265's quaternion (w, x, y, z), of ``q_VC``."""
    w, x, y, z = q_VC
    return (w, -y, z, -x)
