"""Camera poses become poses of the body in W: hand-worked mountings, jumps, nonsense, and a new start."""

from __future__ import annotations

from math import cos, inf, nan, pi, radians, sin

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from msgspec.structs import replace

from drivers.rotation import about_z, from_euler, heading, multiply, rotate
from drivers.samples import Odometry, Quat, Vec3
from drivers.tracking import CameraPose, JumpLimits, Mount, Tracking, UnusableError

LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
ZERO: Vec3 = (0.0, 0.0, 0.0)
START: Vec3 = (0.0, 0.0, 0.24)
MS = 1_000_000
REST = CameraPose(0, ZERO, LEVEL, ZERO, ZERO, 3)


def tracking(mount: Mount | None = None, start: Vec3 = START, start_heading: float = 0.0) -> Tracking:
    return Tracking(mount or Mount(), JumpLimits(), start, start_heading)


def take(t: Tracking, pose: CameraPose) -> Odometry:
    return t.take(pose)[0]


def test_it_begins_where_it_is_told() -> None:
    first = take(tracking(), replace(REST, t_ns=7, p_VC=(5.0, 6.0, 7.0), confidence=2))
    assert first.p_WB == pytest.approx(START)
    assert (first.t_ns, first.q_WB, first.confidence, first.reset_counter) == (7, LEVEL, 2, 0)


def test_it_goes_on_from_there() -> None:
    """Begun facing +y: what is forward and left for the camera is +y and -x."""
    t = tracking(start_heading=0.5 * pi)
    take(t, REST)
    moved = take(t, replace(REST, t_ns=MS, p_VC=(0.01, 0.02, 0.03), v_VC=(1.0, 2.0, 3.0)))
    assert moved.p_WB == pytest.approx((-0.02, 0.01, 0.27))
    assert moved.v_WB == pytest.approx((-2.0, 1.0, 3.0))
    assert heading(moved.q_WB) == pytest.approx(0.5 * pi)


def test_a_tilt_at_the_start_stays() -> None:
    """Only heading and place are chosen; the vertical is the camera's."""
    tilt = from_euler(0.1, -0.2, 0.0)
    assert take(tracking(), replace(REST, q_VC=tilt)).q_WB == pytest.approx(tilt)


def test_a_camera_that_looks_down() -> None:
    """V of such a camera may have any heading. The body is level, and what goes along V goes along W."""
    mount = Mount(rotation_deg=(0.0, 90.0, 0.0))
    t = tracking(mount)
    q_VC = multiply(about_z(1.0), from_euler(0.0, 0.5 * pi, 0.0))
    first = take(t, replace(REST, q_VC=q_VC))
    assert first.q_WB == pytest.approx(LEVEL)
    moved = take(t, replace(REST, t_ns=MS, q_VC=q_VC, v_VC=(cos(1.0), sin(1.0), 0.0)))
    assert moved.v_WB == pytest.approx((1.0, 0.0, 0.0))


def test_a_camera_in_front_tells_a_body_that_turns_on_the_spot() -> None:
    """0.1 m ahead of the origin, a quarter turn to the left at 2 rad/s: the camera goes round, the body does not."""
    t = tracking(Mount(offset=(0.1, 0.0, 0.0)))
    take(t, REST)
    angle = 0.5 * pi
    turned = take(
        t,
        CameraPose(
            t_ns=round(angle / 2.0 * 1e9),
            p_VC=(-0.1, 0.1, 0.0),
            q_VC=about_z(angle),
            v_VC=(-0.2, 0.0, 0.0),
            w_VC=(0.0, 0.0, 2.0),
            confidence=3,
        ),
    )
    assert turned.p_WB == pytest.approx(START, abs=1e-12)
    assert turned.v_WB == pytest.approx(ZERO, abs=1e-12)
    assert heading(turned.q_WB) == pytest.approx(angle)


def test_a_camera_above_tells_a_body_that_pitches() -> None:
    """0.1 m above the origin, nose down at 1 rad/s: the camera goes forward at 0.1 m/s, the body stands."""
    t = tracking(Mount(offset=(0.0, 0.0, 0.1)))
    moved = take(t, replace(REST, v_VC=(0.1, 0.0, 0.0), w_VC=(0.0, 1.0, 0.0)))
    assert moved.v_WB == pytest.approx(ZERO, abs=1e-12)


number = st.floats(-0.5, 0.5)
triple = st.tuples(number, number, number)
turn = st.tuples(*[st.floats(-80.0, 80.0)] * 3)


