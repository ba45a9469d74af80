"""Contact of the sleeve with the pipe, of the vehicle with the ground, and the stick-slip friction of both."""

from __future__ import annotations

from math import atan2, sin, sqrt
from typing import Annotated

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from sim_backend import layout as at
from sim_backend.compiled import compiled
from sim_backend.deviations import WAVES
from sim_backend.knob import knob

Array = NDArray[np.float64]
Three = tuple[float, float, float]

#: The first of the points that the ground can touch belong to the airframe: a hard hit of one breaks the vehicle.
FRAME_POINTS = 8

#: Modes of a bristle.
FREE, STICK, SLIDE = 0.0, 1.0, 2.0

#: Least factor on the friction coefficients where the pipe is uneven.
SLIPPERIEST = 0.2

#: A contact slower than this does not slide, m/s.
STANDSTILL = 1e-9


def _check_friction(static: float, kinetic: float) -> None:
    if kinetic > static:
        raise ValueError(f"friction_kinetic {kinetic} is above friction_static {static}; it must not be")


class ContactParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Sleeve on pipe. Stiffness, damping and both friction coefficients: the paper, section VII."""

    stiffness: Annotated[float, knob("N/m", "normal stiffness", 1e2, 1e6)] = 50e3
    damping: Annotated[float, knob("N s/m", "normal damping", 0.0, 1e3)] = 50.0
    friction_static: Annotated[float, knob("1", "static friction coefficient", 0.0, 3.0)] = 1.0
    friction_kinetic: Annotated[float, knob("1", "dynamic friction coefficient", 0.0, 3.0)] = 0.9
    tangential_stiffness: Annotated[float, knob("N/m", "stiffness of the sticking contact", 1e2, 1e6)] = 20e3
    tangential_damping: Annotated[float, knob("N s/m", "damping of the sticking contact", 0.0, 1e3)] = 40.0
    unevenness: Annotated[
        float, knob("1", "standard deviation of both friction coefficients along and round the pipe", 0.0, 0.5)
    ] = 0.0
    patch: Annotated[
        float, knob("m", "wavelength of their unevenness; each wave has half of it to double", 0.005, 1.0)
    ] = 0.05
    release_angle: Annotated[float, knob("rad", "gripper angle beyond which the sleeve is let go", 0.05, 3.0)] = 0.8

    def __post_init__(self) -> None:
        _check_friction(self.friction_static, self.friction_kinetic)


class GroundParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Ground under skids, rotor hubs and arm: firm soil; values chosen for a sink of 0.3 mm and no bounce."""

    stiffness: Annotated[float, knob("N/m", "normal stiffness of one point", 1e2, 1e6)] = 20e3
    damping: Annotated[float, knob("N s/m", "normal damping of one point", 0.0, 1e3)] = 200.0
    friction_static: Annotated[float, knob("1", "static friction coefficient", 0.0, 3.0)] = 0.8
    friction_kinetic: Annotated[float, knob("1", "dynamic friction coefficient", 0.0, 3.0)] = 0.7
    tangential_stiffness: Annotated[float, knob("N/m", "stiffness of the sticking contact", 1e2, 1e6)] = 10e3
    tangential_damping: Annotated[float, knob("N s/m", "damping of the sticking contact", 0.0, 1e3)] = 100.0
    crash_speed: Annotated[float, knob("m/s", "a faster hit breaks the vehicle", 0.1, 20.0)] = 2.0

    def __post_init__(self) -> None:
        _check_friction(self.friction_static, self.friction_kinetic)


@compiled()
def friction(
    mode: float,
    z1: float,
    z2: float,
    v1: float,
    v2: float,
    normal: float,
    step: float,
    stiffness: float,
    damping: float,
    static: float,
    kinetic: float,
) -> tuple[float, float, float, float, float, float]:
    """One step of stick-slip friction in two tangential directions.

    Sticking, the contact is a spring-damper with stretch z that breaks when its force exceeds static * normal.
    Sliding, the force is kinetic * normal against the velocity v, and z keeps the direction of sliding; it sticks
    again when the velocity reverses. Returns the force (2), the mode, z (2) and the path slid in this step.
    """
    if mode != SLIDE:
        z1 += step * v1
        z2 += step * v2
        f1 = -stiffness * z1 - damping * v1
        f2 = -stiffness * z2 - damping * v2
        force = sqrt(f1 * f1 + f2 * f2)
        if force <= static * normal:
            return f1, f2, STICK, z1, z2, 0.0
        # Pulled off its place it slides; let go (the normal force fell) its spring relaxes and it stays.
        if f1 * v1 + f2 * v2 >= 0.0:
            shrink = static * normal / force
            return f1 * shrink, f2 * shrink, STICK, z1 * shrink, z2 * shrink, 0.0
        z1, z2 = -f1, -f2
    speed = sqrt(v1 * v1 + v2 * v2)
    limit = kinetic * normal
    if v1 * z1 + v2 * z2 <= 0.0 or speed < STANDSTILL:
        length = sqrt(z1 * z1 + z2 * z2)
        scale = limit / (stiffness * length) if length > 0.0 else 0.0
        z1 *= scale
        z2 *= scale
        return -stiffness * z1, -stiffness * z2, STICK, z1, z2, 0.0
    d1 = v1 / speed
    d2 = v2 / speed
    # While the contact is nearly unloaded, z must still hold the direction of sliding.
    reach = max(limit / stiffness, 1e-12)
    return -limit * d1, -limit * d2, SLIDE, reach * d1, reach * d2, speed * step


