"""Many flights in one onboard process, each with a station that comes and goes: what the process has after each.

``python -m tests.link.soak FLIGHTS FOLDER`` prints it as JSON.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import os
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path

import msgspec
from msgspec.structs import replace

from groundstation.client import Client, StationSettings
from onboard.clock import VirtualClock
from onboard.config import Config, dump_config, load_config
from onboard.core.types import LinkState, Outputs, Phase, Request, Tick
from onboard.devices import mock_devices, world_of
from onboard.loop import Loop
from onboard.recorder import Recorder
from onboard.records import Timing
from onboard.reload import Reloader
from onboard.simulate import TruthSink, run_info
from onboard.stations import Stations
from onboard.wire import Ack, Ask, Mission, Outcome, ReleaseLease, TakeLease
from tests.waiting import LONG, seconds_until
from tests.zenoh_sessions import free_port

#: Brisk, and not high; with a battery that lasts.
SETS = (
    "plan.takeoff_height=0.5", "plan.speed=0.8", "plan.acceleration=0.8", "plan.jerk=2", "plan.descent_speed=0.4",
    "vehicle.battery.capacity=100", "vehicle.battery.hover_current=0.01",
)  # fmt: skip

#: What is waited for, in the ticks.
Until = Callable[[Outputs], bool]


class Left(msgspec.Struct, frozen=True):
    """What the process has, between two flights."""

    memory: int
    """Resident, bytes."""
    threads: int
    files: int
    sessions: int
    """Transports of Zenoh that end at the vehicle."""
    objects: int
    """That Python's collector knows."""


def left(stations: Stations) -> Left:
    """Once the last station is gone."""
    session = stations.link._session
    assert session is not None
    seconds_until(lambda: not session.info.transports())
    seconds_until(lambda: stations.link._sessions.heard(time.monotonic_ns()) == ())
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed and kept for the next is not left behind
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Left(
        pages * os.sysconf("SC_PAGE_SIZE"),
        len(os.listdir("/proc/self/task")),
        len(os.listdir("/proc/self/fd")),
        len(session.info.transports()),
        len(gc.get_objects()),
    )


class Soak:
    """The onboard process: the core in virtual time, and the link as it flies."""

    def __init__(self, config: Config, folder: Path, flights: int) -> None:
        self.config, self.flights = config, flights
        world = world_of(config)
        self.clock = VirtualClock(world.advance)
        devices = mock_devices(world)
        with Recorder(folder / "log.mcap", run_info(config), config, dump_config(config)) as recorder:
            self.stations: Stations | None = None
            sink = _Sink(TruthSink(recorder, world), self._tick)
            loop = Loop(devices, self.clock, config, sink, link=self._link)
            reloader = Reloader(lambda: config, loop)
            self.stations = stations = Stations(
                config.link, loop, reloader, devices.autopilot, devices.servos, lambda params: (), {}
            )
            stations.start()
            self.found: list[Left] = []
            self._flights = self._fly(stations)
            self._until: Until = next(self._flights)
            try:
                asyncio.run(loop.run(self._on_tick))
            finally:
                stations.stop()
                reloader.close()
                reloader.join(LONG)

    def _tick(self, tick: Tick) -> None:
        if self.stations is not None:
            self.stations.tick(tick)

    def _link(self) -> LinkState:
        """What the link knows, with the same age on the clock of the ticks."""
        state = self.stations.state() if self.stations is not None else LinkState()
        age_ns = round(state.age(time.monotonic_ns()) * 1e9)
        return replace(state, heard_ns=self.clock.now_ns() - age_ns)

    def _on_tick(self, outputs: Outputs) -> bool:
        assert self.stations is not None
        self.stations.after(outputs)
        self.stations.notices()
        if outputs.phase_time > 60.0:
            raise TimeoutError(f"{outputs.phase} for a minute; {outputs.verdict}")
        if self._until(outputs):
            try:
                self._until = next(self._flights)
            except StopIteration:
                return False
        return True

    def _fly(self, stations: Stations) -> Generator[Until, None, None]:
        """All flights. While a station is asked, no time passes for the vehicle."""
        settings = StationSettings(self.config.link.vehicle, self.config.link.listen, "alice", plain=True)
        for _ in range(self.flights):
            with Client(settings, timeout=LONG) as alice:
                assert _asked(alice, TakeLease()).outcome is Outcome.DONE
                yield lambda outputs: outputs.estimate.valid and not outputs.verdict.reasons
                _ask(alice, Request.TAKEOFF)
                yield lambda outputs: outputs.phase is Phase.HOLD and outputs.phase_time > 0.5
                _ask(alice, Request.LAND)
                yield lambda outputs: outputs.phase is Phase.STOPPED
                seconds_until(lambda alice=alice: len(alice.events) > 3)  # type: ignore[misc]
                _ask(alice, Request.RESET)
                yield lambda outputs: outputs.phase is Phase.PREFLIGHT
                assert _asked(alice, ReleaseLease()).outcome is Outcome.DONE
            self.found.append(left(stations))


class _Sink:
    """The recorder; of each tick, the link hears too."""

    def __init__(self, recorded: TruthSink, hear: Callable[[Tick], None]) -> None:
        self._recorded, self._hear = recorded, hear
        self.keyframe, self.revision = recorded.keyframe, recorded.revision

    def tick(self, tick: Tick) -> None:
        """Take one cycle."""
        self._recorded.tick(tick)
        self._hear(tick)

    def timing(self, timing: Timing) -> None:
        """There is none in virtual time."""


def _asked(station: Client, what: Ask) -> Ack:
    return station.ask(what, timeout=LONG)


def _ask(station: Client, request: Request) -> None:
    assert _asked(station, Mission(request)).outcome is Outcome.ACCEPTED


if __name__ == "__main__":
    at = f"link.listen=[tcp/127.0.0.1:{free_port()}]"
    soak = Soak(load_config("paper", sets=[*SETS, at, "link.plain=true"]), Path(sys.argv[2]), int(sys.argv[1]))
    sys.stdout.write(msgspec.json.encode(soak.found).decode())
