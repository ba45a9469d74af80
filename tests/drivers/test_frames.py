"""Hand-worked cases of the frame conversions, and that each undoes itself."""

from __future__ import annotations

from math import cos, pi, radians, sin, sqrt

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import frames
from drivers.samples import Quat, Vec3

HALF = sqrt(0.5)
number = st.floats(-100.0, 100.0)
vector = st.tuples(number, number, number)


def rotate(q: Quat, v: Vec3) -> Vec3:
    """Turn v by q: the sandwich product written out."""
    w, x, y, z = q
    a, b, c = v
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx)


def about(axis: Vec3, angle: float) -> Quat:
    s = sin(0.5 * angle)
    return (cos(0.5 * angle), s * axis[0], s * axis[1], s * axis[2])


def test_world_axes() -> None:
    assert frames.world_from_px4((1.0, 0.0, 0.0)) == (0.0, 1.0, -0.0)  # north is +y of W
    assert frames.world_from_px4((0.0, 1.0, 0.0)) == (1.0, 0.0, -0.0)  # east is +x of W
    assert frames.world_from_px4((0.0, 0.0, 1.0)) == (0.0, 0.0, -1.0)  # down is -z of W
    assert frames.px4_from_world((3.0, 4.0, 5.0)) == (4.0, 3.0, -5.0)


def test_body_axes() -> None:
    assert frames.body_from_px4((1.0, 2.0, 3.0)) == (1.0, -2.0, -3.0)
    # The accelerometer of a vehicle at rest and level reads -9.81 along its down axis.
    assert frames.body_from_px4((0.0, 0.0, -9.81))[2] == 9.81
    assert frames.px4_from_body((0.1, 0.2, 0.3)) == (0.1, -0.2, -0.3)


def test_level_facing_north() -> None:
    """PX4's identity faces north, which is +y: a quarter turn to the left in W."""
    q = frames.attitude_from_px4((1.0, 0.0, 0.0, 0.0))
    assert q == pytest.approx((HALF, 0.0, 0.0, HALF))
    assert rotate(q, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))
    assert rotate(q, (0.0, 0.0, 1.0)) == pytest.approx((0.0, 0.0, 1.0))


def test_level_facing_east() -> None:
    """PX4's yaw of +90 degrees (clockwise from north) faces east, which is W's own x: the identity."""
    q = frames.attitude_from_px4(about((0.0, 0.0, 1.0), 0.5 * pi))
    assert q == pytest.approx((1.0, 0.0, 0.0, 0.0))


def test_yaw_is_counted_the_other_way() -> None:
    """PX4's yaw of 100 degrees is -10 degrees in W."""
    q = frames.attitude_from_px4(about((0.0, 0.0, 1.0), radians(100.0)))
    assert q == pytest.approx(about((0.0, 0.0, 1.0), radians(-10.0)))


def test_nose_down_leans_the_thrust_forward() -> None:
    """Facing east and 20 degrees nose down: negative pitch in PX4, positive here; thrust gains +x in W."""
    east, down_20 = about((0.0, 0.0, 1.0), 0.5 * pi), about((0.0, 1.0, 0.0), radians(-20.0))
    w1, x1, y1, z1 = east
    w2, x2, y2, z2 = down_20
    product = (
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
    )
    q = frames.attitude_from_px4(product)
    assert q == pytest.approx(about((0.0, 1.0, 0.0), radians(20.0)))
    assert rotate(q, (0.0, 0.0, 1.0)) == pytest.approx((sin(radians(20.0)), 0.0, cos(radians(20.0))))


def test_roll_right_keeps_its_sign() -> None:
    """Facing east, 15 degrees right side down: positive roll in both; thrust gains -y (south)."""
    q = frames.attitude_from_px4(
        (HALF * cos(radians(7.5)), HALF * sin(radians(7.5)), HALF * sin(radians(7.5)), HALF * cos(radians(7.5)))
    )
    assert q == pytest.approx(about((1.0, 0.0, 0.0), radians(15.0)))
    assert rotate(q, (0.0, 0.0, 1.0))[1] == pytest.approx(-sin(radians(15.0)))


