"""The rigid-body plant: coupled 9-DOF dynamics with rotors, servos, drag, battery, pipe contact and ground.

Integration is leapfrog: positions live at the middle of a step, where forces are evaluated once, with velocities
predicted there from the last acceleration. Second order for smooth motion, no energy drift in the contact springs,
one evaluation a step.
"""

from __future__ import annotations

from math import cos, floor, hypot, isfinite, pi, sin, sqrt
from typing import Annotated

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.compiled import compiled
from sim_backend.contact import SLIDE, ContactParams, GroundParams, ground_point, pipe_contact
from sim_backend.deviations import AS_MODELLED, Deviations
from sim_backend.dynamics import accelerations, lump
from sim_backend.knob import knob, switch
from sim_backend.motors import battery, lag_gain, near_surfaces, rated_voltage, rotor_drag, rotors
from sim_backend.plant import Actuation, Truth
from sim_backend.servos import joint_torque, stop_torque, tool_servos

Array = NDArray[np.float64]
Three = tuple[float, float, float]

#: Texts of the crash codes 1.., with the value that goes with each.
CRASHES = (
    "",
    "hit the ground at {:.1f} m/s",
    "turned over at {:.1f} m above the ground",
    "propeller struck the pipe, {:.3f} m from its axis",
)

StartAngle = Annotated[float, knob("rad", "joint angle that the servos hold at the start", -4.0, 4.0)]


class PlantParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How the rigid-body plant is simulated, and which parts of it are ideal."""

    step: Annotated[float, knob("s", "physics step", 1e-5, 2e-4)] = 1e-4
    ideal_motors: Annotated[bool, switch("no thrust lag, full thrust at any battery voltage")] = True
    ideal_servos: Annotated[bool, switch("no gear friction, current proportional to torque")] = True
    tool_servo_time: Annotated[float, knob("s", "time constant of the pump and gripper servos", 0.005, 1.0)] = 0.04
    friction_speed: Annotated[
        float, knob("rad/s", "joint speed below which gear friction is regularised", 1e-4, 1.0)
    ] = 0.02
    stop_stiffness: Annotated[float, knob("N m/rad", "mechanical stops of the joints", 1.0, 200.0)] = 50.0
    stop_damping: Annotated[float, knob("N m s/rad", "mechanical stops of the joints", 0.0, 5.0)] = 0.5
    motor_lag: Annotated[
        float, knob("s", "thrust lag in place of the vehicle file's; 0: as ``ideal_motors`` says", 0.0, 0.5)
    ] = 0.0
    battery_sag: Annotated[
        float, knob("1", "share of the thrust's fall with the voltage squared that no map makes up for", 0.0, 1.0)
    ] = 0.0
    rotor_constant: Annotated[float, knob("N s^2", "thrust of a rotor over its speed squared", 1e-6, 1e-3)] = 1.37e-5
    rotor_drag: Annotated[
        float, knob("N s^2/m", "drag of a rotor in its plane, over its speed and that of the air", 0.0, 1e-2)
    ] = 0.0
    ground_effect: Annotated[float, knob("1", "share of Cheeseman and Bennett's gain of thrust", 0.0, 2.0)] = 0.0
    wall_effect: Annotated[
        float, knob("1", "share of a rotor's thrust that pulls it to the pipe at one radius from it", 0.0, 0.5)
    ] = 0.0
    backlash: Annotated[float, knob("rad", "play of the joint servos' gears, end to end", 0.0, 0.1)] = 0.0
    gear_stiffness: Annotated[float, knob("N m/rad", "of the teeth where there is play", 10.0, 1e3)] = 200.0
    gear_damping: Annotated[float, knob("N m s/rad", "of the teeth where there is play", 0.0, 5.0)] = 0.3
    start_joints: tuple[StartAngle, StartAngle, StartAngle] = (-2.80, -0.35, 0.0)
    """The arm folded above the ground."""
    contact: ContactParams = ContactParams()
    ground: GroundParams = GroundParams()


@compiled()
def drift(x: Array, step: float) -> None:
    """Move positions and attitude on by ``step`` seconds at the present velocities."""
    for i in range(3):
        x[at.POSITION + i] += step * x[at.VELOCITY + i]
        x[at.JOINT + i] += step * x[at.JOINT_RATE + i]
    half = 0.5 * step
    a = half * x[at.RATE]
    b = half * x[at.RATE + 1]
    c = half * x[at.RATE + 2]
    qw = x[at.ATTITUDE]
    qx = x[at.ATTITUDE + 1]
    qy = x[at.ATTITUDE + 2]
    qz = x[at.ATTITUDE + 3]
    nw = qw - qx * a - qy * b - qz * c
    nx = qx + qw * a + qy * c - qz * b
    ny = qy + qw * b + qz * a - qx * c
    nz = qz + qw * c + qx * b - qy * a
    scale = 1.0 / sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    x[at.ATTITUDE] = nw * scale
    x[at.ATTITUDE + 1] = nx * scale
    x[at.ATTITUDE + 2] = ny * scale
    x[at.ATTITUDE + 3] = nz * scale


@compiled()
def _rotation(x: Array) -> tuple[float, float, float, float, float, float, float, float, float]:
    w = x[at.ATTITUDE]
    i = x[at.ATTITUDE + 1]
    j = x[at.ATTITUDE + 2]
    k = x[at.ATTITUDE + 3]
    return (
        1.0 - 2.0 * (j * j + k * k),
        2.0 * (i * j - w * k),
        2.0 * (i * k + w * j),
        2.0 * (i * j + w * k),
        1.0 - 2.0 * (i * i + k * k),
        2.0 * (j * k - w * i),
        2.0 * (i * k - w * j),
        2.0 * (j * k + w * i),
        1.0 - 2.0 * (i * i + j * j),
    )


@compiled()
def _kick(x: Array, p: Array, u: Array) -> None:
    """Evaluate all forces at the present positions and move the velocities on by one step."""
    step = p[at.STEP]
    half = 0.5 * step
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _rotation(x)
    vx = x[at.VELOCITY] + half * x[at.ACCELERATION]
    vy = x[at.VELOCITY + 1] + half * x[at.ACCELERATION + 1]
    vz = x[at.VELOCITY + 2] + half * x[at.ACCELERATION + 2]
    wx = x[at.RATE] + half * x[at.ACCELERATION + 3]
    wy = x[at.RATE + 1] + half * x[at.ACCELERATION + 4]
    wz = x[at.RATE + 2] + half * x[at.ACCELERATION + 5]
    r1 = x[at.JOINT_RATE] + half * x[at.ACCELERATION + 6]
    r2 = x[at.JOINT_RATE + 1] + half * x[at.ACCELERATION + 7]
    r3 = x[at.JOINT_RATE + 2] + half * x[at.ACCELERATION + 8]
    a1 = x[at.JOINT]
    a2 = x[at.JOINT + 1]
    a3 = x[at.JOINT + 2]
    c1 = cos(a1)
    s1 = sin(a1)
    c2 = cos(a2)
    s2 = sin(a2)
    c3 = cos(a3)
    s3 = sin(a3)

    # Rotors and drag.
    thrust, mx, my, mz = rotors(x, p, u)
    ax = vx - u[at.U_WIND]
    ay = vy - u[at.U_WIND + 1]
    az = vz - u[at.U_WIND + 2]
    in_plane = rotor_drag(x, p)
    fx = -(p[at.DRAG] + in_plane) * (xx * ax + yx * ay + zx * az)
    fy = -(p[at.DRAG + 1] + in_plane) * (xy * ax + yy * ay + zy * az)
    fz = thrust - p[at.DRAG + 2] * (xz * ax + yz * ay + zz * az)
    if p[at.GROUND_EFFECT] != 0.0 or p[at.WALL_EFFECT] != 0.0:
        ex, ey, ez, hx, hy, hz = near_surfaces(x, p, (xx, xy, xz, yx, yy, yz, zx, zy, zz))
        fx += ex
        fy += ey
        fz += ez
        mx += hx
        my += hy
        mz += hz

    # Servos and stops.
    tool_servos(x, p, u)
    o1 = joint_torque(x, p, u, 0, a1, r1)
    o2 = joint_torque(x, p, u, 1, a2, r2)
    o3 = joint_torque(x, p, u, 2, a3, r3)
    x[at.JOINT_TORQUE] = o1
    x[at.JOINT_TORQUE + 1] = o2
    x[at.JOINT_TORQUE + 2] = o3
    t1 = o1 + stop_torque(p, 0, a1, r1)
    t2 = o2 + stop_torque(p, 1, a2, r2)
    t3 = o3 + stop_torque(p, 2, a3, r3)

    # The sleeve on the pipe.
    l1 = p[at.LINK_1]
    l2 = p[at.LINK_2]
    l3 = p[at.TOOL]
    bx = p[at.MOUNT] + l1 * c1 + l2 * c2 + l3 * c3
    by = p[at.MOUNT + 1]
    bz = p[at.MOUNT + 2] + l1 * s1 + l2 * s2 + l3 * s3
    tx = x[at.POSITION] + xx * bx + xy * by + xz * bz
    ty = x[at.POSITION + 1] + yx * bx + yy * by + yz * bz
    tz = x[at.POSITION + 2] + zx * bx + zy * by + zz * bz
    ux = wy * bz - wz * by - (l1 * s1 * r1 + l2 * s2 * r2 + l3 * s3 * r3)
    uy = wz * bx - wx * bz
    uz = wx * by - wy * bx + l1 * c1 * r1 + l2 * c2 * r2 + l3 * c3 * r3
    px, py, pz = pipe_contact(
        x,
        p,
        (tx, ty, tz),
        (vx + xx * ux + xy * uy + xz * uz, vy + yx * ux + yy * uy + yz * uz, vz + zx * ux + zy * uy + zz * uz),
    )
    x[at.CONTACT_VECTOR] = px
    x[at.CONTACT_VECTOR + 1] = py
    x[at.CONTACT_VECTOR + 2] = pz
    if x[at.CONTACT_FORCE] > 0.0:
        ex = xx * px + yx * py + zx * pz
        ey = xy * px + yy * py + zy * pz
        ez = xz * px + yz * py + zz * pz
        fx += ex
        fy += ey
        fz += ez
        mx += by * ez - bz * ey
        my += bz * ex - bx * ez
        mz += bx * ey - by * ex
        t1 += l1 * (c1 * ez - s1 * ex)
        t2 += l2 * (c2 * ez - s2 * ex)
        t3 += l3 * (c3 * ez - s3 * ex)
    if x[at.PAYLOAD] != 0.0 and x[at.GRIPPER] > p[at.RELEASE_ANGLE]:
        x[at.PAYLOAD] = 0.0
        x[at.SLEEVE_ON_PIPE] = 1.0 if x[at.CONTACT_FORCE] > 0.0 else 0.0

    # The ground under skids, rotor hubs and arm.
    x[at.ON_GROUND] = 0.0
    if x[at.POSITION + 2] < p[at.GROUND_REACH]:
        for i in range(at.GROUND_POINTS):
            d1 = 0.0
            d2 = 0.0
            d3 = 0.0
            e3 = 0.0
            if i < 8:
                left = 1.0 if i & 1 else -1.0
                front = 1.0 if i & 2 else -1.0
                reach_x = p[at.GEAR_SPAN] if i < 4 else p[at.ROTOR_X]
                reach_y = p[at.GEAR_SPAN] if i < 4 else p[at.ROTOR_Y]
                bx = front * reach_x
                by = left * reach_y
                bz = -p[at.GEAR_HEIGHT] if i < 4 else 0.0
            else:
                d1 = l1
                d2 = l2 if i > 8 else 0.0
                d3 = l3 if i == 10 else 0.0
                e3 = p[at.NEEDLE] if i == 11 else 0.0
                bx = p[at.MOUNT] + d1 * c1 + d2 * c2 + d3 * c3 - e3 * s3
                by = p[at.MOUNT + 1]
                bz = p[at.MOUNT + 2] + d1 * s1 + d2 * s2 + d3 * s3 + e3 * c3
            height = x[at.POSITION + 2] + zx * bx + zy * by + zz * bz
            ux = wy * bz - wz * by - (d1 * s1 * r1 + d2 * s2 * r2 + (d3 * s3 + e3 * c3) * r3)
            uy = wz * bx - wx * bz
            uz = wx * by - wy * bx + d1 * c1 * r1 + d2 * c2 * r2 + (d3 * c3 - e3 * s3) * r3
            gx, gy, gz = ground_point(
                x,
                p,
                i,
                height,
                (vx + xx * ux + xy * uy + xz * uz, vy + yx * ux + yy * uy + yz * uz, vz + zx * ux + zy * uy + zz * uz),
            )
            if gz > 0.0:
                x[at.ON_GROUND] = 1.0
                ex = xx * gx + yx * gy + zx * gz
                ey = xy * gx + yy * gy + zy * gz
                ez = xz * gx + yz * gy + zz * gz
                fx += ex
                fy += ey
                fz += ez
                mx += by * ez - bz * ey
                my += bz * ex - bx * ez
                mz += bx * ey - by * ex
                t1 += d1 * (c1 * ez - s1 * ex)
                t2 += d2 * (c2 * ez - s2 * ex)
                t3 += d3 * (c3 * ez - s3 * ex) - e3 * (s3 * ez + c3 * ex)

    lumped = at.LUMPED + at.LUMPED_SIZE if x[at.PAYLOAD] != 0.0 else at.LUMPED
    sx, sy, sz, n1, n2, n3, n4, n5, n6 = accelerations(
        p, lumped, c1, s1, c2, s2, c3, s3, wx, wy, wz, r1, r2, r3, (fx, fy, fz), (mx, my, mz), (t1, t2, t3)
    )
    x[at.SPECIFIC_FORCE_SUM] += sx
    x[at.SPECIFIC_FORCE_SUM + 1] += sy
    x[at.SPECIFIC_FORCE_SUM + 2] += sz
    x[at.ACCELERATION] = xx * sx + xy * sy + xz * sz
    x[at.ACCELERATION + 1] = yx * sx + yy * sy + yz * sz
    x[at.ACCELERATION + 2] = zx * sx + zy * sy + zz * sz - p[at.GRAVITY]
    x[at.ACCELERATION + 3] = n1
    x[at.ACCELERATION + 4] = n2
    x[at.ACCELERATION + 5] = n3
    x[at.ACCELERATION + 6] = n4
    x[at.ACCELERATION + 7] = n5
    x[at.ACCELERATION + 8] = n6
    for i in range(3):
        x[at.VELOCITY + i] += step * x[at.ACCELERATION + i]
        x[at.RATE + i] += step * x[at.ACCELERATION + 3 + i]
        x[at.JOINT_RATE + i] += step * x[at.ACCELERATION + 6 + i]


@compiled()
def _tips(x: Array, p: Array) -> None:
    """Write the tips of both tools to ``x``."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _rotation(x)
    c3 = cos(x[at.JOINT + 2])
    s3 = sin(x[at.JOINT + 2])
    wrist_x = p[at.MOUNT] + p[at.LINK_1] * cos(x[at.JOINT]) + p[at.LINK_2] * cos(x[at.JOINT + 1])
    wrist_z = p[at.MOUNT + 2] + p[at.LINK_1] * sin(x[at.JOINT]) + p[at.LINK_2] * sin(x[at.JOINT + 1])
    by = p[at.MOUNT + 1]
    for tool in range(2):
        length = p[at.TOOL] if tool == 0 else p[at.NEEDLE]
        bx = wrist_x + length * (c3 if tool == 0 else -s3)
        bz = wrist_z + length * (s3 if tool == 0 else c3)
        row = at.TIP if tool == 0 else at.NEEDLE_TIP
        x[row] = x[at.POSITION] + xx * bx + xy * by + xz * bz
        x[row + 1] = x[at.POSITION + 1] + yx * bx + yy * by + yz * bz
        x[row + 2] = x[at.POSITION + 2] + zx * bx + zy * by + zz * bz


