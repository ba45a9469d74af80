"""The statistics of each realistic condition of sensors and links: what is declared is what comes."""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.samples import AutopilotState, FlightMode, Interface, Landed, Odometry
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams, constants
from sim_backend.autopilot import Autopilot, AutopilotParams, SetPoint
from sim_backend.motors import rotors
from sim_backend.sensors import (
    REALISTIC,
    AutopilotSensorParams,
    OdometryParams,
    SensorParams,
    Sensors,
    Snapshot,
    hover_thrust,
)
from tests.sim_backend.flying import PIPE

Array = NDArray[np.float64]
TICK = 0.004


def still(t: float = 0.0, thrust: float = 0.0, angles: tuple[float, ...] = (0.0,) * 4) -> Snapshot:
    """A vehicle that stands in the air at the origin, its rotors at this thrust (N, each) and angle."""
    x = [0.0] * at.STATE_SIZE
    x[at.ATTITUDE] = 1.0
    x[at.ROTOR : at.ROTOR + 4] = (thrust,) * 4
    x[at.ROTOR_ANGLE : at.ROTOR_ANGLE + 4] = angles
    return Snapshot(round(t * 1e9), x, 1, True, FlightMode.OFFBOARD, Landed.IN_AIR, True)


def messages(vehicle: Vehicle, seconds: float, seed: int = 1, **errors: Any) -> list[AutopilotState]:
    """What the autopilot tells of that vehicle, every tick."""
    sensors = Sensors(SensorParams(autopilot=AutopilotSensorParams(**errors)), vehicle, seed)
    told = []
    for k in range(round(seconds / TICK)):
        now = still(k * TICK)
        sensors.observe(now)
        state = sensors.autopilot(now)
        assert state is not None
        told.append(state)
    return told


def poses(vehicle: Vehicle, seconds: float, tick: float, seed: int = 1, **errors: Any) -> list[Odometry]:
    sensors = Sensors(SensorParams(odometry=OdometryParams(**errors)), vehicle, seed)
    told = []
    for k in range(round(seconds / tick)):
        now = still(k * tick)
        sensors.observe(now)
        pose = sensors.odometry(now)
        assert pose is not None
        told.append(pose)
    return told


def test_nothing_is_off_by_default() -> None:
    params = SensorParams()
    assert params.odometry.exact
    assert params.autopilot.exact
    assert params.servos.exact
    assert not any(device.exact for device in (REALISTIC.odometry, REALISTIC.autopilot, REALISTIC.servos))


def test_one_error_alone_spoils_nothing_else(vehicle: Vehicle) -> None:
    states = messages(vehicle, 0.4, accelerometer_noise=0.04)
    assert {state.q_WB for state in states} == {(1.0, 0.0, 0.0, 0.0)}
    assert {state.w_WB_B for state in states} == {(0.0, 0.0, 0.0)}
    assert len({state.f_B for state in states}) == 100
    assert [state.t_ns for state in states] == [round(k * TICK * 1e9) for k in range(100)]


def test_what_one_device_shows_does_not_depend_on_how_another_errs(vehicle: Vehicle) -> None:
    alone = SensorParams(autopilot=REALISTIC.autopilot)
    told = []
    for params in (alone, REALISTIC):
        sensors = Sensors(params, vehicle, 5)
        for k in range(200):
            sensors.observe(still(k * TICK))
        told.append(sensors.autopilot(still(0.8)))
    assert told[0] == told[1] is not None


def test_accelerometer_noise_is_white(vehicle: Vehicle) -> None:
    f = np.array([state.f_B for state in messages(vehicle, 40.0, accelerometer_noise=0.04)])
    assert f.std(axis=0) == pytest.approx([0.04] * 3, rel=0.03)
    assert np.abs(f.mean(axis=0)).max() < 4.0 * 0.04 / sqrt(len(f))
    power = np.abs(np.fft.rfft(f[:, 0])) ** 2
    low, high = power[1:2000].mean(), power[-2000:].mean()
    assert low / high == pytest.approx(1.0, abs=0.12)


def test_gyro_noise_is_white(vehicle: Vehicle) -> None:
    w = np.array([state.w_WB_B for state in messages(vehicle, 40.0, gyro_noise=0.005)])
    assert w.std(axis=0) == pytest.approx([0.005] * 3, rel=0.03)
    assert abs(np.corrcoef(w[1:, 0], w[:-1, 0])[0, 1]) < 0.04


