"""The plan: whatever the pipe, what is planned can be flown, keeps clear of it, and what cannot is told."""

from __future__ import annotations

from itertools import pairwise
from math import atan2, cos, degrees, dist, hypot, pi, radians, sin

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from onboard.config import load_config
from onboard.core import kinematics, plan
from onboard.core.compensation import wrist_in_body
from onboard.core.kinematics import Tool
from onboard.core.plan import InfeasibleError, Params, Path, Site, survey
from onboard.core.repair import Pipe

VEHICLE: Vehicle = load_config("paper").vehicle
P = Params()
MOUNT = VEHICLE.arm.mount
HOME = (0.0, 0.0, VEHICLE.base.gear_height + P.takeoff_height)

pipes = st.builds(
    Pipe,
    position=st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(1.0, 3.0)),
    heading_deg=st.floats(-180.0, 180.0),
    radius=st.floats(0.04, 0.12),
)


def feasible(pipe: Pipe) -> Site:
    """Places of a pipe that is not in the way of the take-off: of these pipes, that alone can be wrong."""
    site, reason = None, ""
    try:
        site = survey(pipe, VEHICLE, P)
    except InfeasibleError as error:
        reason = str(error)
    assume("from take-off" not in reason)
    assert site is not None, reason
    return site


def from_axis(point: Vec3, pipe: Pipe) -> float:
    """Distance of a point from the pipe's axis, m."""
    return float(_from_axis(np.array([point]), pipe)[0])


def _from_axis(points: NDArray[np.float64], pipe: Pipe) -> NDArray[np.float64]:
    yaw = radians(pipe.heading_deg)
    along = np.array((-sin(yaw), cos(yaw), 0.0))
    r = points - np.array(pipe.position)
    half = 0.5 * pipe.length
    distances: NDArray[np.float64] = np.linalg.norm(r - np.outer(np.clip(r @ along, -half, half), along), axis=1)
    return distances


# --- places -----------------------------------------------------------------------------------------------------------


@given(pipes)
def test_the_places_are_in_front_of_the_crack_at_the_height_of_the_work(pipe: Pipe) -> None:
    site = feasible(pipe)
    n = (cos(radians(pipe.heading_deg)), sin(radians(pipe.heading_deg)), 0.0)
    assert site.normal == pytest.approx(n[:2])
    assert from_axis(site.crack, pipe) == pytest.approx(pipe.radius)
    # the crack faces the vehicle: going on in the direction of pressing leads to the axis
    assert [c + pipe.radius * k for c, k in zip(site.crack, n, strict=True)] == pytest.approx(list(pipe.position))
    for distance in (site.far, site.needle, site.near):
        place = plan.beside(site, distance)
        assert place[2] + MOUNT[2] == pytest.approx(pipe.position[2])
        assert dist(place[:2], site.crack[:2]) == pytest.approx(distance)
        assert from_axis(place, pipe) > pipe.radius + VEHICLE.rotors.arm_x + VEHICLE.rotors.radius


@given(pipes)
def test_level_before_the_advance_the_gripper_is_a_gap_away(pipe: Pipe) -> None:
    site = feasible(pipe)
    theta_1, theta_2 = kinematics.inverse_wrist(VEHICLE.arm, P.press_reach, 0.0)
    c, s = site.normal
    R = (c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)
    tip = kinematics.tip_W(VEHICLE.arm, plan.beside(site, site.near), R, (theta_1, theta_2, 0.0), Tool.GRIPPER)
    assert dist(tip, site.crack) == pytest.approx(P.gap)
    ahead = kinematics.tip_W(
        VEHICLE.arm, plan.beside(site, site.near - P.gap), R, (theta_1, theta_2, 0.0), Tool.GRIPPER
    )
    assert ahead == pytest.approx(site.crack)


# --- the arc ----------------------------------------------------------------------------------------------------------


def segment_from(a: tuple[float, float], b: tuple[float, float], point: tuple[float, float]) -> float:
    """Distance of a point from the line between a and b, by its samples."""
    return min(
        hypot(a[0] + u * (b[0] - a[0]) - point[0], a[1] + u * (b[1] - a[1]) - point[1])
        for u in (k / 50.0 for k in range(51))
    )


