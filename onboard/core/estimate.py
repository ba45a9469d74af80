"""From samples to what the core believes: body, joints, tip, contact force, and how old it all is.

Attitude, angular velocity and specific force come from the autopilot, position and velocity from odometry,
joints from the servos. A sample that is not finite, or a pose that repeats the one before, is not used: its device
falls silent, and its age tells. When the tracker jumps, the vehicle has not: its position goes on where it was.
"""

from __future__ import annotations

from math import acos, hypot, inf
from typing import TYPE_CHECKING, Annotated

from msgspec import Struct
from msgspec.structs import replace

from drivers.samples import AutopilotState, Odometry, ServoState, Vec3
from onboard.core import contact_trigger, estimators, kinematics, math3, plan
from onboard.core.derived import Derived
from onboard.core.guidance import Progress
from onboard.core.kinematics import Tool
from onboard.core.spec import spec
from onboard.core.types import Estimate, Inputs, Phase, Reference

if TYPE_CHECKING:
    from onboard.core.params import Params as AllParams

PRESSING = (Phase.PRESS, Phase.RELEASE)
NEAR_PIPE = (Phase.ADVANCE, *PRESSING)
#: On the way out of contact.
LEAVING = (Phase.ALIGN, Phase.TARE, Phase.RETREAT, Phase.RETREAT_HOLD, Phase.RETREAT_LAND)
ON_GROUND = (Phase.PREFLIGHT, Phase.ARMED, Phase.STOPPED)
FREE_FLIGHT = (Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE, Phase.RETURN, Phase.HOLD)


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """How samples are used."""

    extrapolate_max: Annotated[
        float, spec("s", 0.0, 0.2, "position is carried forward by velocity for at most this age")
    ] = 0.06
    jump: Annotated[
        float,
        spec("m", 0.003, 1.0, "a step of the tracker beyond what its velocity explains from which it is no motion"),
    ] = 0.01
    released_at: Annotated[
        float, spec("rad", -3.14, 3.14, "measured gripper angle beyond which the sleeve is gone")
    ] = 0.8


class State(Struct, frozen=True, gc=False):
    """The newest usable samples, and the states of the estimators and of the trigger."""

    odometry: Odometry | None = None
    autopilot: AutopilotState | None = None
    servos: ServoState | None = None
    forces: estimators.State = estimators.State()
    trigger: contact_trigger.State = contact_trigger.State()
    payload: bool = True
    finite: bool = True
    """All samples of this tick were finite."""
    jump: float = 0.0
    """Step of the newest odometry sample beyond what its velocity explains, m."""
    reset: bool = False
    """The tracker's reset counter has changed with the newest sample."""
    disagreement: float = 0.0
    """Angle between the verticals of odometry and autopilot, rad."""
    shift: Vec3 = (0.0, 0.0, 0.0)
    """What takes a position of the tracker back into the frame it had before it jumped, m."""
    alarm: contact_trigger.State = contact_trigger.State()
    """Away from the pipe: the trigger, as if the tip were at the crack."""
    near: bool = False
    """There may be contact: the gate of the estimators is open."""