@hypothesis_settings(max_examples=100)
@given(offset=triple, rotation=turn, p=triple, v=triple, w=triple, rpy=triple, yaw=st.floats(-3.0, 3.0))
def test_what_the_mounting_does_is_undone(
    offset: Vec3, rotation: Vec3, p: Vec3, v: Vec3, w: Vec3, rpy: Vec3, yaw: float
) -> None:
    """A body's motion in W, told by a camera in any place and from any V, comes back."""
    mount = Mount(offset, rotation)
    q_BC = mount.q_BC()

    def camera(t_ns: int, p_WB: Vec3, q_WB: Quat, v_WB: Vec3, w_WB: Vec3) -> CameraPose:
        arm = rotate(q_WB, offset)
        p_WC = (p_WB[0] + arm[0], p_WB[1] + arm[1], p_WB[2] + arm[2])
        v_WC = (
            v_WB[0] + w_WB[1] * arm[2] - w_WB[2] * arm[1],
            v_WB[1] + w_WB[2] * arm[0] - w_WB[0] * arm[2],
            v_WB[2] + w_WB[0] * arm[1] - w_WB[1] * arm[0],
        )
        q_VW = about_z(yaw)
        return CameraPose(
            t_ns, rotate(q_VW, p_WC), multiply(q_VW, multiply(q_WB, q_BC)), rotate(q_VW, v_WC), rotate(q_VW, w_WB), 3
        )

    t = tracking(mount)
    take(t, camera(0, START, LEVEL, ZERO, ZERO))
    q_WB = from_euler(*rpy)
    there = take(t, camera(2_000_000_000, p, q_WB, v, w))
    assert there.p_WB == pytest.approx(p, abs=1e-9)
    assert there.v_WB == pytest.approx(v, abs=1e-9)
    assert abs(sum(a * b for a, b in zip(there.q_WB, q_WB, strict=True))) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "bad",
    [
        replace(REST, p_VC=(nan, 0.0, 0.0)),
        replace(REST, v_VC=(0.0, inf, 0.0)),
        replace(REST, w_VC=(0.0, 0.0, nan)),
        replace(REST, q_VC=(nan, 0.0, 0.0, 0.0)),
        replace(REST, p_VC=(inf, -inf, 0.0)),
    ],
)
def test_what_is_not_finite_is_not_used(bad: CameraPose) -> None:
    t = tracking()
    with pytest.raises(UnusableError, match="it is not finite"):
        t.take(bad)
    assert take(t, REST).p_WB == START


def test_what_is_no_rotation_is_not_used() -> None:
    with pytest.raises(UnusableError, match=r"its quaternion has length 0\.00"):
        tracking().take(replace(REST, q_VC=(0.0, 0.0, 0.0, 0.0)))


def test_a_rotation_that_is_almost_one_is_made_one() -> None:
    assert take(tracking(), replace(REST, q_VC=(1.001, 0.0, 0.0, 0.0))).q_WB == pytest.approx(LEVEL, abs=1e-12)


def test_motion_is_no_jump() -> None:
    """3 m/s with 20 m/s^2, turning at 3 rad/s, at 200 Hz and with every second pose missing for a while."""
    t = tracking()
    for k in range(200):
        if 50 < k < 100 and k % 2:
            continue
        s = 0.005 * k
        pose = CameraPose(
            round(s * 1e9), (3.0 * s - 10.0 * s * s, 0.0, 0.0), about_z(3.0 * s), (3.0 - 20.0 * s, 0.0, 0.0),
            (0.0, 0.0, 3.0), 3,
        )  # fmt: skip
        sample, jump = t.take(pose)
        assert jump is None
    assert sample.reset_counter == 0


def test_a_jump_is_measured_and_counted() -> None:
    t = tracking()
    take(t, REST)
    sample, jump = t.take(replace(REST, t_ns=5 * MS, p_VC=(0.0, 0.3, 0.0)))
    assert jump is not None
    assert jump.position == pytest.approx(0.3)
    assert jump.angle == pytest.approx(0.0, abs=1e-6)
    assert sample.p_WB == pytest.approx((0.0, 0.3, 0.24))
    assert sample.reset_counter == 1
    assert take(t, replace(REST, t_ns=10 * MS, p_VC=(0.0, 0.3, 0.0))).reset_counter == 1


def test_a_turn_of_the_frame_is_a_jump() -> None:
    t = tracking()
    take(t, REST)
    sample, jump = t.take(replace(REST, t_ns=5 * MS, q_VC=about_z(radians(10.0))))
    assert jump is not None
    assert jump.angle == pytest.approx(radians(10.0))
    assert sample.reset_counter == 1


def test_the_same_rotation_with_the_other_sign_is_no_jump() -> None:
    t = tracking()
    take(t, REST)
    assert t.take(replace(REST, t_ns=5 * MS, q_VC=(-1.0, 0.0, 0.0, 0.0)))[1] is None


def test_after_a_long_gap_a_small_way_is_no_jump() -> None:
    t = tracking()
    take(t, REST)
    assert t.take(replace(REST, t_ns=300 * MS, p_VC=(0.5, 0.0, 0.0)))[1] is None


def test_a_new_start_goes_on_where_the_last_pose_was() -> None:
    t = tracking()
    take(t, REST)
    last = take(t, replace(REST, t_ns=2 * 10**9, p_VC=(1.0, 2.0, 0.5), q_VC=about_z(0.7)))
    t.restart()
    again = take(t, replace(REST, t_ns=5 * 10**9))
    assert again.p_WB == pytest.approx(last.p_WB)
    assert heading(again.q_WB) == pytest.approx(0.7)
    assert again.reset_counter == 1
    t.restart()
    t.restart()
    assert take(t, replace(REST, t_ns=6 * 10**9)).reset_counter == 2


def test_a_new_start_before_the_first_pose_is_none() -> None:
    t = tracking()
    t.restart()
    assert take(t, REST).reset_counter == 0
