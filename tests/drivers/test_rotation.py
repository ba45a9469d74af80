"""The few operations on quaternions: hand-worked cases and group properties."""

from __future__ import annotations

from math import pi, sqrt

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.rotation import about_z, from_euler, heading, inverse, multiply, rotate
from drivers.samples import Quat, Vec3

angle = st.floats(-3.1, 3.1)
unit = st.builds(from_euler, angle, angle, angle)
vector = st.tuples(*[st.floats(-10.0, 10.0)] * 3)


def test_quarter_turns() -> None:
    """Yaw takes x to y, pitch takes x down and z forward, roll takes y up."""
    assert rotate(from_euler(0.0, 0.0, 0.5 * pi), (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))
    assert rotate(from_euler(0.0, 0.5 * pi, 0.0), (1.0, 0.0, 0.0)) == pytest.approx((0.0, 0.0, -1.0))
    assert rotate(from_euler(0.0, 0.5 * pi, 0.0), (0.0, 0.0, 1.0)) == pytest.approx((1.0, 0.0, 0.0))
    assert rotate(from_euler(0.5 * pi, 0.0, 0.0), (0.0, 1.0, 0.0)) == pytest.approx((0.0, 0.0, 1.0))


def test_yaw_is_applied_last() -> None:
    """Pitched a quarter down and then turned a quarter left, z points where y was."""
    assert rotate(from_euler(0.0, 0.5 * pi, 0.5 * pi), (0.0, 0.0, 1.0)) == pytest.approx((0.0, 1.0, 0.0))


def test_heading() -> None:
    assert heading(about_z(2.0)) == pytest.approx(2.0)
    assert heading(from_euler(0.3, -0.4, -1.2)) == pytest.approx(-1.2)


@settings(max_examples=100)
@given(a=unit, b=unit, v=vector)
def test_products_turn_one_after_the_other_and_inverses_back(a: Quat, b: Quat, v: Vec3) -> None:
    assert rotate(multiply(a, b), v) == pytest.approx(rotate(a, rotate(b, v)), abs=1e-9)
    assert rotate(inverse(a), rotate(a, v)) == pytest.approx(v, abs=1e-9)
    assert sqrt(sum(c * c for c in rotate(a, v))) == pytest.approx(sqrt(sum(c * c for c in v)), abs=1e-9)
