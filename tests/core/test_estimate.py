"""What the core believes, sample by sample."""

from __future__ import annotations

from math import cos, inf, pi, radians, sin
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from drivers.samples import Vec3
from onboard.config import load_config
from onboard.core import estimate, kinematics
from onboard.core.derived import derive
from onboard.core.estimate import State
from onboard.core.estimators import Command
from onboard.core.guidance import Progress
from onboard.core.kinematics import Tool
from onboard.core.types import Estimate, Inputs, Phase
from tests.core.sampled import (
    JOINTS,
    NOT_FINITE,
    T0,
    TICK_NS,
    G,
    autopilot,
    inputs,
    odometry,
    quat,
    servos,
    spoilt,
)  # fmt: skip

CONFIG = load_config("paper", sets=["pipe.heading_deg=90.0", "pipe.position=[1.0,1.2,1.5]"])
DERIVED = derive(CONFIG)
MASS = DERIVED.model.mass(True)
E, LIMITS = CONFIG.estimate, CONFIG.safety


def believe(
    state: State,
    seen: Inputs,
    phase: Phase = Phase.APPROACH,
    progress: Progress = Progress(),  # noqa: B008 - frozen
    thrust: float = MASS * G,
) -> tuple[State, Estimate]:
    return estimate.step(state, seen, phase, progress, None, Command(thrust), DERIVED, CONFIG, 0.004)


def after(state: State, ticks: int, seen: dict[str, Any], **how: Any) -> tuple[State, Estimate]:
    """Believe the same samples, freshly stamped, for some ticks; a little motion tells them apart."""
    believed = None
    for i in range(1, ticks + 1):
        t = T0 + i * TICK_NS
        p = (1.0 + 1e-7 * i, 0.0, 1.5)
        tick = inputs(t, odometry=odometry(t, **({"p_WB": p} | seen.get("odometry", {}))))
        tick = replace(
            tick,
            autopilot=autopilot(t, **seen.get("autopilot", {})),
            servos=servos(t, **seen.get("servos", {})),
        )
        state, believed = believe(state, tick, **how)
    assert believed is not None
    return state, believed


# --- ages and validity ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("missing", ["odometry", "autopilot", "servos"])
def test_valid_only_when_all_three_have_told_something(missing: str) -> None:
    state, believed = believe(State(), replace(inputs(), **{missing: None}))
    assert not believed.valid
    assert getattr(believed, f"age_{missing}") == inf
    assert {believed.age_odometry, believed.age_autopilot, believed.age_servos} == {0.0, inf}
    _, believed = believe(state, inputs())
    assert believed.valid


def test_a_device_that_says_none_again_only_grows_old() -> None:
    state, _ = believe(State(), inputs())
    _, believed = believe(state, Inputs(T0 + 300_000_000, 0.004, None, None, None))
    assert believed.valid
    ages = (believed.age_odometry, believed.age_autopilot, believed.age_servos)
    assert ages == pytest.approx((0.3, 0.3, 0.3))


@given(st.tuples(*[st.integers(0, 400_000_000)] * 3))
def test_ages_are_those_of_the_samples(old: tuple[int, int, int]) -> None:
    a, b, c = (T0 - t for t in old)
    _, believed = believe(State(), inputs(odometry=odometry(a), autopilot=autopilot(b), servos=servos(c)))
    ages = (believed.age_odometry, believed.age_autopilot, believed.age_servos)
    assert ages == pytest.approx(tuple(1e-9 * t for t in old))


