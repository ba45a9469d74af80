"""Where the arm's tools are, and the joint angles that bring them somewhere.

Angles and frames as in ``drivers.vehicle``: joint angle a points along u(a) = (cos a, 0, sin a) in B, and
theta_1, theta_2, theta_3 are each measured against the body (the parallelogram decouples them). In-plane
coordinates are (x, z) of M: forward and up from the arm's mount. Lengths in m, angles in rad.

With the elbow down (the default), theta_2 > theta_1; with the elbow up, theta_2 < theta_1.
"""

from __future__ import annotations

from enum import StrEnum
from math import acos, atan2, ceil, cos, hypot, inf, isfinite, pi, sin

from drivers.samples import Vec3
from drivers.vehicle import Arm
from onboard.core.types import Mat3

#: A target this close to the workspace counts as inside it, m.
TOLERANCE = 1e-9

Plane = tuple[float, float]
Mat2 = tuple[float, float, float, float]


class Tool(StrEnum):
    """The two tools, at a right angle; theta_3 turns one or the other towards the work."""

    GRIPPER = "gripper"
    """Along u(theta_3)."""
    NEEDLE = "needle"
    """Along u(theta_3 + pi/2)."""


class Unreachable(ValueError):  # noqa: N818 - reads as what it says
    """A target lies outside the workspace; ``distance`` says by how much (m; rad for an angle)."""

    def __init__(self, text: str, distance: float) -> None:
        super().__init__(text)
        self.distance = distance


def tool_offset(arm: Arm, theta_3: float, tool: Tool) -> Plane:
    """Wrist to tip of the tool."""
    if tool is Tool.GRIPPER:
        return (arm.gripper * cos(theta_3), arm.gripper * sin(theta_3))
    return (-arm.needle * sin(theta_3), arm.needle * cos(theta_3))


def wrist(arm: Arm, theta_1: float, theta_2: float) -> Plane:
    """Mount to wrist."""
    return (
        arm.link_1 * cos(theta_1) + arm.link_2 * cos(theta_2),
        arm.link_1 * sin(theta_1) + arm.link_2 * sin(theta_2),
    )


def forward(arm: Arm, joints: Vec3, tool: Tool) -> Vec3:
    """Tip of the tool in B."""
    x, z = wrist(arm, joints[0], joints[1])
    dx, dz = tool_offset(arm, joints[2], tool)
    mount = arm.mount
    return (mount[0] + x + dx, mount[1], mount[2] + z + dz)


def tip_W(arm: Arm, p_WB: Vec3, R_WB: Mat3, joints: Vec3, tool: Tool) -> Vec3:
    """Tip of the tool in W."""
    x, y, z = forward(arm, joints, tool)
    return (
        p_WB[0] + R_WB[0] * x + R_WB[1] * y + R_WB[2] * z,
        p_WB[1] + R_WB[3] * x + R_WB[4] * y + R_WB[5] * z,
        p_WB[2] + R_WB[6] * x + R_WB[7] * y + R_WB[8] * z,
    )


def tool_rotation(theta_3: float) -> Mat3:
    """R_ee = R_y(3*pi/2 - theta_3) of eq. 17: takes E to B. The gripper points along -z_E."""
    c, s = cos(theta_3), sin(theta_3)
    return (-s, 0.0, -c, 0.0, 1.0, 0.0, c, 0.0, -s)


def inverse_wrist(arm: Arm, x: float, z: float, elbow_up: bool = False) -> Plane:
    """(theta_1, theta_2) that bring the wrist to (x, z) of M, within the joint limits.

    Raises ``Unreachable``, telling how far the target lies outside the workspace.
    """
    theta_1, theta_2, distance = nearest_wrist(arm, x, z, elbow_up)
    if not distance <= TOLERANCE:
        branch = "up" if elbow_up else "down"
        if not isfinite(distance):
            raise Unreachable(f"wrist target {_point(x, z)} m in M, elbow {branch}: no reachable point", distance)
        raise Unreachable(
            f"wrist target {_point(x, z)} m in M is unreachable by {_millimetres(distance)} with the elbow "
            f"{branch}; the nearest reachable point is {_point(*wrist(arm, theta_1, theta_2))}",
            distance,
        )
    return (theta_1, theta_2)


