"""A stand-in for PX4: our world behind MAVLink 2 on UDP.

``Px4StandIn`` puts PX4's commander in the place of the world's plain autopilot and speaks for it: what MAVSDK,
QGroundControl, MAVProxy and pymavlink need to connect and stay content, with PX4's refusals in PX4's words.
``receive`` takes what has arrived; once the world has been advanced by ``period``, ``publish`` sends what is due.
``start`` paces both on the wall clock in a thread of its own; a test may call ``step`` instead.

The parts: px4_commander (modes, arming, failsafes, landing), px4_estimator (position from vision), px4_parameters,
px4_streams (what is told), px4_link (the socket and its faults).

Alone, it flies the vehicle in real time for any client:
``python -m sim_backend.px4_emulator --bind 127.0.0.1:14580 --peer 127.0.0.1:14540``
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from math import inf, isfinite, nan
from pathlib import Path
from time import sleep
from typing import Any

import msgspec
import yaml
from pymavlink.dialects.v20 import common as mavlink

from drivers.frames import attitude_from_px4, body_from_px4, world_from_px4
from drivers.protocols import DeviceError
from drivers.px4_parameters import Value
from drivers.rotation import rotate
from drivers.samples import Interface, Odometry
from drivers.thrust import motor_signal, thrust_fraction
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.autopilot import SetPoint
from sim_backend.faults import Fault, Faults, Kind, add_fault_options, given_faults
from sim_backend.mock_devices import MockAutopilot
from sim_backend.motors import rated_voltage
from sim_backend.pace import Pace
from sim_backend.px4_commander import Commander, Severity
from sim_backend.px4_estimator import PositionEstimator
from sim_backend.px4_faults import DEVICE, KINDS
from sim_backend.px4_link import Address, Link
from sim_backend.px4_parameters import Parameters
from sim_backend.px4_streams import MODES, Streams
from sim_backend.world import World

_SYSTEM, _AUTOPILOT = 1, 1
_TEXT_CHUNK = 50
_GROUND_STATION_LOST = 2.5  # s
_FORCE = 21196.0
_ACCEPTED, _REJECTED, _DENIED, _UNSUPPORTED, _FAILED = 0, 1, 2, 3, 4  # MAV_RESULT
_MODE_OF = {numbers: mode for mode, numbers in MODES.items()}


class Px4StandIn:
    """The stand-in on one UDP socket.

    It is bound to ``bind`` (port 0: any free one; see ``port``) and sends to everybody who has written to it, and from
    the start to ``peer`` if one is given, as PX4 does to its onboard computer. It holds the parameters of
    configs/px4/x500.params; ``parameters`` are changes of them, by PX4's names. ``period`` is the time one step
    advances the world, s. Of ``faults`` it shows those of the device ``autopilot``; REBOOT stops the motors and
    forgets everything but the parameters. Raises DeviceError when the port cannot be had, ValueError for a parameter
    or fault that cannot be.
    """

    def __init__(
        self,
        world: World,
        *,
        bind: Address = ("127.0.0.1", 0),
        peer: Address | None = None,
        parameters: Mapping[str, Value] | None = None,
        period: float = 0.004,
        faults: Sequence[Fault] = (),
        seed: int = 0,
    ) -> None:
        self.world = world
        self.period = period
        self.faults = Faults(DEVICE, KINDS, faults)
        self.parameters = Parameters(world, parameters)
        #: Messages received so far, by name, and the newest of each name.
        self.received: Counter[str] = Counter()
        self.newest: dict[str, Any] = {}
        self._face = MockAutopilot(world)
        self._link = Link(bind, peer, _SYSTEM, _AUTOPILOT, self.faults, seed)
        self._rebooting = False
        self._handlers: dict[str, Callable[[Any], None]] = {
            "SET_ATTITUDE_TARGET": self._on_set_attitude_target,
            "COMMAND_LONG": self._on_command,
            "COMMAND_INT": self._on_command,
            "SET_MODE": self._on_set_mode,
            "PARAM_REQUEST_LIST": self._on_param_list,
            "PARAM_REQUEST_READ": self._on_param_read,
            "PARAM_SET": self._on_param_set,
            "HEARTBEAT": self._on_heartbeat,
            "TIMESYNC": self._on_timesync,
            "PING": self._on_ping,
            "ODOMETRY": self._on_odometry,
            "SET_GPS_GLOBAL_ORIGIN": self._on_global_origin,
        }
        self._boot()
        self._pace = Pace(world, (self,))

    def _boot(self) -> None:
        """Begin as PX4 does when power comes on."""
        world = self.world
        self.estimator = PositionEstimator(self._parameter, world.vehicle.gravity)
        self.commander = Commander(world.autopilot.params, world.vehicle, self._parameter, self.estimator, self._say)
        world.autopilot = self.commander
        self.streams = Streams(world, self.commander, self.estimator, self.faults, world.snapshot.t_ns)
        #: World time less the time of the peer that tells poses, ns, and the round trip that it was measured on.
        self._peer_clock: tuple[int, int] | None = None
        self._ground_station_s = -inf
        self._text_id = 0
        self._link.forget()

    def _parameter(self, name: str) -> float:
        return self.parameters[name]

    @property
    def port(self) -> int:
        """UDP port it listens on."""
        return self._link.port

    @property
    def sent(self) -> Counter[str]:
        """Messages sent so far, by name."""
        return self._link.sent

    @property
    def vision(self) -> Odometry | None:
        """Newest pose that was fused, in the world's axes and at the world's time."""
        return self.estimator.vision

    # -- life cycle -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Move the world on the wall clock, in a thread of its own, with no other face beside this one."""
        self._pace.start()

    def stop(self) -> None:
        """End the thread, if there is one, and close the socket. Safe to call twice."""
        self._pace.stop()
        self._link.close()

    @property
    def slipped(self) -> float:
        """Seconds since ``start`` that the world could not keep pace with the wall clock."""
        return self._pace.slipped

    def clock(self, t_ns: int) -> int:
        """World time as nanoseconds of the machine's monotonic clock, for mock devices beside this one."""
        return self._pace.clock(t_ns)

    def enter(self, phase: str) -> None:
        """The mission is in this phase: faults declared for it begin. May be told at every step."""
        self.faults.enter(phase, self.world.time)

    def step(self) -> None:
        """Take what has arrived, advance the world by one period, publish what is due."""
        self.receive()
        self.world.advance(self.period)
        self.publish()

    def receive(self) -> None:
        """Take the datagrams that have arrived, and do what they say."""
        for message in self._link.receive(self.world.time):
            name = message.get_type()
            self.received[name] += 1
            self.newest[name] = message
            handler = self._handlers.get(name)
            if handler is not None and getattr(message, "target_system", _SYSTEM) in (0, _SYSTEM):
                handler(message)

    def publish(self) -> None:
        """Look at the world as it now stands: tell what has changed, send what is due."""
        t = self.world.time
        if self._faults_reboot(t):
            return
        self._estimate(t)
        for message in self.streams.due():
            self._link.send(message)
        self._link.flush(t)

    def _faults_reboot(self, t: float) -> bool:
        """Whether it is booting. The motors stop when the power goes, and all is new when it comes back."""
        booting = self.faults.find(Kind.REBOOT, t) is not None
        if booting and not self._rebooting:
            self.commander.kill()
        elif self._rebooting and not booting:
            self._boot()
        self._rebooting = booting
        if booting:
            self._link.flush(t)  # shuts the socket
        return booting

    def _estimate(self, t: float) -> None:
        """Carry the estimator on, and let PX4's own flight follow it instead of the truth."""
        self.streams.state = state = self._face.latest()
        if state is None:
            return
        x, estimator = self.world.snapshot.x, self.estimator
        resting = not self.commander.armed and x[at.ON_GROUND] != 0.0
        estimator.predict(t, self.period, state.f_B, state.q_WB, x[at.POSITION + 2], x[at.VELOCITY + 2], resting)
        v = estimator.v_WB
        self.commander.velocity_error = (
            v[0] - x[at.VELOCITY],
            v[1] - x[at.VELOCITY + 1],
            v[2] - x[at.VELOCITY + 2],
        )

    # -- what comes in --------------------------------------------------------------------------------------------

    def _on_set_attitude_target(self, m: Any) -> None:
        if m.type_mask & mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE:
            return
        rate = bool(m.type_mask & mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE)
        self.commander.offer(
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
        signal = motor_signal(min(max(set_point, 0.0), 1.0), self._parameter("THR_MDL_FAC"))
        voltage = self.world.snapshot.x[at.VOLTAGE] / rated_voltage(vehicle.battery)
        return 4.0 * vehicle.rotors.max_thrust * voltage**2 * thrust_fraction(signal, vehicle.rotors.curve)

    def _on_command(self, m: Any) -> None:
        target = (m.get_srcSystem(), m.get_srcComponent())
        self._link.send(mavlink.MAVLink_command_ack_message(m.command, self._do(m), 0, 0, *target))

    def _do(self, m: Any) -> int:
        commander, t = self.commander, self.world.time
        if m.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            force = m.param2 == _FORCE
            if m.param1 not in (0.0, 1.0):
                return _UNSUPPORTED
            done = commander.try_arm(t, force) if m.param1 == 1.0 else commander.try_disarm(force)
            return _ACCEPTED if done else _REJECTED
        if m.command == mavlink.MAV_CMD_DO_SET_MODE:
            return self._set_mode((_whole(m.param2), max(_whole(m.param3), 0)))
        if m.command == mavlink.MAV_CMD_NAV_LAND:
            return self._set_mode((4, 6))
        if m.command == mavlink.MAV_CMD_DO_FLIGHTTERMINATION:
            if m.param1 >= 0.5:
                commander.terminate()
            return _ACCEPTED
        if m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return _ACCEPTED if self.streams.ask(_whole(m.param1), m.param2) else _FAILED
        requested = {
            mavlink.MAV_CMD_REQUEST_MESSAGE: _whole(m.param1),
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
        }.get(m.command)
        if requested is None:
            return _UNSUPPORTED
        if requested not in self.streams.makers:
            return _DENIED
        message = self.streams.make(requested)
        if message is not None:
            self._link.send(message)
        return _ACCEPTED

    def _set_mode(self, numbers: tuple[int, int]) -> int:
        mode = _MODE_OF.get(numbers)
        if mode is None:
            return _DENIED
        return _ACCEPTED if self.commander.switch(mode, self.world.time) else _REJECTED

    def _on_set_mode(self, m: Any) -> None:
        self._set_mode((m.custom_mode >> 16 & 0xFF, m.custom_mode >> 24 & 0xFF))

    def _on_param_list(self, m: Any) -> None:
        for name in self.parameters.names():
            self._send_param(name)

    def _on_param_read(self, m: Any) -> None:
        names = self.parameters.names()
        name = m.param_id if m.param_index < 0 else names[m.param_index] if m.param_index < len(names) else ""
        if name in self.parameters:
            self._send_param(name)

    def _on_param_set(self, m: Any) -> None:
        if m.param_id not in self.parameters:
            return
        try:
            self.parameters.set_wire(m.param_id, m.param_value)
        except ValueError as error:
            self._say(Severity.ERROR, str(error))
        self._send_param(m.param_id)

    def _send_param(self, name: str) -> None:
        field, kind = self.parameters.wire(name)
        index = self.parameters.names().index(name)
        self._link.send(mavlink.MAVLink_param_value_message(name.encode(), field, kind, len(self.parameters), index))

    def _on_timesync(self, m: Any) -> None:
        now = self.streams.now_ns()
        if m.tc1 == 0:
            self._link.send(mavlink.MAVLink_timesync_message(now, m.ts1))
            return
        trip = now - m.ts1
        if trip >= 0 and (self._peer_clock is None or trip <= self._peer_clock[1]):
            self._peer_clock = (self.world.snapshot.t_ns - trip // 2 - m.tc1, trip)

    def _on_odometry(self, m: Any) -> None:
        """As PX4: odd frames are ignored, and without a common time a pose is of now."""
        if (m.frame_id, m.child_frame_id) != (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD):
            return
        q_WB = attitude_from_px4((m.q[0], m.q[1], m.q[2], m.q[3]))
        now = self.world.snapshot.t_ns
        sample = Odometry(
            t_ns=now if self._peer_clock is None else min(now, m.time_usec * 1000 + self._peer_clock[0]),
            p_WB=world_from_px4((m.x, m.y, m.z)),
            q_WB=q_WB,
            v_WB=rotate(q_WB, body_from_px4((m.vx, m.vy, m.vz))),
            confidence=max(0, round(3 * m.quality / 100)),
            reset_counter=m.reset_counter,
        )
        self.estimator.fuse(self.world.time, sample, m.quality)

    def _on_global_origin(self, m: Any) -> None:
        self.commander.global_origin = True

    def _on_ping(self, m: Any) -> None:
        if m.target_system == 0:
            target = (m.get_srcSystem(), m.get_srcComponent())
            self._link.send(mavlink.MAVLink_ping_message(m.time_usec, m.seq, *target))

    def _on_heartbeat(self, m: Any) -> None:
        if m.type == mavlink.MAV_TYPE_GCS:
            self._ground_station_s = self.world.time

    def _say(self, severity: Severity, text: str) -> None:
        """A status text, in PX4's way: none before a ground station's heartbeat has come, and each with a number.

        PX4 puts a tab behind a text that it tells as an event too, which is nearly all of them. A long text comes in
        pieces, and no empty one follows where the last of them is full.
        """
        if self.world.time - self._ground_station_s > _GROUND_STATION_LOST:
            return
        data = text.encode() + b"\t"
        for chunk in range(-(-len(data) // _TEXT_CHUNK)):
            piece = data[chunk * _TEXT_CHUNK : (chunk + 1) * _TEXT_CHUNK]
            self._link.send(mavlink.MAVLink_statustext_message(severity, piece, self._text_id, chunk))
        self._text_id = (self._text_id + 1) % 0x10000


def _whole(value: float) -> int:
    """A command's parameter as an integer; what is not finite stands for none given."""
    return int(value) if isfinite(value) else -1


# -- alone, from the command line ---------------------------------------------------------------------------------


def _address(text: str) -> Address:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no address; want for example 127.0.0.1:14580")
    return host, int(port)


def _change(text: str) -> tuple[str, Value]:
    name, _, value = text.partition("=")
    try:
        return name, float(value) if set(value) & set(".eE") else int(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no parameter; want for example COM_OF_LOSS_T=1.0") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly the vehicle in real time behind MAVLink on UDP, with PX4's rules and faults on demand. Ctrl-C ends it."""
    parser = argparse.ArgumentParser(prog="px4_emulator", description=main.__doc__)
    here = Path(__file__).resolve().parent.parent / "configs" / "vehicle.yaml"
    parser.add_argument("--bind", type=_address, default=("127.0.0.1", 14580), help="listens here, as PX4's SITL does")
    parser.add_argument("--peer", type=_address, default=("127.0.0.1", 14540), help="sends here unasked")
    parser.add_argument("--vehicle", type=Path, default=here, help="vehicle file")
    add_fault_options(parser)
    parser.add_argument("--set", type=_change, action="append", default=[], help="a parameter: COM_OF_LOSS_T=1.0")
    parser.add_argument("--duration", type=float, default=None, help="seconds; none: until Ctrl-C")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    try:
        faults = given_faults(given)
        try:
            vehicle = msgspec.convert(yaml.safe_load(given.vehicle.read_text(encoding="utf-8")), Vehicle)
        except (yaml.YAMLError, msgspec.ValidationError) as error:
            raise ValueError(f"{given.vehicle}: {error}") from error
        stand_in = Px4StandIn(
            World(vehicle, seed=given.seed),
            bind=given.bind,
            peer=given.peer,
            parameters=dict(given.set),
            faults=faults,
            seed=given.seed,
        )
    except (DeviceError, ValueError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(f"PX4 stand-in on UDP {given.bind[0]}:{stand_in.port}, telling {given.peer[0]}:{given.peer[1]}\n")
    sys.stdout.flush()
    stand_in.start()
    try:
        while given.duration is None or stand_in.world.time < given.duration:
            sleep(0.1)
    except KeyboardInterrupt:
        pass
    finally:
        stand_in.stop()
    truth = stand_in.world.truth()
    sys.stdout.write(
        f"after {stand_in.world.time:.1f} s at {tuple(round(c, 3) for c in truth.p_WB)} m"
        f"{', ' + truth.crashed if truth.crashed else ''}; received {sum(stand_in.received.values())} messages, "
        f"fell {stand_in.slipped:.2f} s behind the wall clock\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