FIELDS = [
    ("odometry", "p_WB", 3), ("odometry", "v_WB", 3), ("odometry", "q_WB", 4),
    ("autopilot", "q_WB", 4), ("autopilot", "w_WB_B", 3), ("autopilot", "f_B", 3),
    ("servos", "position", 5), ("servos", "velocity", 5), ("servos", "current", 5),
    ("servos", "voltage", 5), ("servos", "temperature", 5),
]  # fmt: skip


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize(("device", "field", "size"), FIELDS)
def test_a_sample_that_is_not_finite_is_told_and_not_used(device: str, field: str, size: int, value: float) -> None:
    state, before = believe(State(), inputs())
    assert state.finite
    later = T0 + TICK_NS
    good = inputs(later, odometry=odometry(later, p_WB=(1.0, 0.0, 1.5001)))
    for index in range(size):
        sample = getattr(good, device)
        bad = replace(sample, **{field: spoilt(getattr(sample, field), index, value)})
        spoiled, believed = believe(state, replace(good, **{device: bad}))
        assert not spoiled.finite
        assert getattr(believed, f"age_{device}") == pytest.approx(0.004)
        assert getattr(spoiled, device) == getattr(state, device)
        kept = {"odometry": "p_WB", "autopilot": "rpy", "servos": "joints"}[device]
        assert getattr(believed, kept) == pytest.approx(getattr(before, kept))
        again = later + TICK_NS
        recovered, believed = believe(spoiled, inputs(again, odometry=odometry(again, p_WB=(1.0, 0.0, 1.5002))))
        assert recovered.finite
        assert getattr(believed, f"age_{device}") == 0.0


# --- body -------------------------------------------------------------------------------------------------------------


