"""Vectors, rotations and ZYX Euler angles on plain tuples.

A 3x3 product on tuples costs a fifth of NumPy's, and the laws need nothing larger. Vectors are 3-tuples, matrices
are row-major 9-tuples, quaternions are (w, x, y, z). Euler angles are ``rpy = (phi, theta, psi)`` with
R = R_z(psi) R_y(theta) R_x(phi); a positive pitch leans the thrust towards +x.
"""

from __future__ import annotations

from math import asin, atan2, copysign, cos, hypot, pi, sin, sqrt

from drivers.samples import Quat, Vec3
from onboard.core.types import Mat3

#: Smallest |cos(theta)| by which the Euler rates divide: about 0.06 deg from the vertical.
GIMBAL_COSINE = 1e-3


def wrap_angle(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + pi) % (2.0 * pi) - pi


def clamp(value: float, low: float, high: float) -> float:
    """The value of [low, high] nearest to ``value``."""
    return low if value < low else high if value > high else value


def add(a: Vec3, b: Vec3) -> Vec3:
    """Sum a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Vec3, b: Vec3) -> Vec3:
    """Difference a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(factor: float, a: Vec3) -> Vec3:
    """Product factor * a."""
    return (factor * a[0], factor * a[1], factor * a[2])


def dot(a: Vec3, b: Vec3) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Cross product a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def norm(a: Vec3) -> float:
    """Euclidean length."""
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def rotate(R: Mat3, v: Vec3) -> Vec3:
    """R v."""
    x, y, z = v
    return (
        R[0] * x + R[1] * y + R[2] * z,
        R[3] * x + R[4] * y + R[5] * z,
        R[6] * x + R[7] * y + R[8] * z,
    )


def rotate_transposed(R: Mat3, v: Vec3) -> Vec3:
    """R^T v, which is R^-1 v for a rotation."""
    x, y, z = v
    return (
        R[0] * x + R[3] * y + R[6] * z,
        R[1] * x + R[4] * y + R[7] * z,
        R[2] * x + R[5] * y + R[8] * z,
    )


def matrix_from_euler(rpy: Vec3) -> Mat3:
    """R_z(psi) R_y(theta) R_x(phi)."""
    phi, theta, psi = rpy
    cf, sf, ct, st, cp, sp = cos(phi), sin(phi), cos(theta), sin(theta), cos(psi), sin(psi)
    return (
        cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf,
        sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf,
        -st, ct * sf, ct * cf,
    )  # fmt: skip


def matrix_from_quat(q: Quat) -> Mat3:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


def quat_from_euler(rpy: Vec3) -> Quat:
    """Unit quaternion of R_z(psi) R_y(theta) R_x(phi)."""
    phi, theta, psi = rpy
    cf, sf = cos(0.5 * phi), sin(0.5 * phi)
    ct, st = cos(0.5 * theta), sin(0.5 * theta)
    cp, sp = cos(0.5 * psi), sin(0.5 * psi)
    return (
        cp * ct * cf + sp * st * sf,
        cp * ct * sf - sp * st * cf,
        cp * st * cf + sp * ct * sf,
        sp * ct * cf - cp * st * sf,
    )


def euler_from_quat(q: Quat) -> Vec3:
    """Roll and yaw in [-pi, pi], pitch in [-pi/2, pi/2], of a unit quaternion.

    With the pitch at the vertical only yaw -+ roll is defined; roll is then 0.
    """
    w, x, y, z = q
    sine = 2.0 * (w * y - x * z)
    if abs(sine) > 1.0 - 1e-12:
        return (0.0, copysign(0.5 * pi, sine), wrap_angle(-2.0 * copysign(1.0, sine) * atan2(x, w)))
    return (
        atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        asin(sine),
        atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def quat_multiply(a: Quat, b: Quat) -> Quat:
    """Product a b: first the rotation b, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quat_conjugate(q: Quat) -> Quat:
    """The inverse rotation of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def quat_normalize(q: Quat) -> Quat:
    """Unit quaternion along ``q``; raises ValueError if q has no direction."""
    length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if not 0.0 < length < float("inf"):
        raise ValueError(f"quaternion {q} has no direction: want four finite numbers, not all zero")
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length)


def body_from_euler_rates(rpy: Vec3, rpy_rate: Vec3) -> Vec3:
    """Angular velocity w_WB_B = E(rpy) rpy_rate."""
    phi, theta, _ = rpy
    cf, sf, ct = cos(phi), sin(phi), cos(theta)
    roll, pitch, yaw = rpy_rate
    return (roll - sin(theta) * yaw, cf * pitch + sf * ct * yaw, cf * ct * yaw - sf * pitch)


def euler_rates_from_body(rpy: Vec3, w_WB_B: Vec3) -> Vec3:
    """Rates of the Euler angles, E(rpy)^-1 w_WB_B; bounded near the vertical by ``GIMBAL_COSINE``."""
    phi, theta, _ = rpy
    cf, sf = cos(phi), sin(phi)
    across = sf * w_WB_B[1] + cf * w_WB_B[2]
    yaw = across / _guarded(cos(theta))
    return (w_WB_B[0] + sin(theta) * yaw, cf * w_WB_B[1] - sf * w_WB_B[2], yaw)


def euler_torque_from_body(rpy: Vec3, torque_B: Vec3) -> Vec3:
    """Generalised forces on the Euler angles of a torque on the body, E(rpy)^T torque_B."""
    phi, theta, _ = rpy
    cf, sf, ct = cos(phi), sin(phi), cos(theta)
    x, y, z = torque_B
    return (x, cf * y - sf * z, ct * (sf * y + cf * z) - sin(theta) * x)


def body_torque_from_euler(rpy: Vec3, torque: Vec3) -> Vec3:
    """Body torque that has these generalised forces on the Euler angles, E(rpy)^-T torque; guarded as the rates."""
    phi, theta, _ = rpy
    cf, sf = cos(phi), sin(phi)
    roll, pitch, yaw = torque
    across = (yaw + sin(theta) * roll) / _guarded(cos(theta))
    return (roll, cf * pitch + sf * across, cf * across - sf * pitch)


def vertical(q: Quat) -> Vec3:
    """z of the outer frame in the turned one: the third row of the rotation matrix."""
    w, x, y, z = q
    return (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


def tilt(R: Mat3) -> float:
    """Angle between z of the turned frame and the vertical, rad."""
    return atan2(hypot(R[2], R[5]), R[8])


def _guarded(cosine: float) -> float:
    return cosine if abs(cosine) > GIMBAL_COSINE else copysign(GIMBAL_COSINE, cosine)
