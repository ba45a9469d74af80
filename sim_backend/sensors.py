"""What the devices of a simulated world measure: exact, or with noise, bias, delay and the grain of the encoders."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import cos, exp, inf, pi, sin, sqrt
from typing import Annotated, Generic, NamedTuple, TypeVar

import numpy as np
from msgspec import Struct

from drivers.samples import AutopilotState, FlightMode, Landed, Odometry, Quat, ServoState, Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.deviations import mass_of
from sim_backend.knob import knob, switch

T = TypeVar("T")

#: Grain of the XC330's velocity (0.229 rev/min) and current (1 mA) readings (ROBOTIS e-manual).
VELOCITY_UNIT = 0.229 * 2.0 * pi / 60.0
CURRENT_UNIT = 1e-3


class OdometryParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How a T265 errs; docs/realism.md has values with their sources. Zero is off."""

    period: Annotated[float, knob("s", "time between poses; 0: one at every advance", 0.0, 0.1)] = 0.0
    delay: Annotated[float, knob("s", "exposure to arrival", 0.0, 0.2)] = 0.0
    position_noise: Annotated[float, knob("m", "white noise", 0.0, 0.1)] = 0.0
    position_drift: Annotated[float, knob("m", "standard deviation of the slow error", 0.0, 0.5)] = 0.0
    drift_time: Annotated[float, knob("s", "correlation time of the slow error", 0.1, 1000.0)] = 30.0
    velocity_noise: Annotated[float, knob("m/s", "white noise", 0.0, 0.5)] = 0.0
    attitude_noise: Annotated[float, knob("rad", "white noise", 0.0, 0.1)] = 0.0
    jump_rate: Annotated[float, knob("1/s", "jumps of the position, unannounced, at random times", 0.0, 10.0)] = 0.0
    jump: Annotated[float, knob("m", "length of each jump, in a random direction, for good", 0.0, 1.0)] = 0.02
    doubt_rate: Annotated[float, knob("1/s", "spells of low confidence, at random times", 0.0, 10.0)] = 0.0
    doubt_time: Annotated[float, knob("s", "length of each spell", 0.0, 10.0)] = 0.3
    doubt_confidence: Annotated[int, knob("1", "confidence that is told in a spell", 0, 3)] = 1
    doubt_noise: Annotated[float, knob("1", "factor on the noises in a spell", 1.0, 100.0)] = 3.0

    @property
    def exact(self) -> bool:
        """Nothing is off: each pose is the truth of now."""
        return not any(
            (self.period, self.delay, self.position_noise, self.position_drift, self.velocity_noise,
             self.attitude_noise, self.jump_rate, self.doubt_rate)
        )  # fmt: skip


class AutopilotSensorParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How IMU and attitude of a Pixhawk 6C err, after its filters, and the way of its messages. Zero is off."""

    period: Annotated[float, knob("s", "time between messages; 0: one at every advance", 0.0, 0.1)] = 0.0
    delay: Annotated[float, knob("s", "measurement to arrival, the least", 0.0, 0.2)] = 0.0
    jitter: Annotated[float, knob("s", "mean of the exponential rest of the delay; order is kept", 0.0, 0.1)] = 0.0
    loss: Annotated[float, knob("1", "share of the messages that never arrive", 0.0, 0.9)] = 0.0
    attitude_noise: Annotated[float, knob("rad", "white noise", 0.0, 0.1)] = 0.0
    attitude_drift: Annotated[float, knob("rad", "standard deviation of the estimator's slow error", 0.0, 0.1)] = 0.0
    drift_time: Annotated[float, knob("s", "correlation time of the slow error", 0.1, 1000.0)] = 5.0
    gyro_noise: Annotated[float, knob("rad/s", "white noise", 0.0, 0.5)] = 0.0
    gyro_bias: Annotated[float, knob("rad/s", "standard deviation of the constant error", 0.0, 0.1)] = 0.0
    accelerometer_noise: Annotated[float, knob("m/s^2", "white noise", 0.0, 5.0)] = 0.0
    accelerometer_bias: Annotated[float, knob("m/s^2", "standard deviation of the constant error", 0.0, 1.0)] = 0.0
    accelerometer_drift: Annotated[float, knob("m/s^2", "standard deviation of the bias's slow change", 0.0, 1.0)] = 0.0
    accelerometer_drift_time: Annotated[float, knob("s", "correlation time of that change", 0.1, 1e4)] = 100.0
    vibration: Annotated[
        float, knob("m/s^2", "amplitude of the four rotors' vibration in hover, each at its own speed", 0.0, 10.0)
    ] = 0.0

    @property
    def exact(self) -> bool:
        """Nothing is off: each message is the truth of now."""
        return not any(
            (self.period, self.delay, self.jitter, self.loss, self.attitude_noise, self.attitude_drift,
             self.gyro_noise, self.gyro_bias, self.accelerometer_noise, self.accelerometer_bias,
             self.accelerometer_drift, self.vibration)
        )  # fmt: skip


class ServoSensorParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How the readings of the XC330 bus err. Zero is off."""

    period: Annotated[float, knob("s", "time between bus cycles; 0: one at every advance", 0.0, 0.1)] = 0.0
    delay: Annotated[float, knob("s", "measurement to arrival", 0.0, 0.2)] = 0.0
    grain: Annotated[bool, switch("readings come in whole units of the control table")] = False
    velocity_noise: Annotated[float, knob("rad/s", "white noise", 0.0, 1.0)] = 0.0
    current_noise: Annotated[float, knob("A", "white noise of the supply current", 0.0, 0.5)] = 0.0
    temperature: Annotated[float, knob("degC", "of all servos", -20.0, 80.0)] = 35.0

    @property
    def exact(self) -> bool:
        """Nothing is off: each reading is the truth of now."""
        return not any((self.period, self.delay, self.grain, self.velocity_noise, self.current_noise))


