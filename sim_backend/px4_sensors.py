"""What PX4's own sensors measure in a simulated world: HIL_SENSOR and HIL_GPS messages.

North of PX4 is +y of W, as everywhere (``drivers/frames.py``). The inertial sensors err as ``sensors.SensorParams``
says; magnetometer, barometer and GPS have their own noise here, always: PX4 takes a barometer whose readings repeat for
a failed one.
"""

from __future__ import annotations

from math import cos, radians
from typing import Annotated, Any

import numpy as np
from msgspec import Struct
from pymavlink.dialects.v20 import common as mavlink

from drivers.frames import px4_from_body, px4_from_world
from drivers.rotation import inverse, rotate
from drivers.samples import Quat, Vec3
from sim_backend import layout as at
from sim_backend.knob import knob
from sim_backend.sensors import Imu, SensorParams, Snapshot

_ACCEL_AND_GYRO, _MAGNETOMETER, _BAROMETER = 0x3F, 0x1C0, 0x1A00  # HIL_SENSOR.fields_updated
_MAGNETOMETER_EVERY, _BAROMETER_EVERY, _GPS_EVERY = 3, 5, 50  # samples of the inertial sensors
_METRES_PER_DEGREE = 111_319.5
_NOISE = Imu.NOISES + 3 + 1 + 6


class Px4SensorParams(Struct, frozen=True, forbid_unknown_fields=True):
    """The place, and the noise of what ``SensorParams`` does not know. A place in Zurich, as PX4's simulators use."""

    latitude: Annotated[float, knob("deg", "of W's origin", -89.0, 89.0)] = 47.397742
    longitude: Annotated[float, knob("deg", "of W's origin", -180.0, 180.0)] = 8.545594
    altitude: Annotated[float, knob("m", "of W's origin above the sea", -400.0, 9000.0)] = 488.0
    field_north: Annotated[float, knob("gauss", "horizontal part of the earth's field", 0.0, 0.7)] = 0.215
    field_down: Annotated[float, knob("gauss", "vertical part of it", -0.7, 0.7)] = 0.427
    magnetometer_noise: Annotated[float, knob("gauss", "white noise", 0.0, 0.1)] = 0.002
    barometer_noise: Annotated[float, knob("hPa", "white noise; 0.12 hPa are a metre", 0.0, 1.0)] = 0.01
    temperature: Annotated[float, knob("degC", "of the sensors", -40.0, 85.0)] = 25.0
    gps_noise: Annotated[float, knob("m", "white noise of the position", 0.0, 10.0)] = 0.3
    gps_velocity_noise: Annotated[float, knob("m/s", "white noise of the velocity", 0.0, 5.0)] = 0.05


class Px4Sensors:
    """Makes the messages. Deterministic: same seed and snapshots, same numbers. ``gps``: there is a receiver."""

    def __init__(
        self,
        inertial: SensorParams,
        hover: float,
        params: Px4SensorParams | None = None,
        gps: bool = False,
        seed: int = 0,
    ) -> None:
        """``hover``: thrust of one rotor in hover, N."""
        self._params = params or Px4SensorParams()
        self._gps = gps
        # Not the random numbers of the world's own sensors, which start from the same seed.
        self._random = np.random.default_rng([seed, 4560])
        self._imu = Imu(inertial.autopilot, hover, self._random)
        self._taken = 0

    def measure(self, now: Snapshot) -> list[Any]:
        """The messages of one sample of the inertial sensors, 250 a second; GPS comes every 50th time."""
        noise = self._random.standard_normal(_NOISE)
        messages = [self._sensor(now, noise[: Imu.NOISES + 4])]
        if self._gps and self._taken % _GPS_EVERY == 0:
            messages.append(self._position(now, noise[Imu.NOISES + 4 :]))
        self._taken += 1
        return messages

    def _sensor(self, now: Snapshot, noise: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
        params, x = self._params, now.x
        q: Quat = (x[at.ATTITUDE], x[at.ATTITUDE + 1], x[at.ATTITUDE + 2], x[at.ATTITUDE + 3])
        rate, force = self._imu.errors(noise[: Imu.NOISES].tolist(), now)
        noise = noise[Imu.NOISES :]
        w, f = at.RATE, at.SPECIFIC_FORCE_SUM
        gyro = px4_from_body((x[w] + rate[0], x[w + 1] + rate[1], x[w + 2] + rate[2]))
        accel = px4_from_body(
            (x[f] / now.steps + force[0], x[f + 1] / now.steps + force[1], x[f + 2] / now.steps + force[2])
        )
        field = px4_from_body(rotate(inverse(q), (0.0, params.field_north, -params.field_down)))
        shaken = params.magnetometer_noise * noise[0:3]
        altitude = params.altitude + x[at.POSITION + 2]
        pressure = pressure_at(altitude) + params.barometer_noise * float(noise[3])
        updated = _ACCEL_AND_GYRO
        updated |= _MAGNETOMETER if self._taken % _MAGNETOMETER_EVERY == 0 else 0
        updated |= _BAROMETER if self._taken % _BAROMETER_EVERY == 0 else 0
        return mavlink.MAVLink_hil_sensor_message(
            _microseconds(now),
            *accel,
            *gyro,
            *_three(np.array(field) + shaken),
            pressure,
            0.0,
            altitude,
            params.temperature,
            updated,
        )

    def _position(self, now: Snapshot, noise: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
        params, x = self._params, now.x
        error = params.gps_noise * noise[0:3]
        p = px4_from_world(_three(np.array(x[at.POSITION : at.POSITION + 3]) + error))
        v = px4_from_world(_three(np.array(x[at.VELOCITY : at.VELOCITY + 3]) + params.gps_velocity_noise * noise[3:6]))
        north, east, down = (round(100.0 * part) for part in v)
        speed = round((north * north + east * east) ** 0.5)
        return mavlink.MAVLink_hil_gps_message(
            _microseconds(now),
            3,
            round(1e7 * (params.latitude + p[0] / _METRES_PER_DEGREE)),
            round(1e7 * (params.longitude + p[1] / (_METRES_PER_DEGREE * cos(radians(params.latitude))))),
            round(1e3 * (params.altitude - p[2])),
            30,
            40,
            speed,
            north,
            east,
            down,
            65535,  # the course is not known
            16,
        )


def pressure_at(altitude: float) -> float:
    """Air pressure, hPa, of the standard atmosphere at ``altitude`` m above the sea, below 11 km (ISO 2533)."""
    return float(1013.25 * (1.0 - 0.0065 * altitude / 288.15) ** 5.25588)


def _microseconds(now: Snapshot) -> int:
    return now.t_ns // 1000


def _three(values: np.ndarray[Any, np.dtype[np.float64]]) -> Vec3:
    return (float(values[0]), float(values[1]), float(values[2]))
