"""From what a tracking camera tells to odometry of the body: mounting, the place where it began, jumps, nonsense.

V is the camera's world and C its body, both after ``drivers/frames.py``: x forward along the view, y left, z up. V
begins, level, wherever the camera is when it starts, so it is laid into W at the first pose, and again at each start.
"""

from __future__ import annotations

from math import acos, dist, hypot, isfinite, radians
from typing import Annotated

from msgspec import Meta, Struct

from drivers.rotation import about_z, from_euler, heading, inverse, multiply, rotate
from drivers.samples import Odometry, Quat, Vec3


def _meta(unit: str, doc: str, low: float, high: float) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


Offset = Annotated[float, _meta("m", "signed offset along an axis of B", -1.0, 1.0)]
Angle = Annotated[float, _meta("deg", "angle", -180.0, 180.0)]
Coordinate = Annotated[float, _meta("m", "coordinate in W", -1000.0, 1000.0)]


class Mount(Struct, frozen=True, forbid_unknown_fields=True):
    """How the camera sits on the vehicle."""

    offset: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    """Position of the camera in B."""
    rotation_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw (ZYX) of the camera against B; (0, 90, 0) looks down, with its top to the front."""

    def q_BC(self) -> Quat:
        """The rotation as a quaternion that takes C to B."""
        roll, pitch, yaw = self.rotation_deg
        return from_euler(radians(roll), radians(pitch), radians(yaw))


class JumpLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """A pose that lies farther from where the one before leads to than this, and than motion could, is a jump."""

    position: Annotated[float, _meta("m", "from the mean velocity's way", 0.005, 1.0)] = 0.05
    angle_deg: Annotated[float, _meta("deg", "beyond the turn of the angular rate", 0.5, 90.0)] = 5.0
    acceleration: Annotated[float, _meta("m/s^2", "of which the vehicle is capable", 1.0, 100.0)] = 20.0
    turning: Annotated[float, _meta("rad/s^2", "angular acceleration of which it is capable", 1.0, 1000.0)] = 50.0


class CameraPose(Struct, frozen=True, gc=False):
    """What the camera tells."""

    t_ns: int
    p_VC: Vec3
    q_VC: Quat
    v_VC: Vec3
    """Velocity of the camera, m/s, V."""
    w_VC: Vec3
    """Angular velocity of the camera, rad/s, V."""
    confidence: int


class Jump(Struct, frozen=True, gc=False):
    """How far a pose lies from where the one before leads to."""

    position: float
    """m."""
    angle: float
    """rad."""


class UnusableError(ValueError):
    """A pose that cannot be used; the text says why."""


class Tracking:
    """Turns camera poses into odometry. ``start`` is p_WB (m), ``start_heading`` (rad) the yaw at the first pose."""

    def __init__(self, mount: Mount, limits: JumpLimits, start: Vec3, start_heading: float) -> None:
        self._p_BC: Vec3 = mount.offset
        self._q_CB = inverse(mount.q_BC())
        self._limits = limits
        self._begin_at = (start, start_heading)
        self._p_WV: Vec3 = (0.0, 0.0, 0.0)
        self._q_WV: Quat | None = None
        self._last: Odometry | None = None
        self._last_rate = 0.0
        self._resets = 0

    def restart(self) -> None:
        """The camera has begun a new V: lay it where the body was last, and count it as a reset."""
        self._q_WV = None
        if self._last is not None:
            self._begin_at = (self._last.p_WB, heading(self._last.q_WB))
            self._last = None
            self._resets += 1

    def take(self, pose: CameraPose) -> tuple[Odometry, Jump | None]:
        """Odometry of the body, and the jump if this pose is one. Raises UnusableError."""
        size = hypot(*pose.q_VC)
        if not isfinite(sum(pose.p_VC) + sum(pose.v_VC) + sum(pose.w_VC) + size):
            raise UnusableError("it is not finite")
        if not 0.9 < size < 1.1:
            raise UnusableError(f"its quaternion has length {size:.2f}")
        w, x, y, z = pose.q_VC
        q_VB = multiply((w / size, x / size, y / size, z / size), self._q_CB)
        ax, ay, az = rotate(q_VB, self._p_BC)
        p_VB = (pose.p_VC[0] - ax, pose.p_VC[1] - ay, pose.p_VC[2] - az)
        # v_VB = v_VC - w x arm
        i, j, k = pose.w_VC
        v_VB = (
            pose.v_VC[0] - (j * az - k * ay),
            pose.v_VC[1] - (k * ax - i * az),
            pose.v_VC[2] - (i * ay - j * ax),
        )
        if self._q_WV is None:
            self._lay(p_VB, q_VB)
        assert self._q_WV is not None
        p, o = rotate(self._q_WV, p_VB), self._p_WV
        p_WB = (o[0] + p[0], o[1] + p[1], o[2] + p[2])
        q_WB, v_WB = multiply(self._q_WV, q_VB), rotate(self._q_WV, v_VB)
        rate = hypot(i, j, k)
        jump = self._jump(pose.t_ns, p_WB, q_WB, v_WB, rate)
        self._resets += jump is not None
        self._last = Odometry(pose.t_ns, p_WB, q_WB, v_WB, pose.confidence, self._resets)
        self._last_rate = rate
        return self._last, jump

    def _lay(self, p_VB: Vec3, q_VB: Quat) -> None:
        """Choose W's place and heading against V; both are level already."""
        start, start_heading = self._begin_at
        self._q_WV = about_z(start_heading - heading(q_VB))
        p = rotate(self._q_WV, p_VB)
        self._p_WV = (start[0] - p[0], start[1] - p[1], start[2] - p[2])

    def _jump(self, t_ns: int, p: Vec3, q: Quat, v: Vec3, rate: float) -> Jump | None:
        last = self._last
        if last is None:
            return None
        dt = (t_ns - last.t_ns) * 1e-9
        h = 0.5 * dt
        a, u = last.p_WB, last.v_WB
        led = (a[0] + h * (u[0] + v[0]), a[1] + h * (u[1] + v[1]), a[2] + h * (u[2] + v[2]))
        position = dist(led, p)
        angle = 2.0 * acos(min(1.0, abs(sum(c * d for c, d in zip(last.q_WB, q, strict=True)))))
        limits = self._limits
        far = position > limits.position + 0.5 * limits.acceleration * dt * dt
        turned = angle > radians(limits.angle_deg) + max(rate, self._last_rate) * dt + 0.5 * limits.turning * dt * dt
        return Jump(position, angle) if far or turned else None
