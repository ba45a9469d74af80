"""Dynamics of the aerial manipulator by the Lagrange method: M(q) q'' + C(q, q') q' + G(q) = tau.

q = [x, y, z, phi, theta, psi, theta_1, theta_2, theta_3] (eq. 1): position of the body origin in W, ZYX Euler
angles, and joint angles against the body (``drivers.vehicle``). Generalised forces: rows 0-2 a force in W, rows
3-5 conjugate to the Euler angles (``math3.euler_torque_from_body``), rows 6-8 the joint servos' torques.

Every part of the arm, the bars and plates of the parallelograms included, has its centre of mass at
c + a_1 u(theta_1) + a_2 u(theta_2) + a_3 u(theta_3) in B and turns with the base, a link or the tool; so each adds
to the sums in closed form, and no loop-closure constraint is left to solve. The rotor of each servo, seen through
its gear, adds its inertia to the diagonal of its joint.
"""

from __future__ import annotations

from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Vec3
from drivers.vehicle import Carrier, Part, Vehicle
from onboard.core.compiled import compiled

Nine = tuple[float, float, float, float, float, float, float, float, float]
Four = tuple[float, float, float, float]
Array = NDArray[np.float64]

_CARRIERS = (Carrier.BASE, Carrier.LINK_1, Carrier.LINK_2, Carrier.TOOL)
_REST: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Model:
    """The masses and lengths of one vehicle, packed once, with and without the payload (the sleeve).

    ``payload`` below says whether the sleeve is in the gripper.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        arm, base = vehicle.arm, vehicle.base
        self.gravity_acceleration = vehicle.gravity
        self._variants = tuple(_Variant(vehicle, parts) for parts in (arm.parts, (*arm.parts, arm.sleeve)))
        self._masses = tuple(
            base.mass + sum(part.mass for part in parts) for parts in (arm.parts, (*arm.parts, arm.sleeve))
        )
        self._tip = np.array([*arm.mount, arm.link_1, arm.link_2, arm.gripper])

    @classmethod
    def from_vehicle(cls, vehicle: Vehicle) -> Model:
        """The model of ``vehicle``."""
        return cls(vehicle)

    def mass(self, payload: bool) -> float:
        """Mass of the whole vehicle, kg."""
        return self._masses[payload]

    def inverse_dynamics(self, q: Nine, qd: Nine, qdd: Nine, payload: bool) -> Nine:
        """M qdd + C qd + G: the generalised forces that give this acceleration."""
        variant = self._variants[payload]
        return _inverse_dynamics(q, qd, qdd, variant.parts, variant.turning)

    def momentum(self, q: Nine, qd: Nine, payload: bool) -> tuple[Nine, Nine]:
        """Generalised momentum p = M qd, and C^T qd - G: what p' is beside the generalised forces."""
        return momentum(q, qd, *self.packed(payload))

    def packed(self, payload: bool) -> tuple[Array, Array]:
        """What the kernels are told of the vehicle: ``parts`` and ``turning``."""
        variant = self._variants[payload]
        return variant.parts, variant.turning

    def contact_torque(self, q: Nine, force_W: Vec3) -> Nine:
        """J_tip^T F: generalised forces of a force (N, W) that acts on the gripper's tip."""
        return _contact_torque(q, force_W, self._tip)

    def mass_matrix(self, q: Nine, payload: bool) -> Array:
        """M(q), 9x9, symmetric positive definite away from the vertical pitch."""
        variant = self._variants[payload]
        return _mass_and_coriolis(q, _REST, variant.parts, variant.turning)[0]

    def coriolis(self, q: Nine, qd: Nine, payload: bool) -> Array:
        """C(q, qd), 9x9, the one for which M' - 2C is skew-symmetric."""
        variant = self._variants[payload]
        return _mass_and_coriolis(q, qd, variant.parts, variant.turning)[1]

    def gravity(self, q: Nine, payload: bool) -> Nine:
        """G(q), the gradient of the potential."""
        return self.inverse_dynamics(q, _REST, _REST, payload)

    def potential(self, q: Nine, payload: bool) -> float:
        """Potential energy in gravity, J; zero with every centre of mass at z = 0 of W."""
        phi, theta = q[3], q[4]
        up_x, up_y, up_z = -sin(theta), cos(theta) * sin(phi), cos(theta) * cos(phi)
        x, y, z = self._variants[payload].first_moment(q[6], q[7], q[8])
        return self.gravity_acceleration * (self.mass(payload) * q[2] + up_x * x + up_y * y + up_z * z)

    def kinetic(self, q: Nine, qd: Nine, payload: bool) -> float:
        """Kinetic energy, J."""
        rates = np.array(qd)
        return float(0.5 * rates @ self.mass_matrix(q, payload) @ rates)


