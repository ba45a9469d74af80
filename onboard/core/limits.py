"""The last gate before the actuators. It distrusts the controller: what leaves is finite, permitted, bounded and
rate-limited, whatever came in.

- Finite: a command with a value that is not finite is replaced by the last good one, for ``hold_ticks`` ticks; then
  the autopilot is asked to land by itself, and stays so until it is asked to idle. Joints keep their last goals.
- Permitted: set-points only where motors are allowed, joints only where joints are; KILL, LAND and IDLE always pass,
  without thrust.
- Bounded and rate-limited: the fields that the interface and the joint mode use. Where a bound and a rate collide,
  the bound wins. Limits and rates are taken up from what was sent last; at a take-over, from what is measured.

Commands that need no change leave as the same objects.
"""

from __future__ import annotations

from math import acos, cos, hypot, pi, sin, sqrt
from typing import Annotated, Final

from msgspec import Struct
from msgspec.structs import replace

from drivers.samples import AutopilotCommand, Engage, Five, Interface, JointMode, Quat, ServoCommand, Vec3
from drivers.vehicle import Vehicle
from onboard.core.spec import spec


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """How much of what the vehicle can do is used."""

    hold_ticks: Annotated[int, spec("1", 0, 100, "ticks that the last good command stands in for a bad one")] = 10
    thrust_max: Annotated[float, spec("1", 0.3, 1.0, "largest thrust, share of all rotors' largest")] = 0.9
    thrust_floor: Annotated[float, spec("1", 0.0, 0.8, "least thrust in flight, share of the weight")] = 0.3
    thrust_rate: Annotated[float, spec("N/s", 1.0, 5000.0, "change of thrust")] = 400.0
    torque: tuple[
        Annotated[float, spec("N m", 0.01, 10.0, "body torque about x")],
        Annotated[float, spec("N m", 0.01, 10.0, "body torque about y")],
        Annotated[float, spec("N m", 0.01, 10.0, "body torque about z")],
    ] = (2.0, 2.0, 0.4)
    tilt: Annotated[float, spec("rad", 0.05, 1.0, "tilt of the attitude set-point")] = 0.50
    attitude_rate: Annotated[float, spec("rad/s", 0.1, 50.0, "change of the attitude set-point")] = 6.0
    body_rate: tuple[
        Annotated[float, spec("rad/s", 0.1, 20.0, "body rate about x")],
        Annotated[float, spec("rad/s", 0.1, 20.0, "body rate about y")],
        Annotated[float, spec("rad/s", 0.1, 20.0, "body rate about z")],
    ] = (4.0, 4.0, 2.0)
    joint_torque: Annotated[float, spec("1", 0.05, 1.0, "joint torque, share of the servo's stall torque")] = 1.0
    joint_rate: Annotated[float, spec("rad/s", 0.1, 20.0, "change of a joint's goal position")] = 4.0
    joint_current: Annotated[float, spec("1", 0.05, 1.0, "current limit, share of the servo's stall current")] = 0.9
    pump: tuple[
        Annotated[float, spec("rad", -1000.0, 1000.0, "least pump angle")],
        Annotated[float, spec("rad", -1000.0, 1000.0, "largest pump angle")],
    ] = (-200.0, 200.0)
    gripper: tuple[
        Annotated[float, spec("rad", -6.3, 6.3, "least gripper angle")],
        Annotated[float, spec("rad", -6.3, 6.3, "largest gripper angle")],
    ] = (-3.15, 3.15)
    tool_rate: Annotated[float, spec("rad/s", 0.1, 20.0, "change of the pump's and the gripper's goal")] = 8.0


class Bounds(Struct, frozen=True, gc=False):
    """Params and vehicle in the units of the commands."""

    hold_ticks: int
    thrust_max: float
    thrust_floor: float
    thrust_rate: float
    torque: Vec3
    tilt: float
    cos_tilt: float
    attitude_rate: float
    body_rate: Vec3
    joint_torque: float
    current: float
    low: Five
    high: Five
    rate: Five
    """Least and largest goal positions of the five servos, rad, and their rates, rad/s."""


