"""The PX4 driver over MAVSDK and UDP to a stand-in that moves a world on the wall clock."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import yaml

from drivers.px4 import Px4, Px4Settings
from drivers.samples import AutopilotCommand, Engage, Interface, Quat, Vec3
from drivers.thrust import ThrustMap
from drivers.vehicle import Vehicle
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.world import World

VEHICLE = msgspec.convert(
    yaml.safe_load((Path(__file__).parents[2] / "configs" / "vehicle.yaml").read_text(encoding="utf-8")), Vehicle
)
THRUST = ThrustMap(hover_force=20.0, hover_thrust=0.4, hover_voltage=16.0, curve=0.3, px4_curve=0.3)
LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
STILL: Vec3 = (0.0, 0.0, 0.0)


def settings(url: str, **changes: Any) -> Px4Settings:
    return msgspec.structs.replace(Px4Settings(thrust=THRUST, url=url, stream_time=0.6), **changes)


def command(
    engage: Engage = Engage.OFFBOARD,
    thrust: float = 5.0,
    interface: Interface = Interface.ATTITUDE,
    q_WB: Quat = LEVEL,
    w_WB_B: Vec3 = STILL,
) -> AutopilotCommand:
    return AutopilotCommand(engage, interface, thrust, STILL, q_WB, w_WB_B)


async def until(condition: Callable[[], bool], tick: Callable[[], None] = lambda: None, within: float = 15.0) -> None:
    """Tick every 4 ms until the condition holds."""
    loop = asyncio.get_running_loop()
    end = loop.time() + within
    while not condition():
        assert loop.time() < end, "the condition never held"
        tick()
        await asyncio.sleep(0.004)


@asynccontextmanager
async def linked(stand_in: Px4StandIn, **changes: Any) -> AsyncIterator[tuple[Px4, Px4StandIn]]:
    """The driver, started, on a stand-in that moves."""
    stand_in.start()
    px4 = Px4(settings(f"udpout://127.0.0.1:{stand_in.port}", **changes))
    try:
        await px4.start()
        yield px4, stand_in
    finally:
        await px4.stop()
        stand_in.stop()


def stand_in(**options: Any) -> Px4StandIn:
    return Px4StandIn(World(VEHICLE), **options)
