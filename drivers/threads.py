"""Names for the threads that vendors' libraries start, so that the kernel can tell whose work is whose."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: The kernel keeps no more of a name.
LONGEST = 15


@contextmanager
def named(name: str) -> Iterator[None]:
    """Threads that are started inside by the calling thread, and those that they start, bear this name.

    A thread takes over the name of the one that starts it, so the calling thread bears it meanwhile, and none but code
    that starts threads at once belongs inside. ``top -H`` and ``/proc/PID/task/TID/comm`` show the names.
    """
    comm = Path("/proc/thread-self/comm")
    before = comm.read_text().strip()
    comm.write_text(name[:LONGEST])
    try:
        yield
    finally:
        comm.write_text(before)
