"""A mount that is found is the one with which the motion was seen, or nothing is said of it."""

from __future__ import annotations

from math import degrees

import numpy as np
import pytest

from drivers.mounting import MotionError, Recorded, angle_between, identify
from drivers.samples import AutopilotState, Odometry
from drivers.tracking import Mount
from tests.drivers.moving import GRAVITY, Noise, about_yaw, in_hands, moved, slowly

TRUE = Mount((0.11, -0.02, 0.05), (2.0, 20.0, -5.0))
BEFORE = Mount((0.10, 0.0, 0.03), (0.0, 15.0, 0.0))
DOWN = Mount((0.05, 0.0, -0.06), (0.0, 90.0, 0.0))


def recorded(told: tuple[list[Odometry], list[AutopilotState]]) -> Recorded:
    poses, states = told
    return Recorded(
        t=np.array([pose.t_ns for pose in poses]) * 1e-9,
        q_WB=np.array([pose.q_WB for pose in poses]),
        v_WB=np.array([pose.v_WB for pose in poses]),
        piece=np.array([pose.reset_counter for pose in poses]),
        t_attitude=np.array([state.t_ns for state in states]) * 1e-9,
        attitude=np.array([state.q_WB for state in states]),
        rate_B=np.array([state.w_WB_B for state in states]),
        t_imu=np.array([state.t_imu_ns for state in states]) * 1e-9,
        f_B=np.array([state.f_B for state in states]),
    )


@pytest.mark.parametrize("true", [TRUE, DOWN, Mount()])
def test_a_clean_motion_tells_the_mount(true: Mount) -> None:
    fit = identify(recorded(moved(in_hands, true, BEFORE, 12.0)), BEFORE, GRAVITY)
    assert degrees(angle_between(fit.mount, true)) < 0.05
    assert fit.offset_taken
    assert fit.mount.offset == pytest.approx(true.offset, abs=0.001)
    assert fit.lag == pytest.approx(0.0, abs=2e-4)


def test_noise_bias_and_late_poses() -> None:
    fit = identify(recorded(moved(in_hands, TRUE, BEFORE, 30.0, lag=0.009, noise=Noise())), BEFORE, GRAVITY)
    assert degrees(angle_between(fit.mount, TRUE)) < 0.3
    assert fit.mount.offset == pytest.approx(TRUE.offset, abs=0.008)
    assert fit.lag == pytest.approx(0.009, abs=1.5e-3)
    assert 0.0 < degrees(fit.rotation_error) < 0.3
    assert 0.0 < fit.offset_error < 0.008
    assert degrees(fit.rotation_residual) < 1.0


def test_what_is_said_to_be_known_is_known() -> None:
    """The true mount lies within three of the standard errors that are told."""
    fit = identify(recorded(moved(in_hands, TRUE, BEFORE, 12.0, noise=Noise())), BEFORE, GRAVITY)
    assert angle_between(fit.mount, TRUE) < 3.0 * np.sqrt(3.0) * fit.rotation_error
    away = np.linalg.norm(np.subtract(fit.mount.offset, TRUE.offset))
    assert away < 3.0 * np.sqrt(3.0) * fit.offset_error


def test_turns_about_one_axis_do_not_tell_it() -> None:
    for noise in (Noise(), Noise(0.0, 0.0, 0.0, 0.0)):
        with pytest.raises(MotionError, match=r"about z \(yaw\) of the vehicle cannot be seen.*other two axes"):
            identify(recorded(moved(about_yaw, TRUE, BEFORE, 15.0, noise=noise)), BEFORE, GRAVITY)


def test_a_vehicle_that_stands_still_tells_nothing() -> None:
    def still(t: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        return (0.0, 0.0, 0.3), (0.0, 0.0, 0.24)

    with pytest.raises(MotionError, match="cannot be seen"):
        identify(recorded(moved(still, TRUE, BEFORE, 15.0, noise=Noise())), BEFORE, GRAVITY)


def test_slow_turns_leave_the_offset_as_it_was() -> None:
    fit = identify(recorded(moved(slowly, TRUE, BEFORE, 40.0, noise=Noise())), BEFORE, GRAVITY)
    assert degrees(angle_between(fit.mount, TRUE)) < 0.5
    assert not fit.offset_taken
    assert fit.mount.offset == BEFORE.offset
    assert fit.offset_error > 0.01


def test_jumps_of_the_tracker_do_no_harm() -> None:
    """Its frame turns and moves in the middle: no window reaches across."""
    first, second = (moved(in_hands, TRUE, BEFORE, 10.0) for _ in range(2))
    poses = first[0] + [
        Odometry(p.t_ns + 10_000_000_000, p.p_WB, p.q_WB, p.v_WB, 3, p.reset_counter + 1) for p in second[0]
    ]
    shifted = [
        AutopilotState(
            s.t_ns + 10_000_000_000, s.q_WB, s.w_WB_B, s.t_imu_ns + 10_000_000_000, s.f_B, s.armed, s.mode, s.landed,
            s.battery_voltage, s.battery_remaining,
        )
        for s in second[1]
    ]  # fmt: skip
    fit = identify(recorded((poses, first[1] + shifted)), BEFORE, GRAVITY)
    assert degrees(angle_between(fit.mount, TRUE)) < 0.05
    assert fit.mount.offset == pytest.approx(TRUE.offset, abs=0.002)


def test_wild_poses_are_left_out() -> None:
    poses, states = moved(in_hands, TRUE, BEFORE, 15.0)
    for k in range(500, 2500, 400):
        poses[k] = Odometry(poses[k].t_ns, (9.0, 9.0, 9.0), (1.0, 0.0, 0.0, 0.0), (5.0, 5.0, 5.0), 3)
    fit = identify(recorded((poses, states)), BEFORE, GRAVITY)
    assert degrees(angle_between(fit.mount, TRUE)) < 0.1
    assert fit.mount.offset == pytest.approx(TRUE.offset, abs=0.003)


def test_too_little_was_seen_by_both() -> None:
    poses, states = moved(in_hands, TRUE, BEFORE, 8.0)
    with pytest.raises(MotionError, match=r"s in which both camera and autopilot told.*at least 5 s"):
        identify(recorded((poses, states[:900])), BEFORE, GRAVITY)
    with pytest.raises(MotionError, match="0 s in which"):
        identify(recorded((poses[::20], states)), BEFORE, GRAVITY)