def step(
    state: State,
    inputs: Inputs,
    phase: Phase,
    progress: Progress,
    reference: Reference | None,
    command: estimators.Command,
    derived: Derived,
    params: AllParams,
    dt: float,
) -> tuple[State, Estimate]:
    """One tick. phase, progress, reference, command: of the tick before."""
    finite = True
    jump, reset, disagreement = 0.0, False, state.disagreement
    odometry, autopilot, servos = state.odometry, state.autopilot, state.servos
    new = inputs.odometry
    shift = state.shift if phase is not Phase.PREFLIGHT else _O
    if new is not None and (odometry is None or new.t_ns != odometry.t_ns):
        if not _finite(new.p_WB, new.v_WB, new.q_WB):
            finite = False
        elif odometry is None:
            odometry = new
        elif phase in ON_GROUND or not _repeats(odometry, new):
            leap = _leap(odometry, new)
            jump = hypot(*leap)
            reset = new.reset_counter != odometry.reset_counter
            brief = new.t_ns - odometry.t_ns <= params.estimate.extrapolate_max * 1e9
            if brief and phase is not Phase.PREFLIGHT and (reset or jump > params.estimate.jump):
                shift = (shift[0] - leap[0], shift[1] - leap[1], shift[2] - leap[2])
            odometry = new
    told = inputs.autopilot
    if told is not None:
        if _finite(told.q_WB, told.w_WB_B, told.f_B):
            autopilot = told
        else:
            finite = False
    bus = inputs.servos
    if bus is not None:
        if _finite(bus.position, bus.velocity, bus.current, bus.voltage, bus.temperature):
            servos = bus
        else:
            finite = False

    now = inputs.t_ns
    ages = (
        (now - odometry.t_ns) * 1e-9 if odometry is not None else inf,
        (now - autopilot.t_ns) * 1e-9 if autopilot is not None else inf,
        (now - servos.t_ns) * 1e-9 if servos is not None else inf,
    )
    if odometry is None or autopilot is None or servos is None:
        estimate = _nothing(state.payload, ages)
        waiting = State(
            odometry, autopilot, servos, state.forces, state.trigger, state.payload,
            finite, jump, reset, disagreement, shift, state.alarm, state.near,
        )  # fmt: skip
        return waiting, estimate

    vehicle, site = params.vehicle, derived.site
    R = math3.matrix_from_quat(autopilot.q_WB)
    rpy = math3.euler_from_quat(autopilot.q_WB)
    w = autopilot.w_WB_B
    ax, ay, az = math3.rotate(R, autopilot.f_B)
    acceleration = (ax, ay, az - vehicle.gravity)
    v = odometry.v_WB
    ahead = min(max(0.0, ages[0]), params.estimate.extrapolate_max)
    p = (
        odometry.p_WB[0] + shift[0] + ahead * v[0],
        odometry.p_WB[1] + shift[1] + ahead * v[1],
        odometry.p_WB[2] + shift[2] + ahead * v[2],
    )
    joints, rates = servos.position[:3], servos.velocity[:3]
    # before a flight the gripper is loaded with a sleeve
    payload = phase is Phase.PREFLIGHT or (
        state.payload and not (phase is Phase.RELEASE and servos.position[4] > params.estimate.released_at)
    )

    tip = kinematics.tip_W(vehicle.arm, p, R, joints, Tool.NEEDLE if phase is Phase.ADHESIVE else Tool.GRIPPER)
    at_pipe, crack = phase in NEAR_PIPE or progress.feeling, plan.found(site, progress.along).crack
    if progress.feeling:  # how far it is ahead is what is looked for, and the pipe is long
        distance = abs(tip[2] - crack[2])
    else:
        distance = hypot(tip[0] - crack[0], tip[1] - crack[1], tip[2] - crack[2])
    rpy_rate = math3.euler_rates_from_body(rpy, w)
    near = distance < params.estimators.gate
    if not at_pipe:  # whoever leaves the pipe touches it for a while yet: what presses then is no wind to lean against
        n = site.normal
        clear = (crack[0] - tip[0]) * n[0] + (crack[1] - tip[1]) * n[1]
        near = state.near and phase in LEAVING and clear < 0.5 * params.estimators.gate
    sight = estimators.Sight(
        autopilot.f_B, acceleration, v, ahead, odometry is not state.odometry, R, p, rpy, rpy_rate, servos, ages[2],
        payload, reference.a if reference is not None else _O, near,
        (progress.arrived or progress.taring) and not at_pipe,
    )  # fmt: skip
    dropped = not progress.tare_begun
    watched, forces = estimators.step(
        state.forces, sight, command, progress.taring, progress.tared, dropped, derived, params, dt
    )
    chosen = estimators.selected(forces, params.estimators)
    force, compression = chosen.force_W, chosen.contact

    trigger, alarm = state.trigger, state.alarm
    if at_pipe:
        asked = reference.force if reference is not None and reference.pressing else 0.0
        again = phase in PRESSING  # from there on contact that is not there was lost
        trigger = contact_trigger.step(trigger, distance, compression, forces.felt, asked, params.contact, dt, again)
        alarm = _QUIET
    else:
        trigger = _QUIET
        if phase in FREE_FLIGHT:
            alarm = contact_trigger.step(alarm, 0.0, compression, forces.felt, 0.0, params.contact, dt, False)
        else:
            alarm = _QUIET
    if alarm.contact:
        forces = replace(forces, alarm=True)

    estimate = Estimate(
        p, v, rpy, rpy_rate, R, w, acceleration, joints, rates, tip, force,
        math3.rotate_transposed(kinematics.tool_rotation(joints[2]), math3.rotate_transposed(R, force)),
        compression, trigger.contact, payload, ages[0], ages[1], ages[2], True, forces,
    )  # fmt: skip
    if state.odometry is None or odometry.t_ns != state.odometry.t_ns:
        x, y, z = math3.vertical(odometry.q_WB)
        disagreement = acos(min(1.0, max(-1.0, x * R[6] + y * R[7] + z * R[8])))
    return State(
        odometry, autopilot, servos, watched, trigger, payload, finite, jump, reset, disagreement, shift, alarm, near
    ), estimate


def _finite(*groups: tuple[float, ...]) -> bool:
    total = 0.0
    for group in groups:
        total += sum(group)
    return total - total == 0.0


def _repeats(before: Odometry, after: Odometry) -> bool:
    """A new stamp on the same pose, to the bit: the tracker hangs, so its age must tell."""
    return before.p_WB == after.p_WB and before.v_WB == after.v_WB and before.q_WB == after.q_WB


def _leap(before: Odometry, after: Odometry) -> Vec3:
    """From the position that the mean velocity leads to, to the new one, m."""
    time = (after.t_ns - before.t_ns) * 1e-9
    a, b, u, v = before.p_WB, after.p_WB, before.v_WB, after.v_WB
    return (
        b[0] - a[0] - 0.5 * time * (u[0] + v[0]),
        b[1] - a[1] - 0.5 * time * (u[1] + v[1]),
        b[2] - a[2] - 0.5 * time * (u[2] + v[2]),
    )


_O: Vec3 = (0.0, 0.0, 0.0)
_QUIET = contact_trigger.State()


def _nothing(payload: bool, ages: tuple[float, float, float]) -> Estimate:
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return Estimate(_O, _O, _O, _O, identity, _O, _O, _O, _O, _O, _O, _O, 0.0, False, payload, *ages, False)
