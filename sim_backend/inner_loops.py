"""The autopilot's inner loops, modelled on PX4: attitude, body rate, and the mixer.

They run every millisecond on the true attitude and rate. PX4's own estimator is not modelled here; what the vehicle
tells about its attitude passes through ``sensors``.
"""

from __future__ import annotations

from math import acos, asin, cos, hypot, sin, sqrt
from typing import Annotated

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from drivers.vehicle import Carrier, Vehicle
from sim_backend import layout as at
from sim_backend.compiled import compiled
from sim_backend.knob import knob

Array = NDArray[np.float64]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]

#: What ``u[U_SETPOINT]`` says.
NONE, WRENCH, ATTITUDE, BODY_RATE, VELOCITY, DESCENT, ROTORS = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0


class LoopParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Gains of the inner loops. Attitude: PX4's defaults (MC_ROLL_P, MC_YAW_P, MC_YAW_WEIGHT, MC_ROLLRATE_MAX)."""

    period: Annotated[float, knob("s", "period of the loops", 5e-4, 5e-3)] = 1e-3
    attitude_gain: Annotated[float, knob("1/s", "attitude error to body rate, roll and pitch", 0.5, 20.0)] = 6.5
    yaw_gain: Annotated[float, knob("1/s", "attitude error to body rate, yaw", 0.1, 10.0)] = 2.8
    yaw_weight: Annotated[float, knob("1", "priority of yaw against tilt", 0.1, 1.0)] = 0.4
    rate_limit: Annotated[float, knob("rad/s", "largest roll and pitch rate asked for", 0.1, 30.0)] = 3.84
    yaw_rate_limit: Annotated[float, knob("rad/s", "largest yaw rate asked for", 0.1, 10.0)] = 3.49
    tuned_at: tuple[
        Annotated[float, knob("rad", "theta_1 of the arm pose that the rate loop is tuned in", -3.2, 3.2)],
        Annotated[float, knob("rad", "theta_2 of it", -3.2, 3.2)],
        Annotated[float, knob("rad", "theta_3 of it", -3.2, 3.2)],
    ] = (-0.72, 0.72, 0.0)
    """The working pose, wrist 0.30 m ahead of the mount; folded, the inertia is less and the loop faster."""
    bandwidth: Annotated[float, knob("rad/s", "bandwidth of the roll and pitch rate loop", 1.0, 100.0)] = 30.0
    yaw_bandwidth: Annotated[float, knob("rad/s", "bandwidth of the yaw rate loop", 0.5, 50.0)] = 10.0
    integral_gain: Annotated[float, knob("1/s", "integral over proportional gain of the rate loop", 0.0, 20.0)] = 2.0
    integral_limit: Annotated[float, knob("N m", "bound of the roll and pitch integrators", 0.0, 10.0)] = 1.4
    yaw_integral_limit: Annotated[float, knob("N m", "bound of the yaw integrator", 0.0, 2.0)] = 0.3
    velocity_gain: Annotated[
        float, knob("1/s", "velocity error to acceleration when the autopilot flies by itself", 0.1, 5.0)
    ] = 2.0


def airframe_inertia(vehicle: Vehicle, joints: Three) -> Three:
    """Moments of inertia about the common centre of mass, kg m^2, along the axes of B, arm at ``joints``."""
    parts = [(vehicle.base.mass, np.zeros(3), np.diag(np.array(vehicle.base.inertia)))]
    u = np.array([[cos(a), 0.0, sin(a)] for a in joints])
    for part in (*vehicle.arm.parts, vehicle.arm.sleeve):
        centre = np.array(vehicle.arm.mount) + (part.offset[0], 0.0, part.offset[1]) + np.array(part.along) @ u
        own = np.diag(np.array(part.inertia))
        if part.turns_with is not Carrier.BASE:
            along = u[(Carrier.LINK_1, Carrier.LINK_2, Carrier.TOOL).index(part.turns_with)]
            axes = np.column_stack((along, (0.0, 1.0, 0.0), (-along[2], 0.0, along[0])))
            own = axes @ own @ axes.T
        parts.append((part.mass, centre, own))
    middle = sum(mass * centre for mass, centre, _ in parts) / sum(mass for mass, _, _ in parts)
    total = np.zeros((3, 3))
    for mass, centre, own in parts:
        r = centre - middle
        total += own + mass * (r @ r * np.eye(3) - np.outer(r, r))
    return (float(total[0, 0]), float(total[1, 1]), float(total[2, 2]))