def bounds(vehicle: Vehicle, params: Params) -> Bounds:
    """The bounds of one vehicle."""
    arm, servo = vehicle.arm, vehicle.servo
    mass = vehicle.base.mass + sum(part.mass for part in arm.parts) + arm.sleeve.mass
    joint, tool = params.joint_rate, params.tool_rate
    return Bounds(
        hold_ticks=params.hold_ticks,
        thrust_max=4.0 * vehicle.rotors.max_thrust * params.thrust_max,
        thrust_floor=mass * vehicle.gravity * params.thrust_floor,
        thrust_rate=params.thrust_rate,
        torque=params.torque,
        tilt=params.tilt,
        cos_tilt=cos(params.tilt),
        attitude_rate=params.attitude_rate,
        body_rate=params.body_rate,
        joint_torque=servo.stall_torque * params.joint_torque,
        current=servo.stall_current * params.joint_current,
        low=(*arm.joint_min, params.pump[0], params.gripper[0]),
        high=(*arm.joint_max, params.pump[1], params.gripper[1]),
        rate=(joint, joint, joint, tool, tool),
    )


class Permission(Struct, frozen=True, gc=False):
    """What the mission allows."""

    motors: bool
    """Set-points may be followed."""
    joints: bool
    """Servos may have torque."""
    floor: bool
    """In flight, away from the ground: the thrust floor holds."""


class Measured(Struct, frozen=True, gc=False):
    """Where the vehicle is; None when not known."""

    q_WB: Quat | None
    servos: Five | None
    """Servo positions, rad."""


class State(Struct, frozen=True, gc=False):
    """What was sent last, and how long the commands have been bad."""

    autopilot: AutopilotCommand | None = None
    servos: ServoCommand | None = None
    bad_ticks: int = 0
    landing: bool = False
    """The gate has taken the autopilot out of offboard."""


Clips = tuple[str, ...]
_LEVEL: Final[Quat] = (1.0, 0.0, 0.0, 0.0)
_ZERO: Final[Vec3] = (0.0, 0.0, 0.0)
_SLACK: Final = 1e-9
"""Relative slack of the comparisons, so that what the gate itself has clipped passes unchanged."""


def step(
    state: State,
    autopilot: AutopilotCommand,
    servos: ServoCommand,
    permission: Permission,
    measured: Measured,
    bounds: Bounds,
    dt: float,
) -> tuple[State, AutopilotCommand, ServoCommand, Clips]:
    """One tick: the commands that may leave, and the names of the limits that changed them.

    dt: time that the rates are applied to, s; one that is not a positive number allows no change, and none counts
    as more than a second.
    """
    dt = min(1.0, dt) if dt > 0.0 else 0.0
    bad_ticks, landing = 0, state.landing
    clips: Clips = ()
    if _finite_autopilot(autopilot):
        if autopilot.engage is Engage.IDLE:
            landing = False
    else:
        autopilot, bad_ticks, landing = _instead(state, autopilot, bounds)
        clips = ("non_finite",)
    if landing and autopilot.engage is Engage.OFFBOARD:
        autopilot, clips = _neutral(autopilot, Engage.LAND), (*clips, "non_finite_land")
    if autopilot.engage is not Engage.OFFBOARD:
        if autopilot.thrust != 0.0 or autopilot.torque_B != _ZERO or autopilot.w_WB_B != _ZERO:
            autopilot, clips = _neutral(autopilot, autopilot.engage), (*clips, "not_engaged")
    elif not permission.motors:
        autopilot, clips = _neutral(autopilot, Engage.IDLE), (*clips, "motors_not_permitted")
    else:
        autopilot, clips = _bounded(state.autopilot, autopilot, permission, measured, bounds, dt, clips)
    servos, clips = _joints(state.servos, servos, permission, measured, bounds, dt, clips)
    return State(autopilot, servos, bad_ticks, landing), autopilot, servos, clips


# --- autopilot --------------------------------------------------------------------------------------------------------


def _finite_autopilot(c: AutopilotCommand) -> bool:
    # A sum is NaN or infinite when any of its terms is; x - x is 0 only for a finite x.
    (a, b, d), (w, x, y, z), (e, f, g) = c.torque_B, c.q_WB, c.w_WB_B
    total = c.thrust + a + b + d + w + x + y + z + e + f + g
    return total - total == 0.0


def _instead(state: State, bad: AutopilotCommand, bounds: Bounds) -> tuple[AutopilotCommand, int, bool]:
    """What is sent for a command that is not finite, the number of such in a row, and whether to land."""
    if bad.engage is not Engage.OFFBOARD:
        return _neutral(bad, bad.engage), 0, state.landing and bad.engage is not Engage.IDLE
    ticks, last = state.bad_ticks + 1, state.autopilot
    if ticks > bounds.hold_ticks:
        return _neutral(bad, Engage.OFFBOARD), ticks, True
    if last is None or last.engage is not Engage.OFFBOARD:
        return _neutral(bad, Engage.IDLE), ticks, state.landing
    return last, ticks, state.landing


