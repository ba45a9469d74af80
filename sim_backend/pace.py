"""A simulated world moved on the wall clock, and the faces that show it to somebody."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from threading import Event, Thread
from typing import Protocol

from drivers.mailbox import Notice
from sim_backend.world import World

#: So far behind, the pace starts anew instead of catching up, s.
LATE = 0.1


class Face(Protocol):
    """One way in which a world is shown: an emulated device, or a link to another process."""

    period: float
    """Between two calls of ``publish``, s: a whole number of physics steps."""

    def receive(self) -> None:
        """Take what has come. Called before each advance of the world, more often than ``publish``."""

    def publish(self) -> None:
        """Say what is due, now that the world stands at a multiple of ``period``."""


class Crier:
    """A face that says what another has had to tell."""

    period = 0.1

    def __init__(self, notices: Callable[[], Sequence[Notice]], say: Callable[[str], object]) -> None:
        self._notices, self._say = notices, say

    def receive(self) -> None:
        """Nothing comes in."""

    def publish(self) -> None:
        """Say it."""
        for notice in self._notices():
            self._say(notice.text)


class Pace:
    """Advances the world from one due time of a face to the next, each at its moment of the wall clock.

    One thread, its own (``start``) or the caller's (``run``), calls all faces and moves the world.
    """

    def __init__(self, world: World, faces: Sequence[Face]) -> None:
        self._world = world
        self._faces = [(face, round(face.period * 1e9)) for face in faces]
        self._offset_ns = 0
        self._stopping = Event()
        self._thread: Thread | None = None
        #: Seconds that the world could not keep pace with the wall clock, given up so far.
        self.slipped = 0.0

    def clock(self, t_ns: int) -> int:
        """World time as nanoseconds of the machine's monotonic clock. Any thread may ask."""
        return t_ns + self._offset_ns

    def start(self) -> None:
        """Run in a thread of its own."""
        self._stopping.clear()
        self._offset_ns = time.monotonic_ns() - self._world.snapshot.t_ns
        self._thread = Thread(target=self.run, name="world", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End ``run``, wherever it runs, and wait for the thread that ``start`` made. Safe to call twice."""
        self._stopping.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()

    def run(self) -> None:
        """Move the world until ``stop`` is called."""
        world = self._world
        now = world.snapshot.t_ns
        self._offset_ns = time.monotonic_ns() - now
        due = [now + period for _, period in self._faces]
        while not self._stopping.is_set():
            until = min(due)
            rest = until + self._offset_ns - time.monotonic_ns()
            if rest > 0:
                time.sleep(rest * 1e-9)
            elif -rest > LATE * 1e9:
                self._offset_ns -= rest
                self.slipped -= rest * 1e-9
            for face, _ in self._faces:
                face.receive()
            world.advance((until - world.snapshot.t_ns) * 1e-9)
            for number, (face, period) in enumerate(self._faces):
                if due[number] == until:
                    due[number] += period
                    face.publish()
