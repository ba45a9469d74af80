"""What the rotors and the air do to the airframe; the same for every plant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backend import layout as at
from sim_backend.compiled import compiled
from sim_backend.motors import Nine, Six, near_surfaces, rotor_drag, rotors

Array = NDArray[np.float64]


@compiled()
def airframe(x: Array, p: Array, u: Array, turn: Nine, vx: float, vy: float, vz: float) -> Six:
    """Force (N, B) and moment about the origin (N m, B) of rotors, drag and surfaces; moves the rotors on by one step.

    ``turn`` is R_WB by rows, v the velocity of the origin, m/s, W.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
    thrust, mx, my, mz = rotors(x, p, u)
    ax = vx - u[at.U_WIND]
    ay = vy - u[at.U_WIND + 1]
    az = vz - u[at.U_WIND + 2]
    in_plane = rotor_drag(x, p)
    fx = -(p[at.DRAG] + in_plane) * (xx * ax + yx * ay + zx * az)
    fy = -(p[at.DRAG + 1] + in_plane) * (xy * ax + yy * ay + zy * az)
    fz = thrust - p[at.DRAG + 2] * (xz * ax + yz * ay + zz * az)
    if p[at.GROUND_EFFECT] != 0.0 or p[at.WALL_EFFECT] != 0.0:
        ex, ey, ez, hx, hy, hz = near_surfaces(x, p, turn)
        fx += ex
        fy += ey
        fz += ez
        mx += hx
        my += hy
        mz += hz
    return fx, fy, fz, mx, my, mz
