"""Where the vehicle has to be in each phase: legs of motion from the place of the pipe.

A leg moves eight coordinates at once: base position x, y, z (m, W), yaw (rad), wrist forward and up (m, levelled
heading frame, relative to the arm mount), elevation of the gripper (rad) and pump angle (rad). The heading n
points into the pipe; the base always stands at crack - distance * n, its arm mount level with the pipe's axis.
"""

from __future__ import annotations

from itertools import pairwise
from math import cbrt, cos, hypot, inf, pi, radians, sin, sqrt
from typing import Annotated

from msgspec import Struct
from msgspec.structs import replace

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from onboard.core import kinematics
from onboard.core.math3 import wrap_angle
from onboard.core.repair import Pipe
from onboard.core.spec import note, spec

Eight = tuple[float, float, float, float, float, float, float, float]


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Geometry and speeds of the mission's motion.

    Where the vehicle goes is settled on the ground, since a leg may be under way by one geometry and the arm follow
    another; how fast may be changed in flight, and holds from the next phase on.
    """

    takeoff_height: Annotated[
        float, spec("m", 0.4, 10.0, "height above the start at the end of takeoff", in_flight=False)
    ] = 1.0
    standoff: Annotated[
        float, spec("m", 0.7, 5.0, "base to crack before the approach to the pipe", in_flight=False)
    ] = 1.0
    clearance: Annotated[
        float, spec("m", 0.5, 3.0, "no route passes the pipe's axis closer than this", in_flight=False)
    ] = 0.85
    gap: Annotated[float, spec("m", 0.02, 0.3, "sleeve to crack before the advance", in_flight=False)] = 0.05
    retreat: Annotated[float, spec("m", 0.1, 2.0, "way back along the contact normal", in_flight=False)] = 0.40
    press_reach: Annotated[float, spec("m", 0.1, 0.39, "wrist ahead of the mount while pressing", in_flight=False)] = (
        0.30
    )
    needle_reach: Annotated[
        float, spec("m", 0.1, 0.39, "wrist ahead of the mount at the middle of the arc", in_flight=False)
    ] = 0.25
    needle_gap: Annotated[float, spec("m", 0.0, 0.02, "needle tip above the pipe's surface", in_flight=False)] = 0.003
    needle_clear: Annotated[
        float, spec("m", 0.005, 0.1, "needle lifted off the surface before and after the arc", in_flight=False)
    ] = 0.03
    arc_max: Annotated[float, spec("rad", 0.1, 2.5, "half the arc to dispense on, when reachable", in_flight=False)] = (
        1.3
    )
    link_clear: Annotated[
        float, spec("m", 0.0, 0.2, "least distance of link 2 from the pipe's surface", in_flight=False)
    ] = 0.02
    fold: tuple[
        Annotated[float, spec("m", -0.4, 0.4, "folded wrist, forward", in_flight=False)],
        Annotated[float, spec("m", -0.4, 0.4, "folded wrist, up", in_flight=False)],
    ] = (0.0, -0.14)
    pump_ratio: Annotated[
        float, spec("rad/m", 0.0, 200.0, "pump servo angle per length of adhesive", in_flight=False)
    ] = 12.0
    speed: Annotated[float, spec("m/s", 0.05, 2.0, "peak speed of the base")] = 0.40
    acceleration: Annotated[float, spec("m/s^2", 0.05, 3.0, "peak acceleration of the base")] = 0.35
    jerk: Annotated[float, spec("m/s^3", 0.05, 10.0, "peak jerk of the base")] = 0.7
    near_speed: Annotated[float, spec("m/s", 0.01, 0.5, "peak speed beside the pipe")] = 0.12
    advance_speed: Annotated[float, spec("m/s", 0.002, 0.05, "speed towards contact")] = 0.010
    overtravel: Annotated[float, spec("m", 0.01, 0.3, "advance past the crack before giving up", in_flight=False)] = (
        0.08
    )
    feel: Annotated[bool, note("before the work, find out by touch how far the pipe is", in_flight=False)] = False
    feel_room: Annotated[float, spec("m", 0.02, 0.3, "sleeve to crack where that begins", in_flight=False)] = 0.10
    feel_reach: Annotated[float, spec("m", 0.01, 0.3, "past the crack where that is given up", in_flight=False)] = 0.12
    feel_speed: Annotated[float, spec("m/s", 0.002, 0.05, "speed with which it is felt for")] = 0.015
    descent_speed: Annotated[float, spec("m/s", 0.05, 1.0, "last part of the landing")] = 0.20
    yaw_rate: Annotated[float, spec("rad/s", 0.05, 2.0, "peak yaw rate")] = 0.5
    arm_speed: Annotated[float, spec("m/s", 0.01, 0.5, "peak speed of the wrist")] = 0.12
    arm_turn: Annotated[float, spec("rad/s", 0.05, 3.0, "peak rate of the tool's elevation")] = 0.8
    needle_speed: Annotated[float, spec("m/s", 0.005, 0.2, "peak speed of the needle along the arc")] = 0.025
    spool: Annotated[float, spec("s", 0.2, 5.0, "time in which thrust is built up and taken back on the ground")] = 1.5


class Leg(Struct, frozen=True, gc=False):
    """One motion, quintic in time, from wherever the one before ended."""

    target: Eight
    duration: float
    arc: tuple[float, float, float] | None = None
    """(first angle, last angle, needle tip radius) of a needle sweep about the pipe: the arm follows the arc."""
    pumping: bool = False
    """Adhesive flows."""
    uniform: bool = False
    """Constant speed after a smooth start (the advance and the last descent), not rest to rest."""
    taring: bool = False
    """A rest, in whose last part the force observers are tared."""
    feeling: bool = False
    """The tip is to find the pipe: ends at the touch."""


def duration(distance: float, speed: float, acceleration: float, jerk: float) -> float:
    """Shortest time (s) of a rest-to-rest quintic over ``distance`` within the three peak limits."""
    d = abs(distance)
    return max(15.0 / 8.0 * d / speed, sqrt(5.7735 * d / acceleration), cbrt(60.0 * d / jerk))


class Site(Struct, frozen=True, gc=False):
    """The places that follow from the pipe, the vehicle and the parameters."""

    yaw: float
    normal: tuple[float, float]
    crack: Vec3
    height: float
    """Height of the base beside the pipe."""
    far: float
    needle: float
    near: float
    """Base to crack: at the standoff, while dispensing, before the advance."""
    arc: tuple[float, float]
    """Reachable arc: first and last angle about the pipe's axis, rad; 0 faces the vehicle, positive is up."""


