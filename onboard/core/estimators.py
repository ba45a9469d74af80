"""The force estimators side by side: all run in every tick on the same samples, one is believed.

What they share comes first: the rotors' lag and scale (``thrust_model``), the drag of the vehicle's own speed, the
torques by the servos' currents. The paper's observer takes none of it: it is left as printed. Each has its own tare.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from msgspec import Struct

from drivers.samples import ServoState, Vec3
from onboard.core import body_observer, kalman_observer, math3, momentum_observer, observer, tare, thrust_model
from onboard.core.compiled import compiled
from onboard.core.derived import Derived
from onboard.core.spec import note, spec
from onboard.core.tare import less
from onboard.core.told import Told
from onboard.core.types import Estimator, Force, Forces, Mat3

if TYPE_CHECKING:
    from onboard.core.params import Params as AllParams

Five = tuple[float, float, float, float, float]

#: No force of this world, N or N m.
_ABSURD = 1e4
#: Of the tares.
_PLACE = {estimator: place for place, estimator in enumerate(Estimator)}
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

    felt = momentum_observer.felt(momentum, joints.tare, told.q[6:], R, params.vehicle.arm)
    one, two, three, four = tares
    read = _read(
        paper.force, one.tare if params.observer.tare else tare.ZERO, body.force, two.tare, momentum.force, three.tare,
        kalman.force, four.tare, kalman.contact, felt, R, derived.site.normal,
    )  # fmt: skip
    f1, f2, f3, f4, (c1, c2, c3, c4, c5) = read
    wind = math3.subtract(kalman.force, kalman.contact)
    return (
        State(thrust, paper, body, momentum, kalman, tares, joints, felt),
        Forces(Force(f1, c1), Force(f2, c2), Force(f3, c3), Force(f4, c4), c5, wind, thrust.scale),
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
    return state.tares[_PLACE[params.selected]].tare


def _sound(force: Vec3) -> bool:
    return abs(force[0]) + abs(force[1]) + abs(force[2]) < _ABSURD


@compiled(
    "Tuple((UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 5)))"
    "(UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3),"
    " UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 9), UniTuple(f8, 2))"
)
def _read(
    f1: Vec3, t1: Vec3, f2: Vec3, t2: Vec3, f3: Vec3, t3: Vec3, f4: Vec3, t4: Vec3, contact: Vec3, felt: Vec3, R: Mat3,
    n: tuple[float, float],
) -> tuple[Vec3, Vec3, Vec3, Vec3, Five]:  # fmt: skip
    """Forces (W) less their tares (B); and compressions, the last but one of the Kalman filter's contact force.

    Its disturbance holds whatever was there before the contact: only its whole force wants a tare.
    """
    a, b, c, d = less(f1, t1, R), less(f2, t2, R), less(f3, t3, R), less(f4, t4, R)
    x, y = n
    return (
        a, b, c, d,
        (
            -(a[0] * x + a[1] * y), -(b[0] * x + b[1] * y), -(c[0] * x + c[1] * y),
            -(contact[0] * x + contact[1] * y), -(felt[0] * x + felt[1] * y),
        ),
    )  # fmt: skip


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
    torque = (0.0, 0.0, 0.0)
    if command.torque_B is not None:
        torque = math3.euler_torque_from_body(sight.rpy, command.torque_B)
    return (
        Told(
            sight.f_B, a, sight.desired, sight.R, v, sight.fresh, (*sight.p_W, *sight.rpy, *servos.position[:3]),
            (*v, *sight.rpy_rate, *servos.velocity[:3]), command.thrust, thrust_model.thrust(thrust),
            (-base[0] * x, -base[1] * y, -base[2] * z), torque, command.torque_B is not None,
            servos.current[:3], vehicle.servo, state.felt,
            servos.torque_on and sight.servos_age < _LATE and not any(servos.error[:3]),
            sight.near, derived.site.normal, mass, vehicle.gravity, sight.payload,
        ),
        thrust,
    )  # fmt: skip
