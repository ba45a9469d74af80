"""The driver on the bytes of a real PX4: a recorded flight, played over UDP, and what the driver makes of it.

The recording (tests/record_px4.py) is of PX4 main 9cf3e83197 (2025-05-01, towards v1.16) in our simulated world: start,
takeoff, hover; then the flight process was killed, and PX4 landed by itself. Its rates are thinned.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from pymavlink.dialects.v20 import common as mavlink

from drivers.mailbox import Notice
from drivers.px4 import Px4
from drivers.samples import Engage, Landed, Quat, Vec3
from tests.drivers.px4_rig import command, settings, until
from tests.px4_traffic import Packet, parser, read_tlog

pytestmark = pytest.mark.asyncio

ROOT = Path(__file__).parents[2]
FLIGHT = tuple(read_tlog(Path(__file__).parent / "data" / "px4_flight.tlog"))
PARAMETERS = ROOT / "configs" / "px4" / "x500.params"
#: What the file has wanted differently since the recording.
CHANGED_SINCE = ("COM_DISARM_PRFLT",)
#: While the driver starts, so many times faster than it was recorded.
SPEED = 4.0


class Player(asyncio.DatagramProtocol):
    """Plays the recording, and answers what the driver asks as PX4 has answered it."""

    def __init__(self) -> None:
        self.left: list[Packet] = [*reversed(FLIGHT)]
        self.asked: list[int] = []
        """Numbers of the commands that have come."""
        self._transport: Any = None
        self._driver: Any = None
        self._parser = parser()
        self._answers: defaultdict[int, list[Packet]] = defaultdict(list)
        self._parameters: dict[str, Packet] = {}
        for packet in reversed(FLIGHT):
            if packet.name == "COMMAND_ACK":
                self._answers[packet.message.command].append(packet)
            elif packet.name == "PARAM_VALUE":
                self._parameters[packet.message.param_id] = packet

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, address: object) -> None:
        self._driver = address
        for message in self._parser.parse_buffer(data) or ():
            if message.get_type() == "COMMAND_LONG":
                self.asked.append(message.command)
                answers = self._answers[message.command]
                if answers:  # in their order, the last one again and again
                    self.say(answers.pop() if len(answers) > 1 else answers[0])
            elif message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self._parameters:
                self.say(self._parameters[message.param_id])

    def say(self, packet: Packet) -> None:
        """Send it as it is."""
        self._transport.sendto(bytes(packet.message.get_msgbuf()), self._driver)

    @property
    def url(self) -> str:
        """For the driver."""
        return f"udpout://127.0.0.1:{self._transport.get_extra_info('sockname')[1]}"

    def play(self) -> Packet:
        """Say the next packet that the driver has not asked for."""
        packet: Packet = self.left.pop()
        if packet.name not in ("COMMAND_ACK", "PARAM_VALUE"):
            self.say(packet)
        return packet

    async def play_start(self) -> None:
        """Up to the arming, at its own pace; nobody may have asked yet."""
        while not (self.left[-1].name == "HEARTBEAT" and self.left[-1].armed):
            if self._driver is None:
                await asyncio.sleep(0.01)
                continue
            before = self.play()
            await asyncio.sleep((self.left[-1].t_ns - before.t_ns) * 1e-9 / SPEED)


@asynccontextmanager
async def played(**changes: Any) -> AsyncIterator[tuple[Px4, Player]]:
    """The driver, started on the recording up to before the arming."""
    loop = asyncio.get_running_loop()
    transport, player = await loop.create_datagram_endpoint(Player, local_addr=("127.0.0.1", 0))
    start = asyncio.create_task(player.play_start())
    px4 = Px4(settings(player.url, **changes))
    try:
        await px4.start()
        await start
        yield px4, player
    finally:
        start.cancel()
        await px4.stop()
        transport.close()


async def rest(px4: Px4, player: Player, look: Callable[[Packet], None]) -> None:
    """Play what is left; ``look`` sees each packet that has a counter once the driver has it."""
    while player.left:
        name = player.left[-1].name
        before = px4.counts().get(name)
        packet = player.play()
        if before is not None:
            await until(partial(_came, px4, name, before.received))
            look(packet)


def _came(px4: Px4, name: str, before: int) -> bool:
    return px4.counts()[name].received > before


def texts(notices: tuple[Notice, ...]) -> list[str]:
    return [notice.text for notice in notices]


# -- by hand: from north, east, down and front, right, down to east, north, up and front, left, up -------------------


def axes(q: Quat) -> tuple[Vec3, Vec3, Vec3]:
    """Columns of the rotation matrix: where the body's axes point."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def up_and_left(front: float, right: float, down: float) -> Vec3:
    return (front, -right, -down)


