"""The hover calibration against maps that are known: wrong by some per cent, noisy, in motion, with outliers."""

from __future__ import annotations

from math import cos, nan, pi, sin
from pathlib import Path
from random import Random

import msgspec
import pytest
from msgspec.structs import replace

from drivers.hover_calibration import HoverSample, calibrate
from drivers.rotation import rotate
from drivers.samples import AutopilotCommand, Engage, Interface
from drivers.thrust import ThrustMap
from drivers.vehicle import Vehicle
from sim_backend.mock_devices import MockAutopilot
from sim_backend.sensors import SensorParams
from sim_backend.world import World, WorldParams

VEHICLE = msgspec.yaml.decode((Path(__file__).parents[2] / "configs" / "vehicle.yaml").read_bytes(), type=Vehicle)
GRAVITY = VEHICLE.gravity
FLOWN = ThrustMap.of(VEHICLE)
WEIGHT = FLOWN.hover_force
MASS = WEIGHT / GRAVITY


def hover(
    true: ThrustMap,
    *,
    seconds: float = 20.0,
    sag: float = 0.0,
    noise: float = 0.0,
    motion: float = 0.0,
    lag: float = 0.0,
    seed: int = 1,
) -> list[HoverSample]:
    """Samples at 250 Hz of a vehicle whose motors are ``true``, flown through FLOWN.

    ``noise`` (m/s^2) of the accelerometer, ``motion`` (m/s^2) up and down, whose commands come ``lag`` s before it.
    """
    random, samples = Random(seed), []
    for k in range(round(seconds * 250)):
        t = k / 250
        voltage = 15.6 - sag * t / seconds
        tilt = 0.05 * abs(sin(0.7 * t))
        asked = motion * sin(2.0 * pi * 0.8 * (t + lag))
        moved = motion * sin(2.0 * pi * 0.8 * t)
        # the force that, through the map that is flown, makes the true motors carry this
        needed = MASS * (GRAVITY + asked) / cos(tilt)
        force = FLOWN.force(true.set_point(needed, voltage), voltage)
        samples.append(HoverSample(force, voltage, tilt, moved + random.gauss(0.0, noise)))
    return samples


def off(share: float, exponent: float = 2.0) -> ThrustMap:
    """Motors that give so much of what FLOWN believes, at 15 V."""
    return replace(FLOWN, hover_thrust=FLOWN.hover_thrust / share, voltage_exponent=exponent)


@pytest.mark.parametrize("share", [0.90, 0.95, 1.0, 1.05, 1.10])
def test_a_map_that_is_off(share: float) -> None:
    fit = calibrate(FLOWN, hover(off(share), noise=0.3), WEIGHT, GRAVITY)
    assert fit.correction == pytest.approx(share, abs=0.003)
    for voltage in (15.2, 15.6):
        for force in (0.8 * WEIGHT, WEIGHT, 1.2 * WEIGHT):
            true = off(share).set_point(force, voltage)
            assert fit.thrust.set_point(force, voltage) == pytest.approx(true, rel=0.004)
    assert fit.exponent_identified is False
    assert fit.thrust.voltage_exponent == FLOWN.voltage_exponent
    assert fit.residual == pytest.approx(MASS * 0.3, rel=0.1)
    assert fit.rejected == 0
    assert f"{100 * (fit.correction - 1):+.1f} %" in fit.words()


def test_an_exact_map_is_left_as_it_is() -> None:
    fit = calibrate(FLOWN, hover(FLOWN), WEIGHT, GRAVITY)
    assert fit.correction == pytest.approx(1.0, abs=1e-9)
    assert fit.residual < 1e-9
    assert fit.thrust.set_point(WEIGHT, 15.0) == pytest.approx(FLOWN.set_point(WEIGHT, 15.0), rel=1e-9)