def test_tracker_axes() -> None:
    """The T265 has x right, y up, z backwards."""
    assert frames.from_tracker((1.0, 0.0, 0.0)) == (0.0, -1.0, 0.0)  # right is -y
    assert frames.from_tracker((0.0, 1.0, 0.0)) == (0.0, 0.0, 1.0)  # up is +z
    assert frames.from_tracker((0.0, 0.0, -1.0)) == (1.0, 0.0, 0.0)  # forward is +x
    assert frames.tracker_from((1.0, 2.0, 3.0)) == (-2.0, 3.0, -1.0)


def test_tracker_level() -> None:
    assert frames.attitude_from_tracker((1.0, 0.0, 0.0, 0.0)) == (1.0, 0.0, 0.0, 0.0)


def test_tracker_turned_left() -> None:
    """A turn to the left is one about up: the T265's y, our z."""
    q = frames.attitude_from_tracker(about((0.0, 1.0, 0.0), 0.5 * pi))
    assert q == pytest.approx(about((0.0, 0.0, 1.0), 0.5 * pi))
    assert rotate(q, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))


def test_tracker_nose_down() -> None:
    """Looking down is a turn about the T265's right by -30 degrees, and +30 degrees of pitch: thrust gains +x."""
    q = frames.attitude_from_tracker(about((1.0, 0.0, 0.0), radians(-30.0)))
    assert q == pytest.approx(about((0.0, 1.0, 0.0), radians(30.0)))
    assert rotate(q, (0.0, 0.0, 1.0))[0] == pytest.approx(0.5)


def test_tracker_right_side_down() -> None:
    """Right side down is a turn about forward, the T265's -z: positive roll here."""
    q = frames.attitude_from_tracker(about((0.0, 0.0, -1.0), radians(15.0)))
    assert q == pytest.approx(about((1.0, 0.0, 0.0), radians(15.0)))


@settings(deadline=None, max_examples=50, derandomize=True)
@given(v=vector)
def test_vectors_round_trip(v: Vec3) -> None:
    assert frames.px4_from_world(frames.world_from_px4(v)) == v
    assert frames.px4_from_body(frames.body_from_px4(v)) == v
    assert frames.tracker_from(frames.from_tracker(v)) == v


@settings(deadline=None, max_examples=100, derandomize=True)
@given(q=st.tuples(number, number, number, number).filter(lambda q: sum(c * c for c in q) > 1e-3), v=vector)
def test_attitude_round_trips_and_agrees_with_the_vectors(q: Quat, v: Vec3) -> None:
    """Turning a body vector in PX4's frames and converting it equals converting first and turning in ours."""
    n = sqrt(sum(c * c for c in q))
    q = (q[0] / n, q[1] / n, q[2] / n, q[3] / n)
    q_WB = frames.attitude_from_px4(q)
    assert frames.px4_from_attitude(q_WB) == pytest.approx(q, abs=1e-12)
    assert rotate(q_WB, frames.body_from_px4(v)) == pytest.approx(frames.world_from_px4(rotate(q, v)), abs=1e-9)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(q=st.tuples(number, number, number, number).filter(lambda q: sum(c * c for c in q) > 1e-3), v=vector)
def test_the_trackers_attitude_round_trips_and_agrees_with_its_vectors(q: Quat, v: Vec3) -> None:
    n = sqrt(sum(c * c for c in q))
    q = (q[0] / n, q[1] / n, q[2] / n, q[3] / n)
    q_VC = frames.attitude_from_tracker(q)
    assert frames.tracker_from_attitude(q_VC) == q
    assert rotate(q_VC, frames.from_tracker(v)) == pytest.approx(frames.from_tracker(rotate(q, v)), abs=1e-9)
