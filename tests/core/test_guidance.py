"""The reference: it never jumps, keeps its limits and keeps the needle off the pipe, however it is interrupted."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import cos, dist, hypot, pi, sin

import pytest
from msgspec.structs import replace

from onboard.config import Config, load_config
from onboard.core.derived import derive
from onboard.core.guidance import BACKING_OUT, PRESSING, READY_BACK, SMOOTH_START, STANDING
from onboard.core.types import Phase, Reference
from tests.core.following import CHAIN, DT, Follower, Step

CONFIG: Config = load_config(
    "paper",
    sets=["pipe.position=[2.0,0.7,1.8]", "pipe.heading_deg=35.0", "repair.hold=1.0", "force_profile.ramp=2.0"],
)
P, G = CONFIG.plan, CONFIG.guidance
SPEED = max(P.speed, P.near_speed, P.descent_speed)
#: Shortest time in which a motion at the speed v is broken off, s.
STOP = {v: max(1.0, 2.0 * v / G.stop_acceleration) for v in [0.05 * k * SPEED for k in range(1, 21)]}
#: A quintic that begins at the speed v or the acceleration a and lasts T: peaks 4.14 v / T + a, 36 v / T^2 + 9 a / T.
BREAKING = P.acceleration + P.acceleration + max(4.14 * v / t for v, t in STOP.items())
BREAKING_JERK = P.jerk + 9.0 * P.acceleration + max(36.0 * v / (t * t) for v, t in STOP.items())


@pytest.fixture(scope="module")
def flown() -> tuple[list[Step], list[Follower]]:
    """A whole mission, and copies of it every 0.8 s."""
    first = Follower(CONFIG, heading=0.4)
    for phase in CHAIN:
        first.finish(phase)
    again, copies = Follower(CONFIG, heading=0.4), []
    for i, step in enumerate(first.steps):
        again.tick(step.phase)
        if step.phase is Phase.RELEASE:
            again.estimate = replace(again.estimate, payload=False)
        if i % 200 == 0:
            copies.append(again.copy())
    assert again.steps == first.steps
    return first.steps, copies


@pytest.fixture(scope="module")
def mission(flown: tuple[list[Step], list[Follower]]) -> list[Step]:
    return flown[0]


@pytest.fixture(scope="module")
def moments(flown: tuple[list[Step], list[Follower]]) -> list[Follower]:
    return flown[1]


def of(mission: list[Step], *phases: Phase) -> list[Reference]:
    return [step.reference for step in mission if step.phase in phases]


def places(r: Reference) -> tuple[float, ...]:
    return (*r.p, r.yaw, *r.wrist, r.elevation)


def rates(r: Reference) -> tuple[float, ...]:
    return (*r.v, r.yaw_rate, *r.wrist_rate, r.elevation_rate)


def is_smooth(references: Sequence[Reference], acceleration: float, jerk: float) -> None:
    """Places, rates and accelerations follow from each other, and stay within the limits."""
    for a, b in pairwise(references):
        for x, y, u, v in zip(places(a), places(b), rates(a), rates(b), strict=True):
            assert abs(y - x - 0.5 * DT * (u + v)) < 2e-5, (a, b)
        for u, v, c, d in zip(a.v, b.v, a.a, b.a, strict=True):
            assert abs(v - u - 0.5 * DT * (c + d)) < 2e-5, (a, b)
        assert hypot(*b.a) <= acceleration * 1.001 + 1e-9, b
        assert dist(b.a, a.a) <= jerk * DT * 1.001 + 1e-9, (a, b)


# --- smoothness -------------------------------------------------------------------------------------------------------


def test_the_mission_is_smooth_and_within_its_limits(mission: list[Step]) -> None:
    before, after = (
        [s.reference for s in mission if s.phase in CHAIN[1:8]],
        [s.reference for s in mission if s.phase in CHAIN[10:] and not s.reference.pressing],
    )
    descent = P.descent_speed / SMOOTH_START  # a uniform leg gathers its speed within that time
    for references in (before, [r for r in after if r.lift >= 1.0]):
        is_smooth(references, max(P.acceleration, 1.875 * descent), max(P.jerk, 5.774 * descent / SMOOTH_START))
        assert max(hypot(*r.v) for r in references) <= SPEED * 1.001
        assert max(abs(r.yaw_rate) for r in references) <= P.yaw_rate * 1.001
        assert max(hypot(*r.wrist_rate) for r in references) <= 2.0 * P.arm_speed * 1.001


def test_beside_the_pipe_it_is_slow(mission: list[Step]) -> None:
    for reference in of(mission, *CHAIN[4:7], Phase.RETREAT):
        assert hypot(*reference.v) <= P.near_speed * 1.001
    for reference in of(mission, Phase.ADVANCE):
        assert hypot(*reference.v) <= P.advance_speed * 1.001


INTERRUPTIONS = (Phase.HOLD, Phase.RETREAT_HOLD, Phase.RETREAT_LAND, Phase.LAND)


@pytest.mark.parametrize("by", INTERRUPTIONS)
def test_broken_off_anywhere_in_free_flight_nothing_jumps(moments: list[Follower], by: Phase) -> None:
    tried = 0
    for moment in moments:
        last = moment.steps[-1]
        if last.phase in (*STANDING, *PRESSING, by) or last.reference.pressing or last.reference.lift < 1.0:
            continue
        tried += 1
        follower = moment.copy()
        follower.run(by, 2.0)
        is_smooth([s.reference for s in follower.steps if s.reference.lift >= 1.0], BREAKING, BREAKING_JERK)
    assert tried > 50


def test_a_hold_ends_at_rest_close_by(moments: list[Follower]) -> None:
    for moment in moments:
        last = moment.steps[-1]
        if last.phase in (*STANDING, *PRESSING, Phase.LAND) or last.reference.pressing or last.reference.lift < 1.0:
            continue
        follower = moment.copy()
        follower.finish(Phase.HOLD, within=5.0)
        reference = follower.steps[-1].reference
        assert rates(reference) == (0.0,) * 7
        assert reference.a == (0.0, 0.0, 0.0)
        speed = hypot(*last.reference.v)
        stop = max(1.0, 2.0 * speed / G.stop_acceleration)
        assert dist(reference.p, last.reference.p) <= 0.5 * speed * stop + 0.02


@pytest.mark.parametrize("wait", [0.2, 0.8])
def test_resumed_in_the_middle_of_a_hold_nothing_jumps(moments: list[Follower], wait: float) -> None:
    for moment in moments:
        phase, reference, _ = moment.steps[-1]
        if phase not in CHAIN[1:8] or reference.lift < 1.0:
            continue
        follower = moment.copy()
        follower.run(Phase.HOLD, wait)
        follower.run(Phase.TARE if phase is Phase.ADVANCE else phase, 1.5)
        is_smooth([s.reference for s in follower.steps], BREAKING + 1.0, 2.0 * BREAKING_JERK)


# --- the needle -------------------------------------------------------------------------------------------------------


def needle_from_axis(reference: Reference) -> float:
    """Distance of the needle's tip from the pipe's axis, m, the base standing where the reference wants it."""
    site, arm = derive(CONFIG).site, CONFIG.vehicle.arm
    axis = site.needle - arm.mount[0] + CONFIG.pipe.radius
    direction = reference.elevation + 0.5 * pi
    x = reference.wrist[0] + arm.needle * cos(direction) - axis
    z = reference.wrist[1] + arm.needle * sin(direction)
    return hypot(x, z)


def test_the_needle_dispenses_along_the_arc_and_else_keeps_off(mission: list[Step]) -> None:
    radius = CONFIG.pipe.radius + P.needle_gap
    dispensing = [r for r in of(mission, Phase.ADHESIVE) if r.dispensing]
    for reference in dispensing:
        assert needle_from_axis(reference) == pytest.approx(radius, abs=1e-9)
    first, last = derive(CONFIG).site.arc
    angles = [-r.elevation - 0.5 * pi for r in dispensing]
    assert (angles[0], angles[-1]) == pytest.approx((first, last), abs=1e-3)
    assert all(b >= a for a, b in pairwise(angles))
    assert min(needle_from_axis(r) for r in of(mission, Phase.ADHESIVE)) > radius - 1e-9


def test_the_pump_turns_in_proportion_to_the_arc(mission: list[Step]) -> None:
    radius = CONFIG.pipe.radius + P.needle_gap
    references = of(mission, Phase.ADHESIVE)
    for a, b in pairwise(references):
        if a.dispensing and b.dispensing:
            assert b.pump - a.pump == pytest.approx(P.pump_ratio * radius * (a.elevation - b.elevation), abs=1e-9)
        elif not b.dispensing and not a.dispensing:
            assert a.pump == b.pump
    first, last = derive(CONFIG).site.arc
    assert references[-1].pump - references[0].pump == pytest.approx(P.pump_ratio * radius * (last - first))
    speed = [abs(r.elevation_rate) * radius for r in references if r.dispensing]
    assert max(speed) <= P.needle_speed * 1.001


def test_dispensing_waits_for_servos_that_were_not_heard_and_for_the_arm_to_come_back(moments: list[Follower]) -> None:
    moment = next(m for m in moments if m.steps[-1].phase is Phase.ADHESIVE and m.steps[-1].reference.dispensing)
    follower = moment.copy()
    before = follower.steps[-1].reference
    for age, hangs in ((CONFIG.safety.servos_late + 0.01, False), (0.0, True)):
        for _ in range(50):
            a, b, c = follower.estimate.joints
            follower.estimate = replace(follower.estimate, age_servos=age, joints=(a + 0.3 * hangs, b, c))
            told = follower.tick(Phase.ADHESIVE).reference
            assert not told.dispensing
            assert (told.pump, told.wrist, told.elevation) == (before.pump, before.wrist, before.elevation)
            assert (told.wrist_rate, told.elevation_rate) == ((0.0, 0.0), 0.0)
    rest = follower.finish(Phase.ADHESIVE)
    angles = [-s.reference.elevation - 0.5 * pi for s in rest.steps if s.reference.dispensing]
    assert max(angles) == pytest.approx(follower.site.arc[1], abs=1e-3)


def test_held_anywhere_the_needle_is_not_driven_into_the_pipe(moments: list[Follower]) -> None:
    tried = 0
    for moment in moments:
        if moment.steps[-1].phase is not Phase.ADHESIVE:
            continue
        for later in (0.0, 0.2, 0.4, 0.6):
            follower = moment.copy()
            follower.run(Phase.ADHESIVE, later)
            follower.run(Phase.HOLD, 2.0)
            assert min(needle_from_axis(s.reference) for s in follower.steps) > CONFIG.pipe.radius + 0.5 * P.needle_gap
            tried += 1
    assert tried > 50


@pytest.mark.parametrize("nth", range(3))
def test_resumed_anywhere_the_needle_keeps_off_and_dispenses_the_whole_arc(moments: list[Follower], nth: int) -> None:
    for moment in [m for m in moments if m.steps[-1].phase is Phase.ADHESIVE][nth::9]:
        follower = moment.copy()
        follower.run(Phase.HOLD, 2.0).finish(Phase.ADHESIVE)
        assert min(needle_from_axis(s.reference) for s in follower.steps) > CONFIG.pipe.radius + 0.5 * P.needle_gap
        angles = [-s.reference.elevation - 0.5 * pi for s in follower.steps[2:] if s.reference.dispensing]
        first, last = follower.site.arc
        assert min(angles) == pytest.approx(first, abs=1e-3)
        assert max(angles) == pytest.approx(last, abs=1e-3)


# --- on the way to a phase beside the pipe ----------------------------------------------------------------------------


def from_axis(follower: Follower) -> float:
    """Least distance of needle, gripper and wrist from the pipe's axis, m, wherever base and tool are."""
    arm, n, axis = CONFIG.vehicle.arm, follower.site.normal, CONFIG.pipe.position
    least = 10.0
    for _, reference, _ in follower.steps:
        (forward, up), elevation = reference.wrist, reference.elevation
        for length, angle in ((arm.needle, elevation + 0.5 * pi), (arm.gripper, elevation), (0.0, 0.0)):
            ahead = arm.mount[0] + forward + length * cos(angle)
            x = reference.p[0] - axis[0] + ahead * cos(reference.yaw)
            y = reference.p[1] - axis[1] + ahead * sin(reference.yaw)
            z = reference.p[2] - axis[2] + arm.mount[2] + up + length * sin(angle)
            least = min(least, hypot(x * n[0] + y * n[1], z))
    return least


