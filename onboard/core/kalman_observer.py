"""Kalman filter of the external force: at the tip a random walk, beside it the wind as another.

On each axis (contact normal, to its left, up) three states: velocity v, contact force f, disturbance d.

    v' = u + (f + d) / m + noise,    f' = noise,    d' = noise

u is what thrust, drag and gravity alone would do. Measured are f + d by the accelerometer, v by the tracker, and f by
the joints (in the arm's plane). Wind and contact are the same force to the first two, so what tells them apart is:

- the contact gate: where the tip is not near the pipe, f is zero and all is wind;
- the onset: a contact rises in tenths of a second, so f may move fast and d only slowly (``force_rate``,
  ``wind_rate``);
- what the arm feels (``joint_noise``): no wind acts on the tip. It decides slowly; what is fast is the accelerometer's.

An offset of any kind (accelerometer, thrust, steady wind) is in d, so that f wants no tare.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Struct

from drivers.samples import Vec3
from onboard.core.compiled import compiled
from onboard.core.spec import spec
from onboard.core.told import Nine, Told

#: Covariance of (v, f, d): vv, vf, vd, ff, fd, dd.
Six = tuple[float, float, float, float, float, float]

_START: Six = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Noise densities; each is a standard deviation."""

    force_rate: Annotated[float, spec("N/s^0.5", 0.001, 20.0, "random walk of the contact force near the pipe")] = 1.2
    wind_rate: Annotated[float, spec("N/s^0.5", 0.001, 20.0, "random walk of the disturbance near the pipe")] = 0.5
    free_rate: Annotated[float, spec("N/s^0.5", 0.001, 20.0, "the same in free flight")] = 0.5
    velocity_rate: Annotated[float, spec("m/s^1.5", 1e-4, 10.0, "errors of thrust and attitude in v'")] = 0.10
    force_noise: Annotated[float, spec("N", 0.001, 20.0, "force by the accelerometer, each tick")] = 0.7
    velocity_noise: Annotated[float, spec("m/s", 0.001, 2.0, "velocity by the tracker, each sample")] = 0.05
    joint_noise: Annotated[float, spec("N", 0.01, 1000.0, "force by the joints, each tick; large: not used")] = 0.3


class State(Struct, frozen=True, gc=False):
    """v, f, d of the three axes, and the covariances in the arm's plane and across it."""

    x: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    plane: Six = _START
    across: Six = _START
    force: Vec3 = (0.0, 0.0, 0.0)
    """f + d: the whole external force, N, W."""
    contact: Vec3 = (0.0, 0.0, 0.0)
    """f alone, N, W."""
    begun: bool = False


def step(state: State, told: Told, params: Params, dt: float) -> State:
    """One tick."""
    noise = (
        params.velocity_rate**2 * dt,
        params.force_rate**2 * dt if told.near else 0.0,
        (params.wind_rate if told.near else params.free_rate) ** 2 * dt,
        params.force_noise**2,
        params.velocity_noise**2 if told.fresh else 0.0,
        params.joint_noise**2 if told.joints_known else 0.0,
    )
    x, plane, across, force, contact = _step(
        state.x, state.plane, state.across, told.f_B, told.v_W, told.felt, told.R, told.thrust, told.drag,
        (told.mass, told.gravity, dt), noise, told.normal, told.near, state.begun,
    )  # fmt: skip
    return State(x, plane, across, force, contact, True)


