"""The laws joined: equilibrium, signs, continuity, and nothing that is not finite."""

from __future__ import annotations

from math import atan2, cos, hypot, isfinite, pi, sin
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from drivers.samples import Interface, JointMode, Vec3
from onboard.config import Config, load_config
from onboard.core import control, kinematics, math3
from onboard.core.control import State
from onboard.core.derived import derive
from onboard.core.types import Control, Estimate, Phase, Reference
from tests.core.following import RESTING, Follower
from tests.core.sampled import JOINTS, quat
from tests.core.strategies import vector

CONFIG = load_config("paper")
VEHICLE = CONFIG.vehicle
ARM = VEHICLE.arm
GRAVITY = VEHICLE.gravity
ARM_AT: Vec3 = (JOINTS[0], JOINTS[1], -0.3)
DT = 0.004
WRIST = kinematics.wrist(ARM, ARM_AT[0], ARM_AT[1])
AT: Vec3 = (1.0, 0.0, 1.5)
REFERENCE: Reference = replace(
    Follower(CONFIG).tick(Phase.PREFLIGHT).reference, p=AT, wrist=WRIST, elevation=ARM_AT[2], lift=1.0
)
HOVER: Estimate = replace(RESTING, p_WB=AT, joints=ARM_AT)


def believed(rpy: Vec3 = (0.0, 0.0, 0.0), **changes: Any) -> Estimate:
    """A hover at another attitude."""
    q = math3.quat_from_euler(rpy)
    return replace(HOVER, rpy=rpy, R_WB=math3.matrix_from_quat(q), **changes)


def act(
    estimate: Estimate = HOVER,
    reference: Reference = REFERENCE,
    ticks: int = 1,
    state: State | None = None,
    config: Config = CONFIG,
    flying: bool = True,
    near_pipe: bool = False,
) -> tuple[State, Control]:
    state = State() if state is None else state
    wanted = None
    for _ in range(ticks):
        state, wanted = control.step(
            state, estimate, reference, flying, near_pipe, config.joints is JointMode.TORQUE, derive(config), config, DT
        )
    assert wanted is not None
    return state, wanted


# --- equilibrium ------------------------------------------------------------------------------------------------------


def parts(payload: bool) -> list[tuple[float, float, tuple[float, float, float]]]:
    """Mass, how far ahead of the origin (m), and lengths along the links, of everything but the base."""
    found = []
    for part in (*ARM.parts, *([ARM.sleeve] if payload else [])):
        ahead = ARM.mount[0] + part.offset[0] + sum(a * cos(q) for a, q in zip(part.along, ARM_AT, strict=True))
        found.append((part.mass, ahead, part.along))
    return found


@pytest.mark.parametrize("payload", [True, False])
@pytest.mark.parametrize("yaw", [0.0, 2.0, -pi])
def test_in_hover_thrust_and_torques_balance_gravity(payload: bool, yaw: float) -> None:
    estimate = believed((0.0, 0.0, yaw), payload=payload)
    _, wanted = act(estimate, replace(REFERENCE, yaw=yaw))
    mass = VEHICLE.base.mass + sum(part[0] for part in parts(payload))
    assert wanted.thrust == pytest.approx(mass * GRAVITY)
    # weight ahead of the origin pulls the nose down (+y); the body torque holds against it
    nose_down = GRAVITY * sum(m * ahead for m, ahead, _ in parts(payload))
    assert wanted.torque_B == pytest.approx((0.0, -nose_down, 0.0), abs=1e-9)
    # each joint carries what hangs on its link
    for k in range(3):
        load = GRAVITY * sum(m * along[k] for m, _, along in parts(payload)) * cos(ARM_AT[k])
        assert wanted.joint_torque[k] == pytest.approx(load, abs=1e-9)
    assert wanted.q_WB == pytest.approx(quat(yaw), abs=1e-12)
    assert wanted.w_WB_B == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert wanted.joints == pytest.approx(ARM_AT)


def test_the_rotor_inertia_is_no_weight() -> None:
    servo = replace(VEHICLE.servo, rotor_inertia=10.0 * VEHICLE.servo.rotor_inertia)
    heavier = replace(CONFIG, vehicle=replace(VEHICLE, servo=servo))
    assert act(config=heavier)[1].joint_torque == pytest.approx(act()[1].joint_torque)


# --- signs ------------------------------------------------------------------------------------------------------------

SHIFT = 0.05