@compiled()
def _watch(x: Array, p: Array) -> None:
    """Set the crash code when the vehicle has turned over or a propeller reaches into the pipe."""
    if x[at.CRASH] != 0.0:
        return
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _rotation(x)
    if zz < 0.0:
        x[at.CRASH] = 2.0
        x[at.CRASH_VALUE] = x[at.POSITION + 2]
        return
    nx = p[at.PIPE_NORMAL]
    ny = p[at.PIPE_NORMAL + 1]
    # In the pipe's cross-section: from the axis to the hub (ahead, up), and the disc's normal.
    tilt_a = xz * nx + yz * ny
    tilt_s = yz * nx - xz * ny
    for i in range(4):
        bx = p[at.ROTOR_X] if i & 1 else -p[at.ROTOR_X]
        by = p[at.ROTOR_Y] if i & 2 else -p[at.ROTOR_Y]
        dx = x[at.POSITION] + xx * bx + xy * by - p[at.PIPE_POINT]
        dy = x[at.POSITION + 1] + yx * bx + yy * by - p[at.PIPE_POINT + 1]
        up = x[at.POSITION + 2] + zx * bx + zy * by - p[at.PIPE_POINT + 2]
        ahead = dx * nx + dy * ny
        away = hypot(ahead, up)
        beside = abs(dy * nx - dx * ny) - p[at.PIPE_HALF_LENGTH]
        if away > p[at.PIPE_RADIUS] + p[at.ROTOR_RADIUS] or beside > p[at.ROTOR_RADIUS]:
            continue
        # The point of the disc nearest to the axis: from the hub along the way to the axis, laid into the disc.
        lean = -(ahead * tilt_a + up * zz)
        ga = -ahead - lean * tilt_a
        gs = -lean * tilt_s
        gu = -up - lean * zz
        length = sqrt(ga * ga + gs * gs + gu * gu)
        share = 0.0 if length == 0.0 else min(1.0, p[at.ROTOR_RADIUS] / length)
        near = hypot(ahead + share * ga, up + share * gu)
        if near < p[at.PIPE_RADIUS]:
            x[at.CRASH] = 3.0
            x[at.CRASH_VALUE] = near
            return


