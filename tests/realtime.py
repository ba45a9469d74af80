"""Real-time flights of one machine come one after the other: two at once would only measure each other.

Nor does anything else run beside them in ``make test``: a pseudo-terminal's bytes are carried by workers of the kernel
that wait their turn behind every busy process, whatever the priority of ours.
"""

from __future__ import annotations

import fcntl
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

#: Marks of a module with such flights. They also wait for those of others.
REALTIME = [pytest.mark.realtime, pytest.mark.timeout(1800)]


@contextmanager
def alone() -> Iterator[None]:
    """Wait for the flights of other test processes to end, and keep the next ones waiting."""
    with (Path(tempfile.gettempdir()) / "pipewright-realtime.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