class SensorParams(Struct, frozen=True, forbid_unknown_fields=True):
    """What the devices measure: as declared, exact, without delay and fresh at every advance."""

    odometry: OdometryParams = OdometryParams()
    autopilot: AutopilotSensorParams = AutopilotSensorParams()
    servos: ServoSensorParams = ServoSensorParams()


#: What the scenario ``realistic`` sets; the emulators that run alone take it too. Sources: docs/realism.md.
REALISTIC = SensorParams(
    odometry=OdometryParams(
        period=0.005, delay=0.030, position_noise=0.0005, position_drift=0.005, velocity_noise=0.01,
        attitude_noise=0.0009, jump_rate=0.02, doubt_rate=0.02,
    ),
    autopilot=AutopilotSensorParams(
        period=0.004, delay=0.020, jitter=0.002, loss=0.01, attitude_noise=0.0003, attitude_drift=0.0017,
        gyro_noise=0.005, gyro_bias=0.001, accelerometer_noise=0.04, accelerometer_bias=0.05,
        accelerometer_drift=0.02, vibration=0.3,
    ),
    servos=ServoSensorParams(period=0.004, delay=0.002, grain=True, velocity_noise=0.01, current_noise=0.005),
)  # fmt: skip


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
    """Samples on their way: taken every period, told after a delay, in order."""

    def __init__(self, period: float, delay: float) -> None:
        self._period = round(period * 1e9)
        self._delay = round(delay * 1e9)
        self._due = 0
        self._last = 0
        self._under_way: deque[tuple[int, T]] = deque()
        self._newest: T | None = None

    def due(self, t_ns: int) -> bool:
        """It is time for the next sample."""
        if t_ns < self._due:
            return False
        self._due = max(self._due + self._period, t_ns - self._period)
        return True

    def put(self, t_ns: int, sample: T, more: float = 0.0) -> None:
        """It sets out now; ``more`` is what it takes beyond the delay, s."""
        self._last = max(self._last, t_ns + self._delay + round(more * 1e9))
        self._under_way.append((self._last, sample))

    def newest(self, t_ns: int) -> T | None:
        """The last sample that has arrived by now."""
        under_way = self._under_way
        while under_way and under_way[0][0] <= t_ns:
            self._newest = under_way.popleft()[1]
        return self._newest


class _Drift:
    """Three slow errors: Gauss-Markov processes of a given standard deviation and correlation time."""

    def __init__(self, deviation: float, time: float, start: Sequence[float]) -> None:
        self._deviation, self._time = deviation, time
        self._t_ns: int | None = None
        self.value: Vec3 = (deviation * start[0], deviation * start[1], deviation * start[2])

    def step(self, t_ns: int, noise: Sequence[float]) -> Vec3:
        """The errors at this time, of three standard normal numbers."""
        since, self._t_ns = self._t_ns, t_ns
        if since is not None and self._deviation:
            a = exp((since - t_ns) * 1e-9 / self._time)
            b = self._deviation * sqrt(1.0 - a * a)
            x, y, z = self.value
            self.value = (a * x + b * noise[0], a * y + b * noise[1], a * z + b * noise[2])
        return self.value