def found(site: Site, along: float) -> Site:
    """The site with the crack ``along`` m farther along the contact normal than the mission believes."""
    if along == 0.0:
        return site
    (x, y, z), (nx, ny) = site.crack, site.normal
    return replace(site, crack=(x + along * nx, y + along * ny, z))


class InfeasibleError(ValueError):
    """The pipe cannot be repaired from where the parameters put it; the text says why."""


def survey(pipe: Pipe, vehicle: Vehicle, params: Params) -> Site:
    """Places of the mission. Raises ``InfeasibleError`` when arm or airframe cannot do it."""
    yaw = radians(pipe.heading_deg)
    normal = (cos(yaw), sin(yaw))
    x, y, z = pipe.position
    mount = vehicle.arm.mount
    needle_radius = pipe.radius + params.needle_gap
    site = Site(
        yaw=yaw,
        normal=normal,
        crack=(x - pipe.radius * normal[0], y - pipe.radius * normal[1], z),
        height=z - mount[2],
        far=params.standoff,
        needle=mount[0] + params.needle_reach + vehicle.arm.needle + params.needle_gap,
        near=mount[0] + params.press_reach + vehicle.arm.gripper + params.gap,
        arc=(0.0, 0.0),
    )
    lowest = z - pipe.radius - vehicle.base.gear_height
    if lowest < 0.3:
        raise InfeasibleError(
            f"pipe.position z = {z} m: no room to fly under the arm; at least {z + 0.3 - lowest:.2f} m is needed"
        )
    rotor = vehicle.rotors.arm_x + vehicle.rotors.radius
    if min(site.needle, site.near - params.gap) - rotor < 0.05:
        raise InfeasibleError(
            "plan.needle_reach / plan.press_reach: the propellers would come closer than 5 cm to the pipe"
        )
    start: Eight = (0.0, 0.0, vehicle.base.gear_height + params.takeoff_height, 0.0, 0.0, 0.0, 0.0, 0.0)
    over = start[:3]
    there = ((0.0, 0.0, 0.0), over, *route(start, beside(site, site.far), pipe, site, params))
    done = beside(site, max(site.near - params.gap + params.retreat, params.clearance))
    back = (done, *route((*done, 0.0, 0.0, 0.0, 0.0, 0.0), over, pipe, site, params))
    passes = min(_from_pipe(a, b, pipe, normal) for way in (there, back) for a, b in pairwise(way))
    if passes < params.clearance:
        raise InfeasibleError(
            f"pipe.position {pipe.position}: the way from take-off to the pipe and back passes {passes:.2f} m from its "
            f"axis; at least {params.clearance} m is needed"
        )
    if not _reaches(params.press_reach, 0.0, vehicle):
        raise InfeasibleError(f"plan.press_reach = {params.press_reach} m: the arm cannot hold the wrist there")
    angles = [_farthest(sign, pipe.radius, needle_radius, vehicle, params) for sign in (-1.0, 1.0)]
    if angles[1] - angles[0] < radians(20.0):
        raise InfeasibleError(f"pipe.radius = {pipe.radius} m: the needle reaches no useful arc of the pipe")
    return Site(
        site.yaw, site.normal, site.crack, site.height, site.far, site.needle, site.near, (angles[0], angles[1])
    )


