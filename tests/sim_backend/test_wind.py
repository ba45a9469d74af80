"""Wind: variance, correlation and spectrum of the gusts are those of MIL-F-8785C, and the seed repeats them."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams
from sim_backend.wind import PERIOD, Wind, WindParams, scales
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import REACH, plant_at

Array = NDArray[np.float64]

#: Carried past quickly, so that a short series holds many lengths of the turbulence.
QUICK = WindParams(gusts=5.0, carried=20.0)


def blown(params: WindParams, seconds: float, seed: int = 1) -> Array:
    wind = Wind(params, seed)
    return np.array([wind.until(round(k * PERIOD * 1e9)) for k in range(round(seconds / PERIOD))])


def test_scales_and_intensities_are_those_of_the_specification() -> None:
    """At 20 ft by hand: 0.177 + 0.000823 * 20 = 0.19346."""
    lengths, deviations = scales(WindParams(gusts=10.0, height=20 * 0.3048))
    assert lengths == pytest.approx((20 * 0.3048 / 0.19346**1.2, 20 * 0.3048 / 0.19346**1.2, 20 * 0.3048))
    assert deviations == pytest.approx((1.0 / 0.19346**0.4, 1.0 / 0.19346**0.4, 1.0))
    assert scales(WindParams(height=0.5)) == scales(WindParams(height=3.048))


def test_gusts_have_their_variance() -> None:
    _, deviations = scales(QUICK)
    series = np.concatenate([blown(QUICK, 200.0, seed) for seed in range(4)])
    assert series.std(axis=0) == pytest.approx(deviations, rel=0.1)
    assert np.abs(series.mean(axis=0) / deviations).max() < 0.25


def test_gusts_begin_as_they_go_on() -> None:
    """No seed begins in calm air: over many seeds the first value has the whole variance."""
    _, deviations = scales(QUICK)
    first = np.array([Wind(QUICK, seed).until(0) for seed in range(600)])
    assert first.std(axis=0) == pytest.approx(deviations, rel=0.09)


def test_gusts_have_their_spectrum() -> None:
    """Against the specification's one-sided densities, in bands from well below the corner to well above it."""
    series = np.stack([blown(QUICK, 160.0, seed) for seed in range(10, 16)])
    count = series.shape[1]
    power = (np.abs(np.fft.rfft(series * np.hanning(count)[:, None], axis=1)) ** 2).mean(axis=0)
    density = power * 2.0 * PERIOD / np.sum(np.hanning(count) ** 2)
    frequency = np.fft.rfftfreq(count, PERIOD)
    lengths, deviations = scales(QUICK)
    for axis, (length, sigma) in enumerate(zip(lengths, deviations, strict=True)):
        time = length / QUICK.carried
        w2 = (2.0 * pi * frequency * time) ** 2
        along = 4.0 * sigma**2 * time / (1.0 + w2)
        across = 2.0 * sigma**2 * time * (1.0 + 3.0 * w2) / (1.0 + w2) ** 2
        wanted = along if axis == 0 else across
        for low, high in ((0.05, 0.2), (0.2, 0.8), (0.8, 3.0), (3.0, 12.0)):
            band = (frequency > low) & (frequency <= high)
            assert density[band, axis].sum() == pytest.approx(wanted[band].sum(), rel=0.3), (axis, low)


def test_mean_wind_blows_where_it_is_told_to() -> None:
    wind = Wind(WindParams(mean=2.0, towards_deg=90.0), 0)
    assert wind.until(0) == pytest.approx((0.0, 2.0, 0.0))
    assert wind.until(10**9) == wind.until(0)


def test_the_seed_repeats_the_wind_and_times_in_between_do_not_matter() -> None:
    series = blown(QUICK, 2.0, 3)
    assert (series == blown(QUICK, 2.0, 3)).all()
    assert (series != blown(QUICK, 2.0, 4)).any()
    wind = Wind(QUICK, 3)
    fine = [wind.until(k * 1_000_000) for k in range(2000)]
    assert fine[1996] == tuple(series[499])


def specific_force(vehicle: Vehicle, params: PlantParams, velocity: Vec3, wind: Vec3) -> Array:
    """Of a vehicle that hovers in still air but for these velocities, along x and y, m/s^2."""
    plant = plant_at(vehicle, params, REACH, 1.0, velocity)
    plant.p[at.DRAG : at.DRAG + 3] = vehicle.base.drag
    plant.x[at.ROTOR : at.ROTOR + 4] = 5.9
    plant.u[at.U_ROTOR : at.U_ROTOR + 4] = 5.9
    plant.u[at.U_WIND : at.U_WIND + 3] = wind
    plant.begin()
    plant.move(1)
    return plant.x[at.SPECIFIC_FORCE_SUM : at.SPECIFIC_FORCE_SUM + 2].copy()


@pytest.mark.parametrize("rotor_drag", [0.0, 8.06e-5])
def test_air_that_moves_pulls_as_moving_through_air_does(vehicle: Vehicle, rotor_drag: float) -> None:
    """Drag sees the difference alone; that of the rotors grows with their speed."""
    params, still = PlantParams(rotor_drag=rotor_drag), (0.0, 0.0, 0.0)
    calm = specific_force(vehicle, params, still, still)
    flying = specific_force(vehicle, params, (1.0, 0.0, 0.0), still) - calm
    blown_at = specific_force(vehicle, params, still, (-1.0, 0.0, 0.0)) - calm
    assert flying == pytest.approx(blown_at, rel=1e-2, abs=1e-5)
    strength = 0.10 + 4.0 * rotor_drag * sqrt(5.9 / 1.37e-5)
    assert -flying[0] == pytest.approx(strength / 2.4, rel=0.25)
    carried = specific_force(vehicle, params, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)) - calm
    assert carried == pytest.approx(np.zeros(2), abs=1e-9)


def test_a_hovering_world_is_blown_away(vehicle: Vehicle) -> None:
    world = World(vehicle, WorldParams(wind=WindParams(mean=3.0, towards_deg=0.0)))
    world.plant.x[at.POSITION + 2] = 5.0
    world.advance(0.5)
    assert world.truth().v_WB[0] == pytest.approx(0.10 * 3.0 * 0.5 / 2.4, rel=0.2)
    assert world.plant.u[at.U_WIND] == 3.0
