"""The desk mission in virtual time: world, mock devices, loop and recorder in one process."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from onboard.clock import VirtualClock
from onboard.config import Config, dump_config
from onboard.core.params import Params
from onboard.core.step import State
from onboard.core.types import Outputs, Tick
from onboard.devices import simulated_devices, world_of
from onboard.errand import Errand
from onboard.loop import Loop
from onboard.recorder import Recorder
from onboard.records import RunInfo, Timing
from onboard.version import version
from sim_backend.plant import Truth
from sim_backend.world import World

#: A mission that has not ended by then is broken off, s of simulated time.
LONGEST = 900.0


class Record(Protocol):
    """What a simulated mission is recorded to."""

    def tick(self, tick: Tick, truth: Truth | None = None) -> None:
        """Take one cycle, and what was true in the world."""

    def keyframe(self, index: int, t_ns: int, state: State) -> None:
        """Take the core's state just before the tick of this index."""

    def timing(self, timing: Timing) -> None:
        """Take the punctuality of one tick."""

    def revision(self, index: int, t_ns: int, revision: int, config: Params) -> None:
        """Take the parameter set that is in force from the tick of this index on."""


class TruthSink:
    """Records each tick together with what is true in the world at that moment."""

    def __init__(self, recorder: Record, world: World) -> None:
        self._recorder, self._world = recorder, world

    def tick(self, tick: Tick) -> None:
        """Take one cycle."""
        self._recorder.tick(tick, self._world.truth())

    def keyframe(self, index: int, t_ns: int, state: State) -> None:
        """Take the core's state just before the tick of this index."""
        self._recorder.keyframe(index, t_ns, state)

    def timing(self, timing: Timing) -> None:
        """Take the punctuality of one tick."""
        self._recorder.timing(timing)

    def revision(self, index: int, t_ns: int, revision: int, config: Params) -> None:
        """Take the parameter set that is in force from the tick of this index on."""
        self._recorder.revision(index, t_ns, revision, config)


def run_info(config: Config, *, realtime: bool = False, started: str = "") -> RunInfo:
    """What the log says of the run."""
    return RunInfo(version(), config.scenario, config.law, config.seed, realtime, started)


def simulate(
    config: Config,
    log: Path,
    watch: Callable[[Outputs, float], None] | None = None,
    longest: float | None = None,
) -> None:
    """Fly the whole mission of ``config`` and record it to ``log``; as ``fly`` does."""
    world = world_of(config)
    with Recorder(log, run_info(config), config, dump_config(config)) as recorder:
        fly(config, world, recorder, watch, longest)


def fly(
    config: Config,
    world: World,
    record: Record,
    watch: Callable[[Outputs, float], None] | None = None,
    longest: float | None = None,
) -> None:
    """Fly the whole mission in ``world``; ``watch`` sees outputs and time (s) of each tick.

    Ends when the mission has stopped, when the vehicle is lost, or after ``longest`` simulated seconds (``LONGEST``).
    Raises ConfigError for faults that no device can show.
    """
    clock = VirtualClock(world.advance)
    devices = simulated_devices(world, config)
    loop = Loop(devices, clock, config, TruthSink(record, world))
    errand = Errand(loop.request, LONGEST if longest is None else longest)

    def on_tick(outputs: Outputs) -> bool:
        t = clock.now_ns() * 1e-9
        devices.enter(outputs.phase)
        if watch is not None:
            watch(outputs, t)
        return errand.goes_on(outputs, t) and not world.truth().crashed

    asyncio.run(loop.run(on_tick))