def check_fence(site: Site, pipe: Pipe, params: Params, low: Vec3, high: Vec3) -> None:
    """Raise ``InfeasibleError`` when the way to the pipe leads out of the box from ``low`` to ``high`` (m, W)."""
    start: Eight = (0.0, 0.0, params.takeoff_height, 0.0, 0.0, 0.0, 0.0, 0.0)
    for point in (start[:3], *route(start, beside(site, site.far), pipe, site, params), beside(site, site.needle)):
        if not all(a <= x <= b for x, a, b in zip(point, low, high, strict=True)):
            at = ", ".join(f"{x:.1f}" for x in point)
            raise InfeasibleError(
                f"pipe.position {pipe.position}: the way to it leads to ({at}) m, outside of the fence from "
                f"safety.fence_low {low} to safety.fence_high {high}"
            )


def wrist_on_arc(
    angle: float, radius: float, pipe_radius: float, vehicle: Vehicle, params: Params
) -> tuple[float, float, float]:
    """Wrist (forward, up; m) and gripper elevation (rad) with the needle square on the pipe at ``angle``.

    radius: distance of the needle tip from the pipe's axis, m.
    """
    axis = params.needle_reach + vehicle.arm.needle + params.needle_gap + pipe_radius
    rho = radius + vehicle.arm.needle
    return axis - rho * cos(angle), rho * sin(angle), -angle - 0.5 * pi


def _reaches(forward: float, up: float, vehicle: Vehicle) -> bool:
    return kinematics.clamp_wrist(vehicle.arm, forward, up)[2] < 1e-6


def _farthest(sign: float, pipe_radius: float, radius: float, vehicle: Vehicle, params: Params) -> float:
    """Last angle, in steps of one degree from 0, at which the arm reaches the arc and keeps clear of the pipe."""
    arm = vehicle.arm
    step, reached = radians(1.0), 0.0
    axis = params.needle_reach + arm.needle + params.needle_gap + pipe_radius
    while reached + step <= params.arc_max:
        angle = sign * (reached + step)
        # three degrees of pitch either way must stay within reach, since the arm compensates them
        for clear in (radius, radius + params.needle_clear):
            x, z, elevation = wrist_on_arc(angle, clear, pipe_radius, vehicle, params)
            if not all(_reaches(x + d * (z - 0.06), z + d * x, vehicle) for d in (-0.05, 0.0, 0.05)):
                return sign * reached
            if not arm.joint_min[2] + 0.05 < elevation < arm.joint_max[2] - 0.05:
                return sign * reached
        x, z, _ = wrist_on_arc(angle, radius, pipe_radius, vehicle, params)
        theta_1, _ = kinematics.inverse_wrist(arm, x, z)
        elbow = (arm.link_1 * cos(theta_1), arm.link_1 * sin(theta_1))
        if _segment_distance(elbow, (x, z), (axis, 0.0)) < pipe_radius + params.link_clear:
            return sign * reached
        reached += step
    return sign * reached


