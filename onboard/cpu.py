"""How much of a processor each part of the flight process takes: read from the kernel, thread by thread."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

#: Between two samples, s.
PERIOD: Final = 1.0
OTHER: Final = "other"
#: Parts of the process, and how the names of their threads begin.
PARTS: Final = {
    "loop": ("MainThread",),
    "dynamixel": ("dynamixel",),
    "recorder": ("recorder",),
    "mavsdk": ("mavsdk",),
    "realsense": ("realsense", "t265"),
    "world": ("world",),
}
_TASKS: Final = Path("/proc/self/task")


class Used(NamedTuple):
    """What a thread has used since it was started."""

    name: str
    seconds: float


def part(name: str) -> str:
    """The part that a thread of this name belongs to."""
    return next((part for part, begins in PARTS.items() if name.startswith(begins)), OTHER)


def threads() -> dict[int, Used]:
    """All threads of this process by their number: Python's under their names there, others under the kernel's."""
    known = {thread.native_id: thread.name for thread in threading.enumerate()}
    tick = os.sysconf("SC_CLK_TCK")
    found = {}
    for task in _TASKS.iterdir():
        try:
            stat = (task / "stat").read_text()
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended meanwhile
        comm, _, rest = stat.partition("(")[2].rpartition(")")
        fields = rest.split()
        number = int(task.name)
        found[number] = Used(known.get(number) or comm, (int(fields[11]) + int(fields[12])) / tick)
    return found


def shares(before: Mapping[int, Used], after: Mapping[int, Used], elapsed: float) -> dict[str, float]:
    """Share of one processor that each part has taken between two looks, ``elapsed`` seconds apart.

    What a thread used after the first look and before its end, when it did not live to the second, is not known.
    """
    result = dict.fromkeys((*PARTS, OTHER), 0.0)
    for number, used in after.items():
        began = before.get(number)
        result[part(used.name)] += (used.seconds - (began.seconds if began is not None else 0.0)) / elapsed
    return result


class CpuMeter:
    """Looks once a second, from a thread of its own. The kernel counts in hundredths of a second."""

    def __init__(self) -> None:
        self._over = threading.Event()
        self._latest: dict[str, float] = {}
        self._thread = threading.Thread(target=self._run, name="cpu", daemon=True)
        self._first = threads()
        self._began = time.monotonic()
        self._thread.start()

    def latest(self) -> dict[str, float]:
        """Shares of one processor by part, over the last second; empty before the first has passed."""
        return self._latest

    def mean(self) -> dict[str, float]:
        """The same since the meter was made."""
        return shares(self._first, threads(), time.monotonic() - self._began)

    def stop(self) -> None:
        """Look no more; safe to call twice."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        before, since = self._first, self._began
        while not self._over.wait(PERIOD):
            now, after = time.monotonic(), threads()
            self._latest = shares(before, after, now - since)
            before, since = after, now
