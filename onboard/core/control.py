"""From reference to wrench, attitude, body rates and joint torques: the laws, in the order of the paper's Fig. 4.

Translation (eq. 2, 3) -> roll, pitch and thrust (eq. 4) -> attitude reference -> joint compensation (eq. 10)
-> attitude and joints (eq. 5 to 7). Beyond the paper, each switched by a parameter: the reaction of the moving
arm on the base, the base's acceleration in the attitude and joint torques, and the contact force's torque.
"""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING, Annotated

from msgspec import Struct

from drivers.samples import Interface, Vec3
from onboard.core import backstepping, compensation, kinematics, math3, sliding_mode, tilt
from onboard.core.derived import Derived
from onboard.core.spec import note, spec
from onboard.core.types import Control, Estimate, Reference

if TYPE_CHECKING:
    from onboard.core.params import Params as AllParams


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """How the laws are joined."""

    coupling: Annotated[bool, note("feed the arm's reaction on the base, and the base's acceleration, forward")] = True
    contact_torque: Annotated[bool, note("feed the desired contact force's torque on attitude and joints forward")] = (
        True
    )
    contact_blend: Annotated[float, spec("s", 0.0, 5.0, "time in which the translation law turns compliant")] = 0.3
    attitude_lead: Annotated[float, spec("s", 0.0, 0.5, "lead of the attitude set-point over the reference")] = 0.0
    rate_lead: Annotated[float, spec("s", 0.0, 0.5, "lead of the body-rate set-point over the reference")] = 0.0


class State(Struct, frozen=True, gc=False):
    """States of the laws."""

    backstepping: backstepping.State = backstepping.State()
    tilt: tilt.State = tilt.State()
    sliding: sliding_mode.State = sliding_mode.State()
    compensation: compensation.State | None = None
    """None before the first sample."""
    joint_acceleration: Vec3 = (0.0, 0.0, 0.0)
    contact: float = 0.0
    """0 in free flight to 1 with the force loop closed."""
    steady: float = 0.0
    """0 to 1: how far the arm makes up for the base's position error."""


def step(
    state: State,
    estimate: Estimate,
    reference: Reference,
    flying: bool,
    near_pipe: bool,
    joints_closed: bool,
    derived: Derived,
    params: AllParams,
    dt: float,
) -> tuple[State, Control]:
    """One tick of the laws.

    flying: off the ground (the laws adapt); near_pipe: the tip is at the pipe; joints_closed: our law closes the
    joints' loops (else the servos do, and the torques are feed-forward alone).
    """
    if reference.lift == 0.0:  # on the ground with the motors off: nothing of the last flight is remembered
        state = State(compensation=state.compensation)
    own, model = params.control, derived.model
    p, v, rpy, rpy_rate = estimate.p_WB, estimate.v_WB, estimate.rpy, estimate.rpy_rate
    joints, joint_rates = estimate.joints, estimate.joint_rates
    payload = estimate.payload
    mass = model.mass(payload)

    change = dt / own.contact_blend if own.contact_blend > 0.0 else 1.0
    contact = min(1.0, state.contact + change) if reference.pressing else max(0.0, state.contact - change)

    # along the arm, not along the pipe's normal: the vehicle turns about the tip that friction holds, and a push past
    # the tip would turn it further
    along = (cos(rpy[2]), sin(rpy[2]))
    rp, rv, ra = reference.p, reference.v, reference.a
    translation, force, _ = backstepping.step(
        state.backstepping,
        (p[0] - rp[0], p[1] - rp[1], p[2] - rp[2]),
        (v[0] - rv[0], v[1] - rv[1], v[2] - rv[2]),
        ra,
        mass,
        mass * params.vehicle.gravity,
        along,
        contact,
        flying,
        near_pipe,
        reference.force_ahead,
        estimate.forces.wind,
        params.backstepping,
        dt,
    )

    q = (*p, *rpy, *joints)
    qd = (*v, *rpy_rate, *joint_rates)
    if own.coupling:
        # the same force law with the arm's own motion in it: rows of M q'' + C q' beyond m v
        moving = model.inverse_dynamics(q, qd, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *state.joint_acceleration), payload)
        force = (force[0] + moving[0], force[1] + moving[1], force[2] + moving[2] - mass * params.vehicle.gravity)

    roll, pitch, thrust = tilt.attitude_and_thrust(force, rpy[2], params.tilt)
    tilted, roll_acceleration, pitch_acceleration = tilt.step(state.tilt, roll, pitch, params.tilt, dt)

    change = dt / params.compensation.steady_blend
    steady = min(1.0, state.steady + change) if reference.steady else max(0.0, state.steady - change)
    filtered, joint_acceleration = _arm(state.compensation, estimate, reference, steady, params, dt)
    target, target_rate = filtered.joints, filtered.rates

    wanted = (tilted.roll, tilted.pitch, reference.yaw)
    wanted_rate = (tilted.roll_rate, tilted.pitch_rate, reference.yaw_rate)
    error = (
        rpy[0] - wanted[0],
        rpy[1] - wanted[1],
        math3.wrap_angle(rpy[2] - wanted[2]),
        joints[0] - target[0],
        joints[1] - target[1],
        joints[2] - target[2],
    )
    error_rate = (
        rpy_rate[0] - wanted_rate[0],
        rpy_rate[1] - wanted_rate[1],
        rpy_rate[2] - wanted_rate[2],
        joint_rates[0] - target_rate[0],
        joint_rates[1] - target_rate[1],
        joint_rates[2] - target_rate[2],
    )
    # Where the autopilot or the servos close a loop themselves, ours stays open on those axes: what is left of the
    # torques is feed-forward, and the joints do not answer to an attitude law that nobody applies.
    sliding, angular, adapted = sliding_mode.step(
        state.sliding,
        _ours(error, params, joints_closed),
        _ours(error_rate, params, joints_closed),
        (roll_acceleration, pitch_acceleration, reference.yaw_acceleration, *joint_acceleration),
        flying,
        params.sliding_mode,
        dt,
    )
    base = ra if own.coupling else (0.0, 0.0, 0.0)
    tau = model.inverse_dynamics(q, qd, (*base, *angular), payload)
    t3, t4, t5, t6, t7, t8 = (
        tau[3] + adapted[0], tau[4] + adapted[1], tau[5] + adapted[2],
        tau[6] + adapted[3], tau[7] + adapted[4], tau[8] + adapted[5],
    )  # fmt: skip
    if own.contact_torque and reference.pressing:
        f = contact * max(0.0, reference.force)  # the pipe does not pull
        push = model.contact_torque(q, (-f * along[0], -f * along[1], 0.0))
        t3, t4, t5, t6, t7, t8 = t3 - push[3], t4 - push[4], t5 - push[5], t6 - push[6], t7 - push[7], t8 - push[8]
    torque = math3.body_torque_from_euler(rpy, (t3, t4, t5))

    gains = params.sliding_mode.attitude
    lead = own.rate_lead
    rates = math3.body_from_euler_rates(
        rpy,
        (
            wanted_rate[0] + lead * roll_acceleration - sliding_mode.surface_rate(error[0], gains),
            wanted_rate[1] + lead * pitch_acceleration - sliding_mode.surface_rate(error[1], gains),
            wanted_rate[2] + lead * reference.yaw_acceleration - sliding_mode.surface_rate(error[2], gains),
        ),
    )
    ahead = own.attitude_lead
    heading = wanted[2] + ahead * wanted_rate[2]
    leant = tilt.turned(wanted[0] + ahead * wanted_rate[0], wanted[1] + ahead * wanted_rate[1], rpy[2] - heading)
    attitude = math3.quat_from_euler((*leant, heading))
    lift = reference.lift
    return (
        State(translation, tilted, sliding, filtered, joint_acceleration, contact, steady),
        Control(
            lift * thrust,
            (lift * torque[0], lift * torque[1], lift * torque[2]),
            (t6, t7, t8),
            wanted,
            wanted_rate,
            target,
            target_rate,
            rates,
            attitude,
        ),
    )


