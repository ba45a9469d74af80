"""The PX4 driver over MAVSDK and UDP, against the stand-in: its bytes, its refusals, and what it survives."""

from __future__ import annotations

import struct
import time
from collections.abc import AsyncIterator
from math import cos, inf, isnan, nan, pi, sin
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

import msgspec
import pytest
import pytest_asyncio

from drivers.mailbox import Level
from drivers.protocols import DeviceError
from drivers.px4 import Px4, Px4Settings
from drivers.rotation import rotate
from drivers.samples import AutopilotCommand, Engage, FlightMode, Interface, Odometry
from sim_backend import layout as at
from sim_backend.px4_commander import Severity
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.world import World
from tests.drivers.px4_rig import LEVEL, VEHICLE, command, linked, settings, until

pytestmark = pytest.mark.asyncio


@pytest_asyncio.fixture
async def pair() -> AsyncIterator[tuple[Px4, Px4StandIn]]:
    async with linked(Px4StandIn(World(VEHICLE))) as found:
        yield found


def free_port() -> int:
    with socket(AF_INET, SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def test_nobody_there() -> None:
    px4 = Px4(settings(f"udpin://127.0.0.1:{free_port()}", timeout=0.3))
    with pytest.raises(DeviceError, match=r"no heartbeat on udpin://127\.0\.0\.1:\d+ within 0\.3 s; is PX4 powered"):
        await px4.start()
    assert px4.latest() is None
    await px4.stop()


@pytest.mark.parametrize("url", ["nonsense", "udpin://127.0.0.1:notaport", "serial:///dev/no-such-port:921600"])
async def test_a_url_that_cannot_be_opened(url: str) -> None:
    with pytest.raises(DeviceError, match=f"cannot open {url} .*want for example serial:///dev/ttyTHS1:921600"):
        await Px4(settings(url, timeout=0.3)).start()


async def test_no_url() -> None:
    with pytest.raises(DeviceError, match="no URL of PX4 in the settings; want for example serial"):
        await Px4(settings("")).start()


async def test_no_thrust_map() -> None:
    with pytest.raises(ValueError, match=r"no thrust map; want thrust in its settings"):
        Px4(Px4Settings(url="udpin://127.0.0.1:0"))


async def test_a_taken_port() -> None:
    with socket(AF_INET, SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(DeviceError, match=r"cannot open .*no other process on that port"):
            await Px4(settings(f"udpin://127.0.0.1:{other.getsockname()[1]}", timeout=0.3)).start()


async def test_a_message_that_never_comes() -> None:
    stand_in = Px4StandIn(World(VEHICLE))
    del stand_in.streams.makers[147]  # no battery monitor
    stand_in.streams.intervals.pop(147)
    stand_in.start()
    px4 = Px4(settings(f"udpout://127.0.0.1:{stand_in.port}", timeout=1.5))
    try:
        with pytest.raises(DeviceError, match=r"BATTERY_STATUS never came from udpout://.* within 1\.5 s"):
            await px4.start()
    finally:
        stand_in.stop()
    assert any("BATTERY_STATUS at 2 Hz: failed" in n.text for n in px4.notices())


async def test_command_outside_of_start_and_stop() -> None:
    with pytest.raises(DeviceError, match="before start"):
        Px4(settings("udpin://127.0.0.1:0")).command(command())


async def test_wrench_is_refused(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, _ = pair
    with pytest.raises(DeviceError, match="PX4 accepts no body torques; set the interface to attitude or body_rate"):
        px4.command(command(interface=Interface.WRENCH))
    assert px4.sent() == 0


async def test_the_bytes_of_an_attitude_set_point(pair: tuple[Px4, Px4StandIn]) -> None:
    """Facing +y (north), 20 N of 50: q (1, 0, 0, 0) on the wire, thrust 0.4, body rates ignored."""
    px4, stand_in = pair
    px4.command(command(thrust=20.0, q_WB=(0.5**0.5, 0.0, 0.0, 0.5**0.5)))
    await until(lambda: "SET_ATTITUDE_TARGET" in stand_in.newest)
    raw = bytes(stand_in.newest["SET_ATTITUDE_TARGET"].get_msgbuf())
    assert raw[0] == 0xFD
    assert (raw[5], raw[6]) == (1, 191)  # the vehicle's system, its onboard computer
    assert int.from_bytes(raw[7:10], "little") == 82
    payload = raw[10:-2].ljust(51, b"\0")  # MAVLink 2 cuts zeros at the end; three extension floats follow
    _, *q, roll, pitch, yaw, thrust, system, component, mask = struct.unpack("<I8fBBB", payload[:39])
    assert q == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert (roll, pitch, yaw) == (0.0, 0.0, 0.0)
    assert thrust == pytest.approx(0.4, abs=1e-6)
    assert (system, component, mask) == (1, 1, 0b0000_0111)
    assert payload[39:] == b"\0" * 12


async def test_the_bytes_of_a_body_rate_set_point(pair: tuple[Px4, Px4StandIn]) -> None:
    """The wire's y and z axes point right and down; the attitude is ignored."""
    px4, stand_in = pair
    px4.command(command(thrust=25.0, interface=Interface.BODY_RATE, w_WB_B=(0.1, 0.2, 0.3)))
    await until(lambda: "SET_ATTITUDE_TARGET" in stand_in.newest)
    raw = bytes(stand_in.newest["SET_ATTITUDE_TARGET"].get_msgbuf())
    payload = raw[10:-2].ljust(51, b"\0")
    _, *_, roll, pitch, yaw, thrust, system, component, mask = struct.unpack("<I8fBBB", payload[:39])
    assert (roll, pitch, yaw) == pytest.approx((0.1, -0.2, -0.3), abs=1e-6)
    assert thrust == pytest.approx(0.5, abs=1e-6)
    assert (system, component, mask) == (1, 1, 0b1000_0000)


ROOT_HALF = 0.5**0.5
#: q_WB; the wire's quaternion (FRD to NED), worked by hand; where in NED the thrust axis (-z of FRD) points by it.
ATTITUDES = {
    "level, facing east": (LEVEL, (ROOT_HALF, 0.0, 0.0, ROOT_HALF), (0.0, 0.0, -1.0)),
    "level, facing north": ((ROOT_HALF, 0.0, 0.0, ROOT_HALF), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "level, facing west": ((0.0, 0.0, 0.0, 1.0), (ROOT_HALF, 0.0, 0.0, -ROOT_HALF), (0.0, 0.0, -1.0)),
    # nose down by 60 degrees: thrust leans ahead, +x of W, which is east
    "pitched forward, facing east": (
        (cos(pi / 6), 0.0, sin(pi / 6), 0.0),
        (6**0.5 / 4, 2**0.5 / 4, -(2**0.5) / 4, 6**0.5 / 4),
        (0.0, sin(pi / 3), -cos(pi / 3)),
    ),
    # right side down by 60 degrees, facing north: thrust leans to the right, east
    "rolled right, facing north": (
        (6**0.5 / 4, 2**0.5 / 4, 2**0.5 / 4, 6**0.5 / 4),
        (cos(pi / 6), sin(pi / 6), 0.0, 0.0),
        (0.0, sin(pi / 3), -cos(pi / 3)),
    ),
}


@pytest.mark.parametrize("name", ATTITUDES)
async def test_attitudes_on_the_wire(pair: tuple[Px4, Px4StandIn], name: str) -> None:
    """Set-point and pose alike carry the quaternion that was worked by hand, and its thrust points where it should."""
    px4, stand_in = pair
    q_WB, want, axis = ATTITUDES[name]
    px4.command(command(q_WB=q_WB))
    px4.odometry(msgspec.structs.replace(POSE, q_WB=q_WB), 1e-3, 1e-3, 1e-3, 100)
    await until(lambda: {"SET_ATTITUDE_TARGET", "ODOMETRY"} <= set(stand_in.newest))
    set_point = bytes(stand_in.newest["SET_ATTITUDE_TARGET"].get_msgbuf())[10:]
    pose = bytes(stand_in.newest["ODOMETRY"].get_msgbuf())[10:]
    for q in (struct.unpack("<4f", set_point[4:20]), struct.unpack("<4f", pose[20:36])):
        sign = 1.0 if sum(a * b for a, b in zip(q, want, strict=True)) > 0.0 else -1.0
        assert [sign * c for c in q] == pytest.approx(want, abs=1e-6)
        assert rotate(q, (0.0, 0.0, -1.0)) == pytest.approx(axis, abs=1e-6)


POSE = Odometry(
    t_ns=1_234_567_890_123_456,
    p_WB=(1.0, 2.0, 3.0),
    q_WB=(0.5**0.5, 0.0, 0.0, 0.5**0.5),
    v_WB=(0.4, 0.5, 0.6),
    confidence=3,
    reset_counter=258,
)


async def test_the_bytes_of_a_pose(pair: tuple[Px4, Px4StandIn]) -> None:
    """Facing +y (north): x on the wire is W's y, y its x, z down; the body sees its velocity ahead, right, down."""
    px4, stand_in = pair
    px4.odometry(POSE, 1e-3, 2e-3, 3e-3, 66)
    await until(lambda: "ODOMETRY" in stand_in.newest)
    raw = bytes(stand_in.newest["ODOMETRY"].get_msgbuf())
    assert raw[0] == 0xFD
    assert (raw[5], raw[6]) == (1, 191)
    assert int.from_bytes(raw[7:10], "little") == 331
    assert len(raw) == 10 + 233 + 2
    payload = raw[10:-2]
    microseconds, *floats = struct.unpack("<Q55f", payload[:228])
    frame, child, reset, estimator, quality = struct.unpack("<4Bb", payload[228:])
    assert microseconds == 1_234_567_890_123  # us, of the clock that TIMESYNC tells
    assert floats[0:3] == pytest.approx([2.0, 1.0, -3.0])
    assert floats[3:7] == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert floats[7:10] == pytest.approx([0.5, 0.4, -0.6])
    assert all(isnan(value) for value in floats[10:13])  # angular velocity: not told
    nought = 0.0
    assert floats[13:34] == pytest.approx(
        [1e-3, *[nought] * 5, 1e-3, *[nought] * 4, 1e-3, *[nought] * 3, 2e-3, nought, nought, 2e-3, nought, 2e-3]
    )
    assert floats[34:55] == pytest.approx(
        [3e-3, *[nought] * 5, 3e-3, *[nought] * 4, 3e-3, *[nought] * 3, nan, nought, nought, nan, nought, nan],
        nan_ok=True,
    )
    assert (frame, child, estimator) == (20, 12, 3)  # MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD, MAV_ESTIMATOR_TYPE_VIO
    assert (reset, quality) == (2, 66)  # the counter goes round at 256


async def test_a_pose_arrives_as_it_was_sent(pair: tuple[Px4, Px4StandIn]) -> None:
    """At the far end, in W again, and at the time of the far end's clock, give or take the steps of its thread."""
    px4, stand_in = pair
    await until(lambda: stand_in.received["TIMESYNC"] > 10)
    now = time.monotonic_ns()
    there = stand_in.world.snapshot.t_ns
    px4.odometry(msgspec.structs.replace(POSE, t_ns=now - 100_000_000, q_WB=(0.5, 0.5, 0.5, 0.5)), 1e-3, 1e-3, 1e-3, 66)
    await until(lambda: stand_in.vision is not None)
    seen = stand_in.vision
    assert seen is not None
    assert seen.t_ns == pytest.approx(there - 100_000_000, abs=20_000_000)
    assert seen.p_WB == pytest.approx((1.0, 2.0, 3.0))
    assert seen.q_WB == pytest.approx((0.5, 0.5, 0.5, 0.5))
    assert seen.v_WB == pytest.approx((0.4, 0.5, 0.6))
    assert (seen.confidence, seen.reset_counter) == (2, 2)


async def test_a_failed_pose_is_told_as_failed(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, stand_in = pair
    px4.odometry(POSE, 1.0, 1.0, 1.0, -1)
    await until(lambda: "ODOMETRY" in stand_in.newest)
    assert stand_in.newest["ODOMETRY"].quality == -1
    assert stand_in.vision is None


async def test_poses_are_thinned_out_and_never_repeated(pair: tuple[Px4, Px4StandIn]) -> None:
    """Of 2 s at 200 Hz, each offered at two ticks, 40 Hz are sent; of one that grows old, nothing more."""
    px4, stand_in = pair
    for k in range(400):
        sample = msgspec.structs.replace(POSE, t_ns=POSE.t_ns + 5_000_000 * k)
        for _ in range(2):
            px4.odometry(sample, 1e-3, 1e-3, 1e-3, 100)
    assert px4.vision_sent() == 80
    for _ in range(100):
        px4.odometry(sample, 1e-3, 1e-3, 1e-3, 100)
    assert px4.vision_sent() == 80
    # a tracker whose clock was set back goes on
    px4.odometry(msgspec.structs.replace(POSE, t_ns=5), 1e-3, 1e-3, 1e-3, 100)
    assert px4.vision_sent() == 81
    await until(lambda: stand_in.received["ODOMETRY"] == 81)


async def test_a_pose_that_is_not_finite_is_not_sent(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, stand_in = pair
    for k in range(10):
        px4.odometry(
            msgspec.structs.replace(POSE, t_ns=POSE.t_ns + 10**9 * k, v_WB=(nan, 0.0, 0.0)), 1e-3, 1e-3, 1e-3, 100
        )
    px4.odometry(msgspec.structs.replace(POSE, t_ns=POSE.t_ns + 10**11), 1e-3, 1e-3, 1e-3, 100)
    await until(lambda: stand_in.received["ODOMETRY"] > 0)
    assert stand_in.received["ODOMETRY"] == px4.vision_sent() == 1
    assert sum("a pose that is not finite was not sent" in n.text for n in px4.notices()) == 1


async def test_poses_outside_of_start_and_stop() -> None:
    with pytest.raises(DeviceError, match=r"odometry\(\) before start"):
        Px4(settings("udpin://127.0.0.1:0")).odometry(POSE, 1e-3, 1e-3, 1e-3, 100)


@pytest.mark.parametrize(
    "bad", [command(thrust=nan), command(q_WB=(nan, 0.0, 0.0, 0.0)), command(thrust=1.0, q_WB=(inf, -inf, 0.0, 0.0))]
)
async def test_what_is_not_finite_is_not_sent(pair: tuple[Px4, Px4StandIn], bad: AutopilotCommand) -> None:
    px4, stand_in = pair
    px4.command(bad)
    px4.command(bad)
    px4.command(command())
    await until(lambda: stand_in.received["SET_ATTITUDE_TARGET"] > 0)
    assert stand_in.received["SET_ATTITUDE_TARGET"] == px4.sent() == 1
    assert sum("not finite" in n.text for n in px4.notices()) == 1


async def test_asked_rates_are_reached(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, _ = pair
    await until(lambda: px4.counts()["HIGHRES_IMU"].rate > 0.0 and px4.counts()["ATTITUDE_QUATERNION"].rate > 0.0)
    await until(
        lambda: all(px4.counts()[name].rate > 200.0 for name in ("ATTITUDE_QUATERNION", "HIGHRES_IMU")), within=10.0
    )
    assert px4.motion() is not None


async def test_ready_to_arm_is_of_the_present_mode(pair: tuple[Px4, Px4StandIn]) -> None:
    """PX4 in Hold without a global position is not; in offboard, with set-points, it is."""
    px4, _ = pair
    assert not px4.ready_to_arm()
    await until(px4.ready_to_arm, lambda: px4.command(command()))


async def test_offboard_is_not_taken_back_from_a_pilot(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, stand_in = pair
    commander = stand_in.commander

    def state() -> tuple[bool, FlightMode]:
        latest = px4.latest()
        assert latest is not None
        return latest.armed, latest.mode

    def tick() -> None:
        px4.command(command())

    await until(lambda: state() == (True, FlightMode.OFFBOARD), tick)
    stand_in.parameters.set("COM_DISARM_LAND", 5.0)
    commander.mode = FlightMode.LAND  # the pilot's switch
    await until(lambda: state()[1] is FlightMode.LAND, tick)
    sent = px4.sent()
    await until(lambda: px4.sent() > sent + 500, tick)
    assert commander.mode is FlightMode.LAND
    assert sum("has left offboard by itself" in n.text for n in px4.notices()) == 1
    px4.command(command(Engage.LAND))
    await until(lambda: not state()[0])
    await until(lambda: state() == (True, FlightMode.OFFBOARD), tick)


async def test_each_insistence_is_one_numbered_message(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, stand_in = pair
    seen: list[tuple[int, float, int]] = []
    handle = stand_in._handlers["COMMAND_LONG"]

    def on_command(m: Any) -> None:
        if m.command in (400, 176):
            seen.append((m.command, m.param2, m.confirmation))
        handle(m)

    stand_in._handlers["COMMAND_LONG"] = on_command
    kill, land = (400, 21196.0), (176, 4.0)
    calls = (Engage.KILL, Engage.KILL, Engage.LAND, Engage.LAND, Engage.LAND, Engage.KILL, None, Engage.KILL)
    for engage in calls:
        px4.insist(engage)
    await until(lambda: len(seen) == 7)
    assert seen == [(*kill, 0), (*kill, 1), (*land, 0), (*land, 1), (*land, 2), (*kill, 0), (*kill, 0)]


@pytest.mark.parametrize("engage", [Engage.IDLE, Engage.OFFBOARD])
async def test_only_what_is_safe_can_be_insisted_on(pair: tuple[Px4, Px4StandIn], engage: Engage) -> None:
    with pytest.raises(ValueError, match=rf"insist\({engage}\); want kill, land or None"):
        pair[0].insist(engage)


async def test_insisting_outside_of_start_and_stop() -> None:
    with pytest.raises(DeviceError, match=r"insist\(\) before start\(\) or after stop\(\)"):
        Px4(settings("udpin://127.0.0.1:0")).insist(Engage.KILL)


async def test_a_refusal_is_told_with_px4s_reason(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, stand_in = pair
    stand_in.world.plant.x[at.CHARGE] = 0.06
    told: list[str] = []

    def tick() -> None:
        px4.command(command())
        told.extend(n.text for n in px4.notices())

    want = {
        "autopilot: arming: temporarily rejected",
        "autopilot: PX4 says: Arming denied: Resolve system health failures first",
        "autopilot: PX4 says: Critical battery",
    }
    await until(lambda: want <= set(told), tick)


async def test_loss_and_return_of_the_link() -> None:
    """PX4 reboots: what was told grows old, the loss is told, and after its return the rates are asked for again."""
    first = Px4StandIn(World(VEHICLE))
    first.start()
    port = first.port
    px4 = Px4(settings(f"udpout://127.0.0.1:{port}"))
    told: list[tuple[Level, str]] = []

    def listen() -> None:
        told.extend((n.level, n.text) for n in px4.notices())

    try:
        await px4.start()
        first.stop()
        lost = "autopilot: the link to PX4 is lost: nothing comes any more; check its cable and power"
        await until(lambda: (Level.ERROR, lost) in told, listen)
        stale = px4.latest()
        px4.command(command())  # survives
        second = Px4StandIn(World(VEHICLE), bind=("127.0.0.1", port))
        second.start()
        try:
            await until(lambda: any("autopilot: the link to PX4 is back after" in text for _, text in told), listen)
            fresh = px4.latest()
            assert stale is not None
            assert fresh is not None
            await until(lambda: second.streams.intervals[31] == pytest.approx(0.004))
            await until(lambda: px4.counts()["ATTITUDE_QUATERNION"].rate > 200.0)
        finally:
            await px4.stop()
            second.stop()
    finally:
        await px4.stop()
        first.stop()


async def test_start_again_after_stop(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, _ = pair
    await px4.stop()
    await px4.stop()
    with pytest.raises(DeviceError, match="after stop"):
        px4.command(command())
    await px4.start()
    assert px4.latest() is not None


async def test_a_number_that_is_not_finite_is_rejected(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, stand_in = pair
    make = stand_in.streams.makers[31]

    def broken() -> object:
        message = make()
        message.q1 = nan
        return message

    stand_in.streams.makers[31] = broken
    await until(lambda: px4.counts()["ATTITUDE_QUATERNION"].rejected > 10)
    latest = px4.latest()
    assert latest is not None
    assert latest.q_WB == pytest.approx(LEVEL, abs=1e-3)


async def test_long_status_texts_are_joined(pair: tuple[Px4, Px4StandIn]) -> None:
    px4, stand_in = pair
    await until(lambda: stand_in.received["HEARTBEAT"] > 0)
    texts = ["".join(chr(97 + i % 26) for i in range(length)) for length in (130, 49, 99, 50, 20)]
    for text in texts:  # with the tab that PX4 adds, the second and third end in a full piece
        stand_in._say(Severity.WARNING, text)
    told: list[tuple[Level, str]] = []
    await until(
        lambda: len(told) == 5, lambda: told.extend((n.level, n.text) for n in px4.notices() if "abc" in n.text)
    )
    assert told == [(Level.WARNING, f"autopilot: PX4 says: {text}") for text in texts]
    stand_in._say(Severity.ERROR, texts[1])  # and nothing after it
    await until(
        lambda: told[-1] == (Level.ERROR, f"autopilot: PX4 says: {texts[1]}"),
        lambda: told.extend((n.level, n.text) for n in px4.notices() if "abc" in n.text),
    )


async def test_a_rate_that_has_fallen_is_told_once_and_asked_for_again(pair: tuple[Px4, Px4StandIn]) -> None:
    """As after a reboot too short to break the link."""
    px4, stand_in = pair
    told: list[str] = []

    def listen() -> None:
        told.extend(n.text for n in px4.notices() if "ATTITUDE_QUATERNION comes at" in n.text)

    await until(lambda: px4.counts()["ATTITUDE_QUATERNION"].rate > 200.0, listen)
    told.clear()
    stand_in.streams.intervals[31] = 0.02
    await until(lambda: bool(told), listen)
    await until(lambda: stand_in.streams.intervals[31] == pytest.approx(0.004), listen)
    assert len(told) == 1
    assert "asked for 250 Hz; asking again" in told[0]
