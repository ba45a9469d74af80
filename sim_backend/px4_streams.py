"""What the stand-in tells: each message from the world, the estimator and the commander, at the rate asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import asin, atan2, isfinite, nan
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from drivers.frames import px4_from_attitude, px4_from_body, px4_from_world
from drivers.samples import AutopilotState, FlightMode, Landed, Quat
from sim_backend import layout as at
from sim_backend.faults import Faults, Kind
from sim_backend.px4_commander import Commander
from sim_backend.px4_estimator import PositionEstimator
from sim_backend.world import World

#: Streams that PX4 sends unasked on an onboard link: message id and Hz.
DEFAULT_RATES: Mapping[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 10.0,
}
#: PX4's custom mode of each mode: main, sub. Descend is told as Land.
MODES = {FlightMode.OFFBOARD: (6, 0), FlightMode.HOLD: (4, 3), FlightMode.LAND: (4, 6)}

_ACCEL_AND_GYRO = 0x3F
_UNUSED_CELL = 65535
_UNKNOWN_TEMPERATURE = 32767
_VERSION = 1 << 24 | 16 << 16 | 0 << 8 | 255  # 1.16.0, release
_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    | mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION
)
_CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
)
_LANDED = {
    Landed.UNKNOWN: mavlink.MAV_LANDED_STATE_UNDEFINED,
    Landed.ON_GROUND: mavlink.MAV_LANDED_STATE_ON_GROUND,
    Landed.IN_AIR: mavlink.MAV_LANDED_STATE_IN_AIR,
}
#: Messages that faults of the measurements strike, with the fields that NAN spoils.
_MEASURED = {
    "ATTITUDE_QUATERNION": ("q1", "q2", "q3", "q4"),
    "HIGHRES_IMU": ("xacc", "yacc", "zacc"),
    "LOCAL_POSITION_NED": ("x", "y", "z"),
}
_SPOILT_BY_DEFAULT = ("ATTITUDE_QUATERNION", "HIGHRES_IMU")


class Streams:
    """The messages of one boot. ``origin`` is the world time of that boot, ns."""

    def __init__(
        self, world: World, commander: Commander, estimator: PositionEstimator, faults: Faults, origin: int
    ) -> None:
        self._world = world
        self._commander = commander
        self._estimator = estimator
        self._faults = faults
        self._origin = origin
        self._frozen: dict[str, Any] = {}
        self.state: AutopilotState | None = None
        #: Seconds between two of each message id.
        self.intervals = {number: 1.0 / rate for number, rate in DEFAULT_RATES.items()}
        self._due = dict.fromkeys(self.intervals, 0.0)
        #: What can be told, by message id; None: nothing measured yet.
        self.makers: dict[int, Callable[[], Any]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: self._highres_imu,
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery_status,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_sys_state,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._autopilot_version,
            mavlink.MAVLINK_MSG_ID_TIMESYNC: self._timesync,
        }

    def ask(self, number: int, microseconds: float) -> bool:
        """MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops the stream, 0 is its default, else the interval.

        The heartbeat's cannot be set.
        """
        fixed = number == mavlink.MAVLINK_MSG_ID_HEARTBEAT
        if fixed or number not in self.makers or not isfinite(microseconds):
            return False
        if microseconds == 0.0:
            rate = DEFAULT_RATES.get(number, 0.0)
            microseconds = 1e6 / rate if rate else -1.0
        if microseconds < 0.0:
            self.intervals.pop(number, None)
        else:
            self.intervals[number] = microseconds / 1e6
            self._due[number] = self._world.time
        return True

    def due(self) -> Iterator[Any]:
        """Messages whose time has come."""
        t = self._world.time
        for number, interval in self.intervals.items():
            if t >= self._due[number] - 1e-9:
                # From the last due time, not from now, so that the mean rate is the asked one.
                self._due[number] = max(self._due[number] + interval, t)
                message = self.make(number)
                if message is not None:
                    yield message

    def make(self, number: int) -> Any:
        """One message as it is now, spoilt by what is in force."""
        message = self.makers[number]()
        if message is None or message.get_type() not in _MEASURED:
            return message
        name = message.get_type()
        if self._strikes(Kind.FREEZE, name):
            old = self._frozen.setdefault(name, message)
            stamp = "time_usec" if hasattr(message, "time_usec") else "time_boot_ms"
            setattr(old, stamp, getattr(message, stamp))
            message = old
        else:
            self._frozen.pop(name, None)
        if self._strikes(Kind.NAN, name):
            for field in _MEASURED[name]:
                setattr(message, field, nan)
        return message

    def _strikes(self, kind: Kind, name: str) -> bool:
        fault = self._faults.find(kind, self._world.time, name)
        return fault is not None and (fault.part == name or name in _SPOILT_BY_DEFAULT)

    def now_ns(self) -> int:
        """PX4's own time: since its boot."""
        return self._world.snapshot.t_ns - self._origin

    def _boot_ms(self) -> int:
        return self.now_ns() // 1_000_000

    def _heartbeat(self) -> Any:
        commander = self._commander
        main, sub = MODES[commander.mode]
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        status = mavlink.MAV_STATE_STANDBY
        if commander.armed:
            base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            status = mavlink.MAV_STATE_CRITICAL if commander.failsafe else mavlink.MAV_STATE_ACTIVE
        if commander.terminated:
            status = mavlink.MAV_STATE_FLIGHT_TERMINATION
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base, main << 16 | sub << 24, status, 3
        )

    def _timesync(self) -> Any:
        return mavlink.MAVLink_timesync_message(0, self.now_ns())

    def _sys_status(self) -> Any:
        t, healthy = self._world.time, _SENSORS
        if self._commander.can_arm(t):
            healthy |= mavlink.MAV_SYS_STATUS_PREARM_CHECK  # which PX4 tells among the healthy only
        if not self._estimator.horizontal_valid(t):
            healthy &= ~mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION
        return mavlink.MAVLink_sys_status_message(
            _SENSORS, _SENSORS, healthy, 100, self._millivolts(), -1, self._percent(), 0, 0, 0, 0, 0, 0
        )

    def _attitude(self) -> Any:
        state = self.state
        if state is None:
            return None
        roll, pitch, yaw = _euler(px4_from_attitude(state.q_WB))
        return mavlink.MAVLink_attitude_message(self._boot_ms(), roll, pitch, yaw, *px4_from_body(state.w_WB_B))

    def _attitude_quaternion(self) -> Any:
        state = self.state
        if state is None:
            return None
        q, w = px4_from_attitude(state.q_WB), px4_from_body(state.w_WB_B)
        return mavlink.MAVLink_attitude_quaternion_message(self._boot_ms(), *q, *w)

    def _highres_imu(self) -> Any:
        state = self.state
        if state is None:
            return None
        f, w = px4_from_body(state.f_B), px4_from_body(state.w_WB_B)
        unused = (0.0,) * 6
        return mavlink.MAVLink_highres_imu_message(self.now_ns() // 1000, *f, *w, *unused, 25.0, _ACCEL_AND_GYRO)

    def _local_position(self) -> Any:
        p, v = px4_from_world(self._estimator.p_WB), px4_from_world(self._estimator.v_WB)
        return mavlink.MAVLink_local_position_ned_message(self._boot_ms(), *p, *v)

    def _battery_status(self) -> Any:
        voltages = [self._millivolts(), *[_UNUSED_CELL] * 9]
        return mavlink.MAVLink_battery_status_message(
            0,
            mavlink.MAV_BATTERY_FUNCTION_ALL,
            mavlink.MAV_BATTERY_TYPE_LIPO,
            _UNKNOWN_TEMPERATURE,
            voltages,
            -1,
            -1,
            -1,
            self._percent(),
        )

    def _millivolts(self) -> int:
        return round(1e3 * self._world.snapshot.x[at.VOLTAGE])

    def _percent(self) -> int:
        return round(100.0 * self._world.snapshot.x[at.CHARGE])

    def _extended_sys_state(self) -> Any:
        return mavlink.MAVLink_extended_sys_state_message(0, _LANDED[self._commander.landed])

    def _autopilot_version(self) -> Any:
        return mavlink.MAVLink_autopilot_version_message(
            _CAPABILITIES, _VERSION, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 1
        )


def _euler(q: Quat) -> tuple[float, float, float]:
    """Roll, pitch and yaw, rad, of a quaternion in any axes (ZYX)."""
    w, x, y, z = q
    sine = min(max(2.0 * (w * y - z * x), -1.0), 1.0)
    return (
        atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        asin(sine),
        atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