@pytest.mark.parametrize("yaw", [0.0, 1.0, 0.5 * pi, -2.5])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_reference_ahead_leans_the_nose_down_and_one_to_the_left_leans_left(yaw: float, sign: float) -> None:
    estimate = believed((0.0, 0.0, yaw))
    c, s = sign * SHIFT * cos(yaw), sign * SHIFT * sin(yaw)
    ahead = replace(REFERENCE, yaw=yaw, p=(AT[0] + c, AT[1] + s, AT[2]))
    _, wanted = act(estimate, ahead, ticks=50)
    assert sign * wanted.attitude[1] > 0.005
    assert wanted.attitude[0] == pytest.approx(0.0, abs=1e-9)
    left = replace(REFERENCE, yaw=yaw, p=(AT[0] - s, AT[1] + c, AT[2]))
    _, wanted = act(estimate, left, ticks=50)
    assert sign * wanted.attitude[0] < -0.005
    assert wanted.attitude[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_it_pulls_towards_the_reference_of_place_and_velocity(axis: int, sign: float) -> None:
    rest = act(ticks=50)[1]
    for field in ("p", "v"):
        values = list(getattr(REFERENCE, field))
        values[axis] += sign * SHIFT
        wanted = act(HOVER, replace(REFERENCE, **{field: tuple(values)}), ticks=50)[1]
        gain = (wanted.attitude[1], -wanted.attitude[0], wanted.thrust - rest.thrust)[axis]
        assert sign * gain > 1e-3


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_and_body_rate_turn_back_a_wrong_attitude(axis: int, sign: float) -> None:
    rpy = [0.0, 0.0, 0.0]
    rpy[axis] = sign * 0.05
    turned, rest = act(believed((rpy[0], rpy[1], rpy[2])))[1], act()[1]
    assert sign * (turned.torque_B[axis] - rest.torque_B[axis]) < -0.01
    assert sign * turned.w_WB_B[axis] < -0.01


def test_the_shorter_way_of_yaw_is_taken() -> None:
    _, wanted = act(believed((0.0, 0.0, pi - 0.05)), replace(REFERENCE, yaw=-pi + 0.05))
    assert wanted.w_WB_B[2] > 0.0
    assert wanted.torque_B[2] > 0.0


@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_is_turned_back_to_its_reference(joint: int, sign: float) -> None:
    state, _ = act(ticks=200)
    joints = list(ARM_AT)
    joints[joint] += sign * 0.05
    estimate = replace(HOVER, joints=(joints[0], joints[1], joints[2]))
    back, rest = act(estimate, state=state)[1], act(state=state)[1]
    assert sign * (back.joint_torque[joint] - rest.joint_torque[joint]) < -0.005


def test_the_attitude_set_point_is_the_attitude_wanted() -> None:
    ahead = replace(REFERENCE, p=(AT[0] + 0.2, AT[1] + 0.1, AT[2]), yaw=0.7)
    _, wanted = act(believed((0.0, 0.0, 0.7)), ahead, ticks=30)
    lead = CONFIG.control.attitude_lead
    leading = tuple(a + lead * r for a, r in zip(wanted.attitude, wanted.attitude_rate, strict=True))
    assert math3.euler_from_quat(wanted.q_WB) == pytest.approx(leading)


@pytest.mark.parametrize("yaw", [0.2, -0.2])
def test_the_attitude_set_point_leans_where_it_is_wanted_before_the_heading_is_reached(yaw: float) -> None:
    """An autopilot leans first and turns later: what it is told must not turn with a heading that is still wrong."""
    _, wanted = act(believed((0.0, 0.0, yaw)), replace(REFERENCE, p=(AT[0] + 0.3, AT[1], AT[2])), ticks=300)
    R = math3.matrix_from_quat(wanted.q_WB)
    assert math3.euler_from_quat(wanted.q_WB)[2] == pytest.approx(REFERENCE.yaw, abs=1e-9)
    assert R[2] > 0.05
    assert R[5] == pytest.approx(0.0, abs=0.001)


# --- contact ----------------------------------------------------------------------------------------------------------


def pressing(force: float) -> Reference:
    return replace(REFERENCE, pressing=True, force=force, force_ahead=force)


def test_the_desired_force_leans_the_vehicle_into_the_pipe() -> None:
    _, wanted = act(reference=pressing(2.0), ticks=300, near_pipe=True)
    push = CONFIG.backstepping.feed_forward * 2.0
    weight = (VEHICLE.base.mass + sum(part[0] for part in parts(True))) * GRAVITY
    assert wanted.attitude[1] == pytest.approx(atan2(push, weight), rel=0.02)
    assert wanted.thrust == pytest.approx(hypot(push, weight), rel=0.02)


@pytest.mark.parametrize("yaw", [0.1, -0.1])
def test_the_push_goes_along_the_arm(yaw: float) -> None:
    """Friction holds the tip: past it, the push would turn the vehicle further from the pipe's normal."""
    turned = believed((0.0, 0.0, yaw))
    pushed, rest = (math3.matrix_from_quat(act(turned, pressing(f), ticks=300)[1].q_WB) for f in (2.0, 0.0))
    assert atan2(pushed[5] - rest[5], pushed[2] - rest[2]) == pytest.approx(yaw, abs=0.01)


def test_the_arm_pushes_with_the_torques_of_the_desired_force() -> None:
    """J^T f: a force f ahead at the tip takes -f L sin(angle) of each joint."""
    blended, force = State(contact=1.0), 1.5
    without = replace(CONFIG, control=replace(CONFIG.control, contact_torque=False))
    more = act(reference=pressing(force), state=blended)[1]
    less = act(reference=pressing(force), state=blended, config=without)[1]
    for k, length in enumerate((ARM.link_1, ARM.link_2, ARM.gripper)):
        assert more.joint_torque[k] - less.joint_torque[k] == pytest.approx(-force * length * sin(ARM_AT[k]), abs=1e-9)
    # the pipe pushes the tip back, (-f, 0, 0) at tip - origin: the base holds against z (-f) about +y
    tip = ARM.mount[2] + sum(a * sin(q) for a, q in zip((ARM.link_1, ARM.link_2, ARM.gripper), ARM_AT, strict=True))
    assert more.torque_B[1] - less.torque_B[1] == pytest.approx(tip * force, abs=1e-9)


def largest_jump(config: Config, references: list[Reference]) -> float:
    """Largest change of the attitude reference's rate from tick to tick, rad/s, off the reference by 3 cm."""
    state, rates = State(), []
    estimate = replace(HOVER, p_WB=(AT[0] + 0.03, *AT[1:]))
    state, _ = act(estimate, REFERENCE, 300, config=config, flying=False)
    for reference in references:
        state, wanted = act(estimate, reference, state=state, config=config, flying=False)
        rates.append(wanted.attitude_rate[1])
    return max(abs(b - a) for a, b in zip([0.0, *rates], rates, strict=False))


def test_turning_compliant_and_stiff_again_does_not_jump() -> None:
    there_and_back = [pressing(0.0)] * 200 + [REFERENCE] * 200
    hard = replace(CONFIG, control=replace(CONFIG.control, contact_blend=0.0))
    soft = replace(CONFIG, control=replace(CONFIG.control, contact_blend=0.3))
    assert largest_jump(hard, there_and_back) > 0.005
    assert largest_jump(soft, there_and_back) < 0.2 * largest_jump(hard, there_and_back)


def test_near_the_pipe_the_law_does_not_adapt_against_it() -> None:
    """With ``freeze_in_contact``, an error along the normal is not wound up, one across it is."""
    config = replace(CONFIG, backstepping=replace(CONFIG.backstepping, freeze_in_contact=True, beta=1.0))
    assert derive(config).site.normal == (1.0, 0.0)
    estimate = replace(HOVER, p_WB=(AT[0] - 0.05, AT[1] - 0.05, AT[2]))
    at_pipe = act(estimate, ticks=100, config=config, near_pipe=True)[0].backstepping.disturbance
    away = act(estimate, ticks=100, config=config)[0].backstepping.disturbance
    assert at_pipe[0] == 0.0
    assert at_pipe[1] == away[1] > 0.0
    assert away[0] > 0.0


# --- ground, spool and interfaces -------------------------------------------------------------------------------------


@given(st.floats(0.01, 1.0))
def test_lift_scales_thrust_and_torque_and_leaves_the_arm(lift: float) -> None:
    whole = act(believed((0.02, -0.03, 0.1)))[1]
    part = act(believed((0.02, -0.03, 0.1)), replace(REFERENCE, lift=lift))[1]
    assert part.thrust == pytest.approx(lift * whole.thrust)
    assert part.torque_B == pytest.approx(tuple(lift * x for x in whole.torque_B))
    assert part.joint_torque == whole.joint_torque


def test_on_the_ground_nothing_adapts_and_nothing_is_remembered() -> None:
    off = replace(HOVER, p_WB=(0.5, 0.3, 1.0), rpy=(0.1, 0.1, 0.1))
    grounded, _ = act(off, ticks=50, flying=False)
    assert grounded.backstepping.disturbance == (0.0, 0.0, 0.0)
    assert grounded.sliding.adapted == (0.0,) * 6
    flown, _ = act(off, ticks=50)
    assert flown.backstepping.disturbance != (0.0, 0.0, 0.0)
    landed, _ = act(off, replace(REFERENCE, lift=0.0), state=flown, flying=False)
    assert landed.backstepping.disturbance == (0.0, 0.0, 0.0)
    assert landed.sliding.adapted == (0.0,) * 6
    assert landed.contact == 0.0


@pytest.mark.parametrize("interface", [Interface.ATTITUDE, Interface.BODY_RATE])
def test_where_the_autopilot_holds_the_attitude_our_law_does_not_wind_up(interface: Interface) -> None:
    config = replace(CONFIG, interface=interface)
    state, _ = act(believed((0.1, 0.1, 0.1)), ticks=100, config=config)
    assert state.sliding.adapted[:3] == (0.0, 0.0, 0.0)
    assert state.sliding.integral[:3] == (0.0, 0.0, 0.0)
    state, _ = act(believed((0.1, 0.1, 0.1)), ticks=100)
    assert all(x != 0.0 for x in state.sliding.adapted[:3])


def test_where_the_servos_hold_the_joints_our_law_does_not_wind_up() -> None:
    bent = replace(HOVER, joints=(ARM_AT[0] + 0.1, ARM_AT[1] + 0.1, ARM_AT[2] + 0.1))
    state, _ = act(bent, ticks=100, config=replace(CONFIG, joints=JointMode.POSITION))
    assert state.sliding.adapted[3:] == (0.0, 0.0, 0.0)
    state, _ = act(bent, ticks=100)
    assert all(x != 0.0 for x in state.sliding.adapted[3:])


# --- anything at all --------------------------------------------------------------------------------------------------

beliefs = st.builds(
    lambda p, v, rpy, rpy_rate, joints, joint_rates, payload: replace(
        HOVER, p_WB=p, v_WB=v, rpy=rpy, rpy_rate=rpy_rate, joints=joints, joint_rates=joint_rates, payload=payload,
        R_WB=math3.matrix_from_quat(math3.quat_from_euler(rpy)),
    ),
    vector(50.0), vector(20.0), st.tuples(st.floats(-pi, pi), st.floats(-1.5, 1.5), st.floats(-pi, pi)), vector(30.0),
    st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)), vector(50.0), st.booleans(),
)  # fmt: skip
references = st.builds(
    lambda p, v, a, yaw, wrist, elevation, lift, force, pressing: replace(
        REFERENCE, p=p, v=v, a=a, yaw=yaw, wrist=wrist, elevation=elevation, lift=lift, force=force,
        force_ahead=1.2 * force, pressing=pressing,
    ),
    vector(50.0), vector(5.0), vector(5.0), st.floats(-10.0, 10.0),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), st.floats(-3.0, 3.0),
    st.floats(0.0, 1.0), st.floats(0.0, 4.0), st.booleans(),
)  # fmt: skip


def numbers(value: object) -> list[float]:
    if isinstance(value, float):
        return [value]
    if isinstance(value, dict):
        return [x for child in value.values() for x in numbers(child)]
    if isinstance(value, list | tuple):
        return [x for child in value for x in numbers(child)]
    return []


@settings(max_examples=150)
@given(beliefs, references, st.sampled_from(Interface), st.booleans(), st.booleans())
def test_finite_in_finite_out(
    estimate: Estimate, reference: Reference, interface: Interface, flying: bool, near_pipe: bool
) -> None:
    config = CONFIG if interface is CONFIG.interface else replace(CONFIG, interface=interface)
    state, wanted = act(estimate, reference, 5, config=config, flying=flying, near_pipe=near_pipe)
    for value in (*numbers(msgspec.to_builtins(wanted)), *numbers(msgspec.to_builtins(state))):
        assert isfinite(value)
    assert max(abs(angle) for angle in wanted.attitude[:2]) <= 2.0 * CONFIG.tilt.tilt_max
    assert hypot(*wanted.q_WB) == pytest.approx(1.0)
