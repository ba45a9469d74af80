"""The PX4 stand-in on its real socket, stepped by the test: no thread, no waiting."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from math import nan
from socket import AF_INET, SOCK_DGRAM, socket

import pytest
from pymavlink.dialects.v20 import common as mavlink

from drivers.protocols import DeviceError
from drivers.px4_parameters import read_parameter_file
from drivers.samples import FlightMode, Landed
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.px4_commander import Severity
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.px4_parameters import FILE
from sim_backend.world import World
from tests.sim_backend.px4_client import (
    ACCEPTED,
    ARM,
    DENIED,
    FAILED,
    FORCE,
    INTERVAL,
    LAND,
    LEVEL_EAST,
    LEVEL_RATES,
    OFFBOARD,
    REJECTED,
    REQUEST,
    SET_MODE,
    TERMINATE,
    UNSUPPORTED,
    Client,
    of,
)


@pytest.fixture
def client(vehicle: Vehicle) -> Iterator[Client]:
    stand_in = Px4StandIn(World(vehicle))
    client = Client(stand_in)
    yield client
    client.socket.close()
    stand_in.stop()


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
    assert (position.x, position.y, position.z) == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)  # where it was switched on


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


def test_offboard_needs_a_stream(client: Client) -> None:
    """Disarmed, the mode can be chosen, but not armed in without set-points; armed, not even chosen."""
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    assert client.command(ARM, 1.0) == REJECTED
    assert client.texts() == ["Arming denied: Resolve system health failures first"]
    client.run(0.1, 0.3)
    assert client.command(ARM, 1.0) == ACCEPTED
    client.sees = True
    client.run(0.3, 0.3)
    assert client.command(SET_MODE, *LAND) == ACCEPTED
    client.run(0.7)
    assert client.command(SET_MODE, *OFFBOARD) == REJECTED


def test_hold_wants_a_global_position_to_arm(client: Client) -> None:
    """As in PX4: nobody arms in Hold on vision alone, and attitude offboard does without vision."""
    client.sees = True
    client.run(0.2)
    assert client.command(ARM, 1.0) == REJECTED
    client.send(mavlink.MAVLink_set_gps_global_origin_message(1, 473977000, 85456000, 400000))
    assert client.command(ARM, 1.0) == ACCEPTED


def test_prearm_check_follows_the_mode(client: Client) -> None:
    def passes() -> bool:
        assert client.command(REQUEST, 1) == ACCEPTED
        healthy = of(client.seen, "SYS_STATUS")[-1].onboard_control_sensors_health
        return bool(healthy & mavlink.MAV_SYS_STATUS_PREARM_CHECK)

    assert not passes()
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    client.run(0.1, 0.3)
    assert passes()


def test_thrust_is_what_was_asked(client: Client) -> None:
    """Set-point 0.4: 4 x 13 N x 0.4 at half battery; the square of the voltage says what it is now."""
    client.fly()
    truth = client.world.truth()
    want = 52.0 * 0.4 * (truth.battery_voltage / 15.0) ** 2
    assert sum(truth.rotor_thrust) == pytest.approx(want, rel=0.01)


def test_silence_lands_and_disarms(client: Client) -> None:
    client.sees = True
    client.fly()
    client.run(0.45)
    assert client.mode() is FlightMode.OFFBOARD
    client.run(0.15)
    assert client.mode() is FlightMode.LAND
    assert client.texts()[-1] == "Failsafe activated"
    client.run(8.0)
    assert client.texts()[-2:] == ["Landing detected", "Disarmed by landing"]
    assert client.landed() is Landed.ON_GROUND
    assert not client.armed()
    assert not client.world.truth().crashed
    assert client.mode() is FlightMode.OFFBOARD  # the last mode in which one may arm
    assert client.command(ARM, 1.0) == REJECTED
    assert client.command(SET_MODE, *LAND) == ACCEPTED
    client.run(0.1, 0.3)
    assert client.command(ARM, 1.0) == REJECTED
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    assert client.command(ARM, 1.0) == ACCEPTED


def test_silence_without_vision_descends_level(client: Client) -> None:
    """Land wants a local position; Descend keeps level and drifts, and comes down all the same."""
    client.fly()
    client.world.plant.x[at.VELOCITY] = 0.5
    client.run(0.6)
    assert client.mode() is FlightMode.LAND  # so Descend is told
    client.run(1.0)
    truth = client.world.truth()
    assert truth.v_WB[0] > 0.4  # nobody stops it
    assert truth.v_WB[2] < -0.3
    client.run(8.0)
    assert not client.armed()


@pytest.mark.parametrize(
    ("action", "mode", "armed", "word"),
    [
        (0, FlightMode.LAND, True, "Failsafe activated"),  # Position wants sticks, and NAV_RCL_ACT is Land
        (3, FlightMode.LAND, True, "Failsafe activated"),  # Return wants a home
        (4, FlightMode.LAND, True, "Failsafe activated"),
        (5, FlightMode.LAND, True, "Failsafe activated"),  # Hold wants a global position
        (6, FlightMode.OFFBOARD, False, "Failsafe activated"),
        (7, FlightMode.OFFBOARD, False, "Disarmed by failsafe"),
    ],
)
def test_what_is_done_about_silence(vehicle: Vehicle, action: int, mode: FlightMode, armed: bool, word: str) -> None:
    stand_in = Px4StandIn(World(vehicle), parameters={"COM_OBL_RC_ACT": action})
    client = Client(stand_in)
    client.sees = True
    try:
        client.fly()
        client.run(0.6)
        assert (client.mode(), client.armed()) == (mode, armed)
        assert any(word in text for text in client.texts())
    finally:
        client.socket.close()
        stand_in.stop()


def test_hold_with_a_global_position(vehicle: Vehicle) -> None:
    stand_in = Px4StandIn(World(vehicle), parameters={"COM_OBL_RC_ACT": 5})
    client = Client(stand_in)
    client.sees = True
    try:
        client.send(mavlink.MAVLink_set_gps_global_origin_message(1, 473977000, 85456000, 400000))
        client.fly()
        client.run(2.6)
        assert client.mode() is FlightMode.HOLD
        before = client.world.truth().p_WB
        client.run(2.0)
        assert client.world.truth().p_WB == pytest.approx(before, abs=0.05)
        client.sees = False
        client.run(6.0)
        assert client.mode() is FlightMode.LAND
        assert client.texts()[-1] == "Failsafe activated"
    finally:
        client.socket.close()
        stand_in.stop()


def test_little_thrust_without_motion_is_a_landing(client: Client) -> None:
    """PX4's land detector in attitude offboard: no descent need be commanded, and no ground be there."""
    client.fly()
    assert client.landed() is Landed.IN_AIR
    x = client.world.plant.x
    for _ in range(300):
        x[at.VELOCITY : at.VELOCITY + 3] = 0.0  # something holds the vehicle
        client.run(0.004, 0.15)
    assert client.landed() is Landed.IN_AIR  # above MPC_MANTHR_MIN: contact, but no landing
    for _ in range(280):
        x[at.VELOCITY : at.VELOCITY + 3] = 0.0
        client.run(0.004, 0.08)
    assert client.landed() is Landed.ON_GROUND
    assert client.texts()[-1] == "Landing detected"
    client.run(0.02, 0.3)
    assert client.landed() is Landed.IN_AIR


