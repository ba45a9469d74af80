from __future__ import annotations

from math import cos, isclose, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.samples import Quat, Vec3
from onboard.core import math3

angles = st.floats(-pi, pi)
pitches = st.floats(-1.5, 1.5)
numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers)
eulers = st.tuples(angles, pitches, angles)
steady = settings(max_examples=200)


def close(a: tuple[float, ...], b: tuple[float, ...], tolerance: float = 1e-9) -> bool:
    return all(isclose(x, y, rel_tol=tolerance, abs_tol=tolerance) for x, y in zip(a, b, strict=True))


def test_positive_pitch_leans_the_thrust_forward() -> None:
    R = math3.matrix_from_euler((0.0, 0.2, 0.0))
    assert close(math3.rotate(R, (0.0, 0.0, 1.0)), (sin(0.2), 0.0, cos(0.2)))


def test_positive_roll_leans_the_thrust_right_and_positive_yaw_turns_left() -> None:
    assert math3.rotate(math3.matrix_from_euler((0.2, 0.0, 0.0)), (0.0, 0.0, 1.0))[1] < 0.0
    assert close(math3.rotate(math3.matrix_from_euler((0.0, 0.0, pi / 2)), (1.0, 0.0, 0.0)), (0.0, 1.0, 0.0))


@steady
@given(eulers, vectors)
def test_matrix_and_quaternion_agree_and_come_back(rpy: Vec3, v: Vec3) -> None:
    R, q = math3.matrix_from_euler(rpy), math3.quat_from_euler(rpy)
    assert close(R, math3.matrix_from_quat(q))
    back = math3.euler_from_quat(q)
    assert all(abs(math3.wrap_angle(a - b)) < 1e-7 for a, b in zip(back, rpy, strict=True))
    assert close(math3.euler_from_quat((-q[0], -q[1], -q[2], -q[3])), back)
    assert close(math3.rotate_transposed(R, math3.rotate(R, v)), v)


@steady
@given(st.sampled_from([-1.0, 1.0]), angles, angles)
def test_at_the_vertical_the_attitude_is_kept_with_no_roll(sign: float, roll: float, yaw: float) -> None:
    q = math3.quat_from_euler((roll, sign * pi / 2, yaw))
    phi, theta, psi = math3.euler_from_quat(q)
    assert phi == 0.0
    assert theta == sign * pi / 2
    assert close(math3.matrix_from_euler((phi, theta, psi)), math3.matrix_from_quat(q), 1e-6)


@steady
@given(eulers, eulers, vectors)
def test_product_of_quaternions_is_the_product_of_rotations(a: Vec3, b: Vec3, v: Vec3) -> None:
    p, q = math3.quat_from_euler(a), math3.quat_from_euler(b)
    both = math3.rotate(math3.matrix_from_quat(math3.quat_multiply(p, q)), v)
    one_by_one = math3.rotate(math3.matrix_from_quat(p), math3.rotate(math3.matrix_from_quat(q), v))
    assert close(both, one_by_one, 1e-8)
    assert close(math3.quat_multiply(p, math3.quat_conjugate(p)), (1.0, 0.0, 0.0, 0.0))


@steady
@given(eulers, vectors)
def test_body_rates_are_the_derivative_of_the_attitude(rpy: Vec3, rates: Vec3) -> None:
    step = 1e-6
    ahead, behind = (
        np.array(math3.matrix_from_euler((rpy[0] + h * rates[0], rpy[1] + h * rates[1], rpy[2] + h * rates[2])))
        for h in (step, -step)
    )
    R = np.array(math3.matrix_from_euler(rpy)).reshape(3, 3)
    skew = R.T @ ((ahead - behind) / (2.0 * step)).reshape(3, 3)
    assert np.allclose(math3.body_from_euler_rates(rpy, rates), (skew[2, 1], skew[0, 2], skew[1, 0]), atol=1e-3)


@steady
@given(eulers, vectors, vectors)
def test_euler_rates_and_torques_are_dual(rpy: Vec3, rates: Vec3, torque_B: Vec3) -> None:
    w = math3.body_from_euler_rates(rpy, rates)
    assert close(math3.euler_rates_from_body(rpy, w), rates, 1e-8)
    torque = math3.euler_torque_from_body(rpy, torque_B)
    assert close(math3.body_torque_from_euler(rpy, torque), torque_B, 1e-8)
    # The same power, in either coordinates.
    assert math3.dot(torque, rates) == pytest.approx(math3.dot(torque_B, w), abs=1e-7)


@steady
@given(st.floats(-pi, pi), st.floats(-10.0, 10.0), vectors)
def test_gimbal_lock_is_bounded(roll: float, pitch: float, w: Vec3) -> None:
    bound = 2.0 * (math3.norm(w) + 1e-9) / math3.GIMBAL_COSINE
    assert math3.norm(math3.euler_rates_from_body((roll, pitch, 0.0), w)) <= bound
    assert math3.norm(math3.body_torque_from_euler((roll, pitch, 0.0), w)) <= 2.0 * bound


@steady
@given(vectors, vectors)
def test_vectors_as_numpy(a: Vec3, b: Vec3) -> None:
    assert close(math3.cross(a, b), tuple(np.cross(a, b).tolist()))
    assert math3.dot(a, b) == pytest.approx(float(np.dot(a, b)), abs=1e-9)
    assert math3.norm(a) == pytest.approx(float(np.linalg.norm(a)), rel=1e-12)
    assert close(math3.subtract(math3.add(a, b), b), a)
    assert math3.scale(2.0, a) == math3.add(a, a)


@steady
@given(st.floats(-1e6, 1e6))
def test_wrapped_angle_is_the_same_direction(angle: float) -> None:
    wrapped = math3.wrap_angle(angle)
    assert -pi <= wrapped < pi or wrapped == pytest.approx(pi)
    assert cos(wrapped) == pytest.approx(cos(angle), abs=1e-8)
    assert sin(wrapped) == pytest.approx(sin(angle), abs=1e-8)


@steady
@given(vectors, st.floats(0.1, 10.0))
def test_quaternion_is_normalised(v: Vec3, w: float) -> None:
    q = math3.quat_normalize((w, *v))
    assert sum(x * x for x in q) == pytest.approx(1.0)
    assert close(tuple(x * w / q[0] for x in q), (w, *v), 1e-6)


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0, 1.0), (float("inf"), 0.0, 0.0, 0.0)])
def test_quaternion_without_direction_is_refused(q: Quat) -> None:
    with pytest.raises(ValueError, match="no direction"):
        math3.quat_normalize(q)


def test_tilt_and_clamp() -> None:
    assert math3.tilt(math3.matrix_from_euler((0.0, 0.3, 1.0))) == pytest.approx(0.3)
    assert math3.tilt(math3.matrix_from_euler((pi, 0.0, 0.0))) == pytest.approx(pi)
    assert [math3.clamp(x, -1.0, 2.0) for x in (-3.0, 0.5, 7.0)] == [-1.0, 0.5, 2.0]
