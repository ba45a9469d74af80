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
from onboard.core.dynamics import Array, Model, momentum
from onboard.core.spec import note, spec
from onboard.core.told import Nine, Told
from onboard.core.types import Mat3

Four = tuple[float, float, float, float]
Five = tuple[float, float, float, float, float]

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
    if not state.begun:
        p, _ = model.momentum(told.q, told.qd, told.payload)
        return State(p, _ZERO, told.v_W, True)
    parts, turning = model.packed(told.payload)
    predicted, residual, velocity = _step(
        state.predicted, state.velocity, told.q, told.qd, told.a_W, told.R, told.thrust, told.drag, told.torque,
        told.currents, servo_constants(told.servo), params.supply_current,
        (params.force_gain, params.torque_gain if told.torque_known else 0.0, params.joint_gain, params.velocity_gain),
        dt, parts, turning,
    )  # fmt: skip
    return State(predicted, residual, velocity, True)


def servo_constants(servo: Servo) -> Five:
    """What ``servo_torque`` is to know of a servo."""
    return (
        servo.stall_torque, servo.stall_current, servo.no_load_speed, servo.friction_static, servo.friction_viscous
    )  # fmt: skip


@compiled("f8(f8, f8, UniTuple(f8, 5), b1)")
def servo_torque(current: float, rate: float, servo: Five, supply: bool) -> float:
    """Torque of a joint servo at its output by its current (A) and rate (rad/s), N m.

    The gear's friction is taken off as far as it is known: all of it while the joint moves, none while it sticks.

    servo: ``servo_constants``. supply: the current is that of the supply, motor current times duty cycle, and the duty
    cycle is what overcomes resistance and back-EMF: i / i_stall = s |s + rate / no-load rate| with s = torque / stall
    torque.
    """
    stall_torque, stall_current, no_load_speed, friction_static, friction_viscous = servo
    share = current / stall_current
    if supply and share != 0.0:
        speed = rate / no_load_speed
        sign = 1.0 if share > 0.0 else -1.0
        square, four = speed * speed, 4.0 * abs(share)
        if sign * speed < 0.0 and four <= square:
            # braking: up to three torques draw this current; the least is the likeliest of an arm that hardly works
            share = 0.5 * sign * (abs(speed) - sqrt(square - four))
        else:
            share = 0.5 * (sign * sqrt(square + four) - speed)
    slip = max(-1.0, min(1.0, rate / _SLIDING))
    return stall_torque * share - slip * friction_static - rate * friction_viscous


@compiled(
    "Tuple((UniTuple(f8, 9), UniTuple(f8, 9), UniTuple(f8, 3)))"
    "(UniTuple(f8, 9), UniTuple(f8, 3), UniTuple(f8, 9), UniTuple(f8, 9), UniTuple(f8, 3), UniTuple(f8, 9), f8,"
    " UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 5), b1, UniTuple(f8, 4), f8, f8[:, ::1],"
    " f8[:, ::1])"
)
def _step(
    predicted: Nine, velocity: Vec3, q: Nine, qd: Nine, a: Vec3, r: Nine, thrust: float, drag: Vec3, torque: Vec3,
    currents: Vec3, servo: Five, supply: bool, gains: Four, dt: float, parts: Array, turning: Array,
) -> tuple[Nine, Nine, Vec3]:  # fmt: skip
    g0, g1, g2, follow = gains
    share = min(1.0, follow * dt)
    vx = velocity[0] + a[0] * dt + share * (qd[0] - velocity[0])
    vy = velocity[1] + a[1] * dt + share * (qd[1] - velocity[1])
    vz = velocity[2] + a[2] * dt + share * (qd[2] - velocity[2])
    p, drift = momentum(q, (vx, vy, vz, qd[3], qd[4], qd[5], qd[6], qd[7], qd[8]), parts, turning)
    x, y, z = drag[0], drag[1], thrust + drag[2]
    tau = (
        r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z,
        torque[0], torque[1], torque[2],
        servo_torque(currents[0], qd[6], servo, supply), servo_torque(currents[1], qd[7], servo, supply),
        servo_torque(currents[2], qd[8], servo, supply),
    )  # fmt: skip
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
    return after, f, (vx, vy, vz)


def felt(state: State, tare: Vec3, angles: Vec3, R_WB: Mat3, arm: Arm) -> Vec3:
    """Force at the gripper's tip in the arm's plane that explains the torques less their tare (N m) best, N, W."""
    return _felt(state.residual, tare, angles, R_WB, (arm.link_1, arm.link_2, arm.gripper))


@compiled("UniTuple(f8, 3)(UniTuple(f8, 9), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 9), UniTuple(f8, 3))")
def _felt(residual: Nine, tare: Vec3, angles: Vec3, r: Nine, lengths: Vec3) -> Vec3:
    xx = xz = zz = bx = bz = 0.0
    for i in range(3):
        jx, jz = -lengths[i] * sin(angles[i]), lengths[i] * cos(angles[i])
        torque = residual[6 + i] - tare[i]
        xx += jx * jx
        xz += jx * jz
        zz += jz * jz
        bx += jx * torque
        bz += jz * torque
    # a stretched arm feels nothing along itself: there the least force is taken
    ridge = 1e-3 * (xx + zz)
    xx += ridge
    zz += ridge
    det = xx * zz - xz * xz
    x, z = (zz * bx - xz * bz) / det, (xx * bz - xz * bx) / det
    return r[0] * x + r[2] * z, r[3] * x + r[5] * z, r[6] * x + r[8] * z