def test_who_does_not_take_off_is_disarmed(vehicle: Vehicle) -> None:
    stand_in = Px4StandIn(World(vehicle), parameters={"COM_DISARM_PRFLT": 2.0})
    client = Client(stand_in)
    try:
        client.run(0.1, 0.05)
        assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
        assert client.command(ARM, 1.0) == ACCEPTED
        client.run(1.9, 0.05)
        assert client.armed()
        client.run(0.2, 0.05)
        assert not client.armed()
        assert client.texts()[-1] == "Disarmed by auto preflight disarming"
    finally:
        client.socket.close()
        stand_in.stop()


def test_an_empty_battery_lands(client: Client) -> None:
    client.sees = True
    client.fly()
    charge = client.world.plant.x
    charge[at.CHARGE] = 0.14
    client.run(0.1, 0.45)
    assert "Low battery" in client.texts()
    assert client.mode() is FlightMode.OFFBOARD
    charge[at.CHARGE] = 0.06
    client.run(0.1, 0.45)
    assert "Critical battery" in client.texts()
    assert client.mode() is FlightMode.LAND
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED  # who commands it may take it back
    client.run(0.1, 0.45)
    assert client.mode() is FlightMode.OFFBOARD


def test_an_empty_battery_does_not_arm(client: Client) -> None:
    client.world.plant.x[at.CHARGE] = 0.06
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    client.run(0.1, 0.3)
    assert client.command(ARM, 1.0) == REJECTED
    assert "Critical battery" in client.texts()


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
    assert client.command(ARM, 1.0, FORCE) == ACCEPTED
    assert client.command(ARM, 0.0, FORCE) == ACCEPTED
    assert client.command(ARM, 1.0, FORCE) == ACCEPTED
    assert client.command(TERMINATE, 1.0) == ACCEPTED
    assert client.command(ARM, 1.0) == REJECTED
    assert client.command(ARM, 1.0, FORCE) == REJECTED
    assert of(client.run(1.1), "HEARTBEAT")[-1].system_status == mavlink.MAV_STATE_FLIGHT_TERMINATION