@compiled(
    "Tuple((UniTuple(f8, 3), UniTuple(f8, 6)))"
    "(UniTuple(f8, 3), UniTuple(f8, 6), f8, f8, f8, f8, f8, f8, f8, UniTuple(f8, 6), b1)"
)
def _axis(
    x: Vec3, p: Six, drive: float, measured: float, velocity: float, felt: float, joint_noise: float, mass: float,
    dt: float, noise: Six, near: bool,
) -> tuple[Vec3, Six]:  # fmt: skip
    """Predict and correct one axis. drive: u, m/s^2; measured: f + d, N; noise: variances, 0 for no measurement."""
    v, f, d = x
    vv, vf, vd, ff, fd, dd = p
    g = dt / mass
    if not near:  # the gate is closed: there is no contact
        d, f = d + f, 0.0
        vd, vf, dd, fd, ff = vd + vf, 0.0, dd + 2.0 * fd + ff, 0.0, 0.0
    v += dt * drive + g * (f + d)
    vv += 2.0 * g * (vf + vd) + g * g * (ff + 2.0 * fd + dd) + noise[0]
    vf += g * (ff + fd)
    vd += g * (fd + dd)
    ff += noise[1]
    dd += noise[2]

    # f + d by the accelerometer
    hv, hf, hd = vf + vd, ff + fd, fd + dd
    s = 1.0 / (hf + hd + noise[3])
    e = s * (measured - f - d)
    v, f, d = v + hv * e, f + hf * e, d + hd * e
    vv, vf, vd = vv - s * hv * hv, vf - s * hv * hf, vd - s * hv * hd
    ff, fd, dd = ff - s * hf * hf, fd - s * hf * hd, dd - s * hd * hd

    if noise[4] > 0.0:  # v by the tracker
        s = 1.0 / (vv + noise[4])
        e = s * (velocity - v)
        hv, hf, hd = vv, vf, vd
        v, f, d = v + hv * e, f + hf * e, d + hd * e
        vv, vf, vd = vv - s * hv * hv, vf - s * hv * hf, vd - s * hv * hd
        ff, fd, dd = ff - s * hf * hf, fd - s * hf * hd, dd - s * hd * hd

    if near and joint_noise > 0.0:  # f by the joints
        s = 1.0 / (ff + joint_noise)
        e = s * (felt - f)
        hv, hf, hd = vf, ff, fd
        v, f, d = v + hv * e, f + hf * e, d + hd * e
        vv, vf, vd = vv - s * hv * hv, vf - s * hv * hf, vd - s * hv * hd
        ff, fd, dd = ff - s * hf * hf, fd - s * hf * hd, dd - s * hd * hd
    return (v, f, d), (vv, vf, vd, ff, fd, dd)


@compiled(
    "Tuple((UniTuple(f8, 9), UniTuple(f8, 6), UniTuple(f8, 6), UniTuple(f8, 3), UniTuple(f8, 3)))"
    "(UniTuple(f8, 9), UniTuple(f8, 6), UniTuple(f8, 6), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3),"
    " UniTuple(f8, 9), f8, UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 6), UniTuple(f8, 2), b1, b1)"
)
def _step(
    x: Nine, plane: Six, across: Six, f_B: Vec3, v_W: Vec3, felt: Vec3, r: Nine, thrust: float, drag: Vec3,
    constants: Vec3, noise: Six, normal: tuple[float, float], near: bool, begun: bool,
) -> tuple[Nine, Six, Six, Vec3, Vec3]:  # fmt: skip
    mass, gravity, dt = constants
    n, m = normal
    # what thrust and drag do, and what the accelerometer feels beside them, in W
    ux, uy, uz = drag[0], drag[1], drag[2] + thrust
    wx = r[0] * ux + r[1] * uy + r[2] * uz
    wy = r[3] * ux + r[4] * uy + r[5] * uz
    wz = r[6] * ux + r[7] * uy + r[8] * uz
    ex, ey, ez = mass * f_B[0] - ux, mass * f_B[1] - uy, mass * f_B[2] - uz
    zx = r[0] * ex + r[1] * ey + r[2] * ez
    zy = r[3] * ex + r[4] * ey + r[5] * ez
    zz = r[6] * ex + r[7] * ey + r[8] * ez
    v = (n * v_W[0] + m * v_W[1], n * v_W[1] - m * v_W[0], v_W[2])
    if not begun:
        x = (v[0], 0.0, 0.0, v[1], 0.0, 0.0, v[2], 0.0, 0.0)
    a, p = _axis(
        (x[0], x[1], x[2]), plane, (n * wx + m * wy) / mass, n * zx + m * zy, v[0], n * felt[0] + m * felt[1],
        noise[5], mass, dt, noise, near,
    )  # fmt: skip
    b, q = _axis(
        (x[3], x[4], x[5]), across, (n * wy - m * wx) / mass, n * zy - m * zx, v[1], 0.0, 0.0, mass, dt, noise, near
    )
    c, _ = _axis((x[6], x[7], x[8]), plane, wz / mass - gravity, zz, v[2], felt[2], noise[5], mass, dt, noise, near)
    ahead, left, up = a[1] + a[2], b[1] + b[2], c[1] + c[2]
    return (
        (a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]),
        p,
        q,
        (n * ahead - m * left, m * ahead + n * left, up),
        (n * a[1] - m * b[1], m * a[1] + n * b[1], c[1]),
    )
