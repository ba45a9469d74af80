"""Observer of the external wrench by the generalised momentum, arm included (first order).

    p = M(q) q',    p' = tau + C^T q' - G + tau_ext
    r = K (p - integral of (tau + C^T q' - G + r))    =>    tau_ext filtered by K / (s + K)

in the nine coordinates of ``dynamics``: a force in W, generalised torques on the Euler angles, and torques on the
joints. No acceleration is differentiated and the arm's reaction on the base is in M: swinging the arm is no force.
(De Luca and Mattone, ICRA 2005; for aerial manipulators Tomic et al., IJRR 2017.)

The velocity is that of the tracker at low frequencies and the integral of the accelerometer above them
(``velocity_gain``): the noise of the tracker alone, times mass and gain, would be half a newton. The rows of the Euler
angles are zero when the autopilot is not sent torques: its own loops are not known.

The rows of the joints see what acts on the tip, and no wind on the base: ``felt`` is the force at the tip in the arm's
plane that explains them best. What is not known of the gears' friction stays in it.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Annotated

from msgspec import Struct

from drivers.samples import Vec3
from drivers.vehicle import Arm, Servo
from onboard.core.compiled import compiled
from onboard.core.dynamics import Model
from onboard.core.spec import note, spec
from onboard.core.told import Nine, Told

#: From this rate on a joint slides, rad/s; well above the grain of a servo's rate.
_SLIDING = 0.05
_ZERO: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Gains."""

    force_gain: Annotated[float, spec("rad/s", 0.1, 100.0, "K of the force")] = 20.0
    torque_gain: Annotated[float, spec("rad/s", 0.1, 100.0, "K of the torque on the body")] = 20.0
    joint_gain: Annotated[float, spec("rad/s", 0.1, 100.0, "K of the torques on the joints")] = 30.0
    velocity_gain: Annotated[
        float, spec("1/s", 0.0, 20.0, "how fast the integrated accelerometer follows the tracker's velocity")
    ] = 0.5
    supply_current: Annotated[
        bool, note("the servos tell the current of their supply, not of the motor, as XC330s do")
    ] = True


class State(Struct, frozen=True, gc=False):
    """Predicted momentum, residual (external generalised forces), velocity (m/s, W)."""

    predicted: Nine = _ZERO
    residual: Nine = _ZERO
    velocity: Vec3 = (0.0, 0.0, 0.0)
    begun: bool = False

    @property
    def force(self) -> Vec3:
        """External force on the vehicle, not tared, N, W."""
        return self.residual[:3]

    @property
    def joints(self) -> Vec3:
        """External torques on the joints, not tared, N m."""
        return self.residual[6:]


def step(state: State, told: Told, model: Model, params: Params, dt: float) -> State:
    """One tick."""
    v = told.v_W
    if not state.begun:
        q = told.q
        p, _ = model.momentum(q, (*v, *told.qd[3:]), told.payload)
        return State(p, _ZERO, v, True)
    a, old = told.a_W, state.velocity
    share = min(1.0, params.velocity_gain * dt)
    v = (
        old[0] + a[0] * dt + share * (v[0] - old[0]),
        old[1] + a[1] * dt + share * (v[1] - old[1]),
        old[2] + a[2] * dt + share * (v[2] - old[2]),
    )
    p, drift = model.momentum(told.q, (*v, *told.qd[3:]), told.payload)
    predicted, residual = _step(
        state.predicted, p, drift, told.R, told.thrust, told.drag, told.torque, told.joint_torque,
        (params.force_gain, params.torque_gain if told.torque_known else 0.0, params.joint_gain), dt,
    )  # fmt: skip
    return State(predicted, residual, v, True)