def put_loops(p: Array, vehicle: Vehicle, params: LoopParams, step: float) -> None:
    """Write the gains into ``p``."""
    steps = round(params.period / step)
    if steps < 1 or abs(steps * step - params.period) > 1e-9:
        raise ValueError(f"loops.period {params.period} s is not a whole number of physics steps of {step} s")
    mass = vehicle.base.mass + vehicle.arm.sleeve.mass + sum(part.mass for part in vehicle.arm.parts)
    p[at.LOOP : at.CONSTANTS_SIZE] = (
        params.attitude_gain,
        params.yaw_gain,
        params.yaw_weight,
        params.rate_limit,
        params.yaw_rate_limit,
        params.bandwidth,
        params.bandwidth,
        params.yaw_bandwidth,
        params.integral_gain,
        params.integral_gain,
        params.integral_gain,
        params.integral_limit,
        params.integral_limit,
        params.yaw_integral_limit,
        *airframe_inertia(vehicle, params.tuned_at),
        params.period,
        steps,
        params.velocity_gain,
        mass,
    )


@compiled()
def mix(p: Array, limit: float, thrust: float, tx: float, ty: float, tz: float) -> Four:
    """Rotor thrusts, N, for a total thrust (N) and a torque (N m, B), each rotor within 0..limit.

    When not all can be had: first yaw is given up, then thrust is lowered to keep roll and pitch, and only when the
    thrust itself leaves no room, roll and pitch are scaled.
    """
    roll = 0.25 * tx / p[at.ROTOR_Y]
    pitch = 0.25 * ty / p[at.ROTOR_X]
    yaw = 0.25 * tz / p[at.ROTOR_YAW]
    swing = abs(roll) + abs(pitch)
    level = min(max(0.25 * thrust, 0.0), limit)
    if swing > 0.0:
        level = min(level, max(limit - swing, 0.5 * limit))
        scale = min(1.0, level / swing, (limit - level) / swing)
        roll *= scale
        pitch *= scale
    a = level - roll - pitch
    b = level + roll + pitch
    c = level + roll - pitch
    d = level - roll + pitch
    room = min(a, b, limit - c, limit - d) if yaw > 0.0 else min(c, d, limit - a, limit - b)
    turn = min(abs(yaw), max(room, 0.0))
    if yaw < 0.0:
        turn = -turn
    return a - turn, b - turn, c + turn, d + turn


@compiled()
def attitude_rate(
    p: Array, qw: float, qx: float, qy: float, qz: float, dw: float, dx: float, dy: float, dz: float
) -> Three:
    """Body rates, rad/s, that take the attitude q to d (both q_WB): PX4's quaternion attitude law.

    Tilt comes first, by the shortest way of the thrust axis; yaw follows with its weight.
    """
    # Desired thrust axis as seen in B: third column of R(q)^T R(d), by e = q^-1 d.
    ew = qw * dw + qx * dx + qy * dy + qz * dz
    ex = qw * dx - qx * dw - qy * dz + qz * dy
    ey = qw * dy + qx * dz - qy * dw - qz * dx
    ez = qw * dz - qx * dy + qy * dx - qz * dw
    zx = 2.0 * (ex * ez + ew * ey)
    zy = 2.0 * (ey * ez - ew * ex)
    zz = 1.0 - 2.0 * (ex * ex + ey * ey)
    # Shortest turn r (in B) that lays the thrust axis on it; unique unless it is opposite.
    if zz > -0.99999:
        rw = sqrt(0.5 * (1.0 + zz))
        rx = -0.5 * zy / rw
        ry = 0.5 * zx / rw
        # What then is left is a turn about the thrust axis: m = r^-1 e.
        mw = rw * ew + rx * ex + ry * ey
        mz = rw * ez - rx * ey + ry * ex
        if mw < 0.0:
            mw = -mw
            mz = -mz
        weight = p[at.LOOP_YAW_WEIGHT]
        yw = cos(weight * acos(min(1.0, mw)))
        yz = sin(weight * asin(min(max(mz, -1.0), 1.0)))
        ew = rw * yw
        ex = rx * yw + ry * yz
        ey = ry * yw - rx * yz
        ez = rw * yz
    sign = 2.0 if ew >= 0.0 else -2.0
    tilt = sign * p[at.LOOP_ATTITUDE_GAIN]
    yaw = sign * p[at.LOOP_YAW_GAIN] / p[at.LOOP_YAW_WEIGHT]
    most = p[at.LOOP_RATE_LIMIT]
    most_yaw = p[at.LOOP_YAW_RATE_LIMIT]
    return (
        min(max(tilt * ex, -most), most),
        min(max(tilt * ey, -most), most),
        min(max(yaw * ez, -most_yaw), most_yaw),
    )


