"""The gate: sweeps over each limit, and a controller that asks for anything at all."""

from __future__ import annotations

from math import acos, cos, inf, nan, pi, sin, sqrt
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from drivers.samples import AutopilotCommand, Engage, Five, Interface, JointMode, Quat, ServoCommand, Vec3
from drivers.vehicle import Vehicle
from onboard.core import limits
from onboard.core.limits import Measured, Params, Permission, State, step

ROOT = Path(__file__).parents[2]
VEHICLE = msgspec.convert(yaml.safe_load((ROOT / "configs/vehicle.yaml").read_text()), Vehicle, strict=False)
P = Params()
B = limits.bounds(VEHICLE, P)
DT = 0.004
LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
AT: Five = (-1.0, 0.5, -1.0, 0.0, 0.0)
HERE = Measured(LEVEL, AT)
FLYING = Permission(motors=True, joints=True, floor=True)
STARTING = replace(FLYING, floor=False)
HOVER = AutopilotCommand(Engage.OFFBOARD, Interface.ATTITUDE, 24.0, (0.0, 0.0, 0.0), LEVEL, (0.0, 0.0, 0.0))
IDLE = replace(HOVER, engage=Engage.IDLE, thrust=0.0)
GOALS = ServoCommand(JointMode.POSITION, (0.0, 0.0, 0.0), AT, 1.0)
TORQUES = replace(GOALS, mode=JointMode.TORQUE)
SENT = State(HOVER, GOALS)


def about(axis: Vec3, angle: float) -> Quat:
    n = sqrt(sum(a * a for a in axis))
    s = sin(0.5 * angle) / n
    return (cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


def tilt_of(q: Quat) -> float:
    return acos(max(-1.0, min(1.0, 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))))


def between(a: Quat, b: Quat) -> float:
    return 2.0 * acos(min(1.0, abs(sum(x * y for x, y in zip(a, b, strict=True)))))


def fly(
    command: AutopilotCommand, state: State = SENT, permission: Permission = FLYING, dt: float = DT, at: Measured = HERE
) -> tuple[AutopilotCommand, tuple[str, ...]]:
    _, sent, _, clipped = step(state, command, GOALS, permission, at, B, dt)
    return sent, clipped


def move(
    command: ServoCommand, state: State = SENT, permission: Permission = FLYING, dt: float = DT, at: Measured = HERE
) -> tuple[ServoCommand, tuple[str, ...]]:
    _, _, sent, clipped = step(state, HOVER, command, permission, at, B, dt)
    return sent, clipped


def test_bounds_come_from_the_vehicle() -> None:
    assert B.thrust_max == pytest.approx(0.9 * 4 * 13.0)
    mass = 2.05 + 0.05 + 0.008 + 0.015 + 0.010 + 0.012 + 0.045 + 0.010 + 0.020 + 0.080 + 0.100
    assert B.thrust_floor == pytest.approx(0.3 * mass * 9.80665)
    assert B.joint_torque == 0.93
    assert limits.bounds(VEHICLE, replace(P, joint_torque=0.5)).joint_torque == pytest.approx(0.465)
    assert B.current == pytest.approx(0.9 * 1.8)
    assert (B.low[:3], B.high[:3]) == (VEHICLE.arm.joint_min, VEHICLE.arm.joint_max)


@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.TORQUE, JointMode.OFF])
@pytest.mark.parametrize("interface", Interface)
def test_a_good_command_leaves_as_it_is(interface: Interface, mode: JointMode) -> None:
    autopilot = replace(HOVER, interface=interface, torque_B=(0.1, 0.1, 0.1), w_WB_B=(0.1, 0.1, 0.1))
    servos = replace(GOALS, mode=mode)
    state, a, s, clipped = step(State(HOVER, servos), autopilot, servos, FLYING, HERE, B, DT)
    assert a is autopilot
    assert s is servos
    assert clipped == ()
    assert state == State(autopilot, servos)


# --- thrust -----------------------------------------------------------------------------------------------------------