def _neutral(command: AutopilotCommand, engage: Engage) -> AutopilotCommand:
    return AutopilotCommand(engage, command.interface, 0.0, _ZERO, _LEVEL, _ZERO)


def _bounded(
    last: AutopilotCommand | None,
    command: AutopilotCommand,
    permission: Permission,
    measured: Measured,
    bounds: Bounds,
    dt: float,
    clips: Clips,
) -> tuple[AutopilotCommand, Clips]:
    """An engaged, permitted, finite command inside the bounds."""
    before = clips
    taking_over = last is None or last.engage is not Engage.OFFBOARD
    thrust = command.thrust
    if not taking_over or not permission.floor:
        # On the ground the motors start from rest; at a take-over in the air the thrust at work is not known.
        start = 0.0 if last is None else last.thrust
        slewed = _near(thrust, start, bounds.thrust_rate * dt)
        if slewed != thrust:
            thrust, clips = slewed, (*clips, "thrust_rate")
    floor = bounds.thrust_floor if permission.floor else 0.0
    if thrust < floor:
        thrust, clips = floor, (*clips, "thrust_floor")
    if thrust > bounds.thrust_max:
        thrust, clips = bounds.thrust_max, (*clips, "thrust_max")

    torque, q, rate = command.torque_B, command.q_WB, command.w_WB_B
    if command.interface is Interface.WRENCH:
        torque = _within(torque, bounds.torque)
        if torque is not command.torque_B:
            clips = (*clips, "torque")
    elif command.interface is Interface.BODY_RATE:
        rate = _within(rate, bounds.body_rate)
        if rate is not command.w_WB_B:
            clips = (*clips, "body_rate")
    else:
        start_q = _known(measured.q_WB) if last is None or taking_over else last.q_WB
        q, clips = _attitude(start_q, q, bounds, dt, clips)
    if clips is before:
        return command, clips
    return AutopilotCommand(command.engage, command.interface, thrust, torque, q, rate), clips


def _near(value: float, start: float, reach: float) -> float:
    """``value``, no farther than ``reach`` from ``start``."""
    if value > start + reach * (1.0 + _SLACK):
        return start + reach
    if value < start - reach * (1.0 + _SLACK):
        return start - reach
    return value


def _within(value: Vec3, bound: Vec3) -> Vec3:
    """``value`` with each element in +-bound; the same object when it was."""
    (x, y, z), (bx, by, bz) = value, bound
    if -bx <= x <= bx and -by <= y <= by and -bz <= z <= bz:
        return value
    return (min(bx, max(-bx, x)), min(by, max(-by, y)), min(bz, max(-bz, z)))


def _known(q: Quat | None) -> Quat | None:
    """A measured attitude, if it is one."""
    if q is None:
        return None
    w, x, y, z = q
    return q if 0.99 < w * w + x * x + y * y + z * z < 1.01 else None


def _attitude(start: Quat | None, q: Quat, bounds: Bounds, dt: float, clips: Clips) -> tuple[Quat, Clips]:
    w, x, y, z = q
    norm2 = w * w + x * x + y * y + z * z
    if not 1.0 - 1e-6 < norm2 < 1.0 + 1e-6:
        clips = (*clips, "attitude_norm")
        norm = sqrt(norm2)
        # What has no direction, or overflows, is no attitude.
        q = (w / norm, x / norm, y / norm, z / norm) if 1e-6 < norm < 1e6 else start or _LEVEL
    upright = _upright(q, bounds)
    if upright is not q:
        clips = (*clips, "tilt")
    if start is not None:
        slewed = _turned(start, upright, bounds.attitude_rate * dt)
        if slewed is not upright:
            clips = (*clips, "attitude_rate")
            upright = _upright(slewed, bounds)
    return upright, clips