class _Events:
    """Events at random times, so many a second in the mean (a Poisson process)."""

    def __init__(self, rate: float, random: np.random.Generator) -> None:
        self._rate, self._random = rate, random
        self._next = inf if rate == 0.0 else float(random.exponential(1.0 / rate))

    def begun(self, t: float) -> int:
        """How many have begun by ``t`` (s) since this was asked last."""
        count = 0
        while self._next <= t:
            self._next += float(self._random.exponential(1.0 / self._rate))
            count += 1
        return count


def _three(x: Sequence[float], index: int) -> Vec3:
    return (x[index], x[index + 1], x[index + 2])


def _plus(a: Vec3, scale: float, b: Sequence[float]) -> Vec3:
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


def _turned(x: Sequence[float], error: Vec3) -> Quat:
    """The attitude in ``x``, turned by a small rotation vector in B, rad."""
    if error == _EXACT:
        return _attitude(x)
    w, i, j, k = x[at.ATTITUDE], x[at.ATTITUDE + 1], x[at.ATTITUDE + 2], x[at.ATTITUDE + 3]
    a, b, c = 0.5 * error[0], 0.5 * error[1], 0.5 * error[2]
    q = (w - i * a - j * b - k * c, i + w * a + j * c - k * b, j + w * b + k * a - i * c, k + w * c + i * b - j * a)
    norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


_EXACT: Vec3 = (0.0, 0.0, 0.0)


#: Sense of each rotor's turning, in PX4's numbering: counter-clockwise is positive.
_SENSE = (1.0, 1.0, -1.0, -1.0)


class Imu:
    """Errors of an inertial unit: noise, bias with drift, and what the rotors shake.

    ``hover`` is the thrust of one rotor in hover, N: there each rotor has half of the vibration's amplitude, and as
    the square of its speed elsewhere. An unbalanced rotor pulls round in its plane once a turn, its two blades beat
    along its axis twice a turn. Sampled as it is, the vibration shows up at its alias.
    """

    NOISES = 9

    def __init__(self, params: AutopilotSensorParams, hover: float, random: np.random.Generator) -> None:
        self._params, self._hover = params, hover
        start = random.standard_normal(9).tolist()
        self._gyro_bias = _plus(_EXACT, params.gyro_bias, start[0:3])
        self._bias = _plus(_EXACT, params.accelerometer_bias, start[3:6])
        self._drift = _Drift(params.accelerometer_drift, params.accelerometer_drift_time, start[6:9])

    def errors(self, noise: Sequence[float], now: Snapshot) -> tuple[Vec3, Vec3]:
        """Errors of the body rate (rad/s) and of the specific force (m/s^2), B, of nine standard normal numbers."""
        params = self._params
        acceleration = _plus(self._bias, params.accelerometer_noise, noise[3:6])
        acceleration = _plus(acceleration, 1.0, self._drift.step(now.t_ns, noise[6:9]))
        if params.vibration:
            acceleration = _plus(acceleration, 0.5 * params.vibration / self._hover, _shake(now.x))
        return _plus(self._gyro_bias, params.gyro_noise, noise[0:3]), acceleration


def _shake(x: Sequence[float]) -> Vec3:
    """What the rotors shake, as multiples of the thrust of each, N."""
    ahead = aside = up = 0.0
    for i, sense in enumerate(_SENSE):
        thrust, angle = x[at.ROTOR + i], x[at.ROTOR_ANGLE + i]
        ahead += thrust * cos(angle)
        aside += thrust * sense * sin(angle)
        up += thrust * sin(2.0 * angle)
    return (ahead, aside, up)


def hover_thrust(vehicle: Vehicle) -> float:
    """Thrust of one rotor in hover with the sleeve, N."""
    return 0.25 * mass_of(vehicle) * vehicle.gravity