@given(st.integers(-50_000_000, 400_000_000), st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_the_position_is_carried_forward_and_not_too_far(age_ns: int, v: Vec3) -> None:
    _, believed = believe(State(), inputs(odometry=odometry(T0 - age_ns, v_WB=v)))
    ahead = min(max(0.0, age_ns * 1e-9), E.extrapolate_max)
    assert believed.p_WB == pytest.approx((1.0 + ahead * v[0], ahead * v[1], 1.5 + ahead * v[2]))
    assert believed.v_WB == v


def test_attitude_rates_and_acceleration_are_the_autopilot_s() -> None:
    q = quat(yaw=0.5 * pi, pitch=0.2)
    told = autopilot(q_WB=q, w_WB_B=(0.0, 0.3, 0.0), f_B=(1.0, 0.0, G))
    _, believed = believe(State(), inputs(autopilot=told))
    assert believed.rpy == pytest.approx((0.0, 0.2, 0.5 * pi))
    assert believed.rpy_rate == pytest.approx((0.0, 0.3, 0.0))
    # pitched nose down to +y, 1 m/s^2 along the nose and the thrust leaning there
    ahead = cos(0.2) + G * sin(0.2)
    up = -sin(0.2) + G * cos(0.2) - G
    assert believed.a_WB == pytest.approx((0.0, ahead, up), abs=1e-12)


@pytest.mark.parametrize(("phase", "tool"), [(Phase.ADHESIVE, Tool.NEEDLE), (Phase.ADVANCE, Tool.GRIPPER)])
def test_the_tip_is_that_of_the_tool_at_work(phase: Phase, tool: Tool) -> None:
    _, believed = believe(State(), inputs(), phase)
    wanted = kinematics.tip_W(CONFIG.vehicle.arm, (1.0, 0.0, 1.5), believed.R_WB, JOINTS[:3], tool)
    assert believed.tip_W == pytest.approx(wanted)


# --- jumps of the tracker ---------------------------------------------------------------------------------------------


def flown(state: State, i: int, phase: Phase = Phase.APPROACH, **changes: Any) -> tuple[State, Estimate]:
    """Tick i of a flight at 0.5 m/s along x."""
    t = T0 + i * TICK_NS
    told = odometry(t, p_WB=(1.0 + 0.5 * 0.004 * i, 0.0, 1.5), v_WB=(0.5, 0.0, 0.0))
    return believe(state, inputs(t, odometry=replace(told, **changes)), phase)


def test_steady_flight_is_no_jump() -> None:
    state = State()
    for i in range(50):
        state, _ = flown(state, i)
        assert state.jump == pytest.approx(0.0, abs=1e-12)
        assert not state.reset


@given(st.tuples(*[st.floats(-0.9, 0.9)] * 3))
def test_a_jump_is_measured_and_the_position_goes_on(leap: Vec3) -> None:
    state, _ = flown(State(), 0)
    size = sum(x * x for x in leap) ** 0.5
    there = (1.002 + leap[0], leap[1], 1.5 + leap[2])
    state, believed = flown(state, 1, p_WB=there)
    assert state.jump == pytest.approx(size, abs=1e-12)
    carried = size > E.jump
    assert believed.p_WB == pytest.approx((1.002, 0.0, 1.5) if carried else there, abs=1e-12)
    state, believed = flown(state, 2, p_WB=(there[0] + 0.002, *there[1:]))
    assert state.jump == pytest.approx(0.0, abs=1e-12)
    assert believed.p_WB == pytest.approx((1.004, 0.0, 1.5) if carried else (there[0] + 0.002, *there[1:]), abs=1e-12)


def test_a_jump_and_back_leaves_nothing() -> None:
    state, _ = flown(State(), 0)
    state, _ = flown(state, 1, p_WB=(1.3, 0.2, 1.5))
    state, believed = flown(state, 2)
    assert state.jump == pytest.approx(0.36, abs=0.01)
    assert believed.p_WB == pytest.approx((1.004, 0.0, 1.5))
    assert state.shift == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


def test_a_moved_frame_is_told_once_and_carried_however_small() -> None:
    state, _ = flown(State(), 0)
    state, believed = flown(state, 1, p_WB=(1.012, 0.0, 1.5), reset_counter=1)
    assert state.reset
    assert believed.p_WB == pytest.approx((1.002, 0.0, 1.5))
    state, _ = flown(state, 2, p_WB=(1.014, 0.0, 1.5), reset_counter=1)
    assert not state.reset


def test_what_has_happened_in_a_long_gap_is_not_taken_for_a_jump_of_the_frame() -> None:
    state, _ = flown(State(), 0)
    i = round(2.0 * E.extrapolate_max / 0.004)
    there = (1.0 + 0.002 * i + 0.2, 0.0, 1.5)
    state, believed = flown(state, i, p_WB=there)
    assert state.jump == pytest.approx(0.2)
    assert believed.p_WB == pytest.approx(there)


def test_before_a_flight_the_tracker_s_frame_is_taken_as_it_is() -> None:
    state, _ = flown(State(), 0)
    state, _ = flown(state, 1, p_WB=(1.5, 0.0, 1.5))
    assert state.shift != (0.0, 0.0, 0.0)
    _, believed = flown(state, 2, Phase.PREFLIGHT, p_WB=(1.5, 0.1, 1.5))
    assert believed.p_WB == pytest.approx((1.5, 0.1, 1.5))


@pytest.mark.parametrize(("phase", "old"), [(Phase.APPROACH, True), (Phase.PREFLIGHT, False), (Phase.STOPPED, False)])
def test_a_pose_repeated_to_the_bit_is_no_news_in_flight(phase: Phase, old: bool) -> None:
    state, _ = believe(State(), inputs(), phase)
    believed = None
    for i in range(1, 51):
        state, believed = believe(state, inputs(T0 + i * TICK_NS), phase)
    assert believed is not None
    assert believed.age_odometry == pytest.approx(0.2 if old else 0.0)
    assert state.jump == 0.0
    state, believed = believe(state, inputs(T0 + 51 * TICK_NS, odometry=odometry(T0 + 51 * TICK_NS, v_WB=(1e-9, 0, 0))))
    assert believed.age_odometry == 0.0


def test_the_verticals_are_compared() -> None:
    seen = inputs(odometry=odometry(q_WB=quat(yaw=2.0, pitch=0.1)), autopilot=autopilot(q_WB=quat(pitch=-0.05)))
    state, _ = believe(State(), seen)
    assert 0.05 < state.disagreement < 0.15
    turned = inputs(odometry=odometry(q_WB=quat(yaw=2.0)), autopilot=autopilot(q_WB=quat(yaw=-1.0)))
    state, _ = believe(State(), turned)
    assert state.disagreement == pytest.approx(0.0, abs=1e-7)  # yaw is not part of it


# --- payload ----------------------------------------------------------------------------------------------------------

OPEN = {"servos": {"position": (*JOINTS[:4], E.released_at + 0.1)}}


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase not in (Phase.RELEASE, Phase.PREFLIGHT)])
def test_an_open_gripper_lets_go_only_in_release(phase: Phase) -> None:
    state, believed = after(State(), 2, OPEN, phase=phase)
    assert believed.payload
    state, believed = after(state, 1, OPEN, phase=Phase.RELEASE)
    assert not believed.payload
    state, believed = after(state, 2, {}, phase=phase)
    assert not believed.payload  # a gripper that closes again picks nothing up
    _, believed = after(state, 1, {}, phase=Phase.PREFLIGHT)
    assert believed.payload