def _upright(q: Quat, bounds: Bounds) -> Quat:
    """``q`` turned back about a horizontal axis to the largest tilt; the same object when within it."""
    w, x, y, z = q
    up = 1.0 - 2.0 * (x * x + y * y)
    if up >= bounds.cos_tilt - _SLACK:
        return q
    ax, ay = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)  # z of B in W, horizontal part
    across = hypot(ax, ay)
    nx, ny = (-ay / across, ax / across) if across > 1e-9 else (1.0, 0.0)
    half = 0.5 * (bounds.tilt - acos(max(-1.0, up)))
    c, s = cos(half), sin(half)
    nx, ny = s * nx, s * ny
    return (c * w - nx * x - ny * y, c * x + nx * w + ny * z, c * y + ny * w - nx * z, c * z + nx * y - ny * x)


def _turned(start: Quat, q: Quat, angle: float) -> Quat:
    """From ``start`` towards ``q`` by at most ``angle`` (rad); the same object when it is no farther."""
    if angle >= pi:
        return q
    w, x, y, z = start
    a, b, c, d = q
    dot = w * a + x * b + y * c + z * d
    if abs(dot) >= cos(0.5 * angle) - _SLACK:
        return q
    sign = 1.0 if dot >= 0.0 else -1.0
    # The relative rotation start^-1 q has the vector part v; its direction is the axis in B.
    vx = sign * (w * b - x * a - y * d + z * c)
    vy = sign * (w * c - y * a - z * b + x * d)
    vz = sign * (w * d - z * a - x * c + y * b)
    k, s = cos(0.5 * angle), sin(0.5 * angle) / sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = s * vx, s * vy, s * vz
    return (
        w * k - x * vx - y * vy - z * vz,
        w * vx + x * k + y * vz - z * vy,
        w * vy + y * k + z * vx - x * vz,
        w * vz + z * k + x * vy - y * vx,
    )


# --- servos -----------------------------------------------------------------------------------------------------------


def _joints(
    last: ServoCommand | None,
    command: ServoCommand,
    permission: Permission,
    measured: Measured,
    bounds: Bounds,
    dt: float,
    clips: Clips,
) -> tuple[ServoCommand, Clips]:
    (t1, t2, t3), (p1, p2, p3, p4, p5) = command.torque, command.position
    total = t1 + t2 + t3 + p1 + p2 + p3 + p4 + p5 + command.current_limit
    if total - total != 0.0:
        clips = (*clips, "servos_non_finite")
        command = last or ServoCommand(JointMode.OFF, _ZERO, (0.0, 0.0, 0.0, 0.0, 0.0), 0.0)
    if command.mode is JointMode.OFF:
        return command, clips
    if not permission.joints:
        return replace(command, mode=JointMode.OFF, torque=_ZERO), (*clips, "joints_not_permitted")

    before = clips
    torque, position, current = command.torque, list(command.position), command.current_limit
    if command.mode is JointMode.TORQUE:
        first = 3
        torque, clips = _joint_torque(torque, measured.servos, bounds, clips)
    else:
        first = 0
        if not 0.0 <= current <= bounds.current:
            current, clips = min(bounds.current, max(0.0, current)), (*clips, "joint_current")
    slewed = limited = False
    for i in range(first, 5):
        goal = position[i]
        # A joint starts where it is when it was not position-controlled before.
        held = last is not None and last.mode is not JointMode.OFF and (i >= 3 or last.mode is JointMode.POSITION)
        start = last.position[i] if held and last is not None else measured.servos[i] if measured.servos else goal
        near = _near(goal, start, bounds.rate[i] * dt)
        inside = min(bounds.high[i], max(bounds.low[i], near))
        slewed, limited = slewed or near != goal, limited or inside != near
        position[i] = inside
    if slewed:
        clips = (*clips, "joint_rate")
    if limited:
        clips = (*clips, "joint_position")
    if clips is before:
        return command, clips
    p1, p2, p3, p4, p5 = position
    return ServoCommand(command.mode, torque, (p1, p2, p3, p4, p5), current), clips


def _joint_torque(torque: Vec3, at: Five | None, bounds: Bounds, clips: Clips) -> tuple[Vec3, Clips]:
    """Joint torques within the servo's, and none that pushes a joint farther out of its range."""
    m = bounds.joint_torque
    inside = _within(torque, (m, m, m))
    if inside is not torque:
        clips = (*clips, "joint_torque")
    if at is not None:
        outward = tuple(
            0.0 if (at[i] >= bounds.high[i] and t > 0.0) or (at[i] <= bounds.low[i] and t < 0.0) else t
            for i, t in enumerate(inside)
        )
        if outward != inside:
            return (outward[0], outward[1], outward[2]), (*clips, "joint_stop")
    return inside, clips