@pytest.mark.parametrize("exponent", [1.2, 1.6, 2.0])
def test_the_voltage_exponent_where_the_battery_sags(exponent: float) -> None:
    fit = calibrate(FLOWN, hover(off(0.93, exponent), seconds=60.0, sag=1.6, noise=0.2), WEIGHT, GRAVITY)
    assert fit.exponent_identified
    assert fit.thrust.voltage_exponent == pytest.approx(exponent, abs=0.05)
    assert fit.voltage_span == pytest.approx(1.6, abs=0.01)
    for voltage in (14.0, 14.8, 15.6):
        true = off(0.93, exponent).set_point(WEIGHT, voltage)
        assert fit.thrust.set_point(WEIGHT, voltage) == pytest.approx(true, rel=0.004)


def test_motion_and_lag_do_not_spoil_it() -> None:
    """Up and down by 1 m/s^2, the answer a tenth of a second late: half out of step with what was asked."""
    fit = calibrate(FLOWN, hover(off(0.93), motion=1.0, lag=0.1, noise=0.1), WEIGHT, GRAVITY)
    assert fit.correction == pytest.approx(0.93, abs=0.004)


def test_outliers_lose_weight() -> None:
    samples = hover(off(0.93), noise=0.1)
    random = Random(2)
    for k in range(0, len(samples), 10):
        samples[k] = replace(samples[k], acceleration=random.uniform(0.5, 1.9))
    fit = calibrate(FLOWN, samples, WEIGHT, GRAVITY)
    assert fit.correction == pytest.approx(0.93, abs=0.004)


def test_what_is_no_hover_is_left_out() -> None:
    samples = hover(off(0.93))
    spoilt = [
        *samples,
        replace(samples[0], tilt=0.5),
        replace(samples[0], acceleration=5.0),
        replace(samples[0], force=nan),
        replace(samples[0], voltage=0.0),
    ]
    fit = calibrate(FLOWN, spoilt, WEIGHT, GRAVITY)
    assert fit.correction == pytest.approx(0.93, abs=1e-6)
    assert (fit.samples, fit.rejected) == (len(samples), 4)


def test_too_little_to_go_by() -> None:
    with pytest.raises(ValueError, match=r"100 of 100 samples are a hover; want 200"):
        calibrate(FLOWN, hover(FLOWN)[:100], WEIGHT, GRAVITY)
    with pytest.raises(ValueError, match=r"full thrust comes out 2\.00 times that of the map flown; want a weight"):
        calibrate(FLOWN, hover(FLOWN), 2.0 * WEIGHT, GRAVITY)


def test_a_hover_of_the_simulated_vehicle() -> None:
    """Noisy IMU, lagging motors, sagging battery; the map that is flown believes in 8 % more than there is."""
    flown = replace(FLOWN, hover_thrust=FLOWN.hover_thrust * 0.92)
    world = World(VEHICLE, WorldParams(sensors=SensorParams(ideal=False)))
    device, samples = MockAutopilot(world), []
    wanted = 0.24
    for k in range(250 * 20):
        state, truth = device.latest(), world.truth()
        wanted = min(1.2, wanted + 0.002)
        climb = 2.0 * (wanted - truth.p_WB[2]) - truth.v_WB[2]
        force = MASS * (GRAVITY + 3.0 * climb) / 0.92 if k > 150 else 0.3 * WEIGHT
        # the world takes newtons: those that the flown map's set-point makes of its motors
        given = FLOWN.force(flown.set_point(force, truth.battery_voltage), truth.battery_voltage)
        device.command(
            AutopilotCommand(
                Engage.OFFBOARD, Interface.ATTITUDE, given, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            )
        )
        world.advance(0.004)
        if k > 2000 and state is not None:
            up = rotate(state.q_WB, (0.0, 0.0, 1.0))
            acceleration = rotate(state.q_WB, state.f_B)[2] - GRAVITY
            tilt = (up[0] ** 2 + up[1] ** 2) ** 0.5
            samples.append(HoverSample(force, state.battery_voltage, tilt, acceleration))
    fit = calibrate(flown, samples, WEIGHT, GRAVITY)
    # bias of the accelerometer is 0.05 m/s^2, half a per cent
    assert fit.correction == pytest.approx(0.92, abs=0.012)
