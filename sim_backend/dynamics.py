"""The coupled 9-DOF dynamics: floating base and the three absolute link angles, by projected Newton-Euler.

Unknowns are the specific force f at the body origin (acceleration minus gravity, in B), the angular acceleration of
B and the joint accelerations. With c_i = o_i + sum_k a_ik u(theta_k) the centre of mass of part i, w the body rate
and u' = du/dtheta, its acceleration minus gravity is

    f + wdot x c_i + sum_k a_ik u'_k thetadd_k + w x (w x c_i) + 2 w x cdot_i - sum_k a_ik u_k thetad_k^2.

Projecting m_i times this, and the Euler equation of each part, on the nine directions gives the equations of motion;
all sums over parts reduce to the constants of ``lump``, so that the cost does not depend on the number of parts.
Choosing f for the unknown makes gravity disappear.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from drivers.vehicle import Carrier, Part, Vehicle
from sim_backend import layout as at
from sim_backend.compiled import compiled

Array = NDArray[np.float64]
Nine = tuple[float, float, float, float, float, float, float, float, float]
Three = tuple[float, float, float]

_CARRIERS = (Carrier.LINK_1, Carrier.LINK_2, Carrier.TOOL)


def lump(vehicle: Vehicle, parts: Iterable[Part], rotor_inertia: float, centre: Three = (0.0, 0.0, 0.0)) -> Array:
    """The sums over base and parts, shape (38,), in the order of the ``L_`` indices of ``layout``.

    ``centre`` is the base's centre of mass (m, B), about which its inertia is.
    """
    out = np.zeros(at.LUMPED_SIZE)
    first, first_u, cross, pair = np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    inertia, turning = np.diag(np.array(vehicle.base.inertia)), np.zeros((3, 3))
    out[at.L_MASS] = vehicle.base.mass
    if any(centre):
        c = np.array(centre)
        first += vehicle.base.mass * c
        inertia += vehicle.base.mass * (c @ c * np.eye(3) - np.outer(c, c))
    for part in parts:
        o = np.array(vehicle.arm.mount) + np.array([part.offset[0], 0.0, part.offset[1]])
        a = np.array(part.along)
        out[at.L_MASS] += part.mass
        first += part.mass * o
        first_u += part.mass * a
        cross += part.mass * np.outer(a, o)
        pair += part.mass * np.outer(a, a)
        inertia += part.mass * (o @ o * np.eye(3) - np.outer(o, o))
        if part.turns_with is Carrier.BASE:
            inertia += np.diag(np.array(part.inertia))
        else:
            turning[_CARRIERS.index(part.turns_with)] += part.inertia
    out[at.L_FIRST : at.L_FIRST + 3] = first
    out[at.L_FIRST_U : at.L_FIRST_U + 3] = first_u
    out[at.L_CROSS : at.L_CROSS + 9] = cross.ravel()
    out[at.L_PAIR : at.L_PAIR + 6] = pair[np.triu_indices(3)]
    out[at.L_INERTIA : at.L_INERTIA + 6] = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    out[at.L_TURNING : at.L_TURNING + 9] = turning.ravel()
    out[at.L_ROTOR] = rotor_inertia
    return out


@compiled()
def _symmetric_inverse(
    xx: float, yy: float, zz: float, xy: float, xz: float, yz: float
) -> tuple[float, float, float, float, float, float]:
    a = yy * zz - yz * yz
    b = xz * yz - xy * zz
    c = xy * yz - xz * yy
    scale = 1.0 / (xx * a + xy * b + xz * c)
    return (
        scale * a,
        scale * (xx * zz - xz * xz),
        scale * (xx * yy - xy * xy),
        scale * b,
        scale * c,
        scale * (xy * xz - xx * yz),
    )


@compiled()
def accelerations(
    p: Array,
    base: int,
    c1: float,
    s1: float,
    c2: float,
    s2: float,
    c3: float,
    s3: float,
    wx: float,
    wy: float,
    wz: float,
    r1: float,
    r2: float,
    r3: float,
    force: Three,
    moment: Three,
    torque: Three,
) -> Nine:
    """Specific force at the origin (3, m/s^2, B), angular acceleration (3, B) and joint accelerations (3).

    ``p[base:]`` holds one lumped set; c and s are the cosines and sines of the three link angles, r their rates, w the
    body rate. ``force`` (N, B) and ``moment`` (N m, B, about the origin) act on the body besides gravity, ``torque``
    (N m) on the joints.
    """
    mass = p[base + at.L_MASS]
    f1 = p[base + at.L_FIRST_U]
    f2 = p[base + at.L_FIRST_U + 1]
    f3 = p[base + at.L_FIRST_U + 2]
    o1x = p[base + at.L_CROSS]
    o1y = p[base + at.L_CROSS + 1]
    o1z = p[base + at.L_CROSS + 2]
    o2x = p[base + at.L_CROSS + 3]
    o2y = p[base + at.L_CROSS + 4]
    o2z = p[base + at.L_CROSS + 5]
    o3x = p[base + at.L_CROSS + 6]
    o3y = p[base + at.L_CROSS + 7]
    o3z = p[base + at.L_CROSS + 8]
    a11 = p[base + at.L_PAIR]
    a12 = p[base + at.L_PAIR + 1]
    a13 = p[base + at.L_PAIR + 2]
    a22 = p[base + at.L_PAIR + 3]
    a23 = p[base + at.L_PAIR + 4]
    a33 = p[base + at.L_PAIR + 5]

    # First moments: of everything (mc), and weighted with a_k (g_k); u_k = (c, 0, s), u'_k = (-s, 0, c).
    mcx = p[base + at.L_FIRST] + f1 * c1 + f2 * c2 + f3 * c3
    mcy = p[base + at.L_FIRST + 1]
    mcz = p[base + at.L_FIRST + 2] + f1 * s1 + f2 * s2 + f3 * s3
    g1x = o1x + a11 * c1 + a12 * c2 + a13 * c3
    g1z = o1z + a11 * s1 + a12 * s2 + a13 * s3
    g2x = o2x + a12 * c1 + a22 * c2 + a23 * c3
    g2z = o2z + a12 * s1 + a22 * s2 + a23 * s3
    g3x = o3x + a13 * c1 + a23 * c2 + a33 * c3
    g3z = o3z + a13 * s1 + a23 * s2 + a33 * s3
    # Their components along u'_k.
    n1 = c1 * g1z - s1 * g1x
    n2 = c2 * g2z - s2 * g2x
    n3 = c3 * g3z - s3 * g3x

    # Second moments about the origin that change with the angles: sum_k (o_k u_k^T + u_k g_k^T).
    qxx = o1x * c1 + o2x * c2 + o3x * c3 + c1 * g1x + c2 * g2x + c3 * g3x
    qzz = o1z * s1 + o2z * s2 + o3z * s3 + s1 * g1z + s2 * g2z + s3 * g3z
    qxy = c1 * o1y + c2 * o2y + c3 * o3y
    qyz = s1 * o1y + s2 * o2y + s3 * o3y
    qxz = o1x * s1 + o2x * s2 + o3x * s3 + c1 * g1z + c2 * g2z + c3 * g3z
    hxx = p[base + at.L_INERTIA] + qzz
    hyy = p[base + at.L_INERTIA + 1] + qxx + qzz
    hzz = p[base + at.L_INERTIA + 2] + qxx
    hxy = p[base + at.L_INERTIA + 3] - qxy
    hxz = p[base + at.L_INERTIA + 4] - qxz
    hyz = p[base + at.L_INERTIA + 5] - qyz

    # Gyroscopic and centrifugal terms of all point masses and of what turns with the base.
    lx = hxx * wx + hxy * wy + hxz * wz
    ly = hxy * wx + hyy * wy + hyz * wz
    lz = hxz * wx + hyz * wy + hzz * wz
    b1 = g1x * wx + o1y * wy + g1z * wz
    b2 = g2x * wx + o2y * wy + g2z * wz
    b3 = g3x * wx + o3y * wy + g3z * wz
    spread = 2.0 * (r1 * n1 + r2 * n2 + r3 * n3)
    k1 = r1 * r1
    k2 = r2 * r2
    k3 = r3 * r3
    mx = moment[0] - (wy * lz - wz * ly) - wx * spread
    my = moment[1] - (wz * lx - wx * lz) - wy * spread
    mz = moment[2] - (wx * ly - wy * lx) - wz * spread
    mx += -2.0 * (r1 * s1 * b1 + r2 * s2 * b2 + r3 * s3 * b3) + k1 * o1y * s1 + k2 * o2y * s2 + k3 * o3y * s3
    my += k1 * (g1z * c1 - g1x * s1) + k2 * (g2z * c2 - g2x * s2) + k3 * (g3z * c3 - g3x * s3)
    mz += 2.0 * (r1 * c1 * b1 + r2 * c2 * b2 + r3 * c3 * b3) - k1 * o1y * c1 - k2 * o2y * c2 - k3 * o3y * c3

    # Force: w x (w x mc) + 2 w x e - sum_k S_k u_k r_k^2, with e = sum_k S_k u'_k r_k.
    ex = -(f1 * s1 * r1 + f2 * s2 * r2 + f3 * s3 * r3)
    ez = f1 * c1 * r1 + f2 * c2 * r2 + f3 * c3 * r3
    ww = wx * wx + wy * wy + wz * wz
    wm = wx * mcx + wy * mcy + wz * mcz
    fx = force[0] - (wx * wm - ww * mcx) - 2.0 * wy * ez + f1 * c1 * k1 + f2 * c2 * k2 + f3 * c3 * k3
    fy = force[1] - (wy * wm - ww * mcy) - 2.0 * (wz * ex - wx * ez)
    fz = force[2] - (wz * wm - ww * mcz) + 2.0 * wy * ex + f1 * s1 * k1 + f2 * s2 * k2 + f3 * s3 * k3

    # Joints: u'_k . (the same, weighted with a_k).
    d12 = s2 * c1 - c2 * s1
    d13 = s3 * c1 - c3 * s1
    d23 = s3 * c2 - c3 * s2
    e1 = 2.0 * wy * r1 - k1
    e2 = 2.0 * wy * r2 - k2
    e3 = 2.0 * wy * r3 - k3
    t1 = torque[0] - ((c1 * wz - s1 * wx) * b1 - ww * n1 + a12 * d12 * e2 + a13 * d13 * e3)
    t2 = torque[1] - ((c2 * wz - s2 * wx) * b2 - ww * n2 - a12 * d12 * e1 + a23 * d23 * e3)
    t3 = torque[2] - ((c3 * wz - s3 * wx) * b3 - ww * n3 - a13 * d13 * e1 - a23 * d23 * e2)

    # Own rotation of what turns with each angle: J = diag(along, about, across) turned by the angle about -y.
    i1 = p[base + at.L_TURNING + 1]
    i2 = p[base + at.L_TURNING + 4]
    i3 = p[base + at.L_TURNING + 7]
    for k in range(3):
        c, s, r = (c1, s1, r1) if k == 0 else ((c2, s2, r2) if k == 1 else (c3, s3, r3))
        along = p[base + at.L_TURNING + 3 * k]
        about = p[base + at.L_TURNING + 3 * k + 1]
        across = p[base + at.L_TURNING + 3 * k + 2]
        jxx = along * c * c + across * s * s
        jzz = along * s * s + across * c * c
        jxz = (along - across) * s * c
        hxx += jxx
        hyy += about
        hzz += jzz
        hxz += jxz
        turn = wy - r
        jx = jxx * wx + jxz * wz
        jz = jxz * wx + jzz * wz
        y = wz * jx - wx * jz
        mx -= turn * jz - wz * about * turn + (jxx * wz - jxz * wx) * r
        my -= y
        mz -= wx * about * turn - turn * jx + (jxz * wz - jzz * wx) * r
        if k == 0:
            t1 += y
        elif k == 1:
            t2 += y
        else:
            t3 += y

    # Eliminate f: everything about the common centre of mass.
    inverse = 1.0 / mass
    mm = (mcx * mcx + mcy * mcy + mcz * mcz) * inverse
    hxx -= mm - mcx * mcx * inverse
    hyy -= mm - mcy * mcy * inverse
    hzz -= mm - mcz * mcz * inverse
    hxy += mcx * mcy * inverse
    hxz += mcx * mcz * inverse
    hyz += mcy * mcz * inverse
    mx -= (mcy * fz - mcz * fy) * inverse
    my -= (mcz * fx - mcx * fz) * inverse
    mz -= (mcx * fy - mcy * fx) * inverse
    q1 = f1 * inverse
    q2 = f2 * inverse
    q3 = f3 * inverse
    t1 -= q1 * (c1 * fz - s1 * fx)
    t2 -= q2 * (c2 * fz - s2 * fx)
    t3 -= q3 * (c3 * fz - s3 * fx)
    # Columns of the joints: g_k x u'_k - I_k y - S_k mc x u'_k / m.
    y1 = o1y - q1 * mcy
    y2 = o2y - q2 * mcy
    y3 = o3y - q3 * mcy
    h1x = y1 * c1
    h2x = y2 * c2
    h3x = y3 * c3
    h1y = q1 * (c1 * mcx + s1 * mcz) - (c1 * g1x + s1 * g1z) - i1
    h2y = q2 * (c2 * mcx + s2 * mcz) - (c2 * g2x + s2 * g2z) - i2
    h3y = q3 * (c3 * mcx + s3 * mcz) - (c3 * g3x + s3 * g3z) - i3
    h1z = y1 * s1
    h2z = y2 * s2
    h3z = y3 * s3
    rotor = p[base + at.L_ROTOR]
    j11, j22, j33, j12, j13, j23 = _symmetric_inverse(
        a11 - q1 * f1 + i1 + rotor,
        a22 - q2 * f2 + i2 + rotor,
        a33 - q3 * f3 + i3 + rotor,
        (a12 - q1 * f2) * (c1 * c2 + s1 * s2),
        (a13 - q1 * f3) * (c1 * c3 + s1 * s3),
        (a23 - q2 * f3) * (c2 * c3 + s2 * s3),
    )
    # Eliminate the joints: G = h J, H - G h^T.
    gx1 = h1x * j11 + h2x * j12 + h3x * j13
    gx2 = h1x * j12 + h2x * j22 + h3x * j23
    gx3 = h1x * j13 + h2x * j23 + h3x * j33
    gy1 = h1y * j11 + h2y * j12 + h3y * j13
    gy2 = h1y * j12 + h2y * j22 + h3y * j23
    gy3 = h1y * j13 + h2y * j23 + h3y * j33
    gz1 = h1z * j11 + h2z * j12 + h3z * j13
    gz2 = h1z * j12 + h2z * j22 + h3z * j23
    gz3 = h1z * j13 + h2z * j23 + h3z * j33
    vxx, vyy, vzz, vxy, vxz, vyz = _symmetric_inverse(
        hxx - (gx1 * h1x + gx2 * h2x + gx3 * h3x),
        hyy - (gy1 * h1y + gy2 * h2y + gy3 * h3y),
        hzz - (gz1 * h1z + gz2 * h2z + gz3 * h3z),
        hxy - (gx1 * h1y + gx2 * h2y + gx3 * h3y),
        hxz - (gx1 * h1z + gx2 * h2z + gx3 * h3z),
        hyz - (gy1 * h1z + gy2 * h2z + gy3 * h3z),
    )
    mx -= gx1 * t1 + gx2 * t2 + gx3 * t3
    my -= gy1 * t1 + gy2 * t2 + gy3 * t3
    mz -= gz1 * t1 + gz2 * t2 + gz3 * t3
    ax = vxx * mx + vxy * my + vxz * mz
    ay = vxy * mx + vyy * my + vyz * mz
    az = vxz * mx + vyz * my + vzz * mz
    t1 -= h1x * ax + h1y * ay + h1z * az
    t2 -= h2x * ax + h2y * ay + h2z * az
    t3 -= h3x * ax + h3y * ay + h3z * az
    d1 = j11 * t1 + j12 * t2 + j13 * t3
    d2 = j12 * t1 + j22 * t2 + j23 * t3
    d3 = j13 * t1 + j23 * t2 + j33 * t3
    fx -= ay * mcz - az * mcy - (f1 * s1 * d1 + f2 * s2 * d2 + f3 * s3 * d3)
    fy -= az * mcx - ax * mcz
    fz -= ax * mcy - ay * mcx + f1 * c1 * d1 + f2 * c2 * d2 + f3 * c3 * d3
    return (fx * inverse, fy * inverse, fz * inverse, ax, ay, az, d1, d2, d3)