def _ours(error: sliding_mode.Six, params: AllParams, joints_closed: bool) -> sliding_mode.Six:
    """``error`` on the axes whose loops are closed by our law, 0 on the others."""
    if params.interface is not Interface.WRENCH:
        error = (0.0, 0.0, 0.0, *error[3:])
    return error if joints_closed else (*error[:3], 0.0, 0.0, 0.0)


def _arm(
    state: compensation.State | None,
    estimate: Estimate,
    reference: Reference,
    steady: float,
    params: AllParams,
    dt: float,
) -> tuple[compensation.State, Vec3]:
    """Joint reference that holds wrist and tool in the world at the measured pitch."""
    arm = params.vehicle.arm
    pitch, pitch_rate = estimate.rpy[1], estimate.rpy_rate[1]
    wrist, wrist_rate = reference.wrist, reference.wrist_rate
    if steady > 0.0:
        share, most = steady * params.compensation.steady, params.compensation.steady_max
        p, v, rp, rv = estimate.p_WB, estimate.v_WB, reference.p, reference.v
        c, s = cos(reference.yaw), sin(reference.yaw)
        ahead, up = c * (rp[0] - p[0]) + s * (rp[1] - p[1]), rp[2] - p[2]
        if abs(ahead) < most and abs(up) < most:
            wrist_rate = (
                wrist_rate[0] + share * (c * (rv[0] - v[0]) + s * (rv[1] - v[1])),
                wrist_rate[1] + share * (rv[2] - v[2]),
            )
        wrist = (
            wrist[0] + share * min(most, max(-most, ahead)),
            wrist[1] + share * min(most, max(-most, up)),
        )
    x, z, vx, vz = compensation.wrist_in_body(wrist, wrist_rate, (arm.mount[0], arm.mount[2]), pitch, pitch_rate)
    theta_1, theta_2, _ = kinematics.nearest_wrist(arm, x, z)
    a, b, c, d = kinematics.wrist_jacobian_inverse(arm, theta_1, theta_2)
    target = (theta_1, theta_2, reference.elevation + pitch)
    rate = (a * vx + b * vz, c * vx + d * vz, reference.elevation_rate + pitch_rate)
    if state is None:
        state = compensation.State(estimate.joints)
    return compensation.step(state, target, rate, params.compensation, dt)