@compiled()
def physics(x: Array, p: Array, u: Array, steps: int) -> None:
    """Advance the world by ``steps`` physics steps under the constant drive ``u``."""
    step = p[at.STEP]
    drift(x, 0.5 * step)
    for i in range(steps):
        battery(x, p, step)
        _kick(x, p, u)
        drift(x, step if i + 1 < steps else 0.5 * step)
    _tips(x, p)
    _watch(x, p)


@compiled("(f8[::1], f8[::1], f8[::1], i8)")
def advance(x: Array, p: Array, u: Array, steps: int) -> None:
    """``physics`` as a call of its own: the figures that are kept per advance begin anew."""
    x[at.CONTACT_PEAK] = 0.0
    for i in range(3):
        x[at.SPECIFIC_FORCE_SUM + i] = 0.0
    physics(x, p, u, steps)


def constants(
    vehicle: Vehicle,
    params: PlantParams,
    pipe_position: Vec3,
    pipe_heading: float,
    pipe_radius: float,
    pipe_length: float,
    truth: Deviations = AS_MODELLED,
) -> Array:
    """Array ``p`` for a vehicle and a pipe (without the autopilot's gains), both off by ``truth``."""
    p = np.zeros(at.CONSTANTS_SIZE)
    centre, vehicle = truth.base_centre(vehicle), truth.vehicle(vehicle)
    pipe_position, pipe_heading = truth.pipe_pose(pipe_position, pipe_heading)
    base, rotor, arm, servo, cell = vehicle.base, vehicle.rotors, vehicle.arm, vehicle.servo, vehicle.battery
    contact, ground, step = params.contact, params.ground, params.step

    def put(index: int, *values: float) -> None:
        p[index : index + len(values)] = values

    put(at.STEP, step, vehicle.gravity, *base.drag, *arm.mount, arm.link_1, arm.link_2, arm.gripper, arm.needle)
    put(at.JOINT_MIN, *arm.joint_min, *arm.joint_max, params.stop_stiffness, params.stop_damping)
    put(at.ROTOR_X, rotor.arm_x, rotor.arm_y, rotor.max_thrust, rotor.torque_per_thrust)
    lag = params.motor_lag or (0.0 if params.ideal_motors else rotor.time_constant)
    put(at.ROTOR_GAIN, lag_gain(step, lag), rotor.radius)
    put(at.ROTOR_SCALE, truth.thrust, params.battery_sag, cell.full_voltage - cell.resistance * cell.hover_current)
    put(at.SPIN, 1.0 / sqrt(params.rotor_constant), params.rotor_drag, params.ground_effect, params.wall_effect)
    put(at.STALL_TORQUE, servo.stall_torque, servo.stall_current, servo.no_load_speed)
    put(at.FRICTION_STATIC, servo.friction_static, servo.friction_viscous, params.friction_speed)
    put(at.SERVO_STIFFNESS, servo.stiffness, servo.damping, float(params.ideal_servos))
    put(at.BACKLASH, 0.5 * params.backlash, params.gear_stiffness, params.gear_damping, servo.rotor_inertia)
    put(at.TOOL_SERVO_GAIN, lag_gain(step, params.tool_servo_time))
    put(at.PIPE_POINT, *pipe_position, cos(pipe_heading), sin(pipe_heading), pipe_radius)
    put(at.PIPE_HALF_LENGTH, 0.5 * pipe_length)
    put(at.CONTACT_STIFFNESS, contact.stiffness, contact.damping)
    put(at.CONTACT_TANGENTIAL_STIFFNESS, contact.tangential_stiffness, contact.tangential_damping)
    put(at.CONTACT_STATIC, contact.friction_static, contact.friction_kinetic, contact.release_angle)
    put(at.UNEVENNESS, contact.unevenness)
    for i, (way, number, phase) in enumerate(truth.waves):
        size = 2.0 * pi * number / contact.patch
        put(at.WAVE + 3 * i, size * cos(way), size * sin(way), phase)
    put(at.GROUND_STIFFNESS, ground.stiffness, ground.damping)
    put(at.GROUND_TANGENTIAL_STIFFNESS, ground.tangential_stiffness, ground.tangential_damping)
    put(at.GROUND_STATIC, ground.friction_static, ground.friction_kinetic, ground.crash_speed)
    reach = hypot(*arm.mount) + arm.link_1 + arm.link_2 + max(arm.gripper, arm.needle)
    frame = max(hypot(base.gear_height, base.gear_span, base.gear_span), hypot(rotor.arm_x, rotor.arm_y))
    put(at.GROUND_REACH, max(reach, frame), base.gear_height, base.gear_span)
    put(at.BATTERY_FULL, cell.full_voltage, cell.empty_voltage, cell.resistance, 3600.0 * cell.capacity)
    parts = (arm.parts, (*arm.parts, arm.sleeve))
    mass = base.mass + sum(part.mass for part in parts[1])
    put(at.HOVER_CURRENT, cell.hover_current, mass * vehicle.gravity)
    put(at.RATED_VOLTAGE, 0.0 if params.ideal_motors else rated_voltage(cell))
    # With play in the gears the rotors are a side of their own (servos.py) and weigh on no joint.
    rotor_inertia = 0.0 if params.backlash else servo.rotor_inertia
    for i in range(2):
        put(at.LUMPED + i * at.LUMPED_SIZE, *lump(vehicle, parts[i], rotor_inertia, centre))
    return p