@settings(max_examples=40)
@given(pipes, st.floats(0.0, 1.0), st.sampled_from([0.0, P.needle_clear]), st.floats(-0.05, 0.05))
def test_all_of_the_arc_is_reached_with_the_links_clear(pipe: Pipe, part: float, lifted: float, pitch: float) -> None:
    site = feasible(pipe)
    first, last = site.arc
    angle = first + part * (last - first)
    radius = pipe.radius + P.needle_gap + lifted
    x, z, elevation = plan.wrist_on_arc(angle, radius, pipe.radius, VEHICLE, P)

    # the needle's tip is at its radius, square on the pipe, at the angle
    axis = site.needle - MOUNT[0] + pipe.radius
    needle = VEHICLE.arm.needle
    direction = elevation + 0.5 * pi
    tip = (x + needle * cos(direction), z + needle * sin(direction))
    assert hypot(tip[0] - axis, tip[1]) == pytest.approx(radius)
    assert atan2(tip[1], axis - tip[0]) == pytest.approx(angle, abs=1e-9)
    assert (x - axis) * sin(direction) == pytest.approx(z * cos(direction), abs=1e-9)

    # reached level, and while the base pitches a little about its centre
    wx, wz, _, _ = wrist_in_body((x, z), (0.0, 0.0), (MOUNT[0], MOUNT[2]), pitch, 0.0)
    *_, short = kinematics.nearest_wrist(VEHICLE.arm, wx, wz)
    assert short < 1e-3
    low, high = VEHICLE.arm.joint_min[2], VEHICLE.arm.joint_max[2]
    assert low < elevation + pitch < high
    if pitch == 0.0 or lifted == 0.0:
        theta_1, _ = kinematics.inverse_wrist(VEHICLE.arm, x, z)
        elbow = (VEHICLE.arm.link_1 * cos(theta_1), VEHICLE.arm.link_1 * sin(theta_1))
        assert segment_from(elbow, (x, z), (axis, 0.0)) >= pipe.radius + P.link_clear - 1e-3
        assert segment_from((0.0, 0.0), elbow, (axis, 0.0)) >= pipe.radius + P.link_clear


@given(pipes)
def test_the_arc_is_useful_and_no_longer_than_asked(pipe: Pipe) -> None:
    first, last = feasible(pipe).arc
    assert -P.arc_max <= first <= 0.0 <= last <= P.arc_max
    assert degrees(last - first) >= 60.0


def test_a_narrower_arc_can_be_asked_for() -> None:
    narrow = survey(Pipe(), VEHICLE, replace(P, arc_max=0.3)).arc
    assert narrow == pytest.approx((-0.3, 0.3), abs=radians(1.0))


# --- ways -------------------------------------------------------------------------------------------------------------


def legs_of(start: Vec3, goal: Vec3, pipe: Pipe, site: Site) -> list[Vec3]:
    at = (*start, 0.0, 0.0, 0.0, 0.0, 0.0)
    return [start, *plan.route(at, goal, pipe, site, P)]


def least_from_axis(points: list[Vec3], pipe: Pipe) -> float:
    """Least distance of a way from the pipe's axis, m."""
    part = np.linspace(0.0, 1.0, 200)[:, None]
    return min(
        float(_from_axis(np.array(a) + part * (np.array(b) - np.array(a)), pipe).min()) for a, b in pairwise(points)
    )


@settings(max_examples=150)
@given(pipes)
def test_the_ways_there_and_back_keep_clear_of_the_pipe(pipe: Pipe) -> None:
    site = feasible(pipe)
    far = plan.beside(site, site.far)
    retreated = plan.beside(site, site.near - P.gap + P.retreat)
    there = legs_of(HOME, far, pipe, site)
    back = legs_of(retreated, HOME, pipe, site)
    assert there[-1] == far
    assert back[-1] == HOME
    assert least_from_axis([(0.0, 0.0, 0.0), *there], pipe) > P.clearance - 0.01
    assert least_from_axis([*back, (0.0, 0.0, 0.0)], pipe) > P.clearance - 0.01


def test_a_free_way_is_straight_and_a_pipe_between_is_flown_over() -> None:
    pipe = Pipe(position=(2.0, 0.0, 1.5))
    site = survey(pipe, VEHICLE, P)
    far = plan.beside(site, site.far)
    assert legs_of(HOME, far, pipe, site) == [HOME, far]
    behind = replace(pipe, heading_deg=180.0)
    site = survey(behind, VEHICLE, P)
    way = legs_of(HOME, plan.beside(site, site.far), behind, site)
    assert len(way) == 4
    assert min(point[2] for point in way[1:3]) > pipe.position[2] + P.clearance


def test_a_short_pipe_is_passed_beside_its_end() -> None:
    pipe = Pipe(position=(2.0, 1.5, 1.5), heading_deg=180.0, length=0.4)
    site = survey(pipe, VEHICLE, P)
    goal = (4.0, -0.5, 1.5)
    assert legs_of(HOME, goal, pipe, site) == [HOME, goal]
    long = replace(pipe, length=6.0)
    assert len(legs_of(HOME, goal, long, survey(long, VEHICLE, P))) == 4


# --- times ------------------------------------------------------------------------------------------------------------

QUINTIC = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
GRID = np.linspace(0.0, 1.0, 2001)
#: Peaks of the quintic's first three derivatives.
PEAKS = tuple(float(np.abs(QUINTIC.deriv(k)(GRID)).max()) for k in (1, 2, 3))


