"""What comes from devices and from a simulated world, damaged: rejected, and the next is understood."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from socket import AF_INET, SOCK_DGRAM, socket
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.dynamixel_settings import ServoSettings
from drivers.px4 import Px4
from drivers.samples import AutopilotCommand, Engage, Interface, JointMode, ServoCommand
from onboard.config import load_config
from sim_backend.dynamixel_emulator import emulate, order
from sim_backend.dynamixel_wire import BROADCAST, Instruction, Parser, packet
from sim_backend.world import World
from sim_backend.world_link import WorldServer
from sim_backend.world_messages import FOREIGN, Bye, Camera, Command, Hello, encode, from_world, to_world
from tests.drivers.px4_rig import settings
from tests.link.wrong_input import anything, damaged, examples, misspelt, plain, spoilt, yamlish

# --- PX4 --------------------------------------------------------------------------------------------------------------

#: One right message of each kind that the driver reads, as MAVSDK hands it over.
PX4_MESSAGES: dict[str, dict[str, Any]] = {
    "ATTITUDE_QUATERNION": {"time_boot_ms": 5, "q1": 1.0, "q2": 0.0, "q3": 0.0, "q4": 0.0,
                            "rollspeed": 0.1, "pitchspeed": 0.0, "yawspeed": 0.0},
    "HIGHRES_IMU": {"xacc": 0.0, "yacc": 0.0, "zacc": -9.81},
    "LOCAL_POSITION_NED": {"x": 0.0, "y": 0.0, "z": -1.0, "vx": 0.0, "vy": 0.0, "vz": 0.0},
    "HEARTBEAT": {"base_mode": 128, "custom_mode": 6 << 16},
    "EXTENDED_SYS_STATE": {"landed_state": 1},
    "BATTERY_STATUS": {"id": 0, "voltages": [16000, 65535], "battery_remaining": 90},
    "SYS_STATUS": {"onboard_control_sensors_health": 0x1000_0000},
    "STATUSTEXT": {"severity": 4, "text": "x" * 50, "id": 3, "chunk_seq": 0},
    "TIMESYNC": {"tc1": 5, "ts1": 3},
    "PARAM_VALUE": {"param_id": "EKF2_EV_CTRL", "param_type": 6, "param_value": 2.1e-44},
}  # fmt: skip


class Direct:
    """In the place of MAVSDK's plugin: keeps who listens to what."""

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[Any, object], None]] = {}

    def subscribe_message(self, name: str, hear: Callable[[Any, object], None]) -> None:
        self.heard[name] = hear

    def send_message(self, message: object) -> None:
        """Nobody is there."""

    def tell(self, name: str, fields: str) -> None:
        """As if it had come from the autopilot."""
        self.heard[name](SimpleNamespace(component_id=1, fields_json=fields), None)


@pytest.fixture
def listening(monkeypatch: pytest.MonkeyPatch) -> tuple[Px4, Direct]:
    """The driver with all of its subscriptions, connected to nothing."""
    direct, driver = Direct(), Px4(settings("udpin://127.0.0.1:1"))
    driver._direct = direct
    driver._subscribe_all()
    assert set(direct.heard) == set(PX4_MESSAGES)
    return driver, direct


def test_damaged_messages_of_px4(listening: tuple[Px4, Direct]) -> None:
    driver, direct = listening

    def whole(name: str, tree: Any) -> str:
        return msgspec.json.encode(tree, enc_hook=str).decode()

    wrong = st.sampled_from(sorted(PX4_MESSAGES)).flatmap(
        lambda name: st.tuples(
            st.just(name),
            spoilt(PX4_MESSAGES[name], plain).map(lambda tree: whole(name, tree))
            | damaged([whole(name, PX4_MESSAGES[name]).encode()]).map(
                lambda data: data.decode(errors="surrogateescape")
            )
            | st.sampled_from(["[" * 100_000, '{"x":' * 100_000, "1e999", "", "null", '{"param_value":1e300}']),
        )
    )

    @examples(600)
    @given(wrong)
    def feed(message: tuple[str, str]) -> None:
        direct.tell(*message)
        state = driver.latest()
        if state is not None:
            numbers = (*state.q_WB, *state.w_WB_B, *state.f_B)
            assert all(math.isfinite(number) for number in numbers)

    for name, fields in PX4_MESSAGES.items():
        direct.tell(name, whole(name, fields))
    assert driver.latest() is not None
    feed()
    for name, fields in PX4_MESSAGES.items():
        direct.tell(name, whole(name, fields))
    state = driver.latest()
    assert state is not None
    assert state.armed


# --- the servo bus ----------------------------------------------------------------------------------------------------