def test_thrust_sweep() -> None:
    quick = replace(B, thrust_rate=1e9)
    for tenth in range(-500, 1000):
        thrust = 0.1 * tenth
        _, sent, _, clipped = step(SENT, replace(HOVER, thrust=thrust), GOALS, FLYING, HERE, quick, DT)
        assert sent.thrust == min(B.thrust_max, max(B.thrust_floor, thrust))
        low, high = thrust < B.thrust_floor, thrust > B.thrust_max
        assert clipped == (("thrust_floor",) if low else ("thrust_max",) if high else ())
        _, sent, _, _ = step(SENT, replace(HOVER, thrust=thrust), GOALS, STARTING, HERE, quick, DT)
        assert sent.thrust == min(B.thrust_max, max(0.0, thrust)), "no floor on the ground"


@pytest.mark.parametrize("dt", [0.001, 0.004, 0.02])
def test_thrust_rate_sweep(dt: float) -> None:
    reach = P.thrust_rate * dt
    for tenth in range(-200, 200):
        change = 0.1 * tenth
        sent, clipped = fly(replace(HOVER, thrust=24.0 + change), dt=dt)
        wanted = min(B.thrust_max, max(B.thrust_floor, 24.0 + max(-reach, min(reach, change))))
        assert sent.thrust == pytest.approx(wanted, abs=1e-9)
        if abs(change) > reach + 1e-6:
            assert clipped[0] == "thrust_rate"
        if abs(change) < reach - 1e-6 and B.thrust_floor < 24.0 + change < B.thrust_max:
            assert clipped == ()


def test_motors_start_from_rest_on_the_ground_but_are_taken_over_in_the_air() -> None:
    for before in (State(), State(IDLE, GOALS)):
        sent, clipped = fly(HOVER, before, STARTING)
        assert (sent.thrust, clipped) == (P.thrust_rate * DT, ("thrust_rate",))
        sent, clipped = fly(HOVER, before, FLYING)
        assert (sent, clipped) == (HOVER, ())


@pytest.mark.parametrize("dt", [nan, -1.0, 0.0])
def test_without_time_nothing_changes(dt: float) -> None:
    turned = about((0.0, 0.0, 1.0), 0.3)
    sent, clipped = fly(replace(HOVER, thrust=30.0, q_WB=turned), dt=dt)
    assert sent.thrust == 24.0
    assert between(sent.q_WB, LEVEL) < 1e-6
    assert clipped == ("thrust_rate", "attitude_rate")
    goals, clipped = move(replace(GOALS, position=(-0.9, 0.5, -1.0, 0.1, 0.0)), dt=dt)
    assert (goals.position, clipped) == (AT, ("joint_rate",))


# --- torque, rates, attitude ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("interface", "field", "bound", "name"),
    [
        (Interface.WRENCH, "torque_B", P.torque, "torque"),
        (Interface.BODY_RATE, "w_WB_B", P.body_rate, "body_rate"),
    ],
)
def test_torque_and_rate_sweeps(interface: Interface, field: str, bound: Vec3, name: str, axis: int) -> None:
    for step_ in range(-60, 61):
        asked = [0.01, -0.01, 0.01]
        asked[axis] = bound[axis] * step_ / 20.0
        sent, clipped = fly(replace(HOVER, interface=interface, **{field: tuple(asked)}))
        wanted = list(asked)
        wanted[axis] = min(bound[axis], max(-bound[axis], asked[axis]))
        assert getattr(sent, field) == tuple(wanted)
        assert clipped == (() if wanted == asked else (name,))
        for other in set(Interface) - {interface}:
            unused = replace(HOVER, interface=other, **{field: tuple(asked)})
            assert fly(unused) == (unused, ())


@pytest.mark.parametrize("yaw", [-3.0, 0.0, 0.7])
def test_tilt_sweep(yaw: float) -> None:
    quick = replace(B, attitude_rate=1e9)
    heading = about((0.0, 0.0, 1.0), yaw)
    for azimuth in (0.0, 1.0, 2.5, -2.0):
        axis = (cos(azimuth), sin(azimuth), 0.0)
        for degree in range(0, 180, 3):
            asked = product(heading, about(axis, degree * pi / 180.0))
            _, sent, _, clipped = step(SENT, replace(HOVER, q_WB=asked), GOALS, FLYING, HERE, quick, DT)
            assert tilt_of(sent.q_WB) == pytest.approx(min(P.tilt, degree * pi / 180.0), abs=1e-6)
            assert ("tilt" in clipped) is (degree * pi / 180.0 > P.tilt)
            less_far = product(heading, about(axis, min(P.tilt, degree * pi / 180.0)))
            assert between(sent.q_WB, less_far) < 1e-6


