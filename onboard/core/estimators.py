"""The force estimators side by side: all run in every tick on the same samples, one is believed.

What they share comes first: the rotors' lag and scale (``thrust_model``), the drag of the vehicle's own speed, the
torques by the servos' currents. The paper's observer takes none of it: it is left as printed. Each has its own tare.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from msgspec import Struct

from drivers.samples import ServoState, Vec3
from onboard.core import body_observer, kalman_observer, math3, momentum_observer, observer, tare, thrust_model
from onboard.core.derived import Derived
from onboard.core.spec import note, spec
from onboard.core.told import Told
from onboard.core.types import Estimator, Force, Forces, Mat3

if TYPE_CHECKING:
    from onboard.core.params import Params as AllParams

#: No force of this world, N or N m.
_ABSURD = 1e4
#: Currents older than this feel nothing of now, s.
_LATE = 0.05


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Which estimator is believed, and what each is told."""

    selected: Annotated[Estimator, note("the estimator that control, mission and safety believe")] = Estimator.PAPER
    gate: Annotated[float, spec("m", 0.01, 1.0, "tip this near to the crack: there may be contact")] = 0.08
    thrust: thrust_model.Params = thrust_model.Params()
    body: body_observer.Params = body_observer.Params()
    momentum: momentum_observer.Params = momentum_observer.Params()
    kalman: kalman_observer.Params = kalman_observer.Params()


class State(Struct, frozen=True, gc=False):
    """States of all estimators, their tares, and the force at the tip by the joints (N, W)."""

    thrust: thrust_model.State = thrust_model.State()
    paper: observer.State = observer.State()
    body: body_observer.State = body_observer.State()
    momentum: momentum_observer.State = momentum_observer.State()
    kalman: kalman_observer.State = kalman_observer.State()
    tares: tuple[tare.State, tare.State, tare.State, tare.State] = (tare.State(),) * 4
    """In the order of ``Estimator``."""
    joints: tare.State = tare.State()
    felt: Vec3 = (0.0, 0.0, 0.0)


class Command(Struct, frozen=True, gc=False):
    """What was commanded over the last tick."""

    thrust: float = 0.0
    torque_B: Vec3 | None = None
    """None: the autopilot closes its own loops."""


class Sight(Struct, frozen=True, gc=False):
    """Body and arm as ``estimate`` sees them in this tick."""

    f_B: Vec3
    a_W: Vec3
    v_W: Vec3
    age: float
    """Of the velocity, s."""
    fresh: bool
    R: Mat3
    p_W: Vec3
    rpy: Vec3
    rpy_rate: Vec3
    servos: ServoState
    servos_age: float
    """s."""
    payload: bool
    desired: Vec3
    near: bool
    """The tip is within ``gate`` of the crack, in a phase that goes there."""
    hovering: bool
    """In rest in the air, away from the pipe."""


def step(
    state: State, sight: Sight, command: Command, taring: bool, tared: bool, dropped: bool, derived: Derived,
    params: AllParams, dt: float,
) -> tuple[State, Forces]:  # fmt: skip
    """One tick. taring: its readings belong to a tare; tared: they end it; dropped: it was broken off."""
    own = params.estimators
    told, thrust = tell(state, sight, command, derived, params, dt)
    R = sight.R

    paper = observer.step(
        state.paper, told.a_W, told.desired, told.sent, (R[2], R[5], R[8]), told.mass, told.gravity, params.observer, dt
    )
    body = body_observer.step(state.body, told, own.body, dt)
    momentum = momentum_observer.step(state.momentum, told, derived.model, own.momentum, dt)
    kalman = kalman_observer.step(state.kalman, told, own.kalman, dt)
    # one absurd sample must not stay in a filter: it would take minutes to fade, or never do
    if not _sound(body.force):
        body = body_observer.State()
    if not _sound(momentum.force) or not _sound(momentum.joints):
        momentum = momentum_observer.State()
    if not _sound(kalman.force):
        kalman = kalman_observer.State()

    readings = (paper.force, body.force, momentum.force, kalman.force)
    tares, joints = state.tares, state.joints
    if taring:
        a, b, c, d = (
            tare.accumulate(old, math3.rotate_transposed(R, force)) for old, force in zip(tares, readings, strict=True)
        )
        tares, joints = (a, b, c, d), tare.accumulate(joints, momentum.joints)
        if tared:
            a, b, c, d = (tare.finish(old) for old in tares)
            tares, joints = (a, b, c, d), tare.finish(joints)
    elif dropped and joints.count:
        a, b, c, d = (tare.drop(old) for old in tares)
        tares, joints = (a, b, c, d), tare.drop(joints)

    at_joints = math3.subtract(momentum.joints, joints.tare)
    x, z = momentum_observer.force_at_tip(at_joints, told.q[6:], params.vehicle.arm)
    felt = (R[0] * x + R[2] * z, R[3] * x + R[5] * z, R[6] * x + R[8] * z)
    n = derived.site.normal
    one, two, three, four = tares
    seen = (
        Force(*_read(paper.force, one.tare, R, n))
        if params.observer.tare
        else Force(paper.force, _along(paper.force, n)),
        Force(*_read(body.force, two.tare, R, n)),
        Force(*_read(momentum.force, three.tare, R, n)),
        # its disturbance holds whatever was there before the contact: only the whole force wants a tare
        Force(tare.less(kalman.force, four.tare, R), _along(kalman.contact, n)),
    )
    return (
        State(thrust, paper, body, momentum, kalman, tares, joints, felt),
        Forces(*seen, _along(felt, n), math3.subtract(kalman.force, kalman.contact), thrust.scale),
    )


