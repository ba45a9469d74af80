"""How much faster a campaign is flown by two workers than by one."""

from __future__ import annotations

from time import perf_counter

from msgspec import Struct
from msgspec.structs import replace

from groundstation.campaign_file import Job
from groundstation.campaign_pool import pool
from groundstation.campaign_run import failed, flown

#: Asked of two workers on two free cores.
TARGET = 1.8
_JOB = Job(0, "paper", None, (), 0, 30.0, None)


class Throughput(Struct, frozen=True):
    """Runs of equal length; the start of the workers, and the first run of each, left out."""

    runs: int
    sim_s: float
    """Simulated, of each run."""
    one: float
    two: float
    """Wall time for all of them, s."""

    @property
    def ratio(self) -> float:
        """How many times as fast."""
        return self.one / self.two

    @property
    def speed(self) -> float:
        """Times real time, with two."""
        return self.runs * self.sim_s / self.two


def measure(runs: int, sim_s: float = _JOB.longest) -> Throughput:
    """Fly so many runs with one worker, then the same with two."""
    jobs = [replace(_JOB, run=k, seed=k, longest=sim_s) for k in range(runs)]
    times = []
    for workers in (1, 2):
        with pool(workers, None) as flying:
            # The first runs load the compiled code; there are enough that every worker has one.
            list(flying.each(flown, [replace(_JOB, run=k, longest=1.0) for k in range(4 * workers)], failed))
            begun = perf_counter()
            rows = list(flying.each(flown, jobs, failed))
            times.append(perf_counter() - begun)
            errors = [row["error"] for row in rows if row["error"]]
            if errors:
                raise RuntimeError(errors[0])
    return Throughput(runs, sim_s, *times)
