"""The PX4 stand-in on its real socket, stepped by the test: no thread, no waiting."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from math import nan
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from drivers.protocols import DeviceError
from drivers.samples import FlightMode, Landed
from drivers.vehicle import Vehicle
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.world import World

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4
ARM, SET_MODE, TERMINATE, INTERVAL, REQUEST = 400, 176, 185, 511, 512
OFFBOARD, HOLD, LAND = (1.0, 6.0, 0.0), (1.0, 4.0, 3.0), (1.0, 4.0, 6.0)
FORCE = 21196.0
LEVEL_EAST = (0.5**0.5, 0.0, 0.0, 0.5**0.5)  # PX4's quaternion of the identity in W
LEVEL_RATES, LEVEL_ATTITUDE = 128, 7


class Client:
    """A plain MAVLink client of one stand-in."""

    def __init__(self, stand_in: Px4StandIn) -> None:
        self.stand_in = stand_in
        self.world = stand_in.world
        self.socket = socket(AF_INET, SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self.parser = mavlink.MAVLink(None)
        self.seen: list[Any] = []
        self.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), ("127.0.0.1", self.stand_in.port))

    def run(self, seconds: float, thrust: float | None = None, mask: int = LEVEL_RATES) -> list[Any]:
        """Step the stand-in, with a set-point before each step if a thrust is given; what it said meanwhile."""
        seen: list[Any] = []
        for _ in range(round(seconds / self.stand_in.period)):
            if thrust is not None:
                self.send(mavlink.MAVLink_set_attitude_target_message(0, 1, 1, mask, LEVEL_EAST, 0.0, 0.0, 0.0, thrust))
            self.stand_in.step()
            seen += self.receive()
        self.seen += seen
        return seen

    def receive(self) -> list[Any]:
        messages: list[Any] = []
        while True:
            try:
                data = self.socket.recv(4096)
            except BlockingIOError:
                return messages
            messages += self.parser.parse_buffer(data) or []

    def command(self, command: int, *params: float) -> int:
        """Result of one COMMAND_LONG."""
        padded = (*params, *(nan,) * (7 - len(params)))
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *padded))
        (ack,) = [m for m in self.run(0.004) if m.get_type() == "COMMAND_ACK"]
        assert ack.command == command
        assert (ack.target_system, ack.target_component) == (1, 191)
        return int(ack.result)

    def mode(self) -> FlightMode:
        return self.world.autopilot.mode

    def armed(self) -> bool:
        return self.world.autopilot.armed

    def texts(self) -> list[str]:
        return [m.text for m in self.seen if m.get_type() == "STATUSTEXT"]

    def fly(self) -> None:
        """Arm in offboard and climb off the ground."""
        self.run(0.6, 0.3)
        assert self.command(SET_MODE, *OFFBOARD) == ACCEPTED
        assert self.command(ARM, 1.0) == ACCEPTED
        self.run(1.2, 0.4)
        assert self.world.truth().p_WB[2] > 0.4


@pytest.fixture
def client(vehicle: Vehicle) -> Iterator[Client]:
    stand_in = Px4StandIn(World(vehicle))
    client = Client(stand_in)
    yield client
    client.socket.close()
    stand_in.stop()


def of(messages: list[Any], name: str) -> list[Any]:
    return [m for m in messages if m.get_type() == name]


def test_heartbeat_is_a_px4(client: Client) -> None:
    beat = of(client.run(0.1), "HEARTBEAT")[0]
    assert (beat.autopilot, beat.type) == (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_TYPE_QUADROTOR)
    assert beat.custom_mode == 4 << 16 | 3 << 24
    assert not beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def test_attitude_and_imu_in_the_wire_frames(client: Client) -> None:
    """The vehicle starts level along +x of W, which is east, and its accelerometer reads -g along down."""
    seen = client.run(0.1)
    attitude, imu = of(seen, "ATTITUDE_QUATERNION")[-1], of(seen, "HIGHRES_IMU")[-1]
    assert (attitude.q1, attitude.q2, attitude.q3, attitude.q4) == pytest.approx(LEVEL_EAST, abs=1e-3)
    assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx((0.0, 0.0, -9.80665), abs=0.01)
    position = of(seen, "LOCAL_POSITION_NED")[-1]
    assert position.z == pytest.approx(-client.world.truth().p_WB[2], abs=1e-4)


def test_asked_rates_are_kept_in_the_mean(client: Client) -> None:
    assert client.command(INTERVAL, 31, 4000.0) == ACCEPTED
    assert client.command(INTERVAL, 105, 10_000.0) == ACCEPTED
    assert client.command(INTERVAL, 32, -1.0) == ACCEPTED
    seen = client.run(2.0)
    assert len(of(seen, "ATTITUDE_QUATERNION")) == 500
    assert len(of(seen, "HIGHRES_IMU")) in (200, 201)
    assert not of(seen, "LOCAL_POSITION_NED")
    assert client.command(INTERVAL, 32, 0.0) == ACCEPTED  # back to the default of 30 Hz
    assert len(of(client.run(1.0), "LOCAL_POSITION_NED")) in (30, 31)


def test_unknown_requests_are_answered(client: Client) -> None:
    assert client.command(INTERVAL, 9999, 4000.0) == FAILED
    assert client.command(REQUEST, 9999) == DENIED
    assert client.command(12345) == UNSUPPORTED
    assert client.command(SET_MODE, 1.0, 9.0, 9.0) == DENIED


def test_message_on_request(client: Client) -> None:
    assert client.command(REQUEST, 148) == ACCEPTED
    version = of(client.seen, "AUTOPILOT_VERSION")[0]
    assert version.flight_sw_version >> 16 == 1 << 8 | 16
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET


def test_offboard_needs_a_stream_first(client: Client) -> None:
    assert client.command(SET_MODE, *OFFBOARD) == REJECTED
    assert any("offboard" in text for text in client.texts())
    client.run(0.6, 0.3)
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    client.run(0.7)
    assert client.command(ARM, 1.0) == REJECTED
    assert any("no offboard signal" in text for text in client.texts())


def test_thrust_is_what_was_asked(client: Client) -> None:
    """Set-point 0.4: 4 x 13 N x 0.4 at half battery; the square of the voltage says what it is now."""
    client.fly()
    truth = client.world.truth()
    want = 52.0 * 0.4 * (truth.battery_voltage / 15.0) ** 2
    assert sum(truth.rotor_thrust) == pytest.approx(want, rel=0.01)


def test_silence_lands_and_disarms(client: Client) -> None:
    client.fly()
    client.run(0.45)
    assert client.mode() is FlightMode.OFFBOARD
    client.run(0.15)
    assert client.mode() is FlightMode.LAND
    assert any("offboard signal lost" in text for text in client.texts())
    client.run(8.0)
    assert client.world.autopilot.landed is Landed.ON_GROUND
    assert not client.armed()
    assert not client.world.truth().crashed
    assert client.command(ARM, 1.0) == REJECTED  # mode land


def test_loss_time_is_a_parameter(vehicle: Vehicle) -> None:
    stand_in = Px4StandIn(World(vehicle), parameters={"COM_OF_LOSS_T": 1.0})
    client = Client(stand_in)
    try:
        client.run(0.6, 0.3)
        assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
        assert client.command(ARM, 1.0) == ACCEPTED
        client.run(0.9)
        assert client.mode() is FlightMode.OFFBOARD
        client.run(0.2)
        assert client.mode() is FlightMode.LAND
    finally:
        client.socket.close()
        stand_in.stop()


def test_disarming_in_the_air_needs_force(client: Client) -> None:
    client.fly()
    assert client.command(ARM, 0.0) == REJECTED
    assert client.armed()
    assert client.command(ARM, 0.0, FORCE) == ACCEPTED
    assert not client.armed()
    client.run(0.3)
    assert sum(client.world.truth().rotor_thrust) == pytest.approx(0.0, abs=0.1)


def test_arming_again_after_a_forced_disarm_on_the_ground(client: Client) -> None:
    assert client.command(ARM, 1.0) == ACCEPTED
    assert client.command(ARM, 0.0, FORCE) == ACCEPTED
    assert client.command(ARM, 1.0) == ACCEPTED
    assert client.command(TERMINATE, 1.0) == ACCEPTED
    assert client.command(ARM, 1.0) == REJECTED
    assert client.command(ARM, 1.0, FORCE) == REJECTED
    assert of(client.run(1.1), "HEARTBEAT")[-1].system_status == mavlink.MAV_STATE_FLIGHT_TERMINATION


def test_bad_set_points_are_no_stream(client: Client) -> None:
    client.run(0.6, nan)
    assert client.command(SET_MODE, *OFFBOARD) == REJECTED
    client.run(0.6, 0.3, LEVEL_RATES | mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE)
    assert client.command(SET_MODE, *OFFBOARD) == REJECTED


def test_set_points_for_another_system_are_ignored(client: Client) -> None:
    for _ in range(200):
        client.send(mavlink.MAVLink_set_attitude_target_message(0, 7, 1, 128, LEVEL_EAST, 0.0, 0.0, 0.0, 0.3))
        client.run(0.004)
    assert client.command(SET_MODE, *OFFBOARD) == REJECTED


def test_rubbish_is_survived(client: Client) -> None:
    client.socket.sendto(bytes(range(250)), ("127.0.0.1", client.stand_in.port))
    client.socket.sendto(b"", ("127.0.0.1", client.stand_in.port))
    assert client.command(REQUEST, 148) == ACCEPTED


def test_parameters(client: Client) -> None:
    client.send(mavlink.MAVLink_param_request_list_message(1, 1))
    listed = of(client.run(0.004), "PARAM_VALUE")
    assert [p.param_index for p in listed] == list(range(len(listed)))
    assert {p.param_count for p in listed} == {len(listed)}
    by_name = {p.param_id: p for p in listed}
    assert by_name["COM_OF_LOSS_T"].param_value == pytest.approx(0.5)
    bits = struct.unpack("<i", struct.pack("<f", by_name["SYS_AUTOSTART"].param_value))[0]
    assert (by_name["SYS_AUTOSTART"].param_type, bits) == (mavlink.MAV_PARAM_TYPE_INT32, 4019)

    client.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 0.8, mavlink.MAV_PARAM_TYPE_REAL32))
    assert of(client.run(0.004), "PARAM_VALUE")[0].param_value == pytest.approx(0.8)
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 99.0, mavlink.MAV_PARAM_TYPE_REAL32))
    assert of(client.run(0.004), "PARAM_VALUE")[0].param_value == pytest.approx(0.8)
    client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"THR_MDL_FAC", -1))
    assert of(client.run(0.004), "PARAM_VALUE")[0].param_value == pytest.approx(0.3)


def test_a_parameter_that_cannot_be_set(vehicle: Vehicle) -> None:
    with pytest.raises(ValueError, match=r"cannot set COM_OF_LOSS; can set COM_DISARM_LAND, COM_OF_LOSS_T"):
        Px4StandIn(World(vehicle), parameters={"COM_OF_LOSS": 1.0})


def test_timesync_and_ping(client: Client) -> None:
    client.run(0.1)
    client.send(mavlink.MAVLink_timesync_message(0, 123))
    client.send(mavlink.MAVLink_ping_message(5, 6, 0, 0))
    seen = client.run(0.004)
    (sync,) = of(seen, "TIMESYNC")
    assert (sync.tc1, sync.ts1) == (100_000_000, 123)
    assert [m.seq for m in of(seen, "PING")] == [6]


def test_telling_to_a_peer_unasked(vehicle: Vehicle) -> None:
    """As PX4 does towards its onboard computer's port."""
    with socket(AF_INET, SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        stand_in = Px4StandIn(World(vehicle), peer=listener.getsockname())
        try:
            stand_in.step()
            messages = mavlink.MAVLink(None).parse_buffer(listener.recv(4096))
        finally:
            stand_in.stop()
    assert "HEARTBEAT" in [m.get_type() for m in messages]


def test_a_taken_port_is_told(vehicle: Vehicle) -> None:
    with socket(AF_INET, SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(DeviceError, match=r"cannot listen on UDP 127\.0\.0\.1"):
            Px4StandIn(World(vehicle), bind=other.getsockname())


def test_long_texts_come_in_pieces(client: Client) -> None:
    client.run(0.004)
    client.stand_in._say(mavlink.MAV_SEVERITY_INFO, "x" * 100)
    pieces = of(client.run(0.004), "STATUSTEXT")
    assert [(len(p.text), p.chunk_seq) for p in pieces] == [(50, 0), (50, 1), (0, 2)]
    assert len({p.id for p in pieces} - {0}) == 1