class _Variant:
    """Packed arrays of one set of parts.

    ``parts`` (n, 7): mass, constant offset x y z in B, metres along u(theta_1..3); row 0 is the base.
    ``turning`` (5, 3): summed principal inertia of base, link 1, link 2, tool; then rotor inertia, gravity, unused.
    """

    def __init__(self, vehicle: Vehicle, parts: tuple[Part, ...]) -> None:
        mount = vehicle.arm.mount
        rows = [(vehicle.base.mass, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)]
        turning = np.zeros((5, 3))
        turning[0] = vehicle.base.inertia
        for part in parts:
            x, z = part.offset
            rows.append((part.mass, mount[0] + x, mount[1], mount[2] + z, *part.along))
            turning[_CARRIERS.index(part.turns_with)] += part.inertia
        turning[4] = (vehicle.servo.rotor_inertia, vehicle.gravity, 0.0)
        self.parts = np.array(rows)
        self.turning = turning

    def first_moment(self, theta_1: float, theta_2: float, theta_3: float) -> Vec3:
        """Sum of mass times position in B, kg m."""
        x, y, z, a_1, a_2, a_3 = (self.parts[:, 0] @ self.parts[:, 1:]).tolist()
        return (
            x + a_1 * cos(theta_1) + a_2 * cos(theta_2) + a_3 * cos(theta_3),
            y,
            z + a_1 * sin(theta_1) + a_2 * sin(theta_2) + a_3 * sin(theta_3),
        )


@compiled("UniTuple(f8, 3)(f8, f8, f8, f8, f8, f8, f8, f8, f8, f8, f8[::1])")
def _turning_torque(
    wx: float, wy: float, wz: float, bx: float, by: float, bz: float,
    c: float, s: float, rate: float, acceleration: float, inertia: Array,
) -> Vec3:  # fmt: skip
    """I w' + w x I w in B, of a part that turns against B about -y, with its x axis along (c, 0, s)."""
    gx, gy, gz = bx + rate * wz, by - acceleration, bz - rate * wx
    px, py, pz = c * wx + s * wz, wy - rate, c * wz - s * wx
    ix, iy, iz = inertia[0], inertia[1], inertia[2]
    nx = ix * (c * gx + s * gz) + (iz - iy) * py * pz
    ny = iy * gy + (ix - iz) * pz * px
    nz = iz * (c * gz - s * gx) + (iy - ix) * px * py
    return c * nx - s * nz, ny, s * nx + c * nz