def test_a_closed_gripper_keeps_its_payload_in_release() -> None:
    closed = {"servos": {"position": (*JOINTS[:4], E.released_at - 0.01)}}
    assert after(State(), 5, closed, phase=Phase.RELEASE)[1].payload


# --- force ------------------------------------------------------------------------------------------------------------

LONG = 1500


def pushed(force: Vec3, yaw: float = 0.5 * pi, pitch: float = 0.0, theta_3: float = 0.0) -> dict[str, Any]:
    """Samples of a vehicle that hovers while ``force`` (N, W) acts on it: its accelerometer feels thrust and force."""
    q = quat(yaw, pitch)
    forward = (cos(yaw) * cos(pitch), sin(yaw) * cos(pitch), -sin(pitch))
    up = (cos(yaw) * sin(pitch), sin(yaw) * sin(pitch), cos(pitch))
    left = (-sin(yaw), cos(yaw), 0.0)
    f_B = tuple(sum(a * b for a, b in zip(force, axis, strict=True)) / MASS for axis in (forward, left, up))
    return {
        "autopilot": {"q_WB": q, "f_B": (f_B[0], f_B[1], f_B[2] + G)},
        "servos": {"position": (*JOINTS[:2], theta_3, 0.0, 0.0)},
    }


def test_pressing_is_positive() -> None:
    """The pipe lies in the direction n = +y; what it does to the vehicle points to -y."""
    assert DERIVED.site.normal == pytest.approx((0.0, 1.0), abs=1e-12)
    _, believed = after(State(), LONG, pushed((0.0, -2.0, 0.0)))
    assert believed.contact_force == pytest.approx(2.0, abs=1e-6)
    assert believed.force_W == pytest.approx((0.0, -2.0, 0.0), abs=1e-6)
    _, believed = after(State(), LONG, pushed((0.0, 2.0, 0.0)))
    assert believed.contact_force == pytest.approx(-2.0, abs=1e-6)


def test_only_the_part_along_the_normal_counts_as_contact() -> None:
    _, believed = after(State(), LONG, pushed((3.0, -1.0, 4.0)))
    assert believed.contact_force == pytest.approx(1.0, abs=1e-6)
    assert believed.force_W == pytest.approx((3.0, -1.0, 4.0), abs=1e-6)


def test_in_the_end_effector_s_frame_as_worked_by_hand() -> None:
    """Eq. 16 and 17, heading to +y, nose down by 10 deg, the tool up by 30 deg, 2 N against the nose.

    F_body = (-2 cos 10, 0, -2 sin 10). The gripper points along (cos 30, 0, sin 30) of B and -z of E; x of E is
    (-sin 30, 0, cos 30) of B. So F_ee = (2 cos 10 sin 30 - 2 sin 10 cos 30, 0, 2 cos 10 cos 30 + 2 sin 10 sin 30).
    """
    ten, thirty = radians(10.0), radians(30.0)
    seen = pushed((0.0, -2.0, 0.0), pitch=ten, theta_3=thirty)
    _, believed = after(State(), LONG, seen)
    assert believed.force_ee == pytest.approx((2.0 * sin(radians(20.0)), 0.0, 2.0 * cos(radians(20.0))), abs=1e-6)
    assert (believed.force_ee[0], believed.force_ee[2]) == pytest.approx((0.6840, 1.8794), abs=1e-4)


def test_the_force_is_filtered_with_the_observer_s_cutoff() -> None:
    ticks = round(1.0 / CONFIG.observer.cutoff / 0.004)
    _, believed = after(State(), ticks, pushed((0.0, -2.0, 0.0)))
    assert 0.5 < believed.contact_force / 2.0 < 0.75


def test_without_payload_the_observer_knows_the_lighter_mass() -> None:
    light = DERIVED.model.mass(False)
    state = State(payload=False)
    _, believed = after(state, LONG, {}, thrust=light * G)
    assert believed.force_W == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_the_tare_takes_out_what_is_read_at_rest() -> None:
    seen = pushed((0.2, -0.3, 0.4))
    state, believed = after(State(), LONG, seen, phase=Phase.TARE)
    assert believed.contact_force == pytest.approx(0.3, abs=1e-6)
    state, _ = after(state, 100, seen, phase=Phase.TARE, progress=Progress(tare_begun=True, taring=True))
    state, believed = after(
        state, 1, seen, phase=Phase.TARE, progress=Progress(tare_begun=True, taring=True, tared=True)
    )
    assert believed.force_W == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)
    state, believed = after(state, LONG, pushed((0.2, -1.3, 0.4)), phase=Phase.ADVANCE)
    assert believed.contact_force == pytest.approx(1.0, abs=1e-3)


