"""Exact and noisy measurements: size of the errors, delay, grain, and determinism."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from drivers.vehicle import Vehicle
from sim_backend.array_plant import PlantParams
from sim_backend.sensors import (
    AutopilotSensorParams,
    OdometryParams,
    SensorParams,
    ServoSensorParams,
)
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import PIPE
from tests.sim_backend.noisy import NOISY

TICK = 0.004


def world_with(vehicle: Vehicle, sensors: SensorParams, seed: int = 1) -> World:
    return World(vehicle, WorldParams(sensors=sensors, plant=PlantParams(step=2e-4)), PIPE, seed=seed)


def test_ideal_measurements_are_the_truth_of_now(vehicle: Vehicle) -> None:
    world = world_with(vehicle, SensorParams())
    world.advance(TICK)
    truth, now = world.truth(), world.snapshot
    odometry, autopilot, servos = world.sensors.odometry(now), world.sensors.autopilot(now), world.sensors.servos(now)
    assert odometry is not None
    assert autopilot is not None
    assert servos is not None
    assert odometry.t_ns == autopilot.t_ns == autopilot.t_imu_ns == servos.t_ns == 4_000_000
    assert (odometry.p_WB, odometry.v_WB, odometry.q_WB) == (truth.p_WB, truth.v_WB, truth.q_WB)
    assert (autopilot.q_WB, autopilot.w_WB_B) == (truth.q_WB, truth.w_WB_B)
    assert autopilot.f_B == pytest.approx(truth.f_B, rel=1e-12)
    assert servos.position[:3] == truth.joints
    assert servos.velocity[:3] == truth.joint_rates
    assert servos.current[:3] == truth.servo_current
    assert servos.voltage == (5.0,) * 5
    assert servos.error == (0,) * 5


def test_noise_has_the_size_that_is_asked_for(vehicle: Vehicle) -> None:
    params = SensorParams(
        odometry=OdometryParams(period=TICK, delay=0.0, position_noise=0.002, position_drift=0.0, velocity_noise=0.03),
        autopilot=AutopilotSensorParams(
            period=TICK, delay=0.0, gyro_noise=0.02, gyro_bias=0.0, accelerometer_noise=0.1, accelerometer_bias=0.0,
            attitude_noise=0.004, attitude_drift=0.0,
        ),
        servos=ServoSensorParams(period=TICK, delay=0.0, velocity_noise=0.2, current_noise=0.05),
    )  # fmt: skip
    world = world_with(vehicle, params)
    truth = world.truth()
    rows = []
    for _ in range(4000):
        world.advance(TICK)
        now = world.snapshot
        odometry, autopilot, servos = (
            world.sensors.odometry(now),
            world.sensors.autopilot(now),
            world.sensors.servos(now),
        )
        assert odometry is not None
        assert autopilot is not None
        assert servos is not None
        rows.append(
            (
                *odometry.p_WB,
                *odometry.v_WB,
                *autopilot.w_WB_B,
                *autopilot.f_B,
                *autopilot.q_WB[1:],
                *servos.velocity[:3],
                *servos.current[:3],
            )
        )
    errors = np.array(rows)
    deviations = np.repeat([0.002, 0.03, 0.02, 0.1, 0.002, 0.2, 0.05], 3)
    exact = (
        *truth.p_WB, *truth.v_WB, *truth.w_WB_B, *truth.f_B, *truth.q_WB[1:], *truth.joint_rates, *truth.servo_current,
    )  # fmt: skip
    assert errors.std(axis=0) == pytest.approx(deviations, rel=0.06)
    assert np.abs(errors.mean(axis=0) - exact).max() < 0.1 * 0.2
    assert np.abs((errors.mean(axis=0) - exact) / deviations).max() < 0.08


def test_biases_are_constant_and_drift_is_slow(vehicle: Vehicle) -> None:
    quiet = AutopilotSensorParams(
        period=TICK, delay=0.0, gyro_noise=0.0, gyro_bias=0.1, accelerometer_noise=0.0, accelerometer_bias=1.0,
        attitude_noise=0.0, attitude_drift=0.05, drift_time=1.0,
    )  # fmt: skip
    world = world_with(vehicle, SensorParams(autopilot=quiet))
    truth = world.truth()
    tilts = []
    first = world.sensors.autopilot(world.snapshot)
    assert first is not None
    for _ in range(10_000):
        world.advance(TICK)
        state = world.sensors.autopilot(world.snapshot)
        assert state is not None
        tilts.append(2.0 * (state.q_WB[1] - truth.q_WB[1]))
    assert state is not None
    assert state.w_WB_B == pytest.approx(first.w_WB_B, abs=1e-6)
    assert state.f_B == pytest.approx(first.f_B, abs=1e-4)
    assert np.abs(np.array(first.f_B) - truth.f_B).max() > 0.1
    drift = np.array(tilts)
    assert drift.std() == pytest.approx(0.05, rel=0.4)
    lag = round(1.0 / TICK)
    assert np.corrcoef(drift[:-lag], drift[lag:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.25)


def test_samples_come_at_their_rate_and_after_their_delay(vehicle: Vehicle) -> None:
    world = world_with(vehicle, NOISY)
    assert world.sensors.odometry(world.snapshot) is None
    times = []
    for _ in range(500):
        world.advance(0.001)
        sample = world.sensors.odometry(world.snapshot)
        if sample is not None:
            assert world.snapshot.t_ns - sample.t_ns >= 20_000_000
            assert world.snapshot.t_ns - sample.t_ns < 25_000_000
            times.append(sample.t_ns)
    assert np.diff(sorted(set(times))).tolist() == [5_000_000] * (len(set(times)) - 1)


def test_the_mean_rate_holds_where_the_ticks_do_not_fit(vehicle: Vehicle) -> None:
    world = world_with(vehicle, NOISY)
    seen = set()
    for _ in range(500):
        world.advance(TICK)
        sample = world.sensors.odometry(world.snapshot)
        if sample is not None:
            seen.add(sample.t_ns)
    assert len(seen) == pytest.approx(2.0 / 0.005, abs=6)


def test_encoders_have_their_grain(vehicle: Vehicle) -> None:
    world = world_with(vehicle, SensorParams(servos=ServoSensorParams(grain=True)))
    world.advance(TICK)
    servos = world.sensors.servos(world.snapshot)
    assert servos is not None
    grain = 2.0 * pi / 4096
    for k in range(3):
        assert servos.position[k] / grain == pytest.approx(round(servos.position[k] / grain), abs=1e-9)
        assert abs(servos.position[k] - world.truth().joints[k]) <= 0.5 * grain + 1e-12
        assert servos.current[k] * 1e3 == pytest.approx(round(servos.current[k] * 1e3), abs=1e-9)


def test_same_seed_same_samples_however_often_asked(vehicle: Vehicle) -> None:
    def record(seed: int, asks: int) -> list[object]:
        world = world_with(vehicle, NOISY, seed)
        told: list[object] = []
        for _ in range(100):
            world.advance(TICK)
            for _ in range(asks):
                now = world.snapshot
                last = (world.sensors.odometry(now), world.sensors.autopilot(now), world.sensors.servos(now))
            told.append(last)
        return told

    assert record(3, 1) == record(3, 4)
    assert record(3, 1) != record(4, 1)