class RigidBody:
    """The vehicle and one horizontal pipe; a ``Plant``.

    It starts standing at the origin of W, at rest, arm folded and held by its servos, sleeve in the gripper.
    ``pipe_position`` (m, W) is the middle of the pipe's axis, ``pipe_heading`` (rad) the horizontal direction in
    which the vehicle presses, to which the axis is square; ``pipe_radius`` and ``pipe_length`` in m. Vehicle and pipe
    are those of the model; they really are off by ``truth``. ``x``, ``p`` and ``u`` are the arrays of ``layout``.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        params: PlantParams,
        pipe_position: Vec3,
        pipe_heading: float,
        pipe_radius: float,
        pipe_length: float = 2.0,
        truth: Deviations = AS_MODELLED,
    ) -> None:
        self.vehicle = vehicle
        self.params = params
        self.p = constants(vehicle, params, pipe_position, pipe_heading, pipe_radius, pipe_length, truth)
        self.x = np.zeros(at.STATE_SIZE)
        self.u = np.zeros(at.DRIVE_SIZE)
        self.steps = 0
        self.last_steps = 0
        self._start()

    def _start(self) -> None:
        """Stand at rest: settle on the skids with stiff joints, then set the clock to zero."""
        x, u = self.x, self.u
        x[at.POSITION + 2] = self.vehicle.base.gear_height
        x[at.ATTITUDE] = 1.0
        x[at.JOINT : at.JOINT + 3] = self.params.start_joints
        x[at.CHARGE] = 1.0
        x[at.PAYLOAD] = 1.0
        u[at.U_GOAL : at.U_GOAL + 3] = self.params.start_joints
        u[at.U_POSITION_MODE] = 1.0
        u[at.U_TORQUE_ON] = 1.0
        u[at.U_CURRENT_LIMIT] = self.vehicle.servo.stall_current
        advance(x, self.p, u, round(SETTLING_TIME / self.params.step))
        x[at.POSITION : at.POSITION + 2] = 0.0
        x[at.CHARGE] = 1.0
        x[at.TIP_SLIP] = 0.0
        self.last_steps = round(SETTLING_TIME / self.params.step)

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.steps * self.params.step

    def steps_of(self, duration: float) -> int:
        """Number of physics steps in ``duration`` seconds; ValueError when it is not a whole number of them."""
        steps = duration / self.params.step
        whole = floor(steps + 0.5)
        if whole < 1 or abs(steps - whole) > 1e-6 * whole:
            raise ValueError(f"duration {duration} s is not a whole number of physics steps of {self.params.step} s")
        return whole

    def advance(self, actuation: Actuation, duration: float) -> None:
        """Advance by ``duration`` seconds, a whole number of physics steps, under a constant actuation."""
        steps = self.steps_of(duration)
        u = self.u
        u[at.U_ROTOR : at.U_ROTOR + 4] = actuation.rotor_thrust
        u[at.U_TORQUE : at.U_TORQUE + 3] = actuation.joint_torque
        u[at.U_POSITION_MODE] = actuation.position_mode
        u[at.U_GOAL : at.U_GOAL + 5] = actuation.goal
        u[at.U_CURRENT_LIMIT] = actuation.current_limit
        u[at.U_TORQUE_ON] = actuation.torque_on
        advance(self.x, self.p, u, steps)
        self.count(steps)

    def count(self, steps: int) -> None:
        """Note that a kernel has advanced ``x`` by so many steps; FloatingPointError when the state is not finite."""
        if not isfinite(self.x[at.POSITION] + self.x[at.JOINT]):
            raise FloatingPointError(f"the world's state is not finite any more at {self.time:.4f} s")
        self.steps += steps
        self.last_steps = steps

    def truth(self) -> Truth:
        """What is true now."""
        return truth_of(self.x.tolist(), self.time, self.last_steps)


#: Time the vehicle is given to settle on its skids before the start, s.
SETTLING_TIME = 3.0


def truth_of(x: list[float], t: float, steps: int) -> Truth:
    """Truth from the state ``x`` at ``t`` seconds, ``steps`` being the length of the last advance."""
    share = 1.0 / steps

    def three(index: int) -> Vec3:
        return (x[index], x[index + 1], x[index + 2])

    def four(index: int) -> tuple[float, float, float, float]:
        return (x[index], x[index + 1], x[index + 2], x[index + 3])

    specific = three(at.SPECIFIC_FORCE_SUM)
    return Truth(
        t=t,
        p_WB=three(at.POSITION),
        v_WB=three(at.VELOCITY),
        q_WB=four(at.ATTITUDE),
        w_WB_B=three(at.RATE),
        f_B=(specific[0] * share, specific[1] * share, specific[2] * share),
        joints=three(at.JOINT),
        joint_rates=three(at.JOINT_RATE),
        joint_torque=three(at.JOINT_TORQUE),
        servo_current=three(at.SERVO_CURRENT),
        pump=x[at.PUMP],
        gripper=x[at.GRIPPER],
        rotor_thrust=four(at.ROTOR),
        tip_W=three(at.TIP),
        needle_W=three(at.NEEDLE_TIP),
        contact_force=x[at.CONTACT_FORCE],
        contact_peak=x[at.CONTACT_PEAK],
        contact_W=three(at.CONTACT_VECTOR),
        tip_slip=x[at.TIP_SLIP],
        sliding=x[at.CONTACT_MODE] == SLIDE,
        sleeve_on_pipe=x[at.SLEEVE_ON_PIPE] != 0.0,
        on_ground=x[at.ON_GROUND] != 0.0,
        battery_voltage=x[at.VOLTAGE],
        battery_remaining=x[at.CHARGE],
        crashed=CRASHES[int(x[at.CRASH])].format(x[at.CRASH_VALUE]),
        payload=x[at.PAYLOAD] != 0.0,
    )
