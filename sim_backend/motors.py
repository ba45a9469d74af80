"""Rotors and battery: the X500's layout, thrust lag, and what the battery gives.

The curve from PX4's 0..1 to newtons is ``drivers.thrust``; here thrust is in newtons.
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.vehicle import Battery
from sim_backend import layout as at
from sim_backend.compiled import compiled

Array = NDArray[np.float64]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


def rated_voltage(battery: Battery) -> float:
    """Voltage at which ``Rotors.max_thrust`` holds, V: half way between full and empty (as ``drivers.thrust``)."""
    return 0.5 * (battery.full_voltage + battery.empty_voltage)


def lag_gain(step: float, time_constant: float) -> float:
    """Share of the way to a constant demand that a first-order lag covers in one step."""
    return 1.0 if time_constant == 0.0 else 1.0 - exp(-step / time_constant)


@compiled()
def rotors(x: Array, p: Array, u: Array) -> tuple[float, float, float, float]:
    """Advance the rotors by one step; returns the total thrust (N, +z of B) and the moment about the origin (3, B).

    PX4 numbering: front right and rear left turn counter-clockwise seen from above, front left and rear right
    clockwise; the reaction on the airframe is opposite.
    """
    gain = p[at.ROTOR_GAIN]
    most = x[at.ROTOR_LIMIT]
    alive = x[at.CRASH] == 0.0
    scale = p[at.ROTOR_SCALE]
    if p[at.BATTERY_SAG] != 0.0:
        volts = x[at.VOLTAGE] / p[at.HOVER_VOLTAGE]
        scale *= 1.0 + p[at.BATTERY_SAG] * (volts * volts - 1.0)
    for i in range(4):
        demand = min(max(scale * u[at.U_ROTOR + i], 0.0), most) if alive else 0.0
        x[at.ROTOR + i] += gain * (demand - x[at.ROTOR + i])
        x[at.ROTOR_ANGLE + i] += p[at.STEP] * p[at.SPIN] * sqrt(max(0.0, x[at.ROTOR + i]))
    fr = x[at.ROTOR]
    rl = x[at.ROTOR + 1]
    fl = x[at.ROTOR + 2]
    rr = x[at.ROTOR + 3]
    return (
        fr + rl + fl + rr,
        p[at.ROTOR_Y] * (fl + rl - fr - rr),
        p[at.ROTOR_X] * (rl + rr - fr - fl),
        p[at.ROTOR_YAW] * (fl + rr - fr - rl),
    )


@compiled()
def rotor_drag(x: Array, p: Array) -> float:
    """Drag of the rotors against motion of the air in their plane, N s/m: it grows with their speeds."""
    if p[at.ROTOR_DRAG] == 0.0:
        return 0.0
    speed = 0.0
    for i in range(4):
        speed += sqrt(max(0.0, x[at.ROTOR + i]))
    return float(p[at.ROTOR_DRAG] * p[at.SPIN] * speed)


@compiled()
def near_surfaces(x: Array, p: Array, turn: Nine) -> Six:
    """Force (N, B) and moment about the origin (N m, B) that ground and pipe add to the rotors' thrust.

    ``turn`` is R_WB by rows. Ground: Cheeseman and Bennett's 1 / (1 - (R / 4z)^2) for each rotor at its own height z
    of the hub, down to half a radius, where their fit ends. Pipe: each rotor is pulled towards it by a share of its
    thrust that falls with the square of the distance of its hub, in radii of the disc.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
    fx = fy = fz = mx = my = mz = 0.0
    radius = p[at.ROTOR_RADIUS]
    for i in range(4):
        # PX4's order: front right, rear left, front left, rear right.
        bx = p[at.ROTOR_X] if i in (0, 2) else -p[at.ROTOR_X]
        by = p[at.ROTOR_Y] if i in (1, 2) else -p[at.ROTOR_Y]
        thrust = x[at.ROTOR + i]
        rz = x[at.POSITION + 2] + zx * bx + zy * by
        gx = gy = gz = 0.0
        if p[at.GROUND_EFFECT] != 0.0 and zz > 0.0:
            share = radius / (4.0 * max(rz, 0.5 * radius))
            gz += p[at.GROUND_EFFECT] * thrust * (1.0 / (1.0 - share * share) - 1.0)
        if p[at.WALL_EFFECT] != 0.0:
            dx = x[at.POSITION] + xx * bx + xy * by - p[at.PIPE_POINT]
            dy = x[at.POSITION + 1] + yx * bx + yy * by - p[at.PIPE_POINT + 1]
            up = rz - p[at.PIPE_POINT + 2]
            nx = p[at.PIPE_NORMAL]
            ny = p[at.PIPE_NORMAL + 1]
            ahead = dx * nx + dy * ny
            away = sqrt(ahead * ahead + up * up)
            if away > 0.0 and abs(dy * nx - dx * ny) <= p[at.PIPE_HALF_LENGTH]:
                share = radius / max(away - p[at.PIPE_RADIUS], radius)
                pull = p[at.WALL_EFFECT] * thrust * share * share / away
                wx = -pull * ahead * nx
                wy = -pull * ahead * ny
                wz = -pull * up
                gx += xx * wx + yx * wy + zx * wz
                gy += xy * wx + yy * wy + zy * wz
                gz += xz * wx + yz * wy + zz * wz
        fx += gx
        fy += gy
        fz += gz
        mx += by * gz
        my -= bx * gz
        mz += bx * gy - by * gx
    return fx, fy, fz, mx, my, mz


@compiled()
def battery(x: Array, p: Array, step: float) -> None:
    """Discharge the battery over one step at the present thrust; set its voltage and the rotors' limit.

    The current goes with thrust^1.5 (induced power); the open-circuit voltage falls linearly with the charge.
    """
    thrust = x[at.ROTOR] + x[at.ROTOR + 1] + x[at.ROTOR + 2] + x[at.ROTOR + 3]
    share = max(0.0, thrust / p[at.HOVER_THRUST])
    current = p[at.HOVER_CURRENT] * share * sqrt(share)
    x[at.CHARGE] = max(0.0, x[at.CHARGE] - current * step / p[at.BATTERY_CAPACITY])
    open_circuit = p[at.BATTERY_EMPTY] + (p[at.BATTERY_FULL] - p[at.BATTERY_EMPTY]) * x[at.CHARGE]
    x[at.VOLTAGE] = open_circuit - p[at.BATTERY_RESISTANCE] * current
    share = x[at.VOLTAGE] / p[at.RATED_VOLTAGE] if p[at.RATED_VOLTAGE] > 0.0 else 1.0
    x[at.ROTOR_LIMIT] = p[at.ROTOR_MAX] * min(1.0, share * share)