@pytest.mark.parametrize("to", [Phase.APPROACH, *CHAIN[3:7], Phase.RETURN])
def test_after_a_retreat_from_anywhere_the_tools_keep_off_the_pipe(moments: list[Follower], to: Phase) -> None:
    places = {Phase.ALIGN: "needle", Phase.ADHESIVE: "needle", Phase.TOOL_CHANGE: "near", Phase.TARE: "near"}
    beside = [m for m in moments if m.steps[-1].phase in CHAIN[3:7]]
    for moment in beside[:: len(beside) // 7]:
        follower = moment.copy()
        follower.finish(Phase.RETREAT_HOLD).run(Phase.HOLD, 0.2)
        follower.steps = follower.steps[-1:]
        follower.finish(to)
        touching = CONFIG.pipe.radius + (0.9 * P.needle_gap if to in CHAIN[3:5] else 0.9 * P.gap)
        assert from_axis(follower) > touching
        last = follower.steps[-1].reference
        if to in places:
            assert follower.from_crack == pytest.approx(getattr(follower.site, places[to]), abs=1e-6)
            assert sin(last.yaw - follower.site.yaw) == pytest.approx(0.0, abs=1e-9)
            wanted = (P.press_reach, 0.0) if places[to] == "near" else (P.needle_reach - READY_BACK, 0.0)
            assert last.wrist == pytest.approx(wanted)


# --- contact ----------------------------------------------------------------------------------------------------------


def entered(mission: list[Step], phase: Phase) -> tuple[Reference, Reference]:
    """The references of the last tick before a phase and of its first."""
    i = next(k for k, step in enumerate(mission) if step.phase is phase)
    return mission[i - 1].reference, mission[i].reference


def at_contact(force: float) -> Follower:
    """At the end of the advance, the pipe pushing back."""
    follower = Follower(CONFIG)
    for phase in CHAIN[:8]:
        follower.finish(phase)
    follower.estimate = replace(follower.estimate, contact_force=force)
    return follower


@pytest.mark.parametrize("force", [-0.3, 0.0, 0.16, 0.6, 9.0])
def test_pressing_begins_with_the_force_and_at_the_place_of_the_contact(force: float) -> None:
    follower = at_contact(force)
    place = follower.estimate.p_WB
    start = min(max(0.0, force), CONFIG.repair.force)
    reference = follower.tick(Phase.PRESS).reference
    assert reference.pressing
    assert reference.force == pytest.approx(start, abs=1e-3)
    n = follower.site.normal
    lead = (1.0 - CONFIG.backstepping.feed_forward) * start / derive(CONFIG).normal_stiffness
    assert reference.p == pytest.approx((place[0] + lead * n[0], place[1] + lead * n[1], place[2]), abs=1e-4)
    assert reference.compliant_displacement == pytest.approx(0.0, abs=1e-4)


def test_the_force_runs_from_the_contact_over_the_bias_to_the_hold_and_back(mission: list[Step]) -> None:
    forces = [r.force for r in of(mission, Phase.PRESS)]
    profile, repair = CONFIG.force_profile, CONFIG.repair
    assert max(forces) == pytest.approx(repair.force)
    at_most = [force for force in forces if force == pytest.approx(repair.force, abs=1e-9)]
    assert len(at_most) * DT == pytest.approx(repair.hold, abs=0.1 * profile.ramp)
    assert forces[-1] == pytest.approx(profile.bias)
    steepest = 1.875 * max(repair.force / profile.ramp, repair.force / profile.settle)
    assert max(abs(b - a) for a, b in pairwise(forces)) <= steepest * DT * 1.001
    assert {r.force for r in of(mission, Phase.RELEASE)} == {profile.bias}


def test_release_goes_on_where_the_press_ended(mission: list[Step]) -> None:
    a, b = entered(mission, Phase.RELEASE)
    assert b.pressing
    assert b.force == pytest.approx(a.force, abs=1e-9)
    assert dist(a.p, b.p) < 1e-5
    assert (a.gripper, b.gripper) == (G.gripper_closed, G.gripper_open)


@pytest.mark.parametrize("by", BACKING_OUT)
@pytest.mark.parametrize("after", [1.0, 3.5, 5.0])
def test_the_force_is_taken_back_before_the_retreat(by: Phase, after: float) -> None:
    follower = at_contact(0.3)
    follower.run(Phase.PRESS, after)
    before = follower.steps[-1].reference
    assert before.force > 0.1
    follower.run(by, G.force_down)
    *down, freed = [s.reference for s in follower.steps[-round(G.force_down / DT) :]]
    forces = [before.force, *(r.force for r in down)]
    assert all(b <= a for a, b in pairwise(forces))
    assert max(a - b for a, b in pairwise(forces)) <= 1.875 * (before.force + G.pull_back) / G.force_down * DT * 1.001
    assert forces[-1] == pytest.approx(-G.pull_back, abs=1e-4)
    assert all(r.pressing for r in down)
    assert (freed.force, freed.pressing) == (0.0, False)
    start = follower.estimate.p_WB
    follower.finish(by)
    end = follower.steps[-1].reference
    way = [(b - a) for a, b in zip(start, end.p, strict=True)]
    n = follower.site.normal
    assert way == pytest.approx([-P.retreat * n[0], -P.retreat * n[1], 0.0], abs=1e-9)
    assert not end.pressing


@pytest.mark.parametrize("speed", [0.3, 0.02, -0.02, -2.0])
def test_a_retreat_goes_on_from_the_speed_away_from_the_pipe_and_no_other(speed: float) -> None:
    follower = at_contact(0.3)
    follower.run(Phase.PRESS, 3.0)
    follower.run(Phase.RETREAT_HOLD, G.force_down - 0.02)
    place = follower.from_crack
    n = follower.site.normal
    for _ in range(10):
        follower.estimate = replace(follower.estimate, v_WB=(speed * n[0], speed * n[1], 0.3))
        reference = follower.tick(Phase.RETREAT_HOLD).reference
    assert not reference.pressing
    away = -(reference.v[0] * n[0] + reference.v[1] * n[1])
    assert away == pytest.approx(min(P.near_speed, max(0.0, -speed)), abs=0.02 * P.near_speed)
    assert abs(reference.v[2]) < 1e-12
    follower.finish(Phase.RETREAT_HOLD)
    nearest = min(
        -sum((p - q) * k for p, q, k in zip(s.reference.p[:2], follower.site.crack[:2], n, strict=True))
        for s in follower.steps[-1000:]
    )
    assert nearest >= place - 1e-3


@pytest.mark.parametrize("then", BACKING_OUT)
def test_one_retreat_that_turns_into_another_goes_on(then: Phase) -> None:
    straight, turned = at_contact(0.3), at_contact(0.3)
    for follower in (straight, turned):
        follower.run(Phase.PRESS, 3.5)
        follower.run(Phase.RETREAT_HOLD, 0.4)
    straight.run(Phase.RETREAT_HOLD, 3.0)
    turned.run(then, 3.0)
    assert [s.reference for s in turned.steps] == [s.reference for s in straight.steps]


def test_contact_lost_backs_off_without_force(mission: list[Step]) -> None:
    follower = at_contact(0.3)
    follower.run(Phase.PRESS, 3.5)
    first = follower.tick(Phase.TARE).reference
    assert not first.pressing
    assert first.force == 0.0
    assert dist(first.p[:2], follower.estimate.p_WB[:2]) < 1e-4
    follower.finish(Phase.TARE)
    assert follower.from_crack == pytest.approx(follower.site.near)


def test_the_gripper_opens_once_and_stays_open(mission: list[Step]) -> None:
    wanted = [s.reference.gripper for s in mission]
    opened = wanted.index(G.gripper_open)
    assert mission[opened].phase is Phase.RELEASE
    assert set(wanted[:opened]) == {G.gripper_closed}
    assert set(wanted[opened:]) == {G.gripper_open}


# --- the advance, the ground, and progress ----------------------------------------------------------------------------


def test_the_advance_goes_straight_at_its_speed(mission: list[Step]) -> None:
    references = of(mission, Phase.ADVANCE)
    n = derive(CONFIG).site.normal
    for reference in references[round(SMOOTH_START / DT) :]:
        assert reference.v == pytest.approx((P.advance_speed * n[0], P.advance_speed * n[1], 0.0))
        assert reference.a == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert references[0].v == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_the_motors_spool_up_before_anything_moves(mission: list[Step]) -> None:
    waiting = Follower(CONFIG)
    waiting.run(Phase.PREFLIGHT, 0.1)
    for _ in range(100):
        assert waiting.tick(Phase.TAKEOFF, engaged=False).reference.lift == 0.0
    references = of(mission, Phase.TAKEOFF)
    lifts = [r.lift for r in references]
    assert all(b - a <= DT / P.spool * 1.001 for a, b in pairwise(lifts))
    on_ground = [r for r in references if r.lift < 1.0]
    assert len(on_ground) == pytest.approx(P.spool / DT, abs=2)
    assert {r.p for r in on_ground} == {references[0].p}
    assert references[-1].p[2] - references[0].p[2] == pytest.approx(P.takeoff_height)


def test_on_the_ground_the_motors_spool_down(mission: list[Step]) -> None:
    references = of(mission, Phase.LAND)
    ground = CONFIG.vehicle.base.gear_height
    lifts = [r.lift for r in references]
    first = next(k for k, lift in enumerate(lifts) if lift < 1.0)
    assert references[first].p[2] < ground
    assert all(0.0 <= a - b <= DT / P.spool * 1.001 for a, b in pairwise(lifts))
    assert lifts[-1] == 0.0
    assert [s.progress.grounded for s in mission].index(True) == len(mission) - 1


def test_lifted_by_a_gust_in_the_landing_the_motors_stay_on(moments: list[Follower]) -> None:
    landing = next(m for m in moments if m.steps[-1].phase is Phase.LAND and m.steps[-1].reference.lift == 1.0)
    for height in (0.1, 0.3, 1.0):
        follower = landing.copy()
        x, y, z = follower.estimate.p_WB
        assert z > CONFIG.vehicle.base.gear_height + 0.3
        follower.estimate = replace(follower.estimate, p_WB=(x, y, z + height), v_WB=(0.0, 0.0, 0.0))
        assert follower.tick(Phase.LAND).reference.lift == 1.0


def test_it_lands_where_it_took_off(mission: list[Step]) -> None:
    first, last = of(mission, Phase.TAKEOFF)[0], of(mission, Phase.LAND)[-1]
    assert last.p[:2] == pytest.approx(first.p[:2])
    assert sin(last.yaw - first.yaw) == pytest.approx(0.0, abs=1e-9)
    assert last.wrist == pytest.approx(P.fold)


def test_a_motion_has_ended_only_when_the_vehicle_is_there() -> None:
    follower = Follower(CONFIG).finish(Phase.PREFLIGHT)
    follower.finish(Phase.TAKEOFF)
    follower.run(Phase.HOLD, 1.0)
    for _ in range(1000):
        follower.estimate = replace(follower.estimate, p_WB=(0.0, 2.0 * G.settle_position, P.takeoff_height + 0.24))
        assert not follower.tick(Phase.HOLD).progress.arrived
    ticks = 0
    while not follower.tick(Phase.HOLD).progress.arrived:
        ticks += 1
    assert ticks * DT == pytest.approx(G.settle_time, abs=2.5 * DT)


def test_the_tare_is_taken_at_rest_and_long_enough(mission: list[Step]) -> None:
    steps = [s for s in mission if s.phase is Phase.TARE]
    taring = [s.progress.taring for s in steps]
    assert sum(taring) * DT == pytest.approx(G.tare_time, abs=2.5 * DT)
    assert taring.index(True) * DT >= G.tare_settle
    assert [s.progress.tared for s in steps].index(True) == len(steps) - 1


def test_a_tare_by_hand_is_taken_at_rest_in_hover_and_as_long() -> None:
    follower = Follower(CONFIG).finish(Phase.PREFLIGHT).finish(Phase.TAKEOFF)
    follower.run(Phase.HOLD, 2.0 * (G.tare_settle + G.tare_time))
    assert not any(s.progress.taring or s.progress.tare_begun for s in follower.steps)
    for _ in range(2):  # and another one, from the beginning
        asked = len(follower.steps)
        while not follower.tick(Phase.HOLD, tare=True).progress.tared:
            assert (len(follower.steps) - asked) * DT < 20.0
        steps = follower.steps[asked:]
        assert all(s.progress.tare_begun for s in steps)
        taring = [s.progress.taring for s in steps]
        assert taring.index(True) * DT == pytest.approx(G.tare_settle, abs=2.5 * DT)
        assert sum(taring) * DT == pytest.approx(G.tare_time, abs=2.5 * DT)
        assert {s.reference.p for s in steps} == {steps[0].reference.p}
        after = follower.tick(Phase.HOLD).progress
        assert (after.tare_begun, after.taring, after.tared) == (False, False, False)


def test_armed_it_stands_where_it_stood(mission: list[Step]) -> None:
    follower = Follower(CONFIG).run(Phase.PREFLIGHT, 0.1)
    before = follower.steps[-1].reference
    follower.run(Phase.ARMED, 0.5)
    assert {(s.reference.lift, s.reference.p, s.reference.wrist) for s in follower.steps[-100:]} == {
        (0.0, before.p, before.wrist)
    }
    follower.finish(Phase.TAKEOFF)
    assert follower.steps[-1].reference.p == pytest.approx(of(mission, Phase.TAKEOFF)[-1].p)
    broken_off = Follower(CONFIG).run(Phase.PREFLIGHT, 0.1).run(Phase.ARMED, 0.1).run(Phase.LAND, 1.0)
    assert {s.reference.lift for s in broken_off.steps} == {0.0}


def test_without_an_estimate_nothing_is_begun() -> None:
    follower = Follower(CONFIG)
    follower.estimate = replace(follower.estimate, valid=False)
    before = follower.state
    step = follower.tick(Phase.TAKEOFF)
    assert follower.state == before
    assert not any((step.progress.arrived, step.progress.taring, step.reference.pressing))
    assert step.reference.lift == 0.0