def test_bad_set_points_are_no_stream(client: Client) -> None:
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    client.run(0.6, nan)
    assert client.command(ARM, 1.0) == REJECTED
    client.run(0.6, 0.3, LEVEL_RATES | mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE)
    assert client.command(ARM, 1.0) == REJECTED


def test_set_points_for_another_system_are_ignored(client: Client) -> None:
    for _ in range(200):
        client.send(mavlink.MAVLink_set_attitude_target_message(0, 7, 1, 128, LEVEL_EAST, 0.0, 0.0, 0.0, 0.3))
        client.run(0.004)
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    assert client.command(ARM, 1.0) == REJECTED


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
    with pytest.raises(ValueError, match=r"no parameter COM_OF_LOSS; want perhaps COM_OF_LOSS_T"):
        Px4StandIn(World(vehicle), parameters={"COM_OF_LOSS": 1.0})
    with pytest.raises(ValueError, match=r"EKF2_EV_CTRL is 7\.5; want a whole number"):
        Px4StandIn(World(vehicle), parameters={"EKF2_EV_CTRL": 7.5})
    with pytest.raises(ValueError, match=r"COM_OF_LOSS_T is 99\.0: .*<= 5"):
        Px4StandIn(World(vehicle), parameters={"COM_OF_LOSS_T": 99.0})


def test_it_holds_the_parameters_of_the_vehicle(vehicle: Vehicle) -> None:
    stand_in = Px4StandIn(World(vehicle))
    stand_in.stop()
    wanted = read_parameter_file(FILE)
    assert {name: pytest.approx(stand_in.parameters[name]) for name in wanted} == wanted


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
    """As PX4 sends them: a number for each text, a tab at its end, and no empty piece behind a full one."""
    client.run(0.004)
    client.stand_in._say(Severity.INFO, "x" * 99)
    client.stand_in._say(Severity.INFO, "y" * 50)
    pieces = of(client.run(0.004), "STATUSTEXT")
    assert [(len(p.text), p.chunk_seq) for p in pieces] == [(50, 0), (50, 1), (50, 0), (1, 1)]
    assert [p.id - pieces[0].id for p in pieces] == [0, 0, 1, 1]
    assert client.texts() == ["x" * 99, "y" * 50]


def test_texts_are_for_ground_stations(client: Client) -> None:
    client.beats = False
    client.run(3.0)
    client.stand_in._say(Severity.INFO, "nobody hears this")
    assert not of(client.run(0.1), "STATUSTEXT")
    client.beats = True
    client.run(0.1)
    client.stand_in._say(Severity.INFO, "this is heard")
    assert of(client.run(0.1), "STATUSTEXT")