@compiled("UniTuple(f8, 9)(UniTuple(f8, 9), UniTuple(f8, 9), UniTuple(f8, 9), f8[:, ::1], f8[:, ::1])")
def _inverse_dynamics(q: Nine, qd: Nine, qdd: Nine, parts: Array, turning: Array) -> Nine:
    """Newton-Euler sums over the parts in B: the same forces as M qdd + C qd + G, without the matrices."""
    cf, sf, ct, st, cp, sp = cos(q[3]), sin(q[3]), cos(q[4]), sin(q[4]), cos(q[5]), sin(q[5])
    r11, r12, r13 = cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf
    r21, r22, r23 = sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf
    r31, r32, r33 = -st, ct * sf, ct * cf

    # Specific acceleration of the origin, angular velocity and acceleration, all in B.
    ax, ay, az = qdd[0], qdd[1], qdd[2] + turning[4, 1]
    ox, oy, oz = r11 * ax + r21 * ay + r31 * az, r12 * ax + r22 * ay + r32 * az, r13 * ax + r23 * ay + r33 * az
    fd, td, pd = qd[3], qd[4], qd[5]
    wx, wy, wz = fd - st * pd, cf * td + sf * ct * pd, cf * ct * pd - sf * td
    bx = qdd[3] - st * qdd[5] - ct * td * pd
    by = cf * qdd[4] + sf * ct * qdd[5] - sf * fd * td + (cf * ct * fd - sf * st * td) * pd
    bz = cf * ct * qdd[5] - sf * qdd[4] - cf * fd * td - (sf * ct * fd + cf * st * td) * pd

    c1, s1, c2, s2, c3, s3 = cos(q[6]), sin(q[6]), cos(q[7]), sin(q[7]), cos(q[8]), sin(q[8])
    v1, v2, v3 = qd[6], qd[7], qd[8]
    # First and second derivatives of u(theta_i) in B.
    dx1, dz1, dx2, dz2, dx3, dz3 = -s1 * v1, c1 * v1, -s2 * v2, c2 * v2, -s3 * v3, c3 * v3
    ex1, ez1 = -s1 * qdd[6] - c1 * v1 * v1, c1 * qdd[6] - s1 * v1 * v1
    ex2, ez2 = -s2 * qdd[7] - c2 * v2 * v2, c2 * qdd[7] - s2 * v2 * v2
    ex3, ez3 = -s3 * qdd[8] - c3 * v3 * v3, c3 * qdd[8] - s3 * v3 * v3

    fx = fy = fz = tx = ty = tz = 0.0
    j1 = j2 = j3 = 0.0
    for k in range(parts.shape[0]):
        m, a1, a2, a3 = parts[k, 0], parts[k, 4], parts[k, 5], parts[k, 6]
        rx = parts[k, 1] + a1 * c1 + a2 * c2 + a3 * c3
        ry = parts[k, 2]
        rz = parts[k, 3] + a1 * s1 + a2 * s2 + a3 * s3
        ux = a1 * dx1 + a2 * dx2 + a3 * dx3
        uz = a1 * dz1 + a2 * dz2 + a3 * dz3
        # w x r + 2 r', then crossed with w again.
        hx, hy, hz = wy * rz - wz * ry + 2.0 * ux, wz * rx - wx * rz, wx * ry - wy * rx + 2.0 * uz
        px = m * (ox + by * rz - bz * ry + wy * hz - wz * hy + a1 * ex1 + a2 * ex2 + a3 * ex3)
        py = m * (oy + bz * rx - bx * rz + wz * hx - wx * hz)
        pz = m * (oz + bx * ry - by * rx + wx * hy - wy * hx + a1 * ez1 + a2 * ez2 + a3 * ez3)
        fx += px
        fy += py
        fz += pz
        tx += ry * pz - rz * py
        ty += rz * px - rx * pz
        tz += rx * py - ry * px
        j1 += a1 * (c1 * pz - s1 * px)
        j2 += a2 * (c2 * pz - s2 * px)
        j3 += a3 * (c3 * pz - s3 * px)

    # Joint angles turn about -y of B.
    n0 = _turning_torque(wx, wy, wz, bx, by, bz, 1.0, 0.0, 0.0, 0.0, turning[0])
    n1 = _turning_torque(wx, wy, wz, bx, by, bz, c1, s1, v1, qdd[6], turning[1])
    n2 = _turning_torque(wx, wy, wz, bx, by, bz, c2, s2, v2, qdd[7], turning[2])
    n3 = _turning_torque(wx, wy, wz, bx, by, bz, c3, s3, v3, qdd[8], turning[3])
    tx += n0[0] + n1[0] + n2[0] + n3[0]
    ty += n0[1] + n1[1] + n2[1] + n3[1]
    tz += n0[2] + n1[2] + n2[2] + n3[2]
    rotor = turning[4, 0]
    return (
        r11 * fx + r12 * fy + r13 * fz,
        r21 * fx + r22 * fy + r23 * fz,
        r31 * fx + r32 * fy + r33 * fz,
        tx,
        cf * ty - sf * tz,
        ct * (sf * ty + cf * tz) - st * tx,
        j1 - n1[1] + rotor * qdd[6],
        j2 - n2[1] + rotor * qdd[7],
        j3 - n3[1] + rotor * qdd[8],
    )


