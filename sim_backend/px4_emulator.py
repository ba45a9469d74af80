"""A stand-in for PX4: our world behind MAVLink 2 on UDP.

``Px4StandIn`` is a face of ``world.autopilot``: it speaks what MAVSDK and pymavlink need to connect and stay content,
and refuses what PX4 refuses, with PX4's words. ``receive`` takes what has arrived; once the world has been advanced by
``period``, ``publish`` sends what is due. ``start`` paces both on the wall clock in a thread of its own; a test may
call ``step`` instead. Mock devices of the same world may stand beside it, with its ``clock``.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import isfinite, nan
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from drivers.frames import (
    attitude_from_px4,
    body_from_px4,
    px4_from_attitude,
    px4_from_body,
    px4_from_world,
    world_from_px4,
)
from drivers.protocols import DeviceError
from drivers.rotation import rotate
from drivers.samples import FlightMode, Interface, Landed, Odometry
from drivers.thrust import motor_signal, thrust_fraction
from sim_backend import layout as at
from sim_backend.autopilot import SetPoint
from sim_backend.mock_devices import MockAutopilot
from sim_backend.motors import rated_voltage
from sim_backend.pace import Pace
from sim_backend.world import World

Address = tuple[str, int]

_SYSTEM, _AUTOPILOT = 1, 1
_ACCEL_AND_GYRO = 0x3F
_UNUSED_CELL = 65535
_UNKNOWN_TEMPERATURE = 32767
_MAX_DATAGRAM = 1400
_TEXT_CHUNK = 50
_FORCE = 21196.0
_ACCEPTED, _REJECTED, _DENIED, _UNSUPPORTED, _FAILED = 0, 1, 2, 3, 4  # MAV_RESULT

#: Streams that PX4 sends unasked on an onboard link: message id and Hz.
DEFAULT_RATES: Mapping[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 10.0,
}

_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
)
_CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
)
_VERSION = 1 << 24 | 16 << 16 | 0 << 8 | 255  # 1.16.0, release
_LANDED = {
    Landed.UNKNOWN: mavlink.MAV_LANDED_STATE_UNDEFINED,
    Landed.ON_GROUND: mavlink.MAV_LANDED_STATE_ON_GROUND,
    Landed.IN_AIR: mavlink.MAV_LANDED_STATE_IN_AIR,
}
_MODES = {FlightMode.OFFBOARD: (6, 0), FlightMode.HOLD: (4, 3), FlightMode.LAND: (4, 6)}  # main, sub
_MODE_OF = {numbers: mode for mode, numbers in _MODES.items()}

#: Parameters that are facts of the world, with the field of AutopilotParams that holds them.
_HELD = {"COM_OF_LOSS_T": "offboard_timeout", "COM_DISARM_LAND": "disarm_delay", "MPC_LAND_SPEED": "descent_speed"}
#: What a client may read beside them, as on the vehicle. PX4's integers are INT32.
_FIXED: Mapping[str, float | int] = {
    "COM_OBL_RC_ACT": 4,  # land
    "EKF2_EV_CTRL": 15,
    "EKF2_EV_QMIN": 1,
    "EKF2_GPS_CTRL": 0,
    "EKF2_HGT_REF": 3,
    "MAV_SYS_ID": _SYSTEM,
    "SYS_AUTOSTART": 4019,
    "SYS_HAS_GPS": 0,
    "SYS_HAS_MAG": 0,
}
_CURVE = "THR_MDL_FAC"


class Px4StandIn:
    """The stand-in on one UDP socket.

    It is bound to ``bind`` (port 0: any free one; see ``port``) and sends to everybody who has written to it, and from
    the start to ``peer`` if one is given, as PX4 does to its onboard computer. ``parameters`` override those of the
    world, by PX4's names. ``period`` is the time one step advances the world, s.
    """

    def __init__(
        self,
        world: World,
        *,
        bind: Address = ("127.0.0.1", 0),
        peer: Address | None = None,
        parameters: Mapping[str, float | int] | None = None,
        period: float = 0.004,
    ) -> None:
        self.world = world
        self.period = period
        #: Messages received and sent so far, by name.
        self.received: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        #: Newest message of each name received.
        self.newest: dict[str, Any] = {}
        self._face = MockAutopilot(world)
        self._terminated = False
        self._told = world.snapshot
        self._state = self._face.latest()
        self._parameters: dict[str, float | int] = {
            **_FIXED,
            _CURVE: world.vehicle.rotors.curve,
            **{name: getattr(world.autopilot.params, field) for name, field in _HELD.items()},
        }
        for name, value in (parameters or {}).items():
            self._set_parameter(name, value)

        self._peers: dict[Address, None] = {} if peer is None else {peer: None}
        self._out: list[bytes] = []
        self._mav = mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_AUTOPILOT)
        self._parsers: dict[Address, Any] = {}
        #: Newest pose that PX4 would fuse, in the world's axes and at the world's time.
        self.vision: Odometry | None = None
        #: World time less the time of the peer that tells poses, ns, and the round trip that it was measured on.
        self._peer_clock: tuple[int, int] | None = None
        self._intervals = {number: 1.0 / rate for number, rate in DEFAULT_RATES.items()}
        self._due = dict.fromkeys(self._intervals, 0.0)
        self._text_id = 0
        self._makers: dict[int, Callable[[], Any]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: self._highres_imu,
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery_status,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_sys_state,
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: self._home_position,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._autopilot_version,
            mavlink.MAVLINK_MSG_ID_TIMESYNC: self._timesync,
        }
        self._handlers: dict[str, Callable[[Any], None]] = {
            "SET_ATTITUDE_TARGET": self._on_set_attitude_target,
            "COMMAND_LONG": self._on_command,
            "SET_MODE": self._on_set_mode,
            "PARAM_REQUEST_LIST": self._on_param_list,
            "PARAM_REQUEST_READ": self._on_param_read,
            "PARAM_SET": self._on_param_set,
            "TIMESYNC": self._on_timesync,
            "PING": self._on_ping,
            "ODOMETRY": self._on_odometry,
        }
        self._socket = socket(AF_INET, SOCK_DGRAM)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            raise DeviceError(f"PX4 stand-in: cannot listen on UDP {bind[0]}:{bind[1]} ({error.strerror})") from error
        self._socket.setblocking(False)
        self._pace = Pace(world, (self,))

    @property
    def port(self) -> int:
        """UDP port it listens on."""
        return int(self._socket.getsockname()[1])

    # -- life cycle -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Move the world on the wall clock, in a thread of its own, with no other face beside this one."""
        self._pace.start()

    def stop(self) -> None:
        """End the thread, if there is one, and close the socket. Safe to call twice."""
        self._pace.stop()
        self._socket.close()

    @property
    def slipped(self) -> float:
        """Seconds since ``start`` that the world could not keep pace with the wall clock."""
        return self._pace.slipped

    def clock(self, t_ns: int) -> int:
        """World time as nanoseconds of the machine's monotonic clock, for mock devices beside this one."""
        return self._pace.clock(t_ns)

    def step(self) -> None:
        """Take what has arrived, advance the world by one period, publish what is due."""
        self.receive()
        self.world.advance(self.period)
        self.publish()

    def publish(self) -> None:
        """Look at the world as it now stands: tell what has changed, send what is due."""
        self._state = self._face.latest()
        self._tell_changes()
        t = self.world.time
        for number, interval in self._intervals.items():
            if t >= self._due[number] - 1e-9:
                # From the last due time, not from now, so that the mean rate is the asked one.
                self._due[number] = max(self._due[number] + interval, t)
                self._send(self._makers[number]())
        self._flush()

    # -- the wire -------------------------------------------------------------------------------------------------

    def receive(self) -> None:
        """Take the datagrams that have arrived, and do what they say."""
        while True:
            try:
                data, address = self._socket.recvfrom(2048)
            except (BlockingIOError, ConnectionRefusedError):
                return
            if address not in self._parsers:
                parser = mavlink.MAVLink(None)
                parser.robust_parsing = True
                self._parsers[address] = parser
                self._peers.setdefault(address)
            for message in self._parsers[address].parse_buffer(data) or ():
                name = message.get_type()
                self.received[name] += 1
                self.newest[name] = message
                handler = self._handlers.get(name)
                if handler is not None and getattr(message, "target_system", _SYSTEM) in (0, _SYSTEM):
                    handler(message)

    def _send(self, message: Any) -> None:
        if message is None:  # nothing measured yet
            return
        self.sent[message.get_type()] += 1
        self._out.append(message.pack(self._mav))

    def _flush(self) -> None:
        batch = b""
        for packet in (*self._out, b""):
            if batch and (not packet or len(batch) + len(packet) > _MAX_DATAGRAM):
                for peer in self._peers:
                    # A peer that is gone answers with an ICMP error, and a full buffer drops: PX4 cares for neither.
                    with suppress(OSError):
                        self._socket.sendto(batch, peer)
                batch = b""
            batch += packet
        self._out.clear()

    # -- what comes in --------------------------------------------------------------------------------------------

    def _on_set_attitude_target(self, m: Any) -> None:
        if m.type_mask & mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE:
            return
        rate = bool(m.type_mask & mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE)
        self.world.autopilot.offer(
            self.world.time,
            SetPoint(
                interface=Interface.BODY_RATE if rate else Interface.ATTITUDE,
                thrust=self._force(m.thrust),
                q_WB=attitude_from_px4((m.q[0], m.q[1], m.q[2], m.q[3])),
                w_WB_B=body_from_px4((m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)),
            ),
        )

    def _force(self, set_point: float) -> float:
        """Thrust, N, that PX4's linearisation and the motors make of a set-point 0..1."""
        if not isfinite(set_point):
            return nan  # the autopilot ignores what is not finite
        vehicle = self.world.vehicle
        signal = motor_signal(min(max(set_point, 0.0), 1.0), self._parameters[_CURVE])
        voltage = self.world.snapshot.x[at.VOLTAGE] / rated_voltage(vehicle.battery)
        return 4.0 * vehicle.rotors.max_thrust * voltage**2 * thrust_fraction(signal, vehicle.rotors.curve)

    def _on_command(self, m: Any) -> None:
        target = (m.get_srcSystem(), m.get_srcComponent())
        self._send(mavlink.MAVLink_command_ack_message(m.command, self._do(m), 0, 0, *target))

    def _do(self, m: Any) -> int:
        if m.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            done = self._arm(m.param2 == _FORCE) if m.param1 == 1.0 else self._disarm(m.param2 == _FORCE)
            return _ACCEPTED if done else _REJECTED
        if m.command == mavlink.MAV_CMD_DO_SET_MODE:
            return self._set_mode((_whole(m.param2), max(_whole(m.param3), 0)))
        if m.command == mavlink.MAV_CMD_NAV_LAND:
            return self._set_mode(_MODES[FlightMode.LAND])
        if m.command == mavlink.MAV_CMD_DO_FLIGHTTERMINATION:
            if m.param1 >= 0.5:
                self._terminated = True
                self.world.autopilot.kill()
            return _ACCEPTED
        if m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return self._set_interval(_whole(m.param1), m.param2)
        requested = {
            mavlink.MAV_CMD_REQUEST_MESSAGE: _whole(m.param1),
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
        }.get(m.command)
        if requested is None:
            return _UNSUPPORTED
        if requested not in self._makers:
            return _DENIED
        self._send(self._makers[requested]())
        return _ACCEPTED

    def _arm(self, force: bool) -> bool:
        autopilot = self.world.autopilot
        if autopilot.armed:
            return True
        reason = ""
        if self._terminated:
            reason = "flight terminated"
        elif not force and autopilot.mode is FlightMode.OFFBOARD and not self._streaming():
            reason = "no offboard signal"
        elif not force and autopilot.mode is FlightMode.LAND:
            reason = "mode land"
        elif autopilot.killed:
            # Unlike a termination, motors cut by hand may run again once the vehicle stands.
            mode = autopilot.mode
            reason = "" if autopilot.disarm() and autopilot.switch(mode, self.world.time) else "not landed"
        if reason or not autopilot.arm():
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f"Arming denied: {reason}")
            return False
        return True

    def _disarm(self, force: bool) -> bool:
        autopilot = self.world.autopilot
        if not autopilot.armed:
            return True
        if force:
            autopilot.kill()
            return True
        mode = autopilot.mode
        if not autopilot.disarm():
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "Disarming denied: not landed")
            return False
        autopilot.mode = mode
        return True

    def _set_mode(self, numbers: tuple[int, int]) -> int:
        mode = _MODE_OF.get(numbers)
        if mode is None:
            return _DENIED
        if self.world.autopilot.switch(mode, self.world.time):
            return _ACCEPTED
        self._say(mavlink.MAV_SEVERITY_CRITICAL, f"Switching to mode '{mode}' is currently not available")
        return _REJECTED

    def _set_interval(self, number: int, microseconds: float) -> int:
        """MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops the stream, 0 is its default, else the interval."""
        if number not in self._makers:
            return _FAILED
        if not isfinite(microseconds):
            return _FAILED
        if microseconds == 0.0:
            rate = DEFAULT_RATES.get(number, 0.0)
            microseconds = 1e6 / rate if rate else -1.0
        if microseconds < 0.0:
            self._intervals.pop(number, None)
        else:
            self._intervals[number] = microseconds / 1e6
            self._due[number] = self.world.time
        return _ACCEPTED

    def _on_set_mode(self, m: Any) -> None:
        self._set_mode((m.custom_mode >> 16 & 0xFF, m.custom_mode >> 24 & 0xFF))

    def _on_param_list(self, m: Any) -> None:
        for name in self._parameters:
            self._send_param(name)

    def _on_param_read(self, m: Any) -> None:
        names = list(self._parameters)
        name = m.param_id if m.param_index < 0 else names[m.param_index] if m.param_index < len(names) else ""
        if name in self._parameters:
            self._send_param(name)

    def _on_param_set(self, m: Any) -> None:
        old = self._parameters.get(m.param_id)
        if old is None:
            return
        # PX4 carries an integer's bits in the float field.
        value = _bits_of_float(m.param_value) if isinstance(old, int) else m.param_value
        with suppress(ValueError):
            self._set_parameter(m.param_id, value)
        self._send_param(m.param_id)

    def _set_parameter(self, name: str, value: float | int) -> None:
        """Change a parameter; ValueError when there is none of that name, or the value is out of bounds."""
        if name != _CURVE and name not in _HELD:
            raise ValueError(f"PX4 stand-in: cannot set {name}; can set {', '.join(sorted((_CURVE, *_HELD)))}")
        if name in _HELD:
            autopilot = self.world.autopilot
            fields = {**msgspec.structs.asdict(autopilot.params), _HELD[name]: value}
            autopilot.params = msgspec.convert(fields, type(autopilot.params))
        elif not 0.0 <= value <= 1.0:
            raise ValueError(f"PX4 stand-in: {name} is {value}; want 0 to 1")
        self._parameters[name] = value

    def _send_param(self, name: str) -> None:
        value = self._parameters[name]
        integer = isinstance(value, int)
        kind = mavlink.MAV_PARAM_TYPE_INT32 if integer else mavlink.MAV_PARAM_TYPE_REAL32
        wire = _float_of_bits(int(value)) if integer else value
        index = list(self._parameters).index(name)
        self._send(mavlink.MAVLink_param_value_message(name.encode(), wire, kind, len(self._parameters), index))

    def _on_timesync(self, m: Any) -> None:
        now = self.world.snapshot.t_ns
        if m.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(now, m.ts1))
            return
        trip = now - m.ts1
        if trip >= 0 and (self._peer_clock is None or trip <= self._peer_clock[1]):
            self._peer_clock = ((m.ts1 + now) // 2 - m.tc1, trip)

    def _on_odometry(self, m: Any) -> None:
        """As PX4: other frames and less than EKF2_EV_QMIN are ignored, and without a common time it is of now."""
        known = (m.frame_id, m.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
        if not known or m.quality < self._parameters["EKF2_EV_QMIN"]:
            return
        q_WB = attitude_from_px4((m.q[0], m.q[1], m.q[2], m.q[3]))
        now = self.world.snapshot.t_ns
        self.vision = Odometry(
            t_ns=now if self._peer_clock is None else m.time_usec * 1000 + self._peer_clock[0],
            p_WB=world_from_px4((m.x, m.y, m.z)),
            q_WB=q_WB,
            v_WB=rotate(q_WB, body_from_px4((m.vx, m.vy, m.vz))),
            confidence=round(3 * m.quality / 100),
            reset_counter=m.reset_counter,
        )

    def _on_ping(self, m: Any) -> None:
        if m.target_system == 0:
            target = (m.get_srcSystem(), m.get_srcComponent())
            self._send(mavlink.MAVLink_ping_message(m.time_usec, m.seq, *target))

    # -- what goes out --------------------------------------------------------------------------------------------

    def _tell_changes(self) -> None:
        last, now = self._told, self.world.snapshot
        self._told = now
        if now.armed is not last.armed:
            self._say(mavlink.MAV_SEVERITY_INFO, "Armed" if now.armed else "Disarmed")
        if last.armed and last.mode is FlightMode.OFFBOARD and now.mode is FlightMode.LAND and not self._streaming():
            self._say(mavlink.MAV_SEVERITY_ERROR, "Failsafe activated: offboard signal lost, landing")
        if now.landed is not last.landed:
            text = "Takeoff detected" if now.landed is Landed.IN_AIR else "Landing detected"
            self._say(mavlink.MAV_SEVERITY_INFO, text)

    def _streaming(self) -> bool:
        return self.world.autopilot.streaming(self.world.time)

    def _say(self, severity: int, text: str) -> None:
        data = text.encode()
        if len(data) < _TEXT_CHUNK:
            self._send(mavlink.MAVLink_statustext_message(severity, data))
            return
        self._text_id = self._text_id % 0xFFFF + 1
        # A full last piece is followed by an empty one, so that the end is always seen.
        for chunk in range(len(data) // _TEXT_CHUNK + 1):
            piece = data[chunk * _TEXT_CHUNK : (chunk + 1) * _TEXT_CHUNK]
            self._send(mavlink.MAVLink_statustext_message(severity, piece, self._text_id, chunk))

    def _boot_ms(self) -> int:
        return round(self.world.time * 1e3)

    def _heartbeat(self) -> Any:
        autopilot = self.world.autopilot
        main, sub = _MODES[autopilot.mode]
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        status = mavlink.MAV_STATE_STANDBY
        if autopilot.armed:
            base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
            status = mavlink.MAV_STATE_ACTIVE
        if self._terminated:
            status = mavlink.MAV_STATE_FLIGHT_TERMINATION
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base, main << 16 | sub << 24, status, 3
        )

    def _timesync(self) -> Any:
        return mavlink.MAVLink_timesync_message(0, self.world.snapshot.t_ns)

    def _sys_status(self) -> Any:
        voltage, remaining = self._millivolts(), self._percent()
        healthy = _SENSORS if self._terminated else _SENSORS | mavlink.MAV_SYS_STATUS_PREARM_CHECK
        present = _SENSORS | mavlink.MAV_SYS_STATUS_PREARM_CHECK
        return mavlink.MAVLink_sys_status_message(
            present, present, healthy, 100, voltage, -1, remaining, 0, 0, 0, 0, 0, 0
        )

    def _attitude_quaternion(self) -> Any:
        state = self._state
        if state is None:
            return None
        q, w = px4_from_attitude(state.q_WB), px4_from_body(state.w_WB_B)
        return mavlink.MAVLink_attitude_quaternion_message(self._boot_ms(), *q, *w)

    def _highres_imu(self) -> Any:
        state = self._state
        if state is None:
            return None
        f, w = px4_from_body(state.f_B), px4_from_body(state.w_WB_B)
        unused = (0.0,) * 6
        return mavlink.MAVLink_highres_imu_message(round(self.world.time * 1e6), *f, *w, *unused, 25.0, _ACCEL_AND_GYRO)

    def _local_position(self) -> Any:
        x = self.world.snapshot.x
        p = px4_from_world((x[at.POSITION], x[at.POSITION + 1], x[at.POSITION + 2]))
        v = px4_from_world((x[at.VELOCITY], x[at.VELOCITY + 1], x[at.VELOCITY + 2]))
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
        return round(1e3 * self.world.snapshot.x[at.VOLTAGE])

    def _percent(self) -> int:
        return round(100.0 * self.world.snapshot.x[at.CHARGE])

    def _extended_sys_state(self) -> Any:
        return mavlink.MAVLink_extended_sys_state_message(0, _LANDED[self.world.autopilot.landed])

    def _home_position(self) -> Any:
        return mavlink.MAVLink_home_position_message(
            0, 0, 0, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], nan, nan, nan, round(self.world.time * 1e6)
        )

    def _autopilot_version(self) -> Any:
        return mavlink.MAVLink_autopilot_version_message(
            _CAPABILITIES, _VERSION, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 1
        )


def _whole(value: float) -> int:
    """A command's parameter as an integer; what is not finite stands for none given."""
    return int(value) if isfinite(value) else -1


def _float_of_bits(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def _bits_of_float(value: float) -> int:
    return int(struct.unpack("<i", struct.pack("<f", value))[0])
