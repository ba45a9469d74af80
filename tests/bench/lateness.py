"""How late the loop's ticks begin, beside a bare timer that does nothing, by turns in one process."""

from __future__ import annotations

import asyncio
import gc
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from onboard.clock import WallClock
from onboard.config import Config, dump_config
from onboard.core.types import Outputs, Tick
from onboard.loop import Loop
from onboard.recorder import Recorder
from onboard.records import RunInfo, Timing
from tests.bench.measure import Stat, stat

_PERIOD_NS = 4_000_000


class Lateness(Struct, frozen=True):
    """Of ticks at 250 Hz against their schedule, us."""

    loop: Stat
    """The loop on the wall clock, with the core on a flown mission's inputs and the recorder in its thread."""
    bare: Stat
    """``time.sleep`` until the next due time, and nothing else."""

    @property
    def ratio(self) -> float:
        """Loop to bare timer, in the median."""
        return self.loop.median / self.bare.median


class _Flown:
    """A device that shows what a mission's ticks had of it, now, and drops its commands."""

    def __init__(self, samples: Sequence[Any], ages_ns: Sequence[int]) -> None:
        self._left = iter(zip(samples, ages_ns, strict=True))

    def latest(self) -> Any:
        sample, age_ns = next(self._left)
        return None if sample is None else replace(sample, t_ns=time.monotonic_ns() - age_ns)

    def command(self, command: object) -> None: ...


class _Devices:
    """The three devices of a mission that was flown."""

    def __init__(self, ticks: Sequence[Tick]) -> None:
        def of(name: str) -> Any:
            samples = [getattr(tick.inputs, name) for tick in ticks]
            ages = [0 if s is None else tick.inputs.t_ns - s.t_ns for s, tick in zip(samples, ticks, strict=True)]
            return _Flown(samples, ages)

        self.autopilot, self.odometry, self.servos = of("autopilot"), of("odometry"), of("servos")

    def relay(self) -> None: ...

    def obstacles(self) -> tuple[str, ...]:
        return ()


class _Recorder(Recorder):
    """The recorder as in flight, and how late each tick was."""

    late_ns: list[int]

    def timing(self, timing: Timing) -> None:
        super().timing(timing)
        self.late_ns.append(max(0, round(1e9 * timing.late)))


def measure(ticks: Sequence[Tick], config: Config, turns: int = 4) -> Lateness:
    """Run the loop over the first ticks of a mission; ``turns`` of one second each for the loop and for the timer."""
    a_turn = min(250, len(ticks) // turns)
    bare: list[int] = []
    with TemporaryDirectory() as folder:
        info = RunInfo("bench", config.scenario, config.law, config.seed, realtime=True)
        recorder = _Recorder(Path(folder) / "log.mcap", info, config, dump_config(config), background=True)
        recorder.late_ns = []
        with recorder:
            loop = Loop(_Devices(ticks), WallClock(), config, recorder, timed=True)
            requests = {i: tick.inputs.request for i, tick in enumerate(ticks) if tick.inputs.request is not None}
            done = 0

            def on_tick(outputs: Outputs) -> bool:
                nonlocal done
                done += 1
                if (request := requests.get(done)) is not None:
                    loop.request(request)
                return done % a_turn != 0

            gc.collect()
            gc.freeze()  # as in flight
            try:
                for _ in range(turns):
                    asyncio.run(loop.run(on_tick))
                    bare += _bare(a_turn)
            finally:
                gc.unfreeze()
    return Lateness(stat(recorder.late_ns), stat(bare))


def _bare(count: int) -> list[int]:
    """Lateness of each wake-up of a timer, ns."""
    late = []
    due = time.monotonic_ns()
    for _ in range(count):
        due += _PERIOD_NS
        time.sleep(max(0, due - time.monotonic_ns()) * 1e-9)
        late.append(max(0, time.monotonic_ns() - due))
    return late
