"""The core: one pure function from the samples of a tick to its commands."""

from __future__ import annotations

from msgspec import Struct

from drivers.samples import Engage, Interface
from onboard.core import actuation, control, estimate, estimators, facts, guidance, limits, mission, safety
from onboard.core.derived import derive
from onboard.core.params import Params
from onboard.core.types import Event, Inputs, Outputs, Reference


class State(Struct, frozen=True, gc=False):
    """All that the core remembers from one tick to the next."""

    estimate: estimate.State
    safety: safety.State
    mission: mission.State
    progress: guidance.Progress
    guidance: guidance.State
    reference: Reference | None
    control: control.State
    limits: limits.State
    command: estimators.Command
    """Commanded in the last tick."""
    airborne: bool
    engaged: bool
    """The autopilot followed our set-points, and was asked to."""


def initial_state(params: Params) -> State:
    """On the ground, before the first sample."""
    return State(
        estimate.State(), safety.initial(), mission.initial(), guidance.Progress(), guidance.initial(), None,
        control.State(), limits.State(), estimators.Command(), False, False,
    )  # fmt: skip


def step(state: State, inputs: Inputs, params: Params, dt: float) -> tuple[State, Outputs]:
    """Advance the core by dt seconds. Same arguments, same bits."""
    derived = derive(params)
    dt = min(params.dt_max, max(params.dt_min, dt))
    before = state.mission.phase
    lift = state.reference.lift if state.reference is not None else 0.0

    seen, believed = estimate.step(
        state.estimate, inputs, before, state.progress, state.reference, state.command, derived, params, dt
    )
    flying = facts.airborne(state.airborne, seen, believed, before, state.guidance.home[2], lift)
    dangers = facts.for_safety(
        seen, believed, inputs, before, flying, state.engaged, state.reference, state.control.compensation
    )
    safe, verdict, alarms = safety.step(state.safety, dangers, params.safety, dt)
    known = facts.for_mission(seen, believed, state.progress, before, flying, verdict, inputs.go, derived, params)
    task, said = mission.step(state.mission, inputs.request, verdict.action, known, params.mission, dt)
    guided, reference, progress = guidance.step(
        state.guidance, believed, task.phase, task.taring, known.engaged, _pump(seen), derived, params, dt
    )
    aloft = flying and reference.lift >= 1.0
    at_pipe = task.phase in estimate.NEAR_PIPE or progress.feeling
    joints, closed = facts.joint_drive(seen, believed, params)
    laws, wanted = control.step(state.control, believed, reference, aloft, at_pipe, closed, derived, params, dt)
    engage = mission.engage(task, known)
    obeyed = known.engaged and engage is Engage.OFFBOARD
    autopilot = actuation.autopilot_command(wanted, engage, params.interface)
    lead = params.vehicle.servo if joints is params.joints else None
    servos = actuation.servo_command(wanted, reference, joints, params.joint_current, lead)
    permission = facts.permission(task.phase, engage, believed, aloft)
    gate, autopilot, servos, clipped = limits.step(
        state.limits, autopilot, servos, permission, facts.measured(seen), derived.bounds, dt
    )
    sent = estimators.Command(autopilot.thrust, autopilot.torque_B if params.interface is Interface.WRENCH else None)
    events = tuple(Event(inputs.t_ns, *text) for text in (*alarms, *said)) if alarms or said else ()
    return (
        State(seen, safe, task, progress, guided, reference, laws, gate, sent, flying, obeyed),
        Outputs(task.phase, task.phase_time, verdict, believed, reference, wanted, autopilot, servos, clipped, events),
    )


def _pump(seen: estimate.State) -> float:
    return seen.servos.position[3] if seen.servos is not None else 0.0