def product(a: Quat, b: Quat) -> Quat:
    (w, x, y, z), (s, i, j, k) = a, b
    return (
        w * s - x * i - y * j - z * k, w * i + x * s + y * k - z * j, w * j + y * s + z * i - x * k,
        w * k + z * s + x * j - y * i,
    )  # fmt: skip


def test_upside_down_is_brought_to_the_largest_tilt() -> None:
    quick = replace(B, attitude_rate=1e9)
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        asked = about(axis, pi)
        _, sent, _, _ = step(SENT, replace(HOVER, q_WB=asked), GOALS, FLYING, HERE, quick, DT)
        assert tilt_of(sent.q_WB) == pytest.approx(P.tilt, abs=1e-6)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.2, -0.3, 0.5)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_attitude_rate_sweep(axis: Vec3, sign: float) -> None:
    reach = P.attitude_rate * DT
    start = about((0.3, -0.2, 1.0), 0.4)
    state = State(replace(HOVER, q_WB=start), GOALS)
    for tenth in range(1, 40):
        angle = sign * 0.1 * tenth * reach
        asked = product(start, about(axis, angle))
        for asked_either in (asked, cast(Quat, tuple(-x for x in asked))):  # both quaternions mean the same
            sent, clipped = fly(replace(HOVER, q_WB=asked_either), state)
            wanted = product(start, about(axis, max(-reach, min(reach, angle))))
            assert between(sent.q_WB, wanted) < 1e-6
            if abs(tenth - 10) > 0:
                assert clipped == (("attitude_rate",) if tenth > 10 else ())


def test_a_take_over_starts_from_the_measured_attitude() -> None:
    there = about((0.0, 1.0, 0.0), 0.2)
    sent, clipped = fly(HOVER, State(IDLE, GOALS), at=Measured(there, AT))
    assert clipped == ("attitude_rate",)
    assert between(sent.q_WB, there) == pytest.approx(P.attitude_rate * DT, abs=1e-7)
    for unknown in (None, (nan, nan, nan, nan), (0.0, 0.0, 0.0, 0.0), (1e200, 0.0, 0.0, 0.0)):
        assert fly(HOVER, State(IDLE, GOALS), at=Measured(unknown, AT)) == (HOVER, ())


@pytest.mark.parametrize("scale", [0.5, 2.0, 1e5])
def test_a_quaternion_is_normalised(scale: float) -> None:
    q = about((0.0, 0.0, 1.0), 0.01)
    sent, clipped = fly(replace(HOVER, q_WB=cast(Quat, tuple(scale * x for x in q))))
    assert sent.q_WB == pytest.approx(q)
    assert clipped == ("attitude_norm",)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e200])
def test_what_is_no_attitude_is_replaced_by_the_last(scale: float) -> None:
    last = about((0.0, 0.0, 1.0), 0.3)
    asked = replace(HOVER, q_WB=cast(Quat, tuple(scale * x for x in LEVEL)))
    assert fly(asked, State(replace(HOVER, q_WB=last), GOALS))[0].q_WB == last
    assert fly(asked, State(), at=Measured(None, None))[0].q_WB == LEVEL


# --- finite -----------------------------------------------------------------------------------------------------------

PLACES = ["thrust", *((field, i) for field, n in (("torque_B", 3), ("q_WB", 4), ("w_WB_B", 3)) for i in range(n))]


