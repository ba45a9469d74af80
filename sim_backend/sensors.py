"""What the devices of a simulated world measure: exact, or with noise, bias, delay and the grain of the encoders."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import exp, pi, sin, sqrt
from typing import Annotated, Generic, NamedTuple, TypeVar

import numpy as np
from msgspec import Struct

from drivers.samples import AutopilotState, FlightMode, Landed, Odometry, Quat, ServoState, Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.knob import knob, switch

T = TypeVar("T")

#: Grain of the XC330's velocity (0.229 rev/min) and current (1 mA) readings (ROBOTIS e-manual).
VELOCITY_UNIT = 0.229 * 2.0 * pi / 60.0
CURRENT_UNIT = 1e-3


class OdometryParams(Struct, frozen=True, forbid_unknown_fields=True):
    """T265: 200 Hz; noise as seen on a hovering vehicle, drift below 1 % of a path of some metres (Intel data)."""

    period: Annotated[float, knob("s", "time between poses", 0.001, 0.1)] = 0.005
    delay: Annotated[float, knob("s", "exposure to arrival", 0.0, 0.2)] = 0.020
    position_noise: Annotated[float, knob("m", "white noise", 0.0, 0.1)] = 0.0005
    position_drift: Annotated[float, knob("m", "standard deviation of the slow error", 0.0, 0.5)] = 0.005
    drift_time: Annotated[float, knob("s", "correlation time of the slow error", 0.1, 1000.0)] = 30.0
    velocity_noise: Annotated[float, knob("m/s", "white noise", 0.0, 0.5)] = 0.01
    attitude_noise: Annotated[float, knob("rad", "white noise", 0.0, 0.1)] = 0.0009


class AutopilotSensorParams(Struct, frozen=True, forbid_unknown_fields=True):
    """IMU and attitude of a Pixhawk 6C after its filters; figures of flights with an airframe of this class."""

    period: Annotated[float, knob("s", "time between messages", 0.001, 0.1)] = 0.004
    delay: Annotated[float, knob("s", "measurement to arrival", 0.0, 0.2)] = 0.006
    attitude_noise: Annotated[float, knob("rad", "white noise", 0.0, 0.1)] = 0.0003
    attitude_drift: Annotated[float, knob("rad", "standard deviation of the estimator's slow error", 0.0, 0.1)] = 0.0017
    drift_time: Annotated[float, knob("s", "correlation time of the slow error", 0.1, 1000.0)] = 5.0
    gyro_noise: Annotated[float, knob("rad/s", "white noise", 0.0, 0.5)] = 0.005
    gyro_bias: Annotated[float, knob("rad/s", "standard deviation of the constant error", 0.0, 0.1)] = 0.001
    accelerometer_noise: Annotated[float, knob("m/s^2", "white noise", 0.0, 5.0)] = 0.04
    accelerometer_bias: Annotated[float, knob("m/s^2", "standard deviation of the constant error", 0.0, 1.0)] = 0.05
    vibration: Annotated[float, knob("m/s^2", "amplitude of the rotors' vibration, armed", 0.0, 10.0)] = 0.3
    vibration_frequency: Annotated[float, knob("Hz", "frequency of the rotors' vibration", 1.0, 500.0)] = 93.0


class ServoSensorParams(Struct, frozen=True, forbid_unknown_fields=True):
    """XC330 bus: one contiguous sync read a cycle; readings carry the grain of the control table's units."""

    period: Annotated[float, knob("s", "time between bus cycles", 0.001, 0.1)] = 0.004
    delay: Annotated[float, knob("s", "measurement to arrival", 0.0, 0.2)] = 0.002
    velocity_noise: Annotated[float, knob("rad/s", "white noise", 0.0, 1.0)] = 0.01
    current_noise: Annotated[float, knob("A", "white noise of the supply current", 0.0, 0.5)] = 0.005
    temperature: Annotated[float, knob("degC", "of all servos", -20.0, 80.0)] = 35.0


class SensorParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Whether measurements are exact, and what they are otherwise."""

    ideal: Annotated[bool, switch("exact measurements without delay, fresh at every advance")] = True
    odometry: OdometryParams = OdometryParams()
    autopilot: AutopilotSensorParams = AutopilotSensorParams()
    servos: ServoSensorParams = ServoSensorParams()


class Snapshot(NamedTuple):
    """What a world looks like between two advances."""

    t_ns: int
    x: list[float]
    """State, in the order of ``layout``."""
    steps: int
    """Physics steps of the advance that led here."""
    armed: bool
    mode: FlightMode
    landed: Landed
    torque_on: bool


class _Line(Generic[T]):
    """Samples on their way: taken every period, told after a delay."""

    def __init__(self, period: float, delay: float) -> None:
        self._period = round(period * 1e9)
        self._delay = round(delay * 1e9)
        self._due = 0
        self._under_way: deque[tuple[int, T]] = deque()
        self._newest: T | None = None

    def due(self, t_ns: int) -> bool:
        """It is time for the next sample."""
        if t_ns < self._due:
            return False
        self._due = max(self._due + self._period, t_ns - self._period)
        return True

    def put(self, t_ns: int, sample: T) -> None:
        self._under_way.append((t_ns + self._delay, sample))

    def newest(self, t_ns: int) -> T | None:
        """The last sample that has arrived by now."""
        under_way = self._under_way
        while under_way and under_way[0][0] <= t_ns:
            self._newest = under_way.popleft()[1]
        return self._newest


class _Drift:
    """Three slow errors: Gauss-Markov processes of a given standard deviation and correlation time."""

    def __init__(self, deviation: float, time: float, period: float, start: Sequence[float]) -> None:
        self._keep = exp(-period / time)
        self._add = deviation * sqrt(1.0 - self._keep * self._keep)
        self.value: Vec3 = (deviation * start[0], deviation * start[1], deviation * start[2])

    def step(self, noise: Sequence[float]) -> Vec3:
        a, b = self._keep, self._add
        x, y, z = self.value
        self.value = (a * x + b * noise[0], a * y + b * noise[1], a * z + b * noise[2])
        return self.value


def _three(x: Sequence[float], index: int) -> Vec3:
    return (x[index], x[index + 1], x[index + 2])


def _plus(a: Vec3, scale: float, b: Sequence[float]) -> Vec3:
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


def _turned(x: Sequence[float], error: Vec3) -> Quat:
    """The attitude in ``x``, turned by a small rotation vector in B, rad."""
    w, i, j, k = x[at.ATTITUDE], x[at.ATTITUDE + 1], x[at.ATTITUDE + 2], x[at.ATTITUDE + 3]
    a, b, c = 0.5 * error[0], 0.5 * error[1], 0.5 * error[2]
    q = (w - i * a - j * b - k * c, i + w * a + j * c - k * b, j + w * b + k * a - i * c, k + w * c + i * b - j * a)
    norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


_EXACT: Vec3 = (0.0, 0.0, 0.0)


def imu_errors(
    params: AutopilotSensorParams, gyro_bias: Vec3, accelerometer_bias: Vec3, noise: Sequence[float], now: Snapshot
) -> tuple[Vec3, Vec3]:
    """Errors of the body rate (rad/s) and of the specific force (m/s^2), B, of six standard normal numbers."""
    acceleration = _plus(accelerometer_bias, params.accelerometer_noise, noise[3:6])
    if now.armed:
        phase = 2.0 * pi * params.vibration_frequency * (now.t_ns * 1e-9)
        shake = (sin(phase), sin(phase + 2.1), sin(phase + 4.2))
        acceleration = _plus(acceleration, params.vibration, shake)
    return _plus(gyro_bias, params.gyro_noise, noise[0:3]), acceleration


class Sensors:
    """The three devices' measurements. ``observe`` sees every snapshot once; the others tell the newest sample.

    Deterministic: the same seed and snapshots give the same samples, however often they are asked for.
    """

    def __init__(self, params: SensorParams, vehicle: Vehicle, seed: int) -> None:
        self._params = params
        self._vehicle = vehicle
        self._random = np.random.default_rng(seed)
        start = self._random.standard_normal(12).tolist()
        odometry, autopilot, servos = params.odometry, params.autopilot, params.servos
        self._odometry = _Line[Odometry](odometry.period, odometry.delay)
        self._autopilot = _Line[AutopilotState](autopilot.period, autopilot.delay)
        self._servos = _Line[ServoState](servos.period, servos.delay)
        self._drift = _Drift(odometry.position_drift, odometry.drift_time, odometry.period, start[0:3])
        self._tilt = _Drift(autopilot.attitude_drift, autopilot.drift_time, autopilot.period, start[3:6])
        self._gyro_bias = _plus(_EXACT, autopilot.gyro_bias, start[6:9])
        self._accelerometer_bias = _plus(_EXACT, autopilot.accelerometer_bias, start[9:12])

    def observe(self, now: Snapshot) -> None:
        """Take the samples that are due."""
        if self._params.ideal:
            return
        if self._odometry.due(now.t_ns):
            self._odometry.put(now.t_ns, self._measure_odometry(now))
        if self._autopilot.due(now.t_ns):
            self._autopilot.put(now.t_ns, self._measure_autopilot(now))
        if self._servos.due(now.t_ns):
            self._servos.put(now.t_ns, self._measure_servos(now))

    def odometry(self, now: Snapshot) -> Odometry | None:
        """Newest pose that has arrived."""
        if not self._params.ideal:
            return self._odometry.newest(now.t_ns)
        x = now.x
        return Odometry(now.t_ns, _three(x, at.POSITION), _attitude(x), _three(x, at.VELOCITY), 3)

    def autopilot(self, now: Snapshot) -> AutopilotState | None:
        """Newest autopilot state that has arrived."""
        if not self._params.ideal:
            return self._autopilot.newest(now.t_ns)
        return _autopilot_state(now, _attitude(now.x), _EXACT, _EXACT)

    def servos(self, now: Snapshot) -> ServoState | None:
        """Newest bus cycle that has arrived."""
        if not self._params.ideal:
            return self._servos.newest(now.t_ns)
        x = now.x
        return self._servo_state(
            now,
            x[at.JOINT : at.JOINT + 3],
            x[at.JOINT_RATE : at.JOINT_RATE + 3],
            x[at.SERVO_CURRENT : at.SERVO_CURRENT + 3],
        )

    def _measure_odometry(self, now: Snapshot) -> Odometry:
        params, x = self._params.odometry, now.x
        noise = self._random.standard_normal(12).tolist()
        drift = self._drift.step(noise[0:3])
        return Odometry(
            t_ns=now.t_ns,
            p_WB=_plus(_plus(_three(x, at.POSITION), 1.0, drift), params.position_noise, noise[3:6]),
            q_WB=_turned(x, _plus(_EXACT, params.attitude_noise, noise[6:9])),
            v_WB=_plus(_three(x, at.VELOCITY), params.velocity_noise, noise[9:12]),
            confidence=3,
        )

    def _measure_autopilot(self, now: Snapshot) -> AutopilotState:
        params = self._params.autopilot
        noise = self._random.standard_normal(12).tolist()
        tilt = _plus(self._tilt.step(noise[0:3]), params.attitude_noise, noise[3:6])
        rate, acceleration = imu_errors(params, self._gyro_bias, self._accelerometer_bias, noise[6:12], now)
        return _autopilot_state(now, _turned(now.x, tilt), rate, acceleration)

    def _measure_servos(self, now: Snapshot) -> ServoState:
        params, x = self._params.servos, now.x
        noise = self._random.standard_normal(6).tolist()
        grain = 2.0 * pi / self._vehicle.servo.counts
        position = [round(x[at.JOINT + k] / grain) * grain for k in range(3)]
        rate = [x[at.JOINT_RATE + k] + params.velocity_noise * noise[k] for k in range(3)]
        current = [x[at.SERVO_CURRENT + k] + params.current_noise * noise[3 + k] for k in range(3)]
        return self._servo_state(
            now,
            position,
            [round(value / VELOCITY_UNIT) * VELOCITY_UNIT for value in rate],
            [round(value / CURRENT_UNIT) * CURRENT_UNIT for value in current],
        )

    def _servo_state(
        self, now: Snapshot, position: Sequence[float], rate: Sequence[float], current: Sequence[float]
    ) -> ServoState:
        """One bus cycle; pump and gripper carry no load, so draw nothing."""
        x, volts, degrees = now.x, self._vehicle.servo.voltage, self._params.servos.temperature
        return ServoState(
            t_ns=now.t_ns,
            position=(*_three(position, 0), x[at.PUMP], x[at.GRIPPER]),
            velocity=(*_three(rate, 0), x[at.TOOL_SERVO_RATE], x[at.TOOL_SERVO_RATE + 1]),
            current=(*_three(current, 0), 0.0, 0.0),
            voltage=(volts, volts, volts, volts, volts),
            temperature=(degrees, degrees, degrees, degrees, degrees),
            error=(0, 0, 0, 0, 0),
            torque_on=now.torque_on,
        )


def _attitude(x: Sequence[float]) -> Quat:
    return (x[at.ATTITUDE], x[at.ATTITUDE + 1], x[at.ATTITUDE + 2], x[at.ATTITUDE + 3])


def _autopilot_state(now: Snapshot, attitude: Quat, rate: Vec3, acceleration: Vec3) -> AutopilotState:
    """The autopilot's state with this attitude, and with errors added to rate and specific force."""
    x = now.x
    return AutopilotState(
        t_ns=now.t_ns,
        q_WB=attitude,
        w_WB_B=_plus(rate, 1.0, _three(x, at.RATE)),
        t_imu_ns=now.t_ns,
        f_B=_plus(acceleration, 1.0 / now.steps, _three(x, at.SPECIFIC_FORCE_SUM)),
        armed=now.armed,
        mode=now.mode,
        landed=now.landed,
        battery_voltage=x[at.VOLTAGE],
        battery_remaining=x[at.CHARGE],
    )
