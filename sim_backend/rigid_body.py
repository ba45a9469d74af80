"""The rigid-body plant: coupled 9-DOF dynamics with rotors, servos, drag, battery, pipe contact and ground.

Integration is leapfrog: positions live at the middle of a step, where forces are evaluated once, with velocities
predicted there from the last acceleration. Second order for smooth motion, no energy drift in the contact springs,
one evaluation a step.
"""

from __future__ import annotations

from math import cos, hypot, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.airframe import airframe
from sim_backend.array_plant import ArrayPlant, PlantParams
from sim_backend.compiled import compiled
from sim_backend.contact import ground_point, pipe_contact
from sim_backend.deviations import AS_MODELLED, Deviations
from sim_backend.dynamics import accelerations
from sim_backend.inner_loops import inner_loops
from sim_backend.motors import Nine, battery
from sim_backend.pipe import Pipe
from sim_backend.servos import joint_torque, stop_torque, tool_servos

Array = NDArray[np.float64]
Three = tuple[float, float, float]


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
def rotation(x: Array) -> Nine:
    """The rotation from B to W, row by row."""
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
def let_go(x: Array, p: Array) -> None:
    """Leave the sleeve once the gripper is open far enough: on the pipe when in contact."""
    if x[at.PAYLOAD] != 0.0 and x[at.GRIPPER] > p[at.RELEASE_ANGLE]:
        x[at.PAYLOAD] = 0.0
        x[at.SLEEVE_ON_PIPE] = 1.0 if x[at.CONTACT_FORCE] > 0.0 else 0.0


@compiled()
def _kick(x: Array, p: Array, u: Array) -> None:
    """Evaluate all forces at the present positions and move the velocities on by one step."""
    step = p[at.STEP]
    half = 0.5 * step
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation(x)
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

    # Rotors, drag and surfaces.
    fx, fy, fz, mx, my, mz = airframe(x, p, u, (xx, xy, xz, yx, yy, yz, zx, zy, zz), vx, vy, vz)

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
    let_go(x, p)

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
def tips(x: Array, p: Array) -> None:
    """Write the tips of both tools to ``x``."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation(x)
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
def watch(x: Array, p: Array) -> None:
    """Set the crash code when the vehicle has turned over or a propeller reaches into the pipe."""
    if x[at.CRASH] != 0.0:
        return
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation(x)
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
    tips(x, p)
    watch(x, p)


@compiled("(f8[::1], f8[::1], f8[::1], i8)")
def _move(x: Array, p: Array, u: Array, steps: int) -> None:
    """``physics`` as a call of its own."""
    physics(x, p, u, steps)


@compiled("(f8[::1], f8[::1], f8[::1], i8)")
def _fly(x: Array, p: Array, u: Array, steps: int) -> None:
    """Advance by ``steps`` physics steps, running the inner loops whenever they are due."""
    period = int(p[at.LOOP_STEPS])
    done = 0
    while done < steps:
        phase = int(x[at.PHASE])
        if phase == 0:
            inner_loops(x, p, u)
        count = min(period - phase, steps - done)
        physics(x, p, u, count)
        done += count
        phase += count
        x[at.PHASE] = 0.0 if phase == period else phase


class RigidBody(ArrayPlant):
    """The plant of the coupled equations of motion."""

    def __init__(
        self,
        vehicle: Vehicle,
        params: PlantParams,
        pipe: Pipe,
        truth: Deviations = AS_MODELLED,
    ) -> None:
        super().__init__(vehicle, params, pipe, truth)
        self.stand()

    def move(self, steps: int) -> None:
        """Move ``x`` on by so many physics steps under the drive ``u`` as it stands."""
        _move(self.x, self.p, self.u, steps)

    def fly(self, steps: int) -> None:
        """The same, with the autopilot's inner loops whenever they are due."""
        _fly(self.x, self.p, self.u, steps)
