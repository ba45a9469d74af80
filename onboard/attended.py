"""A process that is attended through its standard input: lines are orders, and its closing is the end.

The kernel closes the pipe when the process at the other end dies, however it dies, so a child that ends then is never
left behind.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from threading import Thread

_STDIN = 0


def watch(on_line: Callable[[str], None], on_end: Callable[[], None], source: int = _STDIN) -> Thread:
    """Read standard input in a thread: call ``on_line`` for each line that is not blank, and ``on_end`` at its end.

    An order that raises is told on standard error, and the next one is heard. source: the file descriptor to read.
    """

    # Not through sys.stdin: a thread that waits within its lock makes the interpreter abort when the process ends.
    def read() -> None:
        rest = b""
        while True:
            try:
                data = os.read(source, 4096)
            except OSError:  # a terminal that has gone
                data = b""
            *lines, rest = (rest + data).split(b"\n")
            if not data:
                lines.append(rest)
            for line in lines:
                if text := line.decode(errors="replace").strip():
                    _order(on_line, text)
            if not data:
                break
        on_end()

    thread = Thread(target=read, name="attended", daemon=True)
    thread.start()
    return thread


def _order(on_line: Callable[[str], None], text: str) -> None:
    try:
        on_line(text)
    except Exception as error:  # whoever attends must stay able to stop the process
        sys.stderr.write(f"{text}: {type(error).__name__}: {error}\n")