@given(st.floats(-50.0, 50.0), st.floats(0.01, 2.0), st.floats(0.05, 3.0), st.floats(0.05, 12.0))
def test_duration_keeps_all_three_limits_and_is_the_shortest(
    distance: float, speed: float, acceleration: float, jerk: float
) -> None:
    time = plan.duration(distance, speed, acceleration, jerk)
    if abs(distance) < 1e-12:
        assert time < 0.01
        return
    peaks = [abs(distance) * peak / time ** (k + 1) for k, peak in enumerate(PEAKS)]
    used = [peak / limit for peak, limit in zip(peaks, (speed, acceleration, jerk), strict=True)]
    assert max(used) == pytest.approx(1.0, rel=1e-4)


eights = st.tuples(
    *[st.floats(-5.0, 5.0)] * 3, st.floats(-pi, pi), *[st.floats(-0.3, 0.3)] * 2, st.floats(-2.0, 1.0), st.floats(0, 9)
)


@given(eights, st.tuples(*[st.floats(-5.0, 5.0)] * 3), st.floats(-10.0, 10.0), eights, st.booleans())
def test_a_leg_keeps_every_limit(start: plan.Eight, base: Vec3, yaw: float, arm: plan.Eight, slow: bool) -> None:
    path = Path(start, P).to(base=base, yaw=yaw, arm=arm[4:7], slow=slow)
    (leg,) = path.legs
    assert path.at == leg.target
    assert leg.target[7] == start[7]
    assert leg.target[:3] == base
    turn = leg.target[3] - start[3]
    assert abs(turn) <= pi + 1e-9  # the short way round
    assert sin(leg.target[3]) == pytest.approx(sin(yaw), abs=1e-9)
    assert cos(leg.target[3]) == pytest.approx(cos(yaw), abs=1e-9)
    way = dist(base, start[:3])
    reach = dist(leg.target[4:6], start[4:6])
    peak = PEAKS[0] / leg.duration * (1.0 - 1e-9)
    assert way * peak <= (P.near_speed if slow else P.speed)
    assert abs(turn) * peak <= P.yaw_rate
    assert reach * peak <= P.arm_speed
    assert abs(leg.target[6] - start[6]) * peak <= P.arm_turn
    assert way * PEAKS[1] / leg.duration**2 <= P.acceleration * (1.0 + 1e-4)
    assert way * PEAKS[2] / leg.duration**3 <= P.jerk * (1.0 + 1e-4)


# --- what cannot be done ----------------------------------------------------------------------------------------------


SHORT_ARM = replace(VEHICLE, arm=replace(VEHICLE.arm, link_2=0.10))


@pytest.mark.parametrize(
    ("pipe", "vehicle", "params", "says"),
    [
        (Pipe(position=(2.0, 0.0, 0.5)), VEHICLE, P, r"pipe\.position z = 0\.5 m: no room .* at least 0\.62 m"),
        (Pipe(position=(0.3, 0.0, 1.5)), VEHICLE, P, r"pipe\.position \(0\.3, 0\.0, 1\.5\): the way from take-off"),
        (Pipe(), VEHICLE, replace(P, needle_reach=0.15), r"plan\.needle_reach / plan\.press_reach: the propellers"),
        (Pipe(), SHORT_ARM, P, r"plan\.press_reach = 0\.3 m: the arm cannot hold the wrist there"),
        (Pipe(), VEHICLE, replace(P, arc_max=0.1), r"pipe\.radius = 0\.08 m: the needle reaches no useful arc"),
    ],
)
def test_what_cannot_be_done_is_told_with_its_reason(pipe: Pipe, vehicle: Vehicle, params: Params, says: str) -> None:
    with pytest.raises(InfeasibleError, match=says):
        survey(pipe, vehicle, params)


@pytest.mark.parametrize(("low_x", "high_x", "inside"), [(-1.0, 3.0, True), (-1.0, 1.2, False), (0.1, 3.0, False)])
def test_a_way_out_of_the_fence_is_refused(low_x: float, high_x: float, inside: bool) -> None:
    pipe = Pipe(position=(2.0, 0.0, 1.5))
    site = survey(pipe, VEHICLE, P)
    low, high = (low_x, -1.0, -1.0), (high_x, 1.0, 4.0)
    if inside:
        plan.check_fence(site, pipe, P, low, high)
    else:
        with pytest.raises(InfeasibleError, match=r"pipe\.position .* outside of the fence from safety\.fence_low"):
            plan.check_fence(site, pipe, P, low, high)


def test_the_least_height_that_is_told_is_enough() -> None:
    with pytest.raises(InfeasibleError) as error:
        survey(Pipe(position=(2.0, 0.0, 0.4)), VEHICLE, P)
    least = float(str(error.value).split("at least ")[1].split(" m")[0])
    survey(Pipe(position=(2.0, 0.0, least)), VEHICLE, P)


@pytest.mark.parametrize("heading", [0.0, 90.0, 180.0])
def test_a_pipe_above_the_start_is_refused(heading: float) -> None:
    """The vehicle would have to climb through it."""
    with pytest.raises(InfeasibleError, match="take-off"):
        survey(Pipe(position=(0.0, 0.0, 2.8), heading_deg=heading), VEHICLE, P)