def test_a_tare_broken_off_leaves_nothing_for_the_next() -> None:
    begun, taring = Progress(tare_begun=True), Progress(tare_begun=True, taring=True)
    state, _ = after(State(), LONG, pushed((0.0, -3.0, 0.0)), phase=Phase.TARE, progress=taring)
    state, _ = after(state, 1, pushed((0.0, -0.3, 0.0)), phase=Phase.HOLD)
    assert [own.tare for own in state.forces.tares] == [(0.0, 0.0, 0.0)] * 4
    state, _ = after(state, LONG, pushed((0.0, -0.3, 0.0)), phase=Phase.HOLD, progress=begun)
    state, _ = after(state, 100, pushed((0.0, -0.3, 0.0)), phase=Phase.HOLD, progress=taring)
    state, _ = after(state, 20, pushed((0.0, -0.3, 0.0)), phase=Phase.HOLD, progress=begun)  # moved for a moment
    done = replace(taring, tared=True)
    state, believed = after(state, 1, pushed((0.0, -0.3, 0.0)), phase=Phase.HOLD, progress=done)
    assert believed.force_W == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


# --- contact trigger --------------------------------------------------------------------------------------------------


def at_crack(theta_3: float = 0.0) -> dict[str, Any]:
    """Pressing with the gripper's tip on the crack, heading to the pipe."""
    seen = pushed((0.0, -1.0, 0.0), theta_3=theta_3)
    _, believed = after(State(), 1, seen, phase=Phase.ADVANCE)
    place = tuple(
        1.0 * (i == 0) + 1.5 * (i == 2) + c - t
        for i, (c, t) in enumerate(zip(DERIVED.site.crack, believed.tip_W, strict=True))
    )
    return seen | {"odometry": {"p_WB": place, "v_WB": (0.0, 1e-6, 0.0)}}


def told_anew(seen: dict[str, Any], i: int) -> dict[str, Any]:
    """The same with a velocity of its own, so that it is no repetition."""
    return seen | {"odometry": seen["odometry"] | {"v_WB": (0.0, 1e-9 * (i + 1), 0.0)}}


def contacts(seen: dict[str, Any], phase: Phase, ticks: int = 200) -> bool:
    state, believed = State(), None
    for i in range(ticks):
        t = T0 + i * TICK_NS
        now = told_anew(seen, i)
        tick = Inputs(
            t, 0.004, odometry(t, **now["odometry"]), autopilot(t, **now["autopilot"]), servos(t, **now["servos"])
        )
        state, believed = believe(state, tick, phase)
    return believed is not None and believed.in_contact


@pytest.mark.parametrize(
    ("phase", "found"),
    [(Phase.ADVANCE, True), (Phase.PRESS, True), (Phase.RELEASE, True), (Phase.TARE, False), (Phase.HOLD, False)],
)
def test_contact_is_looked_for_only_near_the_pipe(phase: Phase, found: bool) -> None:
    assert contacts(at_crack(), phase) is found


def test_a_force_away_from_the_crack_is_no_contact() -> None:
    seen = at_crack()
    x, y, z = seen["odometry"]["p_WB"]
    beside = seen | {"odometry": {"p_WB": (x + 2.0 * CONFIG.contact.tolerance, y, z)}}
    assert not contacts(beside, Phase.ADVANCE)


def test_contact_is_forgotten_away_from_the_pipe() -> None:
    state = State()
    state, _ = after(state, 1, {}, phase=Phase.ADVANCE)
    state = replace(state, trigger=replace(state.trigger, contact=True))
    _, believed = after(state, 1, {}, phase=Phase.RETREAT)
    assert not believed.in_contact


def test_the_same_arguments_give_the_same_bits() -> None:
    state, _ = after(State(), 3, pushed((0.1, -0.2, 0.3)))
    seen = inputs(T0 + 20_000_000)
    assert believe(state, seen) == believe(state, seen)