def spoil(command: Any, place: Any, value: float) -> Any:
    if isinstance(place, str):
        return replace(command, **{place: value})
    field, i = place
    values = list(getattr(command, field))
    values[i] = value
    return replace(command, **{field: tuple(values)})


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("place", PLACES, ids=str)
@pytest.mark.parametrize("interface", Interface)
def test_a_command_not_finite_is_held_and_then_landed(interface: Interface, place: Any, value: float) -> None:
    good = replace(HOVER, interface=interface)
    bad = spoil(good, place, value)
    state = State(good, GOALS)
    for _ in range(P.hold_ticks):
        state, sent, _, clipped = step(state, bad, GOALS, FLYING, HERE, B, DT)
        assert sent is good
        assert clipped == ("non_finite",)
    state, sent, _, clipped = step(state, bad, GOALS, FLYING, HERE, B, DT)
    assert (sent.engage, sent.thrust) == (Engage.LAND, 0.0)
    assert clipped == ("non_finite", "non_finite_land")
    state, sent, _, clipped = step(state, good, GOALS, FLYING, HERE, B, DT)
    assert (sent.engage, clipped) == (Engage.LAND, ("non_finite_land",)), "no way back into offboard in the air"
    for engage in (Engage.KILL, Engage.LAND):
        assert step(state, replace(IDLE, engage=engage), GOALS, FLYING, HERE, B, DT)[1].engage is engage
    state, sent, _, _ = step(state, IDLE, GOALS, FLYING, HERE, B, DT)
    assert sent is IDLE
    assert step(state, good, GOALS, STARTING, HERE, B, DT)[1].engage is Engage.OFFBOARD


def test_a_good_command_ends_the_count() -> None:
    state = SENT
    bad = replace(HOVER, thrust=nan)
    for _ in range(5):
        for _ in range(P.hold_ticks):
            state, sent, _, _ = step(state, bad, GOALS, FLYING, HERE, B, DT)
            assert sent is HOVER
        state, sent, _, _ = step(state, HOVER, GOALS, FLYING, HERE, B, DT)
        assert sent is HOVER


@pytest.mark.parametrize("before", [State(), State(IDLE, GOALS)])
def test_nothing_good_to_hold_means_idle(before: State) -> None:
    sent, clipped = fly(replace(HOVER, thrust=nan), before)
    assert sent == IDLE
    assert clipped == ("non_finite",)


@pytest.mark.parametrize("engage", [Engage.IDLE, Engage.LAND, Engage.KILL])
@pytest.mark.parametrize("place", PLACES, ids=str)
def test_what_needs_no_set_point_passes_whatever_it_says(engage: Engage, place: Any) -> None:
    for landing in (True, False):
        state = replace(SENT, landing=landing)
        after, sent, _, _ = step(state, spoil(replace(HOVER, engage=engage), place, nan), GOALS, FLYING, HERE, B, DT)
        assert sent == replace(IDLE, engage=engage)
        assert after.landing is (landing and engage is not Engage.IDLE)


# --- permitted --------------------------------------------------------------------------------------------------------


def test_no_thrust_without_permission() -> None:
    sent, clipped = fly(HOVER, permission=replace(FLYING, motors=False))
    assert (sent, clipped) == (IDLE, ("motors_not_permitted",))


@pytest.mark.parametrize("motors", [True, False])
@pytest.mark.parametrize("engage", [Engage.IDLE, Engage.LAND, Engage.KILL])
@pytest.mark.parametrize("field", ["thrust", "torque_B", "w_WB_B", None])
def test_no_thrust_when_not_engaged(engage: Engage, motors: bool, field: str | None) -> None:
    quiet = replace(IDLE, engage=engage)
    value: Any = 1.0 if field == "thrust" else (0.0, 1.0, 0.0)
    asked = quiet if field is None else replace(quiet, **{field: value})
    sent, clipped = fly(asked, permission=replace(FLYING, motors=motors))
    assert sent == quiet
    assert clipped == (() if field is None else ("not_engaged",))
    assert field is not None or sent is asked


@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.TORQUE])
def test_no_joint_torque_without_permission(mode: JointMode) -> None:
    asked = replace(GOALS, mode=mode, torque=(0.1, 0.1, 0.1))
    sent, clipped = move(asked, permission=replace(FLYING, joints=False))
    assert (sent.mode, sent.torque, clipped) == (JointMode.OFF, (0.0, 0.0, 0.0), ("joints_not_permitted",))