def selected(forces: Forces, params: Params) -> Force:
    """What the selected estimator reads."""
    which = params.selected
    if which is Estimator.PAPER:
        return forces.paper
    if which is Estimator.BODY:
        return forces.body
    return forces.momentum if which is Estimator.MOMENTUM else forces.kalman


def tare_in_force(state: State, params: Params) -> Vec3:
    """Tare of the selected estimator, N, B."""
    return state.tares[tuple(Estimator).index(params.selected)].tare


def _sound(force: Vec3) -> bool:
    return abs(force[0]) + abs(force[1]) + abs(force[2]) < _ABSURD


def _along(force: Vec3, normal: tuple[float, float]) -> float:
    return -(force[0] * normal[0] + force[1] * normal[1])


def _read(force: Vec3, tare_B: Vec3, R: Mat3, normal: tuple[float, float]) -> tuple[Vec3, float]:
    tared = tare.less(force, tare_B, R)
    return tared, _along(tared, normal)


def tell(
    state: State, sight: Sight, command: Command, derived: Derived, params: AllParams, dt: float
) -> tuple[Told, thrust_model.State]:
    """What the estimators are told in this tick, and the state of the thrust model after it."""
    own, vehicle, servos = params.estimators, params.vehicle, sight.servos
    mass = derived.model.mass(sight.payload)
    thrust = thrust_model.step(state.thrust, command.thrust, sight.f_B[2], mass, sight.hovering, own.thrust, dt)
    a, v, age = sight.a_W, sight.v_W, sight.age
    v = (v[0] + age * a[0], v[1] + age * a[1], v[2] + age * a[2])
    x, y, z = math3.rotate_transposed(sight.R, v)
    base = vehicle.base.drag
    rates, supply = servos.velocity, own.momentum.supply_current
    torque = (0.0, 0.0, 0.0)
    if command.torque_B is not None:
        torque = math3.euler_torque_from_body(sight.rpy, command.torque_B)
    servo, current = vehicle.servo, servos.current
    return (
        Told(
            sight.f_B, a, sight.desired, sight.R, v, sight.fresh, (*sight.p_W, *sight.rpy, *servos.position[:3]),
            (*v, *sight.rpy_rate, *rates[:3]), command.thrust, thrust_model.thrust(thrust),
            (-base[0] * x, -base[1] * y, -base[2] * z), torque, command.torque_B is not None,
            (
                momentum_observer.servo_torque(current[0], rates[0], servo, supply),
                momentum_observer.servo_torque(current[1], rates[1], servo, supply),
                momentum_observer.servo_torque(current[2], rates[2], servo, supply),
            ),
            state.felt, servos.torque_on and sight.servos_age < _LATE and not any(servos.error[:3]), sight.near,
            derived.site.normal, mass, vehicle.gravity, sight.payload,
        ),
        thrust,
    )  # fmt: skip
