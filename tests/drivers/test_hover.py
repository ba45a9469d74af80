"""The thrust map from hover: found where it shows, kept where it does not."""

from __future__ import annotations

from random import Random

import pytest

from drivers.hover import HoverPoint, identify
from drivers.thrust import ThrustMap

BEFORE = ThrustMap(
    hover_force=24.0, hover_thrust=0.46, hover_voltage=15.0, curve=0.3, px4_curve=0.5, voltage_exponent=2.0
)
TRUE = ThrustMap(
    hover_force=25.0, hover_thrust=0.55, hover_voltage=15.6, curve=0.3, px4_curve=0.5, voltage_exponent=1.4
)


def hover(volts: list[float], noise: float = 0.0, force: float = 25.3) -> list[HoverPoint]:
    random = Random(5)
    return [HoverPoint(force, TRUE.set_point(force * (1.0 + random.gauss(0.0, noise)), v), v) for v in volts]


def falling(count: int, high: float = 16.6, low: float = 15.0) -> list[float]:
    return [high - (high - low) * i / (count - 1) for i in range(count)]


def test_the_map_that_flew_is_found() -> None:
    fit = identify(hover(falling(40)), BEFORE)
    assert fit.slope_taken
    assert fit.thrust.voltage_exponent == pytest.approx(1.4)
    assert fit.spread < 1e-9
    for volts in (14.0, 15.6, 16.8):
        for force in (5.0, 25.0, 40.0):
            assert fit.thrust.set_point(force, volts) == pytest.approx(TRUE.set_point(force, volts))


def test_noise_is_averaged_and_told() -> None:
    fit = identify(hover(falling(200), noise=0.01), BEFORE)
    assert fit.spread == pytest.approx(0.01, rel=0.2)
    assert fit.slope_taken
    assert abs(fit.thrust.voltage_exponent - 1.4) < 3.0 * fit.slope_error
    assert fit.thrust.full_force(15.6) == pytest.approx(TRUE.full_force(15.6), rel=0.003)


@pytest.mark.parametrize("volts", [[15.6] * 40, falling(40, 15.65, 15.55)])
def test_an_exponent_that_does_not_show_is_kept(volts: list[float]) -> None:
    fit = identify(hover(volts, noise=0.01), BEFORE)
    assert not fit.slope_taken
    assert fit.thrust.voltage_exponent == 2.0
    assert fit.thrust.full_force(15.6) == pytest.approx(TRUE.full_force(15.6), rel=0.005)


def test_a_thrust_that_rises_as_the_battery_empties_is_not_believed() -> None:
    points = [HoverPoint(25.0, 0.5 + 0.02 * (v - 15.0), v) for v in falling(40)]
    assert not identify(points, BEFORE).slope_taken


def test_what_was_carried_for_a_moment_is_left_out() -> None:
    leaning = [HoverPoint(18.0, TRUE.set_point(25.3, v), v) for v in falling(6)]
    fit = identify([*hover(falling(60), noise=0.005), *leaning], BEFORE)
    assert fit.left_out == 6
    assert fit.thrust.full_force(15.6) == pytest.approx(TRUE.full_force(15.6), rel=0.005)
    assert fit.spread < 0.01


def test_the_curves_are_kept() -> None:
    found = identify(hover(falling(40)), BEFORE).thrust
    assert (found.curve, found.px4_curve) == (BEFORE.curve, BEFORE.px4_curve)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (hover(falling(2)), "at least 3"),
        ([*hover(falling(5)), HoverPoint(25.0, 0.0, 15.0)], "is no hover"),
        ([*hover(falling(5)), HoverPoint(25.0, 1.0, 15.0)], "is no hover"),
        ([*hover(falling(5)), HoverPoint(float("nan"), 0.5, 15.0)], "is no hover"),
        ([*hover(falling(5)), HoverPoint(25.0, 0.5, 0.0)], "is no hover"),
    ],
)
def test_what_is_no_hover_is_refused(points: list[HoverPoint], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        identify(points, BEFORE)
