"""Joint compensation: tool direction and wrist stay in the world at any pitch."""

from __future__ import annotations

from math import cos, pi, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from onboard.core import compensation, math3
from onboard.core.kinematics import tool_rotation
from onboard.core.types import Mat3
from tests.core.strategies import number

MOUNT = (0.06, -0.06)


@given(st.floats(-0.5, 0.5), st.floats(-1.5, 1.5))
def test_theta_3_keeps_the_tool_in_the_world(pitch: float, elevation: float) -> None:
    """Eq. 10 against eq. 17: with theta_3 = elevation + pitch, R_WB R_ee does not change with the pitch."""

    def turn(angle: float) -> Mat3:
        return math3.matrix_from_euler((0.0, angle, 0.0))

    tool = tool_rotation(elevation + pitch)
    z_E = math3.rotate(turn(pitch), (tool[2], tool[5], tool[8]))
    assert z_E == pytest.approx((-cos(elevation), 0.0, -sin(elevation)), abs=1e-12)


@given(st.floats(-0.5, 0.5), st.floats(0.0, 0.4), st.floats(-0.2, 0.2))
def test_the_wrist_stays_in_the_world(pitch: float, forward: float, up: float) -> None:
    x, z, _, _ = compensation.wrist_in_body((forward, up), (0.0, 0.0), MOUNT, pitch, 0.0)
    R = math3.matrix_from_euler((0.0, pitch, 0.0))
    world = math3.rotate(R, (x + MOUNT[0], 0.0, z + MOUNT[1]))
    assert world == pytest.approx((forward + MOUNT[0], 0.0, up + MOUNT[1]), abs=1e-12)


@given(number(0.4), number(1.0), st.floats(0.1, 0.38), number(0.1), number(0.2), number(0.2))
def test_rates_are_the_derivative(
    pitch: float, pitch_rate: float, forward: float, up: float, vx: float, vz: float
) -> None:
    h = 1e-6

    def at(t: float) -> tuple[float, float, float, float]:
        return compensation.wrist_in_body(
            (forward + vx * t, up + vz * t), (vx, vz), MOUNT, pitch + pitch_rate * t, pitch_rate
        )

    a, b, now = at(-h), at(h), at(0.0)
    assert now[2] == pytest.approx((b[0] - a[0]) / (2 * h), abs=1e-6)
    assert now[3] == pytest.approx((b[1] - a[1]) / (2 * h), abs=1e-6)


def test_the_filter_follows_a_moving_target_without_lag_and_starts_without_a_jump() -> None:
    p = compensation.Params()
    state = compensation.State((0.1, 0.2, 0.3))
    state, acceleration = compensation.step(state, (0.1, 0.2, 0.3), (0.0, 0.0, 0.0), p, 0.004)
    assert state.joints == (0.1, 0.2, 0.3)
    assert acceleration == (0.0, 0.0, 0.0)
    for k in range(500):
        angle = 0.2 * sin(0.5 * 2.0 * pi * k * 0.004)
        rate = 0.2 * pi * cos(0.5 * 2.0 * pi * k * 0.004)
        state, _ = compensation.step(state, (angle, -angle, 0.3), (rate, -rate, 0.0), p, 0.004)
    angle = 0.2 * sin(0.5 * 2.0 * pi * 500 * 0.004)
    assert state.joints[0] == pytest.approx(angle, abs=0.004)
