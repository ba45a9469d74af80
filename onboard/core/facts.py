"""From what the core believes to the facts that safety and mission decide on."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

from msgspec.structs import replace

from drivers.samples import Engage, FlightMode, JointMode, Landed
from onboard.core import contact_trigger, estimators, limits, math3, mission, safety
from onboard.core.guidance import Progress
from onboard.core.types import Estimate, Estimator, Inputs, Phase, Reference, Verdict

if TYPE_CHECKING:
    from onboard.core import compensation
    from onboard.core import estimate as estimating
    from onboard.core.derived import Derived
    from onboard.core.params import Params

#: Rise above the place of takeoff that counts as flying, m.
LIFT_OFF = 0.05
_CONTACT = (Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, Phase.RETREAT_HOLD, Phase.RETREAT_LAND)
_DEVICES = ("odometry", "autopilot", "servos")
#: Of a vehicle on the ground of which nothing is known yet.
_NOTHING_AMISS = safety.Facts(
    phase=Phase.PREFLIGHT, airborne=False, armed=False, contact_expected=False, pressing=False, age_odometry=0.0,
    age_autopilot=0.0, age_servos=0.0, odometry_jump=0.0, odometry_reset=False, confidence=3.0, tilt=0.0,
    position=(0.0, 0.0, 0.0), contact_force=0.0, free_flight_force=0.0, servo_error=0, temperature=25.0,
    servo_voltage_min=5.0, servo_voltage_max=5.0, torque_on=True, joint_error=0.0, battery_voltage=16.0,
    battery_remaining=1.0, dt=0.0, inputs_finite=True, offboard_lost=False,
)  # fmt: skip


def airborne(
    before: bool, seen: estimating.State, believed: Estimate, phase: Phase, home_height: float, lift: float
) -> bool:
    """Whether the vehicle is off the ground: it has risen with its motors on, and has not landed since."""
    told = seen.autopilot
    if told is None or not told.armed:
        # a report of "disarmed" in the air must not hide that the vehicle is there; but where it should come down,
        # the autopilot's word ends the landing, since the position may be what was lost
        down = phase is Phase.LAND and told is not None and told.landed is Landed.ON_GROUND
        return before and not down and believed.p_WB[2] > home_height + LIFT_OFF
    if before:
        return not (lift < 1.0 and told.landed is Landed.ON_GROUND)
    return lift > 0.5 and believed.p_WB[2] > home_height + LIFT_OFF


def for_safety(
    seen: estimating.State, believed: Estimate, inputs: Inputs, phase: Phase, flying: bool, engaged_before: bool,
    reference: Reference | None, arm: compensation.State | None,
) -> safety.Facts:  # fmt: skip
    """Facts of one tick. arm: the joint reference."""
    odometry, autopilot, servos = seen.odometry, seen.autopilot, seen.servos
    if odometry is None or autopilot is None or servos is None:
        return replace(
            _NOTHING_AMISS,
            phase=phase,
            age_odometry=0.0 if odometry is None else believed.age_odometry,
            age_autopilot=0.0 if autopilot is None else believed.age_autopilot,
            age_servos=0.0 if servos is None else believed.age_servos,
            dt=inputs.dt,
            inputs_finite=seen.finite,
            obstacles=" ".join(inputs.obstacles),
            commander=inputs.link.commander,
            link_age=inputs.link.age(inputs.t_ns),
            missing=", ".join(
                name for name, told in zip(_DEVICES, (odometry, autopilot, servos), strict=True) if told is None
            ),
        )
    f = believed.force_W
    now = believed.joints
    joints = arm.joints if arm is not None else now
    errors = servos.error
    return safety.Facts(
        phase,
        flying,
        autopilot.armed,
        phase in _CONTACT,
        phase is Phase.PRESS and reference is not None and reference.pressing,
        believed.age_odometry,
        believed.age_autopilot,
        believed.age_servos,
        seen.jump,
        seen.reset,
        odometry.confidence,
        math3.tilt(believed.R_WB),
        believed.p_WB,
        believed.contact_force,
        hypot(f[0], f[1], f[2]),
        errors[0] | errors[1] | errors[2] | errors[3] | errors[4],
        max(servos.temperature),
        min(servos.voltage),
        max(servos.voltage),
        servos.torque_on,
        max(abs(now[0] - joints[0]), abs(now[1] - joints[1]), abs(now[2] - joints[2])) if flying else 0.0,
        autopilot.battery_voltage,
        autopilot.battery_remaining,
        inputs.dt,
        seen.finite,
        engaged_before and autopilot.mode is not FlightMode.OFFBOARD,
        seen.disagreement,
        obstacles=" ".join(inputs.obstacles),
        commander=inputs.link.commander,
        link_age=inputs.link.age(inputs.t_ns),
    )


def for_mission(
    seen: estimating.State, believed: Estimate, progress: Progress, phase: Phase, flying: bool, verdict: Verdict,
    go: Phase | None, derived: Derived, params: Params,
) -> mission.Facts:  # fmt: skip
    """Facts of one tick. progress: of the reference in the tick before, in the same phase. go: where to, if asked."""
    told = seen.autopilot
    armed = told is not None and told.armed
    grounded = told is not None and told.landed is Landed.ON_GROUND
    site, contact = derived.site, params.contact
    crack, tip, n = site.crack, believed.tip_W, site.normal
    beyond = (tip[0] - crack[0]) * n[0] + (tip[1] - crack[1]) * n[1] - progress.along
    aside, up = abs((tip[1] - crack[1]) * n[0] - (tip[0] - crack[0]) * n[1]), tip[2] - crack[2]
    adrift = believed.age_autopilot > params.safety.autopilot_lost
    return mission.Facts(
        ready=believed.valid and grounded and not armed and not verdict.reasons,
        engaged=armed and told is not None and told.mode is FlightMode.OFFBOARD,
        airborne=flying,
        arrived=progress.arrived or adrift,  # without attitude no motion is flown to its end
        triggered=believed.in_contact,
        pressed=progress.pressed,
        released=progress.released,
        tared=progress.tared,
        landed=grounded and not flying,
        disarmed=not armed,
        in_contact=believed.in_contact,
        contact_lost=phase is Phase.PRESS
        # where the tip is off the crack, or the arm not across the pipe, pushing on leads past the pipe
        and (
            abs(up) > contact.height
            or abs(math3.wrap_angle(believed.rpy[2] - site.yaw)) > contact.turn
            or (not believed.in_contact and (progress.lost or aside > contact_trigger.FAR * contact.tolerance))
        ),
        overtravel=progress.missed or (phase is Phase.ADVANCE and beyond > params.plan.overtravel),
        blind=safety.blind(verdict),
        offboard_lost=safety.yielded(verdict),
        payload=believed.payload,
        tare=estimators.tare_in_force(seen.forces, params.estimators),
        tare_used=params.observer.tare or params.estimators.selected is not Estimator.PAPER,
        go=go,
    )


def joint_drive(seen: estimating.State, believed: Estimate, params: Params) -> tuple[JointMode, bool]:
    """How the joints are driven in this tick, and whether our joint law closes their loop.

    Joints that are not seen any more are held by the servos themselves: torques would fling the arm. And where the
    servos do not obey, the loop stays open: the base must not answer to an arm that does not move.
    """
    mode = params.joints if believed.age_servos <= params.safety.servos_late else JointMode.POSITION
    limp = seen.servos is not None and not seen.servos.torque_on
    return mode, mode is JointMode.TORQUE and not limp


def permission(phase: Phase, engage: Engage, believed: Estimate, aloft: bool) -> limits.Permission:
    """What the gate may let through. aloft: away from the ground, with the motors spooled up."""
    return limits.Permission(
        motors=phase not in (Phase.PREFLIGHT, Phase.STOPPED),
        joints=believed.valid and engage is not Engage.KILL,
        floor=aloft and phase is not Phase.LAND,
    )


def measured(seen: estimating.State) -> limits.Measured:
    """Where the gate takes its rates up from."""
    return limits.Measured(
        seen.autopilot.q_WB if seen.autopilot is not None else None,
        seen.servos.position if seen.servos is not None else None,
    )