# --- joints -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", range(3))
def test_joint_torque_sweep(joint: int) -> None:
    for hundredth in range(-200, 201):
        asked = [0.1, -0.1, 0.1]
        asked[joint] = 0.01 * hundredth
        sent, clipped = move(replace(TORQUES, torque=tuple(asked)), State(HOVER, TORQUES))
        wanted = min(0.93, max(-0.93, asked[joint]))
        assert sent.torque[joint] == wanted
        assert clipped == (() if wanted == asked[joint] else ("joint_torque",))
    assert move(replace(GOALS, torque=(9.0, 9.0, 9.0)))[1] == (), "not used under position control"


@pytest.mark.parametrize("joint", range(3))
def test_no_torque_pushes_a_joint_out_of_its_range(joint: int) -> None:
    for at, outward in ((B.high[joint], 0.5), (B.low[joint], -0.5)):
        position = list(AT)
        position[joint] = at
        here = Measured(LEVEL, cast(Five, tuple(position)))
        torque = [0.2, 0.2, 0.2]
        torque[joint] = outward
        sent, clipped = move(replace(TORQUES, torque=tuple(torque)), State(HOVER, TORQUES), at=here)
        torque[joint] = 0.0
        assert (sent.torque, clipped) == (tuple(torque), ("joint_stop",))
        torque[joint] = -outward
        back = replace(TORQUES, torque=tuple(torque))
        assert move(back, State(HOVER, TORQUES), at=here) == (back, ())
    unknown = replace(TORQUES, torque=(0.5, 0.5, 0.5))
    assert move(unknown, State(HOVER, TORQUES), at=Measured(LEVEL, None)) == (unknown, ())


@pytest.mark.parametrize("servo", range(5))
@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.TORQUE])
def test_joint_position_sweep(servo: int, mode: JointMode) -> None:
    quick = replace(B, rate=(1e9,) * 5)
    low, high = B.low[servo], B.high[servo]
    for k in range(-20, 41):
        position = list(AT)
        position[servo] = low + (high - low) * k / 20.0
        asked = replace(GOALS, mode=mode, position=tuple(position))
        _, _, sent, clipped = step(State(HOVER, asked), HOVER, asked, FLYING, HERE, quick, DT)
        bounded = servo >= 3 or mode is JointMode.POSITION
        wanted = min(high, max(low, position[servo])) if bounded else position[servo]
        assert sent.position[servo] == wanted
        assert clipped == (() if wanted == position[servo] else ("joint_position",))


@pytest.mark.parametrize("servo", range(5))
def test_joint_rate_sweep(servo: int) -> None:
    reach = B.rate[servo] * DT
    assert B.rate[servo] == (P.joint_rate if servo < 3 else P.tool_rate)
    for tenth in range(-40, 41):
        position = list(AT)
        position[servo] += 0.1 * tenth * reach
        sent, clipped = move(replace(GOALS, position=tuple(position)))
        wanted = AT[servo] + max(-reach, min(reach, 0.1 * tenth * reach))
        assert sent.position[servo] == pytest.approx(wanted, abs=1e-12)
        if abs(tenth) != 10:
            assert clipped == (("joint_rate",) if abs(tenth) > 10 else ())


def test_a_joint_starts_where_it_is() -> None:
    there = replace(GOALS, position=(0.0, 0.0, 0.0, 5.0, 1.0))
    for before in (None, replace(there, mode=JointMode.OFF)):
        sent, clipped = move(there, State(HOVER, before))
        joint, tool = P.joint_rate * DT, P.tool_rate * DT
        assert sent.position == pytest.approx((-1.0 + joint, 0.5 - joint, -1.0 + joint, tool, tool))
        assert clipped == ("joint_rate",)
        assert move(there, State(HOVER, before), at=Measured(LEVEL, None)) == (there, ())
    from_torque, _ = move(there, State(HOVER, replace(there, mode=JointMode.TORQUE)))
    assert from_torque.position[0] == pytest.approx(-1.0 + P.joint_rate * DT)
    assert from_torque.position[3:] == (5.0, 1.0), "pump and gripper are always position-controlled"