class Sensors:
    """The three devices' measurements. ``observe`` sees every snapshot once; the others tell the newest sample.

    Deterministic: the same seed and snapshots give the same samples, however often they are asked for. Each device
    has random numbers of its own: what one shows does not depend on how another errs.
    """

    def __init__(self, params: SensorParams, vehicle: Vehicle, seed: int) -> None:
        self._params = params
        self._vehicle = vehicle
        self._poses, self._messages, self._cycles, when = (np.random.default_rng([seed, k]) for k in range(4))
        odometry, autopilot, servos = params.odometry, params.autopilot, params.servos
        self._exact = (odometry.exact, autopilot.exact, servos.exact)
        self._odometry = _Line[Odometry](odometry.period, odometry.delay)
        self._autopilot = _Line[AutopilotState](autopilot.period, autopilot.delay)
        self._servos = _Line[ServoState](servos.period, servos.delay)
        start = self._poses.standard_normal(3).tolist()
        self._drift = _Drift(odometry.position_drift, odometry.drift_time, start)
        jumps, doubts = when.spawn(2)
        self._jumps, self._doubts = _Events(odometry.jump_rate, jumps), _Events(odometry.doubt_rate, doubts)
        self._where = when
        self._jumped = _EXACT
        self._doubted_until = 0.0
        start = self._messages.standard_normal(3).tolist()
        self._tilt = _Drift(autopilot.attitude_drift, autopilot.drift_time, start)
        self._imu = Imu(autopilot, hover_thrust(vehicle), self._messages)

    def observe(self, now: Snapshot) -> None:
        """Take the samples that are due."""
        odometry, autopilot, servos = self._exact
        if not odometry and self._odometry.due(now.t_ns):
            self._odometry.put(now.t_ns, self._measure_odometry(now))
        if not autopilot and self._autopilot.due(now.t_ns):
            state = self._measure_autopilot(now)
            lost, more = self._messages.random(), self._messages.standard_exponential()
            if lost >= self._params.autopilot.loss:
                self._autopilot.put(now.t_ns, state, self._params.autopilot.jitter * more)
        if not servos and self._servos.due(now.t_ns):
            self._servos.put(now.t_ns, self._measure_servos(now))

    def odometry(self, now: Snapshot) -> Odometry | None:
        """Newest pose that has arrived."""
        if not self._exact[0]:
            return self._odometry.newest(now.t_ns)
        x = now.x
        return Odometry(now.t_ns, _three(x, at.POSITION), _attitude(x), _three(x, at.VELOCITY), 3)

    def autopilot(self, now: Snapshot) -> AutopilotState | None:
        """Newest autopilot state that has arrived."""
        if not self._exact[1]:
            return self._autopilot.newest(now.t_ns)
        return _autopilot_state(now, _attitude(now.x), _EXACT, _EXACT)

    def servos(self, now: Snapshot) -> ServoState | None:
        """Newest bus cycle that has arrived."""
        if not self._exact[2]:
            return self._servos.newest(now.t_ns)
        x = now.x
        return self._servo_state(
            now,
            x[at.JOINT : at.JOINT + 3],
            x[at.JOINT_RATE : at.JOINT_RATE + 3],
            x[at.SERVO_CURRENT : at.SERVO_CURRENT + 3],
        )

    def _measure_odometry(self, now: Snapshot) -> Odometry:
        params, x, t = self._params.odometry, now.x, now.t_ns * 1e-9
        noise = self._poses.standard_normal(12).tolist()
        for _ in range(self._jumps.begun(t)):
            way = self._where.standard_normal(3)
            self._jumped = _plus(self._jumped, params.jump / float(np.linalg.norm(way)), way.tolist())
        if self._doubts.begun(t):
            self._doubted_until = t + params.doubt_time
        doubted = t < self._doubted_until
        more = params.doubt_noise if doubted else 1.0
        slow = _plus(self._jumped, 1.0, self._drift.step(now.t_ns, noise[0:3]))
        return Odometry(
            t_ns=now.t_ns,
            p_WB=_plus(_plus(_three(x, at.POSITION), 1.0, slow), more * params.position_noise, noise[3:6]),
            q_WB=_turned(x, _plus(_EXACT, more * params.attitude_noise, noise[6:9])),
            v_WB=_plus(_three(x, at.VELOCITY), more * params.velocity_noise, noise[9:12]),
            confidence=params.doubt_confidence if doubted else 3,
        )

    def _measure_autopilot(self, now: Snapshot) -> AutopilotState:
        params = self._params.autopilot
        noise = self._messages.standard_normal(6 + Imu.NOISES).tolist()
        tilt = _plus(self._tilt.step(now.t_ns, noise[0:3]), params.attitude_noise, noise[3:6])
        rate, acceleration = self._imu.errors(noise[6:], now)
        return _autopilot_state(now, _turned(now.x, tilt), rate, acceleration)

    def _measure_servos(self, now: Snapshot) -> ServoState:
        params, x = self._params.servos, now.x
        noise = self._cycles.standard_normal(6).tolist()
        position = [x[at.JOINT + k] for k in range(3)]
        rate = [x[at.JOINT_RATE + k] + params.velocity_noise * noise[k] for k in range(3)]
        current = [x[at.SERVO_CURRENT + k] + params.current_noise * noise[3 + k] for k in range(3)]
        if params.grain:
            units = (2.0 * pi / self._vehicle.servo.counts, VELOCITY_UNIT, CURRENT_UNIT)
            position, rate, current = (
                [round(value / unit) * unit for value in values]
                for values, unit in zip((position, rate, current), units, strict=True)
            )
        return self._servo_state(now, position, rate, current)

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
