"""Real-time flights of one machine come one after the other: two at once would only measure each other."""

from __future__ import annotations

import fcntl
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: For tests with such flights, s: they also wait for those of others.
LONGEST = 1800


@contextmanager
def alone() -> Iterator[None]:
    """Wait for the flights of other test processes to end, and keep the next ones waiting."""
    with (Path(tempfile.gettempdir()) / "pipewright-realtime.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