@compiled()
def grip(p: Array, ahead: float, up: float, along: float) -> float:
    """Factor on both friction coefficients at a place on the pipe: from its axis (ahead, up), and along it, m."""
    if p[at.UNEVENNESS] == 0.0:
        return 1.0
    round_the_pipe = p[at.PIPE_RADIUS] * atan2(up, -ahead)
    waves = 0.0
    for i in range(WAVES):
        row = at.WAVE + 3 * i
        waves += sin(p[row] * along + p[row + 1] * round_the_pipe + p[row + 2])
    return float(max(SLIPPERIEST, 1.0 + p[at.UNEVENNESS] * waves * sqrt(2.0 / WAVES)))


@compiled()
def pipe_contact(x: Array, p: Array, tip: Three, velocity: Three) -> Three:
    """Force of the pipe on the gripper's tip, N, W; updates the bristle, the slip and the contact figures in ``x``.

    ``tip`` (m) and its ``velocity`` (m/s) are in W. The pipe is a horizontal cylinder, square to its heading.
    """
    nx = p[at.PIPE_NORMAL]
    ny = p[at.PIPE_NORMAL + 1]
    rx = tip[0] - p[at.PIPE_POINT]
    ry = tip[1] - p[at.PIPE_POINT + 1]
    up = tip[2] - p[at.PIPE_POINT + 2]
    ahead = rx * nx + ry * ny
    distance = sqrt(ahead * ahead + up * up)
    penetration = p[at.PIPE_RADIUS] - distance
    beyond = abs(ry * nx - rx * ny) > p[at.PIPE_HALF_LENGTH]
    if penetration <= 0.0 or distance == 0.0 or beyond:
        x[at.CONTACT_MODE] = FREE
        x[at.CONTACT_STRETCH] = 0.0
        x[at.CONTACT_STRETCH + 1] = 0.0
        x[at.CONTACT_FORCE] = 0.0
        return 0.0, 0.0, 0.0
    # Outward normal e in the cross-section; round = e turned by 90 deg; the axis points to the left of the heading.
    ea = ahead / distance
    eu = up / distance
    va = velocity[0] * nx + velocity[1] * ny
    vu = velocity[2]
    outward = va * ea + vu * eu
    round_speed = vu * ea - va * eu
    axial_speed = velocity[1] * nx - velocity[0] * ny
    normal = max(0.0, p[at.CONTACT_STIFFNESS] * penetration - p[at.CONTACT_DAMPING] * outward)
    share = grip(p, ahead, up, ry * nx - rx * ny)
    f_round, f_axial, mode, z1, z2, slid = friction(
        x[at.CONTACT_MODE],
        x[at.CONTACT_STRETCH],
        x[at.CONTACT_STRETCH + 1],
        round_speed,
        axial_speed,
        normal,
        p[at.STEP],
        p[at.CONTACT_TANGENTIAL_STIFFNESS],
        p[at.CONTACT_TANGENTIAL_DAMPING],
        share * p[at.CONTACT_STATIC],
        share * p[at.CONTACT_KINETIC],
    )
    x[at.CONTACT_MODE] = mode
    x[at.CONTACT_STRETCH] = z1
    x[at.CONTACT_STRETCH + 1] = z2
    x[at.TIP_SLIP] += slid
    x[at.CONTACT_FORCE] = normal
    if normal > x[at.CONTACT_PEAK]:
        x[at.CONTACT_PEAK] = normal
    fa = normal * ea - f_round * eu
    fu = normal * eu + f_round * ea
    return fa * nx - f_axial * ny, fa * ny + f_axial * nx, fu


@compiled()
def ground_point(x: Array, p: Array, index: int, height: float, velocity: Three) -> Three:
    """Force of the ground on point ``index`` of the vehicle, N, W. ``velocity`` of the point in W, m/s."""
    row = at.GROUND_BRISTLE + 3 * index
    if height >= 0.0:
        x[row] = FREE
        x[row + 1] = 0.0
        x[row + 2] = 0.0
        return 0.0, 0.0, 0.0
    if index < FRAME_POINTS and x[row] == FREE and -velocity[2] > p[at.GROUND_CRASH_SPEED] and x[at.CRASH] == 0.0:
        x[at.CRASH] = 1.0
        x[at.CRASH_VALUE] = -velocity[2]
    normal = max(0.0, -p[at.GROUND_STIFFNESS] * height - p[at.GROUND_DAMPING] * velocity[2])
    fx, fy, mode, z1, z2, _ = friction(
        x[row],
        x[row + 1],
        x[row + 2],
        velocity[0],
        velocity[1],
        normal,
        p[at.STEP],
        p[at.GROUND_TANGENTIAL_STIFFNESS],
        p[at.GROUND_TANGENTIAL_DAMPING],
        p[at.GROUND_STATIC],
        p[at.GROUND_KINETIC],
    )
    x[row] = mode
    x[row + 1] = z1
    x[row + 2] = z2
    return fx, fy, normal
