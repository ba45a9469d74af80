"""A process that is attended through its standard input: lines are orders, and its closing is the end.

The kernel closes the pipe when the process at the other end dies, however it dies, so a child that ends then is never
left behind.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from threading import Thread


def watch(on_line: Callable[[str], None], on_end: Callable[[], None]) -> None:
    """Read standard input in a thread: call ``on_line`` for each line that is not empty, and ``on_end`` at its end."""

    def read() -> None:
        for line in sys.stdin:
            if line.strip():
                on_line(line)
        on_end()

    Thread(target=read, name="attended", daemon=True).start()