def test_accelerometer_bias_is_drawn_once_a_seed(vehicle: Vehicle) -> None:
    biases = []
    for seed in range(300):
        first, _, last = messages(vehicle, 3 * TICK, seed, accelerometer_bias=0.05)
        assert first.f_B == last.f_B
        biases.append(first.f_B)
    assert np.std(biases) == pytest.approx(0.05, rel=0.08)
    assert abs(np.mean(biases)) < 0.006


def test_the_bias_drifts_slowly(vehicle: Vehicle) -> None:
    """Standard deviation over many seeds at once, and the correlation time within long runs."""
    drift = np.array(
        [s.f_B[0] for s in messages(vehicle, 400.0, accelerometer_drift=0.02, accelerometer_drift_time=2.0)]
    )
    lag = round(2.0 / TICK)
    assert drift.std() == pytest.approx(0.02, rel=0.2)
    assert np.corrcoef(drift[:-lag], drift[lag:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.12)
    assert np.abs(np.diff(drift)).max() < 6.0 * 0.02 * sqrt(2.0 * TICK / 2.0)
    start = [messages(vehicle, TICK, seed, accelerometer_drift=0.02)[0].f_B for seed in range(200)]
    assert np.std(start) == pytest.approx(0.02, rel=0.1)


def spun(vehicle: Vehicle, thrusts: tuple[float, ...], count: int) -> list[Snapshot]:
    """A vehicle whose rotors turn in the world's own kernel, looked at every tick."""
    p = constants(vehicle, PlantParams(), PIPE)
    x, u = np.zeros(at.STATE_SIZE), np.zeros(at.DRIVE_SIZE)
    x[at.ATTITUDE] = 1.0
    x[at.ROTOR_LIMIT] = 13.0
    u[at.U_ROTOR : at.U_ROTOR + 4] = thrusts
    seen = []
    for k in range(count):
        for _ in range(round(TICK / p[at.STEP])):
            rotors(x, p, u)
        seen.append(still()._replace(t_ns=round((k + 1) * TICK * 1e9), x=x.tolist()))
    return seen


def lines(values: Array) -> set[int]:
    """Frequencies of the strong lines in a series of one second or more, Hz."""
    power = np.abs(np.fft.rfft(values * np.hanning(len(values)))) ** 2
    frequencies = np.fft.rfftfreq(len(values), TICK)
    return {round(f) for f in frequencies[power > 0.05 * power.max()]}


def test_each_rotor_shakes_at_its_own_speed_aliased_as_sampled(vehicle: Vehicle) -> None:
    thrusts = (4.0, 5.9, 8.0, 10.0)
    params = SensorParams(autopilot=AutopilotSensorParams(vibration=0.3))
    sensors = Sensors(params, vehicle, 0)
    shaken = []
    for now in spun(vehicle, thrusts, 1000):
        sensors.observe(now)
        state = sensors.autopilot(now)
        assert state is not None
        shaken.append(state.f_B)
    f = np.array(shaken)
    speeds = [sqrt(thrust / 1.37e-5) / (2.0 * pi) for thrust in thrusts]
    assert speeds[1] == pytest.approx(104.4, abs=0.1)

    def alias(frequency: float) -> int:
        return round(abs(frequency - 250.0 * round(frequency / 250.0)))

    for found, wanted in (
        (lines(f[:, 0]), {alias(speed) for speed in speeds}),
        (lines(f[:, 1]), {alias(speed) for speed in speeds}),
        (lines(f[:, 2]), {alias(2.0 * speed) for speed in speeds}),
    ):
        assert all(min(abs(one - other) for other in wanted) <= 1 for one in found)
        assert all(min(abs(one - other) for other in found) <= 1 for one in wanted)


def test_in_hover_the_vibration_has_its_amplitude(vehicle: Vehicle) -> None:
    hover = hover_thrust(vehicle)
    sensors = Sensors(SensorParams(autopilot=AutopilotSensorParams(vibration=0.3)), vehicle, 0)
    random = np.random.default_rng(2)
    shaken = []
    for k in range(5000):
        now = still(k * TICK, hover, tuple(random.uniform(0.0, 2.0 * pi, 4)))
        sensors.observe(now)
        state = sensors.autopilot(now)
        assert state is not None
        shaken.append(state.f_B)
    assert np.std(shaken, axis=0) == pytest.approx([0.3 / sqrt(2.0)] * 3, rel=0.04)
    resting = still(21.0)
    sensors.observe(resting)
    assert sensors.autopilot(resting) == msgspec.structs.replace(
        sensors.autopilot(resting) or pytest.fail("no state"), f_B=(0.0, 0.0, 0.0)
    )


def test_messages_are_late_by_delay_and_jitter_in_order_and_some_never_come(vehicle: Vehicle) -> None:
    """At a wide period nothing waits for what went before, so that the jitter is seen as it is drawn."""
    params = AutopilotSensorParams(period=0.05, delay=0.020, jitter=0.002, loss=0.1)
    sensors = Sensors(SensorParams(autopilot=params), vehicle, 3)
    arrived: dict[int, int] = {}
    for taken in range(0, round(100e9), 50_000_000):
        sensors.observe(still()._replace(t_ns=taken))
        for t_ns in range(taken + 19_000_000, taken + 49_000_000, 50_000):
            state = sensors.autopilot(still()._replace(t_ns=t_ns))
            if state is not None and state.t_ns not in arrived:
                arrived[state.t_ns] = t_ns
                break
    late = np.array([came - taken for taken, came in arrived.items()]) * 1e-9
    assert list(arrived) == sorted(arrived)
    assert late.min() >= 0.020
    assert late.mean() == pytest.approx(0.022, abs=2e-4)
    assert late.std() == pytest.approx(0.002, rel=0.12)
    assert len(arrived) / 2000 == pytest.approx(0.9, abs=0.02)


def test_set_points_are_late_by_delay_and_jitter_and_some_never_come() -> None:
    autopilot = Autopilot(AutopilotParams(command_delay=0.012, command_jitter=0.002, command_loss=0.05), 4)
    u = np.zeros(at.DRIVE_SIZE)
    due = []
    for k in range(20_000):
        t = k * 0.05
        autopilot.offer(t, SetPoint(Interface.ATTITUDE, float(k)))
        if autopilot.next_change() < t + 0.05:
            due.append(autopilot.next_change() - t)
            autopilot.update(autopilot.next_change(), still().x, u)
    late = np.array(due)
    assert late.min() >= 0.012
    assert late.mean() == pytest.approx(0.014, abs=1e-4)
    assert late.std() == pytest.approx(0.002, rel=0.05)
    assert len(late) / 20_000 == pytest.approx(0.95, abs=0.006)


def test_set_points_keep_their_order() -> None:
    autopilot = Autopilot(AutopilotParams(command_jitter=0.02), 4)
    autopilot.arm()
    autopilot.offer(-1.0, SetPoint(Interface.ATTITUDE, 1.0))
    u, told = np.zeros(at.DRIVE_SIZE), []
    for k in range(3000):
        t = k * TICK
        autopilot.offer(t, SetPoint(Interface.ATTITUDE, float(k)))
        autopilot.switch(FlightMode.OFFBOARD, t)
        autopilot.update(t, still().x, u)
        told.append(u[at.U_THRUST])
    assert told[2000:] == sorted(told[2000:])
    assert len(set(told[2000:])) > 100


def test_vision_has_its_noise_drift_and_delay(vehicle: Vehicle) -> None:
    seen = poses(vehicle, 400.0, 0.02, position_drift=0.005, drift_time=2.0)
    slow = np.array([pose.p_WB for pose in seen])
    assert slow.std(axis=0) == pytest.approx([0.005] * 3, rel=0.25)
    assert np.corrcoef(slow[:-100, 0], slow[100:, 0])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.12)
    noisy = poses(vehicle, 40.0, 0.02, position_noise=0.0005, velocity_noise=0.01, attitude_noise=0.0009)
    assert np.std([pose.p_WB for pose in noisy], axis=0) == pytest.approx([0.0005] * 3, rel=0.07)
    assert np.std([pose.v_WB for pose in noisy], axis=0) == pytest.approx([0.01] * 3, rel=0.07)
    assert np.std([pose.q_WB[1:] for pose in noisy], axis=0) == pytest.approx([0.00045] * 3, rel=0.07)
    sensors = Sensors(SensorParams(odometry=OdometryParams(period=0.005, delay=0.030)), vehicle, 0)
    for k in range(100):
        sensors.observe(still(k * 0.005))
    late = sensors.odometry(still(0.495))
    assert late is not None
    assert late.t_ns == 465_000_000


