"""How long a set-point takes from the driver's call to the autopilot's socket, beside a bare UDP datagram."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
from time import monotonic_ns

import msgspec
from msgspec import Struct

from drivers.px4 import Px4, Px4Settings
from drivers.samples import AutopilotCommand, Engage, Interface
from drivers.thrust import ThrustMap
from onboard.config import load_config
from tests.bench.far_end import BARE, Arrivals
from tests.bench.measure import Stat, stat

_PERIOD = 0.004
_COMMAND = AutopilotCommand(
    Engage.OFFBOARD, Interface.ATTITUDE, 2.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
)


class SetPoints(Struct, frozen=True):
    """Set-points through MAVSDK and bare datagrams, by turns to the same socket, 250 of each a second. Times in us."""

    ours: Stat
    """From the call of ``Px4.command`` until the message is in the receiver's queue."""
    call: Stat
    """The call alone, which the loop waits for."""
    bare: Stat
    """From the call of ``sendto`` until the datagram is in the same queue."""

    @property
    def ratio(self) -> float:
        """Ours to bare, in the median."""
        return self.ours.median / self.bare.median


def measure(count: int = 1000) -> SetPoints:
    """Send so many of each. Raises RuntimeError when one of them does not arrive."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.bench.far_end"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        called, returned, bare = asyncio.run(_drive(int(process.stdout.readline()), count))
        told, _ = process.communicate()
    arrived = msgspec.json.decode(told, type=Arrivals)
    if lost := 2 * count - len(arrived.set_points) - len(arrived.bare):
        # then nobody knows which call an arrival belongs to
        raise RuntimeError(f"{lost} of {2 * count} datagrams were lost on loopback: is the machine overloaded?")
    return SetPoints(
        ours=stat([b - a for a, b in zip(called, arrived.set_points, strict=True)]),
        call=stat([b - a for a, b in zip(called, returned, strict=True)]),
        bare=stat([b - a for a, b in zip(bare, arrived.bare, strict=True)]),
    )


Times = tuple[list[int], list[int], list[int]]


async def _drive(port: int, count: int) -> Times:
    """Connect, send, and wait until all has long arrived."""
    px4 = Px4(Px4Settings(url=f"udpout://127.0.0.1:{port}"), thrust=ThrustMap.of(load_config("desk").vehicle))
    try:
        await px4.start()
        times = await _send(px4, ("127.0.0.1", port), count)
        await asyncio.sleep(0.1)
    finally:
        await px4.stop()
    return times


async def _send(px4: Px4, address: tuple[str, int], count: int) -> Times:
    """Times before and after each call of the driver, and before each bare send, ns."""
    called, returned, bare = [], [], []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        payload = BARE.ljust(51, b".")  # as long as the set-point's message
        for _ in range(count):
            called.append(monotonic_ns())
            px4.command(_COMMAND)
            returned.append(monotonic_ns())
            await asyncio.sleep(_PERIOD / 2)
            bare.append(monotonic_ns())
            out.sendto(payload, address)
            await asyncio.sleep(_PERIOD / 2)
    return called, returned, bare