@compiled("UniTuple(f8, 9)(UniTuple(f8, 9), UniTuple(f8, 3), f8[::1])")
def _contact_torque(q: Nine, force_W: Vec3, tip: Array) -> Nine:
    cf, sf, ct, st, cp, sp = cos(q[3]), sin(q[3]), cos(q[4]), sin(q[4]), cos(q[5]), sin(q[5])
    x, y, z = force_W
    fx = cp * ct * x + sp * ct * y - st * z
    fy = (cp * st * sf - sp * cf) * x + (sp * st * sf + cp * cf) * y + ct * sf * z
    fz = (cp * st * cf + sp * sf) * x + (sp * st * cf - cp * sf) * y + ct * cf * z
    c1, s1, c2, s2, c3, s3 = cos(q[6]), sin(q[6]), cos(q[7]), sin(q[7]), cos(q[8]), sin(q[8])
    rx = tip[0] + tip[3] * c1 + tip[4] * c2 + tip[5] * c3
    ry = tip[1]
    rz = tip[2] + tip[3] * s1 + tip[4] * s2 + tip[5] * s3
    tx, ty, tz = ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx
    return (
        x,
        y,
        z,
        tx,
        cf * ty - sf * tz,
        ct * (sf * ty + cf * tz) - st * tx,
        tip[3] * (c1 * fz - s1 * fx),
        tip[4] * (c2 * fz - s2 * fx),
        tip[5] * (c3 * fz - s3 * fx),
    )


@compiled("UniTuple(f8, 3)(UniTuple(f8, 3), UniTuple(f8, 3))")
def _cross(a: Vec3, b: Vec3) -> Vec3:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled("UniTuple(f8[:, ::1], 2)(UniTuple(f8, 9), UniTuple(f8, 9), f8[:, ::1], f8[:, ::1])")
def _mass_and_coriolis(q: Nine, qd: Nine, parts: Array, turning: Array) -> tuple[Array, Array]:
    """M = sum of m Jv^T Jv + Jw^T I Jw;  C = sum of m Jv^T Jv' + Jw^T I Jw' - Jw^T S(I w) Jw.

    Jv in B (its derivative is the one in W), Jw in each part's own frame, in which I is constant.
    """
    cf, sf, ct, st, cp, sp = cos(q[3]), sin(q[3]), cos(q[4]), sin(q[4]), cos(q[5]), sin(q[5])
    fd, td = qd[3], qd[4]
    # Columns of E, and of its derivative: w = E rpy'.
    e = ((1.0, 0.0, 0.0), (0.0, cf, -sf), (-st, sf * ct, cf * ct))
    ed = (
        (0.0, 0.0, 0.0),
        (0.0, -sf * fd, -cf * fd),
        (-ct * td, cf * ct * fd - sf * st * td, -sf * ct * fd - cf * st * td),
    )
    w = (fd - st * qd[5], cf * td + sf * ct * qd[5], cf * ct * qd[5] - sf * td)

    mass, coriolis = np.zeros((9, 9)), np.zeros((9, 9))
    jac, jac_d = np.zeros((3, 9)), np.zeros((3, 9))
    jac[0, 0], jac[0, 1], jac[0, 2] = cp * ct, sp * ct, -st
    jac[1, 0], jac[1, 1], jac[1, 2] = cp * st * sf - sp * cf, sp * st * sf + cp * cf, ct * sf
    jac[2, 0], jac[2, 1], jac[2, 2] = cp * st * cf + sp * sf, sp * st * cf - cp * sf, ct * cf
    for k in range(parts.shape[0]):
        m = parts[k, 0]
        rx, rz, ux, uz = parts[k, 1], parts[k, 3], 0.0, 0.0
        for i in range(3):
            a, c, s = parts[k, 4 + i], cos(q[6 + i]), sin(q[6 + i])
            rx += a * c
            rz += a * s
            ux -= a * s * qd[6 + i]
            uz += a * c * qd[6 + i]
            jac[0, 6 + i], jac[2, 6 + i] = -a * s, a * c
            jac_d[0, 6 + i] = -a * c * qd[6 + i] + w[1] * a * c
            jac_d[1, 6 + i] = -w[2] * a * s - w[0] * a * c
            jac_d[2, 6 + i] = -a * s * qd[6 + i] + w[1] * a * s
        for j in range(3):
            lever = _cross(e[j], (rx, parts[k, 2], rz))
            turned = _cross(w, lever)
            dragged = _cross(e[j], (ux, 0.0, uz))
            swung = _cross(ed[j], (rx, parts[k, 2], rz))
            for i in range(3):
                jac[i, 3 + j] = lever[i]
                jac_d[i, 3 + j] = swung[i] + dragged[i] + turned[i]
        for i in range(9):
            for j in range(9):
                for n in range(3):
                    mass[i, j] += m * jac[n, i] * jac[n, j]
                    coriolis[i, j] += m * jac[n, i] * jac_d[n, j]

    for k in range(4):
        jac, jac_d = np.zeros((3, 9)), np.zeros((3, 9))
        c, s, rate = 1.0, 0.0, 0.0
        if k > 0:
            c, s, rate = cos(q[5 + k]), sin(q[5 + k]), qd[5 + k]
            jac[1, 5 + k] = -1.0
        for j in range(3):
            x, y, z = e[j]
            xd, yd, zd = ed[j]
            jac[0, 3 + j], jac[1, 3 + j], jac[2, 3 + j] = c * x + s * z, y, c * z - s * x
            jac_d[0, 3 + j] = c * xd + s * zd + rate * (c * z - s * x)
            jac_d[1, 3 + j] = yd
            jac_d[2, 3 + j] = c * zd - s * xd - rate * (c * x + s * z)
        ix, iy, iz = turning[k, 0], turning[k, 1], turning[k, 2]
        sx, sy, sz = 0.0, 0.0, 0.0
        for j in range(9):
            sx += ix * jac[0, j] * qd[j]
            sy += iy * jac[1, j] * qd[j]
            sz += iz * jac[2, j] * qd[j]
        for j in range(9):
            swirl = _cross((sx, sy, sz), (jac[0, j], jac[1, j], jac[2, j]))
            for i in range(9):
                for n in range(3):
                    mass[i, j] += turning[k, n] * jac[n, i] * jac[n, j]
                    coriolis[i, j] += jac[n, i] * (turning[k, n] * jac_d[n, j] - swirl[n])
    for i in range(6, 9):
        mass[i, i] += turning[4, 0]
    return mass, coriolis