def test_vision_jumps_at_its_rate_by_its_length_and_stays(vehicle: Vehicle) -> None:
    seen = np.array([pose.p_WB for pose in poses(vehicle, 2000.0, 0.02, jump_rate=0.1, jump=0.02)])
    moves = np.linalg.norm(np.diff(seen, axis=0), axis=1)
    jumps = moves[moves > 0.0]
    assert len(jumps) == pytest.approx(200, abs=45)
    assert np.sort(jumps)[: len(jumps) - 3] == pytest.approx(0.02, abs=1e-9)
    assert np.abs(np.diff(seen, axis=0)[moves > 0.0].mean(axis=0)).max() < 0.004


def test_vision_doubts_at_its_rate_for_its_time_and_then_is_noisier(vehicle: Vehicle) -> None:
    seen = poses(
        vehicle,
        4000.0,
        0.02,
        position_noise=0.001,
        doubt_rate=0.05,
        doubt_time=0.3,
        doubt_confidence=1,
        doubt_noise=3.0,
    )
    confidence = np.array([pose.confidence for pose in seen])
    error = np.array([pose.p_WB for pose in seen])
    assert set(confidence.tolist()) == {1, 3}
    assert (confidence == 1).mean() == pytest.approx(0.05 * 0.3, rel=0.25)
    begun = np.flatnonzero((confidence[1:] == 1) & (confidence[:-1] == 3))
    assert len(begun) == pytest.approx(200, abs=45)
    assert error[confidence == 3].std() == pytest.approx(0.001, rel=0.02)
    assert error[confidence == 1].std() == pytest.approx(0.003, rel=0.06)


