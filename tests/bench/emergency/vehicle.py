"""The vehicle's side: ``python -m tests.bench.emergency.vehicle OPTIONS``.

Link, emergency stop and the real drivers, with no mission: a loop at 250 Hz sends set-points and holds the joints. The
first line on standard output says that it is ready; the second, when standard input closes, is ``Vehicle`` as JSON.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import cycle
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event, Lock, Thread
from typing import Any, cast

import msgspec
import zenoh
from msgspec.structs import replace

from drivers.dynamixel import Dynamixel
from drivers.dynamixel_settings import DynamixelSettings
from drivers.mailbox import Notices
from drivers.px4 import Px4, Px4Settings
from drivers.samples import (
    AutopilotCommand,
    AutopilotState,
    Engage,
    FlightMode,
    Interface,
    JointMode,
    ServoCommand,
)
from drivers.thrust import ThrustMap
from groundstation.desk import prefer
from onboard.admission import vehicle_security
from onboard.config import load_config
from onboard.core.types import Request
from onboard.emergency import Done, Emergency
from onboard.identity import load_identity
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.roster import Roster
from onboard.scheduling import ProcessParams, ask
from onboard.wire import Ack, Stop
from tests.bench.emergency.far_end import MARK
from tests.bench.emergency.messages import Frames, Order, Vehicle, VehicleOptions
from tests.synthetic import mission

NAME = "x500"
#: Keys of the raw messages: numbers that are put, and a query that is answered at once.
RAW_PUT, RAW_GET = f"pipewright/{NAME}/raw/put", f"pipewright/{NAME}/raw/get"
#: Of the link, s: with the default of 2 s a connection through a bad network is given up again and again.
LEASE = 10.0
#: Real-time priority, as on the desk.
PRIORITY = 10
_PERIOD_NS = 4_000_000
#: After the last order, until all is as before it, s.
_RENEWED = 0.07
_LIGHT = AutopilotCommand(
    Engage.OFFBOARD, Interface.BODY_RATE, 5.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
)
_HELD = ServoCommand(JointMode.POSITION, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0), 1.0)


@contextmanager
def far_end(what: str, frames: list[Frames]) -> Iterator[str]:
    """The other side of a driver, in a process of its own; gives where it is, and at the end what came there."""
    command = [sys.executable, "-m", "tests.bench.emergency.far_end", what]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        prefer(process.pid, PRIORITY + 2)  # hardware waits for no processor
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        told, _ = process.communicate()
    frames.append(msgspec.json.decode(told, type=Frames))


class Flying(Px4):
    """The driver, on a vehicle that is always said to fly in offboard."""

    def latest(self) -> AutopilotState | None:
        """The newest state, armed."""
        state = super().latest()
        return None if state is None else replace(state, armed=True, mode=FlightMode.OFFBOARD)


class Rig:
    """Everything between the link and the drivers."""

    def __init__(self, px4: Px4, bus: Dynamixel) -> None:
        self._px4, self._bus = px4, bus
        self._requests: deque[tuple[Request, Done | None]] = deque()
        self._used: SimpleQueue[None] = SimpleQueue()
        self._renewing = Lock()
        self._mark = 0
        self.ticked_ns = 0
        self.noted = Vehicle([], {}, {}, Frames())
        self._emergency = self._new()
        Thread(target=self._renew, name="renew", daemon=True).start()

    def _new(self) -> Emergency:
        emergency = Emergency(self._px4, self._bus, self._request, lambda: self.ticked_ns, Notices())
        emergency.start()
        return emergency

    def _request(self, request: Request, *, done: Done | None = None) -> None:
        self._requests.append((request, done))

    def hear(self, asked: Asked) -> Ack:
        """An order, on the link's thread."""
        self.noted.orders.append(Order(asked.id, time.monotonic_ns()))
        with self._renewing:
            if isinstance(asked.ask, Stop):
                self._emergency.stop(lambda outputs: self.noted.marks.__setitem__(asked.id, self._mark))
            else:
                self._emergency.kill()
        self._used.put(None)
        return asked.done()

    def _renew(self) -> None:
        """As if it had never been asked."""
        while True:
            self._used.get()
            with suppress(Empty):
                while True:
                    self._used.get(timeout=_RENEWED)
            with self._renewing:
                self._emergency.close()
                self._px4.insist(None)
                self._bus.insist(False)
                self._emergency = self._new()

    def tick(self) -> None:
        """One cycle of the loop."""
        self.ticked_ns = time.monotonic_ns()
        while self._requests:
            request, done = self._requests.popleft()
            if request is Request.STOP and done is not None:
                self._mark += 1
                done(cast("Any", None))
        self._px4.command(replace(_LIGHT, w_WB_B=(self._mark * MARK, 0.0, 0.0)))
        self._bus.command(_HELD)

    def put(self, sample: zenoh.Sample) -> None:
        """A raw message."""
        self.noted.puts[int(sample.payload.to_string())] = time.monotonic_ns()


async def fly(options: VehicleOptions) -> Vehicle:
    """Until standard input closes."""
    frames: list[Frames] = []
    ask(ProcessParams())
    with far_end("autopilot", frames) as port, far_end("servos", frames) as path:
        thrust = ThrustMap.of(load_config("desk").vehicle)
        px4 = Flying(Px4Settings(url=f"udpout://127.0.0.1:{port}"), thrust=thrust)
        # Patient, so that a busy machine ends no trial.
        bus = Dynamixel(DynamixelSettings(path, reply_margin=0.02, silent_after=0.3, watchdog=0.5, patience=0.3))
        await asyncio.gather(px4.start(), bus.start())
        rig = Rig(px4, bus)
        security = None
        if options.keys:
            security = vehicle_security(NAME, load_identity(Path(options.keys)), Roster())
            del security["access_control"]  # the raw messages have keys that nobody is allowed
        settings = LinkSettings(vehicle=NAME, listen=(options.listen,), plain=not options.keys, peer_lease=LEASE)
        link = Link(settings, rig.hear, security)
        link.start()
        try:
            await _loop(rig, link, options.stuck)
        finally:
            link.stop()
            await asyncio.gather(px4.stop(), bus.stop())
    noted = rig.noted
    for part in frames:
        noted.frames.kills += part.kills
        noted.frames.lands += part.lands
        noted.frames.marks |= part.marks
        noted.frames.limp += part.limp
    return noted


async def _loop(rig: Rig, link: Link, stuck: bool) -> None:
    session = cast("zenoh.Session", link._session)
    session.declare_subscriber(RAW_PUT, rig.put)
    session.declare_queryable(RAW_GET, lambda query: query.reply(query.key_expr, b"x"))
    over = Event()

    def listen() -> None:
        sys.stdin.read()
        over.set()

    ticks = cycle([tick for tick, _ in mission()][:2])
    due = time.monotonic_ns()
    began = due
    listener = Thread(target=listen)
    while not over.is_set():
        rig.tick()
        link.tick(next(ticks))
        if listener.ident is None and due - began > 1_000_000_000:
            print("ready", flush=True)
            listener.start()
            while stuck and not over.is_set():
                pass
        due = max(due + _PERIOD_NS, time.monotonic_ns() - 10 * _PERIOD_NS)
        await asyncio.sleep(max(0, due - time.monotonic_ns()) * 1e-9)
    listener.join()


def main() -> None:
    """Fly, and tell what was noted."""
    options = msgspec.json.decode(sys.argv[1], type=VehicleOptions)
    noted = asyncio.run(fly(options))
    with suppress(BrokenPipeError):
        print(msgspec.json.encode(noted).decode(), flush=True)


if __name__ == "__main__":
    main()