@compiled("UniTuple(f8, 4)(f8, f8, f8, f8, f8, f8, f8[::1])")
def _spin(wx: float, wy: float, wz: float, c: float, s: float, rate: float, inertia: Array) -> Four:
    """I w in B, of a part that turns as in ``_turning_torque``; and the gradient of its energy along its angle."""
    px, py, pz = c * wx + s * wz, wy - rate, c * wz - s * wx
    nx, ny, nz = inertia[0] * px, inertia[1] * py, inertia[2] * pz
    return c * nx - s * nz, ny, s * nx + c * nz, nx * pz - nz * px


@compiled("UniTuple(UniTuple(f8, 9), 2)(UniTuple(f8, 9), UniTuple(f8, 9), f8[:, ::1], f8[:, ::1])")
def momentum(q: Nine, qd: Nine, parts: Array, turning: Array) -> tuple[Nine, Nine]:
    """``Model.momentum``, for kernels: the gradients of the Lagrangian along qd and along q.

    By sums over the parts, without the matrices.
    """
    cf, sf, ct, st, cp, sp = cos(q[3]), sin(q[3]), cos(q[4]), sin(q[4]), cos(q[5]), sin(q[5])
    r11, r12, r13 = cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf
    r21, r22, r23 = sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf
    r31, r32, r33 = -st, ct * sf, ct * cf
    vx = r11 * qd[0] + r21 * qd[1] + r31 * qd[2]
    vy = r12 * qd[0] + r22 * qd[1] + r32 * qd[2]
    vz = r13 * qd[0] + r23 * qd[1] + r33 * qd[2]
    fd, td, pd = qd[3], qd[4], qd[5]
    wx, wy, wz = fd - st * pd, cf * td + sf * ct * pd, cf * ct * pd - sf * td
    c1, s1, c2, s2, c3, s3 = cos(q[6]), sin(q[6]), cos(q[7]), sin(q[7]), cos(q[8]), sin(q[8])
    v1, v2, v3 = qd[6], qd[7], qd[8]
    g = turning[4, 1]
    gx, gy, gz = g * r31, g * r32, g * r33

    # Momentum and angular momentum (B), first moment, and for each joint what turns with it.
    px = py = pz = lx = ly = lz = sx = sy = sz = 0.0
    p1 = p2 = p3 = d1 = d2 = d3 = 0.0
    for k in range(parts.shape[0]):
        m, a1, a2, a3 = parts[k, 0], parts[k, 4], parts[k, 5], parts[k, 6]
        rx = parts[k, 1] + a1 * c1 + a2 * c2 + a3 * c3
        ry = parts[k, 2]
        rz = parts[k, 3] + a1 * s1 + a2 * s2 + a3 * s3
        mx = m * (vx + wy * rz - wz * ry - a1 * s1 * v1 - a2 * s2 * v2 - a3 * s3 * v3)
        my = m * (vy + wz * rx - wx * rz)
        mz = m * (vz + wx * ry - wy * rx + a1 * c1 * v1 + a2 * c2 * v2 + a3 * c3 * v3)
        px += mx
        py += my
        pz += mz
        lx += ry * mz - rz * my
        ly += rz * mx - rx * mz
        lz += rx * my - ry * mx
        sx += m * rx
        sy += m * ry
        sz += m * rz
        # along u'(theta), and along w x u' + u'' theta' less gravity
        p1 += a1 * (c1 * mz - s1 * mx)
        p2 += a2 * (c2 * mz - s2 * mx)
        p3 += a3 * (c3 * mz - s3 * mx)
        d1 += a1 * (c1 * (wy - v1) * mx + (wz * -s1 - wx * c1) * my + s1 * (wy - v1) * mz + m * (s1 * gx - c1 * gz))
        d2 += a2 * (c2 * (wy - v2) * mx + (wz * -s2 - wx * c2) * my + s2 * (wy - v2) * mz + m * (s2 * gx - c2 * gz))
        d3 += a3 * (c3 * (wy - v3) * mx + (wz * -s3 - wx * c3) * my + s3 * (wy - v3) * mz + m * (s3 * gx - c3 * gz))

    n0 = _spin(wx, wy, wz, 1.0, 0.0, 0.0, turning[0])
    n1 = _spin(wx, wy, wz, c1, s1, v1, turning[1])
    n2 = _spin(wx, wy, wz, c2, s2, v2, turning[2])
    n3 = _spin(wx, wy, wz, c3, s3, v3, turning[3])
    lx += n0[0] + n1[0] + n2[0] + n3[0]
    ly += n0[1] + n1[1] + n2[1] + n3[1]
    lz += n0[2] + n1[2] + n2[2] + n3[2]

    # A turn of the body about e leaves e x (..) of all that is fixed in W: velocity of the origin, and gravity.
    ex = py * vz - pz * vy + sz * gy - sy * gz
    ey = pz * vx - px * vz + sx * gz - sz * gx
    ez = px * vy - py * vx + sy * gx - sx * gy
    rotor = turning[4, 0]
    total = 0.0
    for k in range(parts.shape[0]):
        total += parts[k, 0]
    return (
        (
            r11 * px + r12 * py + r13 * pz,
            r21 * px + r22 * py + r23 * pz,
            r31 * px + r32 * py + r33 * pz,
            lx,
            cf * ly - sf * lz,
            ct * (sf * ly + cf * lz) - st * lx,
            p1 - n1[1] + rotor * v1,
            p2 - n2[1] + rotor * v2,
            p3 - n3[1] + rotor * v3,
        ),
        (
            0.0,
            0.0,
            -g * total,
            ex + ly * wz - lz * wy,
            cf * ey - sf * ez - pd * (ct * lx + st * (sf * ly + cf * lz)),
            ct * (sf * ey + cf * ez) - st * ex,
            d1 + n1[3],
            d2 + n2[3],
            d3 + n3[3],
        ),
    )