def _segment_distance(a: tuple[float, float], b: tuple[float, float], point: tuple[float, float]) -> float:
    """Distance of a point from the segment a-b."""
    dx, dz = b[0] - a[0], b[1] - a[1]
    length2 = dx * dx + dz * dz
    t = 0.0 if length2 == 0.0 else ((point[0] - a[0]) * dx + (point[1] - a[1]) * dz) / length2
    t = min(1.0, max(0.0, t))
    return hypot(a[0] + t * dx - point[0], a[1] + t * dz - point[1])


class Path:
    """Builds legs one after the other from ``start``."""

    def __init__(self, start: Eight, params: Params) -> None:
        self.at = start
        self.legs: tuple[Leg, ...] = ()
        self._params = params

    def to(
        self,
        *,
        base: Vec3 | None = None,
        yaw: float | None = None,
        arm: tuple[float, float, float] | None = None,
        slow: bool = False,
    ) -> Path:
        """Add a rest-to-rest leg to what is given; the rest stays. ``slow`` takes the speed beside the pipe."""
        p, s = self._params, self.at
        x, y, z = base if base is not None else s[:3]
        heading = s[3] if yaw is None else s[3] + wrap_angle(yaw - s[3])
        wx, wz, elevation = arm if arm is not None else s[4:7]
        way = hypot(hypot(x - s[0], y - s[1]), z - s[2])
        time = max(
            0.5,
            duration(way, p.near_speed if slow else p.speed, p.acceleration, p.jerk),
            duration(heading - s[3], p.yaw_rate, 1.0, 2.0),
            duration(hypot(wx - s[4], wz - s[5]), p.arm_speed, 0.4, 1.5),
            duration(elevation - s[6], p.arm_turn, 3.0, 12.0),
        )
        return self.add(Leg((x, y, z, heading, wx, wz, elevation, s[7]), time))

    def add(self, leg: Leg) -> Path:
        """Add a leg as it is."""
        self.legs += (leg,)
        self.at = leg.target
        return self


def route(start: Eight, goal: Vec3, pipe: Pipe, site: Site, params: Params) -> list[Vec3]:
    """Way-points to ``goal`` that keep ``clearance`` from the pipe's axis: straight, or over the top."""
    at = (start[0], start[1], start[2])
    if _from_pipe(at, goal, pipe, site.normal) >= params.clearance:
        return [goal]
    top = max(pipe.position[2] + params.clearance + 0.1, start[2], goal[2])
    return [(start[0], start[1], top), (goal[0], goal[1], top), goal]


def _from_pipe(a: Vec3, b: Vec3, pipe: Pipe, normal: tuple[float, float]) -> float:
    """Least distance (m) of the way from a to b from the pipe's axis, sampled every few centimetres."""
    x, y, z = pipe.position
    half = 0.5 * pipe.length
    count = 1 + int(20.0 * (abs(b[0] - a[0]) + abs(b[1] - a[1]) + abs(b[2] - a[2])))
    least = inf
    for k in range(count + 1):
        u = k / count
        dx, dy, dz = a[0] + u * (b[0] - a[0]) - x, a[1] + u * (b[1] - a[1]) - y, a[2] + u * (b[2] - a[2]) - z
        beyond = max(0.0, abs(dy * normal[0] - dx * normal[1]) - half)
        least = min(least, hypot(dx * normal[0] + dy * normal[1], beyond, dz))
    return least


def beside(site: Site, distance: float) -> Vec3:
    """Base position (m, W) at ``distance`` from the crack, at the height of the work."""
    return (site.crack[0] - distance * site.normal[0], site.crack[1] - distance * site.normal[1], site.height)
