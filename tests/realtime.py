"""Real-time flights of one machine come one after the other: two at once would only measure each other.

Nor does anything else run beside them in ``make test``: a pseudo-terminal's bytes are carried by workers of the kernel
that wait their turn behind every busy process, whatever the priority of ours. Where a machine holds such bytes back
all the same, a flight says nothing of our code: what fails then is skipped, with the reason (tests/conftest.py).
"""

from __future__ import annotations

import fcntl
import os
import select
import tempfile
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

#: Marks of a module with such flights. They also wait for those of others.
REALTIME = [pytest.mark.realtime, pytest.mark.timeout(1800)]

#: A byte that needs longer through a pseudo-terminal was held back, s; a servo that is silent for so long is lost.
_HELD_BACK, _LOST = 0.010, 0.045
#: So many bytes held back, and no flight can be judged.
_MANY = 10


@contextmanager
def alone() -> Iterator[None]:
    """Wait for the flights of other test processes to end, and keep the next ones waiting."""
    with (Path(tempfile.gettempdir()) / "pipewright-realtime.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


class Machine:
    """Watches whether the machine keeps time, by a byte through a pseudo-terminal fifty times a second."""

    def __init__(self) -> None:
        self._held_back: list[tuple[float, float]] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="machine", daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        near, far = os.openpty()
        tty.setraw(far)
        try:
            while not self._over.wait(0.02):
                began = time.monotonic()
                os.write(near, b"x")
                if select.select([far], [], [], 5.0)[0]:
                    os.read(far, 64)
                took = time.monotonic() - began
                if took > _HELD_BACK:
                    self._held_back.append((began, took))
        finally:
            os.close(near)
            os.close(far)

    def unfit(self, since: float) -> str:
        """Why nothing in real time could be judged since then (monotonic, s); empty: it could."""
        took = [took for began, took in self._held_back if began >= since]
        if len(took) < _MANY and max(took, default=0.0) < _LOST:
            return ""
        longest = max(took)
        return f"the machine is too busy: it held {len(took)} bytes of a terminal back, one by {longest:.3f} s"

    def stop(self) -> None:
        """Watch no more."""
        self._over.set()
        self._thread.join()