def inverse_tip(arm: Arm, x: float, z: float, theta_3: float, tool: Tool, elbow_up: bool = False) -> Vec3:
    """Joint angles that bring the tip of the tool to (x, z) of M at tool angle ``theta_3``.

    Raises ``Unreachable`` as ``inverse_wrist``, and if theta_3 is beyond its stops.
    """
    low, high = arm.joint_min[2], arm.joint_max[2]
    if not low <= theta_3 <= high:
        beyond = max(low - theta_3, theta_3 - high)
        raise Unreachable(f"theta_3 = {theta_3:.4f} rad is beyond its limits [{low}, {high}]", beyond)
    dx, dz = tool_offset(arm, theta_3, tool)
    theta_1, theta_2 = inverse_wrist(arm, x - dx, z - dz, elbow_up)
    return (theta_1, theta_2, theta_3)


def clamp_wrist(arm: Arm, x: float, z: float, elbow_up: bool = False) -> tuple[float, float, float]:
    """The reachable wrist position nearest to (x, z) of M, and how far it was moved: (x, z, clamped_by)."""
    theta_1, theta_2, distance = nearest_wrist(arm, x, z, elbow_up)
    if distance <= TOLERANCE:
        return (x, z, 0.0)
    return (*wrist(arm, theta_1, theta_2), distance)


def nearest_wrist(arm: Arm, x: float, z: float, elbow_up: bool = False) -> tuple[float, float, float]:
    """Joint angles of the reachable wrist position nearest to (x, z) of M: (theta_1, theta_2, distance).

    Never raises, for the control loop. The distance is 0 inside the workspace, and infinite for a target that is
    not finite (the angles are then the first corner of the workspace).
    """
    l_1, l_2, least = arm.link_1, arm.link_2, arm.elbow_min
    (low_1, low_2, _), (high_1, high_2, _) = arm.joint_min, arm.joint_max
    sign = -1.0 if elbow_up else 1.0
    radius = hypot(x, z)
    cosine = (radius * radius - l_1 * l_1 - l_2 * l_2) / (2.0 * l_1 * l_2)
    if -1.0 <= cosine <= 1.0:
        bend = acos(cosine)
        if least <= bend <= pi - least:
            elbow = atan2(l_2 * sin(bend), l_1 + l_2 * cosine)
            theta_1 = _turn_into(atan2(z, x) - sign * elbow, low_1)
            theta_2 = _turn_into(theta_1 + sign * bend, low_2)
            if theta_1 <= high_1 and theta_2 <= high_2 and abs(theta_2 - theta_1 - sign * bend) < 1e-6:
                return (theta_1, theta_2, 0.0)
    return _nearest_on_boundary(arm, x, z, sign)


def wrist_jacobian(arm: Arm, theta_1: float, theta_2: float) -> Mat2:
    """Row-major J with (x', z') of the wrist = J (theta_1', theta_2')."""
    return (
        -arm.link_1 * sin(theta_1), -arm.link_2 * sin(theta_2),
        arm.link_1 * cos(theta_1), arm.link_2 * cos(theta_2),
    )  # fmt: skip


def wrist_jacobian_inverse(arm: Arm, theta_1: float, theta_2: float) -> Mat2:
    """Row-major J^-1. Its size is bounded within the joint limits: |sin(theta_2 - theta_1)| >= sin(elbow_min).

    Raises ZeroDivisionError at the exact singularity, which those limits exclude.
    """
    scale = 1.0 / sin(theta_2 - theta_1)
    s_1, s_2 = scale / arm.link_1, scale / arm.link_2
    return (s_1 * cos(theta_2), s_1 * sin(theta_2), -s_2 * cos(theta_1), -s_2 * sin(theta_1))