def east_first(north: float, east: float, down: float) -> Vec3:
    return (east, north, -down)


async def test_attitude_rates_and_specific_force_are_those_of_the_flight() -> None:
    compared: defaultdict[str, int] = defaultdict(int)
    async with played() as (px4, player):

        def look(packet: Packet) -> None:
            m, state = packet.message, px4.latest()
            assert state is not None
            compared[packet.name] += 1
            if packet.name == "ATTITUDE_QUATERNION":
                front, right, down = axes((m.q1, m.q2, m.q3, m.q4))
                ours = axes(state.q_WB)
                assert ours[0] == pytest.approx(east_first(*front), abs=1e-5)
                assert ours[1] == pytest.approx(tuple(-part for part in east_first(*right)), abs=1e-5)
                assert ours[2] == pytest.approx(tuple(-part for part in east_first(*down)), abs=1e-5)
                assert state.w_WB_B == pytest.approx(up_and_left(m.rollspeed, m.pitchspeed, m.yawspeed), abs=1e-6)
            elif packet.name == "HIGHRES_IMU":
                assert state.f_B == pytest.approx(up_and_left(m.xacc, m.yacc, m.zacc), abs=1e-5)
            elif packet.name == "LOCAL_POSITION_NED":
                motion = px4.motion()
                assert motion is not None
                assert motion.p_WB == pytest.approx(east_first(m.x, m.y, m.z), abs=1e-5)
                assert motion.v_WB == pytest.approx(east_first(m.vx, m.vy, m.vz), abs=1e-5)

        await rest(px4, player, look)
    assert compared["ATTITUDE_QUATERNION"] > 200
    assert compared["HIGHRES_IMU"] > 100
    assert compared["LOCAL_POSITION_NED"] > 50


async def test_it_stands_level_then_hovers_where_the_world_was() -> None:
    """What the vehicle did is known: it looked along +x of W, and hovered 0.8 m above the ground on which its
    origin had stood at 0.24 m.
    """
    highest = 0.0
    async with played() as (px4, player):
        state = px4.latest()
        assert state is not None
        front, left, up = axes(state.q_WB)
        assert (front[0], left[1], up[2]) == pytest.approx((1.0, 1.0, 1.0), abs=0.01)
        assert state.f_B == pytest.approx((0.0, 0.0, 9.81), abs=0.1)

        def look(packet: Packet) -> None:
            nonlocal highest
            motion = px4.motion()
            assert motion is not None
            highest = max(highest, motion.p_WB[2])
            assert abs(motion.p_WB[0]) < 0.4
            assert abs(motion.p_WB[1]) < 0.4

        await rest(px4, player, look)
    assert highest == pytest.approx(1.04, abs=0.1)