def test_thrust_follows_with_the_lag_that_is_set(vehicle: Vehicle) -> None:
    p = constants(vehicle, PlantParams(motor_lag=0.040), PIPE)
    x, u = np.zeros(at.STATE_SIZE), np.zeros(at.DRIVE_SIZE)
    x[at.ROTOR_LIMIT], u[at.U_ROTOR : at.U_ROTOR + 4] = 13.0, 5.0
    for _ in range(round(0.040 / p[at.STEP])):
        rotors(x, p, u)
    assert x[at.ROTOR] == pytest.approx(5.0 * (1.0 - np.exp(-1.0)), rel=1e-9)


@pytest.mark.parametrize(("sag", "share"), [(0.0, 1.0), (1.0, 0.81), (0.25, 1.0 - 0.25 * 0.19)])
def test_thrust_falls_with_the_voltage_by_the_share_that_no_map_makes_up_for(
    vehicle: Vehicle, sag: float, share: float
) -> None:
    p = constants(vehicle, PlantParams(battery_sag=sag), PIPE)
    x, u = np.zeros(at.STATE_SIZE), np.zeros(at.DRIVE_SIZE)
    x[at.ROTOR_LIMIT], u[at.U_ROTOR : at.U_ROTOR + 4] = 13.0, 5.0
    cell = vehicle.battery
    x[at.VOLTAGE] = 0.9 * (cell.full_voltage - cell.resistance * cell.hover_current)
    assert rotors(x, p, u)[0] == pytest.approx(20.0 * share, rel=1e-9)


def test_the_shake_of_one_rotor_goes_round_in_its_plane(vehicle: Vehicle) -> None:
    """Half of the amplitude is one rotor's; opposite senses go round opposite ways."""
    sensors = Sensors(SensorParams(autopilot=AutopilotSensorParams(vibration=1.0)), vehicle, 0)
    hover = hover_thrust(vehicle)
    for k, angle in enumerate(np.linspace(0.0, 6.0, 7).tolist()):
        for rotor, sense in ((0, 1.0), (2, -1.0)):
            now = still(k * 0.1 + rotor * 0.01, 0.0, (angle,) * 4)
            now.x[at.ROTOR + rotor] = hover
            sensors.observe(now)
            state = sensors.autopilot(now)
            assert state is not None
            assert state.f_B == pytest.approx((0.5 * cos(angle), 0.5 * sense * sin(angle), 0.5 * sin(2.0 * angle)))
