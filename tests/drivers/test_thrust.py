"""The thrust map against cases worked by hand, and its inverse."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.thrust import ThrustMap, motor_signal, thrust_fraction
from drivers.vehicle import Vehicle

VEHICLE = msgspec.yaml.decode((Path(__file__).parents[2] / "configs" / "vehicle.yaml").read_bytes(), type=Vehicle)


def test_map_of_the_vehicle() -> None:
    """PX4 undoes the motors' curve, so at half battery (15 V) a set-point is the fraction of 4 x 13 N."""
    thrust = ThrustMap.of(VEHICLE)
    assert thrust.hover_force == pytest.approx(2.4 * 9.80665)
    assert thrust.full_force(15.0) == pytest.approx(52.0)
    assert thrust.set_point(26.0, 15.0) == pytest.approx(0.5)
    assert thrust.set_point(thrust.hover_force, 15.0) == pytest.approx(thrust.hover_thrust)
    assert thrust.full_force(16.5) == pytest.approx(52.0 * 1.21)


def test_curves_that_differ() -> None:
    """PX4 believes in linear motors (THR_MDL_FAC 0), but thrust goes with u squared: hovers at 0.5, full is 4 x."""
    thrust = ThrustMap(hover_force=10.0, hover_thrust=0.5, hover_voltage=16.0, curve=1.0, px4_curve=0.0)
    assert thrust.full_force(16.0) == pytest.approx(40.0)
    assert thrust.set_point(10.0, 16.0) == pytest.approx(0.5)
    assert thrust.set_point(22.5, 16.0) == pytest.approx(0.75)


def test_battery() -> None:
    """At 90 % of the voltage 81 % of the thrust is left, so the same force asks for more."""
    thrust = ThrustMap(10.0, 0.25, 16.0, curve=0.0, px4_curve=0.0, voltage_exponent=2.0)
    assert thrust.full_force(14.4) == pytest.approx(0.81 * 40.0)
    assert thrust.set_point(10.0, 14.4) == pytest.approx(0.25 / 0.81)
    assert thrust.set_point(10.0, float("nan")) == pytest.approx(0.25)
    assert thrust.set_point(10.0, 0.0) == pytest.approx(0.25)


def test_saturates() -> None:
    thrust = ThrustMap.of(VEHICLE)
    assert thrust.set_point(-3.0, 16.0) == 0.0
    assert thrust.set_point(60.0, 16.0) == 1.0


def test_bounds_are_told() -> None:
    with pytest.raises(msgspec.ValidationError, match=r"<= 0.95.*hover_thrust"):
        msgspec.convert(
            {"hover_force": 20.0, "hover_thrust": 3.0, "hover_voltage": 16.0, "curve": 0.3, "px4_curve": 0.3}, ThrustMap
        )


curve = st.floats(0.0, 1.0)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(
    hover=st.floats(0.1, 0.9),
    curve=curve,
    px4_curve=curve,
    set_point=st.floats(0.01, 0.99),
    voltage=st.floats(13.0, 17.0),
)
def test_round_trip(hover: float, curve: float, px4_curve: float, set_point: float, voltage: float) -> None:
    thrust = ThrustMap(20.0, hover, 16.0, curve, px4_curve, 2.0)
    assert thrust.set_point(thrust.force(set_point, voltage), voltage) == pytest.approx(set_point, abs=1e-6)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(curve=curve, signal=st.floats(0.0, 1.0))
def test_curve_inverse(curve: float, signal: float) -> None:
    assert motor_signal(thrust_fraction(signal, curve), curve) == pytest.approx(signal, abs=1e-6)