def servo_torque(current: float, rate: float, servo: Servo, supply: bool) -> float:
    """Torque of a joint servo at its output by its current (A) and rate (rad/s), N m.

    The gear's friction is taken off as far as it is known: all of it while the joint moves, none while it sticks.

    supply: the current is that of the supply, motor current times duty cycle, and the duty cycle is what overcomes
    resistance and back-EMF: i / i_stall = s |s + rate / no-load rate| with s = torque / stall torque.
    """
    share = current / servo.stall_current
    if supply and share != 0.0:
        speed = rate / servo.no_load_speed
        sign = 1.0 if share > 0.0 else -1.0
        square, four = speed * speed, 4.0 * abs(share)
        if sign * speed < 0.0 and four <= square:
            # braking: up to three torques draw this current; the least is the likeliest of an arm that hardly works
            share = 0.5 * sign * (abs(speed) - sqrt(square - four))
        else:
            share = 0.5 * (sign * sqrt(square + four) - speed)
    slip = max(-1.0, min(1.0, rate / _SLIDING))
    return servo.stall_torque * share - slip * servo.friction_static - rate * servo.friction_viscous


@compiled(
    "UniTuple(UniTuple(f8, 9), 2)"
    "(UniTuple(f8, 9), UniTuple(f8, 9), UniTuple(f8, 9), UniTuple(f8, 9), f8, UniTuple(f8, 3), UniTuple(f8, 3),"
    " UniTuple(f8, 3), UniTuple(f8, 3), f8)"
)
def _step(
    predicted: Nine, p: Nine, drift: Nine, r: Nine, thrust: float, drag: Vec3, torque: Vec3,
    joints: Vec3, gains: Vec3, dt: float,
) -> tuple[Nine, Nine]:  # fmt: skip
    x, y, z = drag[0], drag[1], thrust + drag[2]
    tau = (
        r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z,
        torque[0], torque[1], torque[2], joints[0], joints[1], joints[2],
    )  # fmt: skip
    g0, g1, g2 = gains
    # the residual of now is in its own prediction, which keeps any gain stable: r = K / (1 + K dt) (p - p_known)
    k0, k1, k2 = g0 / (1.0 + g0 * dt), g1 / (1.0 + g1 * dt), g2 / (1.0 + g2 * dt)
    e = (
        p[0] - predicted[0] - dt * (tau[0] + drift[0]), p[1] - predicted[1] - dt * (tau[1] + drift[1]),
        p[2] - predicted[2] - dt * (tau[2] + drift[2]), p[3] - predicted[3] - dt * (tau[3] + drift[3]),
        p[4] - predicted[4] - dt * (tau[4] + drift[4]), p[5] - predicted[5] - dt * (tau[5] + drift[5]),
        p[6] - predicted[6] - dt * (tau[6] + drift[6]), p[7] - predicted[7] - dt * (tau[7] + drift[7]),
        p[8] - predicted[8] - dt * (tau[8] + drift[8]),
    )  # fmt: skip
    f = (k0 * e[0], k0 * e[1], k0 * e[2], k1 * e[3], k1 * e[4], k1 * e[5], k2 * e[6], k2 * e[7], k2 * e[8])
    still = g1 == 0.0
    after = (
        p[0] - f[0] / g0, p[1] - f[1] / g0, p[2] - f[2] / g0,
        p[3] if still else p[3] - f[3] / g1, p[4] if still else p[4] - f[4] / g1, p[5] if still else p[5] - f[5] / g1,
        p[6] - f[6] / g2, p[7] - f[7] / g2, p[8] - f[8] / g2,
    )  # fmt: skip
    return after, f


def force_at_tip(joints: Vec3, angles: Vec3, arm: Arm) -> tuple[float, float]:
    """Force (x, z of B, N) at the gripper's tip that explains external joint torques (N m) best, in least squares."""
    return _force_at_tip(joints, angles, (arm.link_1, arm.link_2, arm.gripper))


@compiled("UniTuple(f8, 2)(UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3))")
def _force_at_tip(joints: Vec3, angles: Vec3, lengths: Vec3) -> tuple[float, float]:
    xx = xz = zz = bx = bz = 0.0
    for i in range(3):
        jx, jz = -lengths[i] * sin(angles[i]), lengths[i] * cos(angles[i])
        xx += jx * jx
        xz += jx * jz
        zz += jz * jz
        bx += jx * joints[i]
        bz += jz * joints[i]
    # a stretched arm feels nothing along itself: there the least force is taken
    ridge = 1e-3 * (xx + zz)
    xx += ridge
    zz += ridge
    det = xx * zz - xz * xz
    return (zz * bx - xz * bz) / det, (xx * bz - xz * bx) / det
