"""A desk flight: the simulated world and the flight process as children, the one made known to the other.

Both are attended: they end when this process does, however it ends.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import IO

#: The first world on a machine compiles before it answers, s.
WORLD_PATIENCE = 180.0
#: A child that has been told to end gets this long, s.
END_PATIENCE = 20.0
_GLANCE = 0.2
#: Real-time priorities. The world's is the higher one: a flight process that computes must not stop the world.
_PRIORITY = {"world": 12, "fly": 10}


class WorldError(Exception):
    """The process that holds the world did not start, or died; ``code`` is its exit code."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


class Desk:
    """The two processes of a desk flight. Use as a context manager; leaving it ends both.

    ``common`` are arguments that both get: configuration, law, settings, seed.
    """

    def __init__(self, common: Sequence[str]) -> None:
        self._common = tuple(common)
        self._world: subprocess.Popen[str] | None = None
        self._flight: subprocess.Popen[str] | None = None
        self._signals: list[int] = []

    def __enter__(self) -> Desk:
        return self

    def __exit__(self, *_: object) -> None:
        for child in (self._flight, self._world):
            if child is not None:
                end(child)

    def start_world(self) -> dict[str, str]:
        """Start the world; gives what the flight process must be told of it. Raises WorldError."""
        self._world = start(["world", *self._common], stdout=subprocess.PIPE)
        assert self._world.stdout is not None
        line = _first_line(self._world.stdout, WORLD_PATIENCE)
        if not line:
            end(self._world)
            code = self._world.returncode
            raise WorldError(f"the simulated world did not start (code {code})", code)
        endpoints: dict[str, str] = json.loads(line)
        return endpoints

    def fly(self, arguments: Sequence[str], endpoints: dict[str, str]) -> int:
        """Run the flight process to its end; gives its exit code. Raises WorldError when the world dies meanwhile."""
        sets = [f"--set={path}={value}" for path, value in endpoints.items()]
        self._flight = flight = start(["fly", *self._common, *sets, "--attended", *arguments])
        for number in self._signals:
            flight.send_signal(number)
        while flight.poll() is None:
            assert self._world is not None
            if (code := self._world.poll()) is not None:
                end(flight)
                raise WorldError(f"the simulated world died (code {code})", code)
            try:
                flight.wait(_GLANCE)
            except subprocess.TimeoutExpired:
                continue
        return flight.returncode

    def order(self, line: str) -> None:
        """A line for the world: a fault in YAML that begins now."""
        assert self._world is not None
        assert self._world.stdin is not None
        self._world.stdin.write(line + "\n")
        self._world.stdin.flush()

    def pass_on(self, number: int) -> None:
        """Hand a signal to the flight process, or keep it for when there is one."""
        if self._flight is None:
            self._signals.append(number)
        else:
            self._flight.send_signal(number)


def start(
    arguments: Sequence[str],
    stdout: int | None = None,
    stderr: int | None = None,
    program: Sequence[str] = ("-m", "onboard"),
) -> subprocess.Popen[str]:
    """Start an onboard process in a process group of its own, attended through its standard input."""
    command = [sys.executable, "-P", *program, *arguments]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stdout, stderr=stderr, text=True, process_group=0)
    prefer(child.pid, _PRIORITY[arguments[0]])
    return child


def prefer(pid: int, priority: int) -> None:
    """Let a process that was just started, and all threads that it will have, run before all ordinary ones.

    Where the machine grants it (root, RLIMIT_RTPRIO): what else runs there is not what is measured.
    """
    with suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(priority))


def end(child: subprocess.Popen[str]) -> None:
    """Let a child end in order; where it does not, make it."""
    if child.stdin is not None and not child.stdin.closed:
        with suppress(BrokenPipeError):
            child.stdin.close()
    for number in (None, signal.SIGTERM, signal.SIGKILL):
        if number is not None:
            child.send_signal(number)
        try:
            child.wait(END_PATIENCE)
        except subprocess.TimeoutExpired:
            continue
        break
    if child.stdout is not None:
        child.stdout.close()


def _first_line(stream: IO[str], patience: float) -> str:
    """The first line, or nothing when the stream closes or ``patience`` (s) is over."""
    until = time.monotonic() + patience
    text = b""
    while not text.endswith(b"\n"):
        ready, _, _ = select.select([stream], [], [], max(0.0, until - time.monotonic()))
        piece = os.read(stream.fileno(), 4096) if ready else b""
        if not piece:
            return ""
        text += piece
    return text.decode()