def test_current_sweep() -> None:
    for tenth in range(-10, 40):
        current = 0.1 * tenth
        sent, clipped = move(replace(GOALS, current_limit=current))
        wanted = min(B.current, max(0.0, current))
        assert (sent.current_limit, clipped) == (wanted, () if wanted == current else ("joint_current",))
        assert move(replace(TORQUES, current_limit=current), State(HOVER, TORQUES))[1] == ()


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize(
    "place", ["current_limit", *((f, i) for f, n in (("torque", 3), ("position", 5)) for i in range(n))], ids=str
)
def test_servo_goals_not_finite_hold_the_last(place: Any, value: float) -> None:
    for last in (GOALS, TORQUES):
        sent, clipped = move(spoil(last, place, value), State(HOVER, last))
        assert sent is last
        assert clipped == ("servos_non_finite",)
    sent, _ = move(spoil(GOALS, place, value), State())
    assert sent.mode is JointMode.OFF


# --- anything ---------------------------------------------------------------------------------------------------------

number = st.one_of(st.floats(), st.floats(-5.0, 5.0), st.floats(0.0, 60.0))
triple = st.tuples(number, number, number)
autopilots = st.builds(
    AutopilotCommand, st.sampled_from(Engage), st.sampled_from(Interface), number, triple,
    st.tuples(number, number, number, number), triple,
)  # fmt: skip
servo_commands = st.builds(
    ServoCommand, st.sampled_from(JointMode), triple, st.tuples(number, number, number, number, number), number
)
permissions = st.builds(Permission, st.booleans(), st.booleans(), st.booleans())
places = st.builds(
    Measured,
    st.one_of(st.none(), st.just(LEVEL), st.tuples(number, number, number, number)),
    st.one_of(st.none(), st.tuples(number, number, number, number, number)),
)
ticks = st.lists(st.tuples(autopilots, servo_commands, permissions, places, number), min_size=1, max_size=20)


@settings(deadline=None, max_examples=300, derandomize=True)
@given(ticks)
def test_whatever_comes_in_what_leaves_is_allowed(
    run: list[tuple[AutopilotCommand, ServoCommand, Permission, Measured, float]],
) -> None:
    state = State()
    for asked, goals, permission, at, dt in run:
        state, sent, servos, clipped = step(state, asked, goals, permission, at, B, dt)
        values = [sent.thrust, *sent.torque_B, *sent.q_WB, *sent.w_WB_B]
        values += [*servos.torque, *servos.position, servos.current_limit]
        assert all(-inf < value < inf for value in values)
        if asked.engage in (Engage.KILL, Engage.LAND, Engage.IDLE):
            assert sent.engage is asked.engage
        if sent.engage is Engage.OFFBOARD:
            assert permission.motors
            assert (B.thrust_floor if permission.floor else 0.0) <= sent.thrust <= B.thrust_max
            if sent.interface is Interface.WRENCH:
                assert all(abs(t) <= b for t, b in zip(sent.torque_B, P.torque, strict=True))
            if sent.interface is Interface.BODY_RATE:
                assert all(abs(w) <= b for w, b in zip(sent.w_WB_B, P.body_rate, strict=True))
            if sent.interface is Interface.ATTITUDE:
                assert sum(x * x for x in sent.q_WB) == pytest.approx(1.0, abs=1e-5)
                assert tilt_of(sent.q_WB) <= P.tilt + 1e-6
        else:
            assert (sent.thrust, sent.torque_B, sent.w_WB_B) == (0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        if servos.mode is not JointMode.OFF:
            assert permission.joints
            controlled = range(3, 5) if servos.mode is JointMode.TORQUE else range(5)
            assert all(B.low[i] <= servos.position[i] <= B.high[i] for i in controlled)
            if servos.mode is JointMode.TORQUE:
                assert all(abs(t) <= B.joint_torque for t in servos.torque)
            else:
                assert 0.0 <= servos.current_limit <= B.current
        assert (clipped == ()) is (sent is asked and servos is goals)
        assert len(set(clipped)) == len(clipped)