async def test_modes_arming_and_landing_are_told() -> None:
    states: list[tuple[str, str]] = []
    grounds: list[Landed] = []
    async with played() as (px4, player):

        def look(packet: Packet) -> None:
            state = px4.latest()
            assert state is not None
            if packet.name == "HEARTBEAT":
                now = ("armed" if state.armed else "disarmed", state.mode.value)
                assert now == ("armed" if packet.armed else "disarmed", packet.mode)
                if now not in states[-1:]:
                    states.append(now)
            elif packet.name == "EXTENDED_SYS_STATE" and state.landed not in grounds[-1:]:
                grounds.append(state.landed)

        await rest(px4, player, look)
    # Disarmed, PX4 goes back to the mode that was last asked for.
    assert states == [("armed", "offboard"), ("armed", "land"), ("disarmed", "offboard")]
    assert grounds == [Landed.ON_GROUND, Landed.IN_AIR, Landed.ON_GROUND]


async def test_status_texts_become_notices_in_their_order() -> None:
    async with played() as (px4, player):
        told = texts(px4.notices())
        await rest(px4, player, lambda packet: None)

        def all_have_come() -> bool:
            told.extend(texts(px4.notices()))
            return any("Failsafe activated" in text for text in told)

        await until(all_have_come)
    before = "autopilot: PX4 says: "
    said = [text.removeprefix(before) for text in told if text.startswith(before)]
    assert [text for text in said if "[logger]" not in text] == [
        "Preflight Fail: heading estimate not stable",
        "Arming denied: Resolve system health failures first",  # came in two pieces
        "Armed by external command",
        "Takeoff detected",
        "Failsafe activated",
    ]


async def test_the_battery_is_told() -> None:
    async with played() as (px4, player):
        await rest(px4, player, lambda packet: None)
        state = px4.latest()
    last = next(p.message for p in reversed(FLIGHT) if p.name == "BATTERY_STATUS")
    assert state is not None
    assert state.battery_voltage == pytest.approx(sum(v for v in last.voltages if v != 65535) / 1000.0)
    assert state.battery_remaining == pytest.approx(last.battery_remaining / 100.0)
    assert 13.2 < state.battery_voltage < 16.8


async def test_the_parameters_that_px4_has_told_are_compared(tmp_path: Path) -> None:
    sitl = yaml.safe_load((ROOT / "configs" / "sitl.yaml").read_text())["devices"]["autopilot"]
    may_differ = (*sitl["may_differ"], *CHANGED_SINCE)
    async with played(parameters=str(PARAMETERS), may_differ=may_differ) as (px4, _):
        assert px4.parameter_differences() == ()
    other = tmp_path / "other.params"
    text = PARAMETERS.read_text()
    assert "COM_OF_LOSS_T\t0.5" in text
    other.write_text(text.replace("COM_OF_LOSS_T\t0.5", "COM_OF_LOSS_T\t1.0").replace("HGT_REF\t3", "HGT_REF\t0"))
    async with played(parameters=str(other), may_differ=may_differ) as (px4, _):
        assert px4.parameter_differences() == ("EKF2_HGT_REF is 3, wants 0", "COM_OF_LOSS_T is 0.5, wants 1")


async def test_a_refusal_to_arm_is_told_and_arming_is_asked_for_again() -> None:
    """PX4 refused at first, for its heading had only just come from vision."""
    async with played(rate=20.0) as (px4, player):
        px4.notices()
        assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in player.asked
        offboard = next(packet for packet in FLIGHT if packet.mode == "offboard" and not packet.armed)
        armed = next(packet for packet in FLIGHT if packet.mode and packet.armed)

        def tick() -> None:
            px4.command(command(Engage.OFFBOARD))
            player.say(armed if player.asked.count(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) > 1 else offboard)

        def is_armed() -> bool:
            state = px4.latest()
            return state is not None and state.armed

        await until(is_armed, tick)
        told: list[str] = []

        def reached() -> bool:
            told.extend(texts(px4.notices()))
            return "autopilot: PX4 is armed, mode offboard" in told

        await until(reached, tick)
    assert [text for text in told if text.startswith("autopilot: arming")] == [
        "autopilot: arming: temporarily rejected"
    ]
