"""One whole mission: what the world, the core and the recorder take in it, and the inputs that the core saw."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter_ns
from typing import Any
from unittest.mock import patch

from msgspec import Struct
from msgspec.structs import replace

from onboard import loop, simulate
from onboard.config import Config
from onboard.core.types import Outputs, Tick
from onboard.recorder import Recorder
from sim_backend.array_plant import PlantKind
from sim_backend.world import World
from tests.bench.measure import Probe, Stat, stat


class Flight(Struct, frozen=True):
    """Figures of one mission as ``pipewright sim`` flies it."""

    ended_in: str
    """Phase of the last tick."""
    sim_s: float
    wall_s: float
    core_s: float
    world_s: float
    recorder_s: float
    """Of the wall time: in the core, in the world, in the recorder; the loop and the devices have the rest."""
    core: Stat
    world: Stat
    recorder: Stat
    """Each tick, us."""
    steps_per_tick: int
    """Physics steps."""
    steps_per_s: float
    """Physics steps per second of the world's own time."""
    log_bytes: int

    @property
    def speed(self) -> float:
        """Simulated seconds per second of the world's own time."""
        return self.sim_s / self.world_s


@contextmanager
def _kept(ticks: list[Tick]) -> Iterator[None]:
    """Keep every tick that goes to a recorder."""
    record = Recorder.tick

    def tick(self: Recorder, tick: Tick, *more: Any) -> None:
        ticks.append(tick)
        record(self, tick, *more)

    with patch.object(Recorder, "tick", tick):
        yield


def fly_in_pybullet(config: Config, longest: float | None = None) -> Flight | None:
    """The same mission in PyBullet; None where that is not installed."""
    if find_spec("pybullet") is None:
        return None
    plant = replace(config.world.plant, kind=PlantKind.PYBULLET)
    return fly(replace(config, world=replace(config.world, plant=plant)), longest)[0]


def fly(config: Config, longest: float | None = None) -> tuple[Flight, list[Tick]]:
    """Fly the mission once; ``longest`` breaks it off after so much simulated time, s."""
    core, world, ticking = Probe((loop, "step")), Probe((World, "advance")), Probe((Recorder, "tick"))
    keyframes = Probe((Recorder, "keyframe"), (Recorder, "close"))
    ticks: list[Tick] = []
    outputs: list[Outputs] = []
    with TemporaryDirectory() as folder, ExitStack() as stack:
        log = Path(folder) / "log.mcap"
        if longest is not None:
            stack.enter_context(patch.object(simulate, "LONGEST", longest))
        for probe in (core, world, ticking, keyframes):
            stack.enter_context(probe.watching())
        stack.enter_context(_kept(ticks))
        start = perf_counter_ns()
        simulate.simulate(config, log, lambda out, t: outputs.__setitem__(slice(None), [out]))
        wall = (perf_counter_ns() - start) * 1e-9
        size = log.stat().st_size
    sim_s = ticks[-1].inputs.t_ns * 1e-9
    step = config.world.plant.physics_step
    advancing = sum(world.spans) * 1e-9
    return (
        Flight(
            ended_in=outputs[-1].phase.value,
            sim_s=sim_s,
            wall_s=wall,
            core_s=sum(core.spans) * 1e-9,
            world_s=advancing,
            recorder_s=(sum(ticking.spans) + sum(keyframes.spans)) * 1e-9,
            core=stat(core.all()),
            world=stat(world.all()),
            recorder=stat(ticking.all()),
            steps_per_tick=round(sim_s / step / len(world.spans)),
            steps_per_s=sim_s / step / advancing,
            log_bytes=size,
        ),
        ticks,
    )