EMULATED = [ServoSettings(id=number) for number in (1, 2, 3, 4, 5)]
requests = st.builds(
    packet,
    st.sampled_from([0, 1, 2, 5, 252, BROADCAST, 255]),
    st.sampled_from([int(code) for code in Instruction]) | st.integers(0, 255),
    st.one_of(
        st.binary(max_size=40),
        st.builds(
            lambda address, size, rest: address.to_bytes(2, "little") + size.to_bytes(2, "little") + rest,
            st.integers(0, 300) | st.integers(0, 65535),
            st.integers(0, 10) | st.sampled_from([146, 147, 1000, 0x7FFF, 0xFFFF]),
            st.binary(max_size=30) | st.just(bytes(range(1, 6))),
        ),
    ),
)


def test_any_bytes_on_the_servo_bus() -> None:
    """Whatever passes on it, a servo that is asked for its model afterwards tells it."""
    emulator = emulate(EMULATED, wire=False)
    bus, parser = emulator.bus, Parser()
    clock = 0.0

    def put(data: bytes) -> list[bytes]:
        nonlocal clock
        clock += 0.01
        return [bus.handle(each, clock)[0] for each in parser.feed(data)]

    @examples(500)
    @given(st.lists(requests | damaged([packet(1, 3, bytes(6))]) | st.binary(max_size=40), min_size=1, max_size=6))
    def feed(pieces: list[bytes]) -> None:
        for piece in pieces:
            put(piece)

    try:
        feed()
        clock += 10.0
        answers = put(b"\x00" * 2000 + packet(BROADCAST, Instruction.PING))
        assert answers[-1]
    finally:
        emulator.stop()


@pytest.mark.parametrize("code", [Instruction.FAST_SYNC_READ, Instruction.SYNC_READ, Instruction.READ])
def test_a_read_of_more_than_a_packet_holds(code: Instruction) -> None:
    emulator = emulate(EMULATED, wire=False)
    try:
        whom = bytes(range(1, 6)) if code is not Instruction.READ else b""
        (wrong,) = Parser().feed(packet(BROADCAST if whom else 1, code, b"\x84\x00\xff\xff" + whom))
        emulator.bus.handle(wrong, 0.1)
        (right,) = Parser().feed(packet(1, Instruction.PING))
        assert emulator.bus.handle(right, 0.2)[0]
    finally:
        emulator.stop()


def test_any_line_for_the_emulator_of_the_bus() -> None:
    emulator = emulate(EMULATED, wire=False)

    @examples(150)
    @given(misspelt(["{device: servos, kind: silent, part: theta_2, duration: 2}", "clear"]) | yamlish)
    def feed(line: str) -> None:
        order(emulator, line)
        emulator.bus.update(emulator.time)

    try:
        feed()
    finally:
        emulator.stop()


# --- the simulated world ----------------------------------------------------------------------------------------------

LEVEL = (1.0, 0.0, 0.0, 0.0)
COMMAND = Command(
    AutopilotCommand(Engage.OFFBOARD, Interface.ATTITUDE, 20.0, (0.0,) * 3, LEVEL, (0.0,) * 3),
    ServoCommand(JointMode.TORQUE, (0.0,) * 3, (0.0,) * 5, 0.5),
)
SAYINGS = (COMMAND, Hello(True, "press", ("autopilot", "odometry", "servos")), Bye())


@contextmanager
def served() -> Iterator[tuple[World, Callable[[bytes], None]]]:
    """A world, and what puts a datagram to it."""
    config = load_config("paper")
    world = World(config.vehicle, config.world)
    server = WorldServer(world, lambda t_ns: t_ns)
    host, _, port = server.address.rpartition(":")
    with socket(AF_INET, SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.setblocking(False)

        def say(datagram: bytes) -> None:
            client.sendto(datagram, (host, int(port)))
            server.receive()
            server.publish()
            world.advance(0.004)
            try:
                while True:
                    from_world(client.recv(65_507))
            except BlockingIOError:
                pass

        try:
            yield world, say
        finally:
            server.close()


datagrams = st.one_of(
    st.sampled_from([msgspec.to_builtins(message) for message in SAYINGS])
    .flatmap(lambda tree: spoilt(tree, anything))
    .map(msgspec.msgpack.encode),
    damaged([encode(message) for message in SAYINGS]),
    st.binary(max_size=60),
    st.sampled_from(
        [b"\xa2\xff\xfe", b"\x81\xa4type\xa2\xff\xfe", b"\x91" * 5000, b"\x82\xa4type\xa5Hello\xa1x" + b"\x91" * 5000]
    ),
)


def test_any_datagram_for_the_world() -> None:
    with served() as (world, say):

        @examples(500)
        @given(datagrams)
        def feed(datagram: bytes) -> None:
            say(datagram)
            truth = world.truth()
            assert all(math.isfinite(x) for x in (*truth.p_WB, *truth.q_WB, *truth.joints, *truth.rotor_thrust))

        for _ in range(200):
            say(encode(COMMAND))
        assert world.snapshot.armed
        feed()


@examples(300)
@given(datagrams | damaged([encode(Camera(False, ()))]))
def test_any_datagram_from_a_world(datagram: bytes) -> None:
    for read in (from_world, to_world):
        try:
            read(datagram)
        except FOREIGN:
            continue