def tip_velocity(arm: Arm, joints: Vec3, joint_rates: Vec3, tool: Tool) -> Plane:
    """(x', z') of the tip against B."""
    j11, j12, j21, j22 = wrist_jacobian(arm, joints[0], joints[1])
    dx, dz = tool_offset(arm, joints[2], tool)
    rate_1, rate_2, rate_3 = joint_rates
    return (j11 * rate_1 + j12 * rate_2 - dz * rate_3, j21 * rate_1 + j22 * rate_2 + dx * rate_3)


def joint_rates(arm: Arm, joints: Vec3, velocity: Plane, theta_3_rate: float, tool: Tool) -> Vec3:
    """Joint rates that give the tip this (x', z') against B while the tool turns at ``theta_3_rate``."""
    i11, i12, i21, i22 = wrist_jacobian_inverse(arm, joints[0], joints[1])
    dx, dz = tool_offset(arm, joints[2], tool)
    x, z = velocity[0] + dz * theta_3_rate, velocity[1] - dx * theta_3_rate
    return (i11 * x + i12 * z, i21 * x + i22 * z, theta_3_rate)


def _nearest_on_boundary(arm: Arm, x: float, z: float, sign: float) -> tuple[float, float, float]:
    """Nearest point of the workspace's boundary.

    The joint limits and the elbow's margin bound a polygon in (theta_1, theta_2), on which the wrist position is
    one to one. Each edge holds one of theta_1, theta_2, theta_2 - theta_1 constant, so it maps to a circular arc,
    on which the nearest point has a closed form.
    """
    l_1, l_2, least = arm.link_1, arm.link_2, arm.elbow_min
    (low_1, low_2, _), (high_1, high_2, _) = arm.joint_min, arm.joint_max
    bend_low, bend_high = (least, pi - least) if sign > 0.0 else (least - pi, -least)
    best = (max(low_1, low_2 - bend_high), max(low_2, low_1 + bend_low), inf)
    for theta_1 in (low_1, high_1):
        low, high = max(low_2, theta_1 + bend_low), min(high_2, theta_1 + bend_high)
        if low <= high:
            angle = atan2(z - l_1 * sin(theta_1), x - l_1 * cos(theta_1))
            best = _closer(arm, x, z, theta_1, _onto(angle, low, high), best)
    for theta_2 in (low_2, high_2):
        low, high = max(low_1, theta_2 - bend_high), min(high_1, theta_2 - bend_low)
        if low <= high:
            angle = atan2(z - l_2 * sin(theta_2), x - l_2 * cos(theta_2))
            best = _closer(arm, x, z, _onto(angle, low, high), theta_2, best)
    for bend in (bend_low, bend_high):
        low, high = max(low_1, low_2 - bend), min(high_1, high_2 - bend)
        if low <= high:
            elbow = atan2(l_2 * sin(bend), l_1 + l_2 * cos(bend))
            theta_1 = _onto(atan2(z, x) - elbow, low, high)
            best = _closer(arm, x, z, theta_1, theta_1 + bend, best)
    return best


def _closer(
    arm: Arm, x: float, z: float, theta_1: float, theta_2: float, best: tuple[float, float, float]
) -> tuple[float, float, float]:
    near_x, near_z = wrist(arm, theta_1, theta_2)
    distance = hypot(x - near_x, z - near_z)
    return (theta_1, theta_2, distance) if distance < best[2] else best


def _turn_into(angle: float, low: float) -> float:
    """The same direction in [low, low + 2*pi)."""
    return low + (angle - low) % (2.0 * pi)


def _onto(angle: float, low: float, high: float) -> float:
    """The angle of [low, high] whose direction is nearest to that of ``angle``."""
    turned = _turn_into(angle, low)
    if turned <= high:
        return turned
    return high if turned - high < low + 2.0 * pi - turned else low


def _point(x: float, z: float) -> str:
    """To a tenth of a millimetre, without a negative zero."""
    return f"({round(x, 4) + 0.0}, {round(z, 4) + 0.0})"


def _millimetres(distance: float) -> str:
    """Rounded up, so that an outside target is never told as unreachable by zero."""
    if distance > 100.0:
        return f"{distance:.3g} m"
    return f"{ceil(distance * 1e4) / 10.0:.1f} mm"