@compiled()
def rate_torque(x: Array, p: Array, dx: float, dy: float, dz: float) -> Three:
    """Torque, N m, that drives the body rate to d (rad/s): proportional, bounded integral, and gyroscopic term."""
    wx = x[at.RATE]
    wy = x[at.RATE + 1]
    wz = x[at.RATE + 2]
    jx = p[at.LOOP_INERTIA]
    jy = p[at.LOOP_INERTIA + 1]
    jz = p[at.LOOP_INERTIA + 2]
    px = jx * p[at.LOOP_BANDWIDTH] * (dx - wx)
    py = jy * p[at.LOOP_BANDWIDTH + 1] * (dy - wy)
    pz = jz * p[at.LOOP_BANDWIDTH + 2] * (dz - wz)
    ix = x[at.RATE_INTEGRAL]
    iy = x[at.RATE_INTEGRAL + 1]
    iz = x[at.RATE_INTEGRAL + 2]
    period = p[at.LOOP_PERIOD]
    most = p[at.LOOP_INTEGRAL_LIMIT]
    x[at.RATE_INTEGRAL] = min(max(ix + period * p[at.LOOP_INTEGRAL_GAIN] * px, -most), most)
    most = p[at.LOOP_INTEGRAL_LIMIT + 1]
    x[at.RATE_INTEGRAL + 1] = min(max(iy + period * p[at.LOOP_INTEGRAL_GAIN + 1] * py, -most), most)
    most = p[at.LOOP_INTEGRAL_LIMIT + 2]
    x[at.RATE_INTEGRAL + 2] = min(max(iz + period * p[at.LOOP_INTEGRAL_GAIN + 2] * pz, -most), most)
    return (
        px + ix + (jz - jy) * wy * wz,
        py + iy + (jx - jz) * wz * wx,
        pz + iz + (jy - jx) * wx * wy,
    )


@compiled()
def _fly_by_velocity(x: Array, p: Array, u: Array) -> tuple[float, float, float, float, float]:
    """Thrust (N) and attitude set-point for a velocity: no drift, ``-u[U_THRUST]`` m/s upwards, yaw kept.

    A descent is flown level, whatever the drift. Velocities are those that the autopilot believes in.
    """
    gain = p[at.LOOP_VELOCITY_GAIN]
    g = p[at.GRAVITY]
    ax = ay = 0.0
    if u[at.U_SETPOINT] == VELOCITY:
        ax = min(max(-gain * (x[at.VELOCITY] + u[at.U_VELOCITY_ERROR]), -0.3 * g), 0.3 * g)
        ay = min(max(-gain * (x[at.VELOCITY + 1] + u[at.U_VELOCITY_ERROR + 1]), -0.3 * g), 0.3 * g)
    climb = x[at.VELOCITY + 2] + u[at.U_VELOCITY_ERROR + 2]
    az = g + min(max(gain * (-u[at.U_THRUST] - climb), -0.3 * g), 0.3 * g)
    length = sqrt(ax * ax + ay * ay + az * az)
    # Shortest turn from +z of W to the thrust's direction, after a turn about z by the present heading.
    tw = sqrt(0.5 * (1.0 + az / length))
    tx = -0.5 * ay / (length * tw)
    ty = 0.5 * ax / (length * tw)
    yw = x[at.ATTITUDE]
    yz = x[at.ATTITUDE + 3]
    norm = hypot(yw, yz)
    if norm < 1e-6:
        yw, yz, norm = 1.0, 0.0, 1.0
    yw /= norm
    yz /= norm
    return p[at.LOOP_MASS] * length, tw * yw, tx * yw + ty * yz, ty * yw - tx * yz, tw * yz


@compiled()
def inner_loops(x: Array, p: Array, u: Array) -> None:
    """Run the loops once: from the set-point in ``u`` to the rotor thrusts demanded, also in ``u``."""
    kind = u[at.U_SETPOINT]
    if kind == ROTORS:
        return
    if kind == NONE:
        for i in range(4):
            u[at.U_ROTOR + i] = 0.0
        for i in range(3):
            x[at.RATE_INTEGRAL + i] = 0.0
        return
    thrust = u[at.U_THRUST]
    if kind == WRENCH:
        tx = u[at.U_BODY_TORQUE]
        ty = u[at.U_BODY_TORQUE + 1]
        tz = u[at.U_BODY_TORQUE + 2]
    else:
        rx = u[at.U_BODY_RATE]
        ry = u[at.U_BODY_RATE + 1]
        rz = u[at.U_BODY_RATE + 2]
        if kind != BODY_RATE:
            dw = u[at.U_ATTITUDE]
            dx = u[at.U_ATTITUDE + 1]
            dy = u[at.U_ATTITUDE + 2]
            dz = u[at.U_ATTITUDE + 3]
            if kind in (VELOCITY, DESCENT):
                thrust, dw, dx, dy, dz = _fly_by_velocity(x, p, u)
            rx, ry, rz = attitude_rate(
                p, x[at.ATTITUDE], x[at.ATTITUDE + 1], x[at.ATTITUDE + 2], x[at.ATTITUDE + 3], dw, dx, dy, dz
            )
        tx, ty, tz = rate_torque(x, p, rx, ry, rz)
    a, b, c, d = mix(p, x[at.ROTOR_LIMIT], thrust, tx, ty, tz)
    u[at.U_ROTOR] = a
    u[at.U_ROTOR + 1] = b
    u[at.U_ROTOR + 2] = c
    u[at.U_ROTOR + 3] = d
