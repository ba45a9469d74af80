"""The map from force to attitude (eq. 4): signs, agreement of both forms, guards, and the reference filter."""

from __future__ import annotations

from math import cos, isfinite, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.samples import Vec3
from onboard.core import math3, tilt
from onboard.core.tilt import Params, State
from tests.core.strategies import number, vector

PRINTED, EXACT = Params(exact=False), Params(exact=True)


def test_signs_against_the_rotation_matrix() -> None:
    """Pushing ahead pitches nose down (positive), pushing right rolls right (positive): the thrust leans there."""
    for yaw in (0.0, 0.7, -2.5):
        ahead = (cos(yaw), sin(yaw), 20.0)
        right = (sin(yaw), -cos(yaw), 20.0)
        roll, pitch, _ = tilt.attitude_and_thrust(ahead, yaw, EXACT)
        assert roll == pytest.approx(0.0, abs=1e-12)
        assert pitch > 0.0
        roll, pitch, _ = tilt.attitude_and_thrust(right, yaw, EXACT)
        assert pitch == pytest.approx(0.0, abs=1e-12)
        assert roll > 0.0


@given(number(4.0), number(4.0), st.floats(10.0, 40.0), number(3.1))
def test_exact_form_yields_the_force(fx: float, fy: float, fz: float, yaw: float) -> None:
    roll, pitch, thrust = tilt.attitude_and_thrust((fx, fy, fz), yaw, Params(exact=True, tilt_max=0.8))
    R = math3.matrix_from_euler((roll, pitch, yaw))
    assert (thrust * R[2], thrust * R[5], thrust * R[8]) == pytest.approx((fx, fy, fz), abs=1e-9)


@given(number(0.5), number(0.5), number(3.1))
def test_printed_form_is_the_small_angle_limit(fx: float, fy: float, yaw: float) -> None:
    force = (fx, fy, 24.0)
    printed, exact = tilt.attitude_and_thrust(force, yaw, PRINTED), tilt.attitude_and_thrust(force, yaw, EXACT)
    assert printed[0] == pytest.approx((fx * sin(yaw) - fy * cos(yaw)) / 24.0)
    assert printed[1] == pytest.approx((fx * cos(yaw) + fy * sin(yaw)) / 24.0)
    assert printed == pytest.approx(exact, abs=0.02)


@given(number(0.4), number(0.4), number(3.1), number(3.1))
def test_a_lean_told_at_another_heading_is_the_same_lean(roll: float, pitch: float, yaw: float, turn: float) -> None:
    here = math3.matrix_from_euler((roll, pitch, yaw + turn))
    there = math3.matrix_from_euler((*tilt.turned(roll, pitch, turn), yaw))
    assert (there[2], there[5], there[8]) == pytest.approx((here[2], here[5], here[8]), abs=1e-12)


@given(vector(1e6), number(10.0), st.booleans())
def test_guarded_and_limited(force: Vec3, yaw: float, exact: bool) -> None:
    p = Params(exact=exact)
    roll, pitch, thrust = tilt.attitude_and_thrust(force, yaw, p)
    assert abs(roll) <= p.tilt_max
    assert abs(pitch) <= p.tilt_max
    assert isfinite(thrust)
    assert thrust >= p.thrust_min


def test_filter_settles_without_overshoot_beyond_its_damping_and_starts_without_a_jump() -> None:
    state = State()
    peak, first = 0.0, 1.0
    for _ in range(500):
        state, _, acceleration = tilt.step(state, 0.0, 0.1, EXACT, 0.004)
        first = min(first, state.pitch)
        peak = max(peak, state.pitch)
    assert first < 0.001
    assert state.pitch == pytest.approx(0.1, abs=1e-6)
    assert abs(acceleration) < 1e-3
    assert peak < 0.1003


def test_filter_rates_are_the_derivative_of_its_angles() -> None:
    state, previous = State(), State()
    for k in range(250):
        previous, (state, _, _) = state, tilt.step(state, 0.05 * sin(0.02 * k), 0.1, EXACT, 0.004)
        assert (state.pitch - previous.pitch) / 0.004 == pytest.approx(
            0.5 * (state.pitch_rate + previous.pitch_rate), abs=1e-9
        )
