"""A stretch of network on this machine that can be cut as Wi-Fi is: nothing passes, and nobody is told."""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from threading import Event, Thread
from types import TracebackType
from typing import Self


class Relay:
    """Carries TCP connections from ``port`` to another port of loopback, ``delay`` seconds late each way.

    Use as a context manager.
    """

    def __init__(self, to: int, delay: float = 0.0) -> None:
        self._to, self._delay = to, delay
        self._late: deque[tuple[float, socket.socket, bytes]] = deque()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._whole = Event()
        self._whole.set()
        self._closing = Event()
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._held: set[socket.socket] = set()
        self._thread = Thread(target=self._carry, name="relay", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        self._whole.set()
        self._thread.join()

    def cut(self) -> None:
        """Let nothing pass any more, neither bytes nor the news that an end has closed."""
        self._whole.clear()

    def mend(self) -> None:
        """Let everything pass again, what has waited first."""
        self._whole.set()

    def hold(self, count: int) -> None:
        """Let nothing more pass on the ``count`` oldest connections, as when a packet is lost again and again."""
        ends = list(self._pairs)[: 2 * count]
        if len(ends) < 2 * count:
            raise ValueError(f"there are {len(self._pairs) // 2} connections")
        self._held.update(ends)

    @property
    def connections(self) -> int:
        """How many there are."""
        return len(self._pairs) // 2

    def _carry(self) -> None:
        while not self._closing.is_set():
            self._whole.wait()
            ready, _, _ = select.select([self._listener, *(self._pairs.keys() - self._held)], [], [], 0.005)
            if not self._whole.is_set():
                continue
            for end in ready:
                if end is self._listener:
                    self._join()
                elif end in self._pairs:
                    self._take(end)
            while self._late and self._late[0][0] <= time.monotonic():
                _, end, data = self._late.popleft()
                if end in self._pairs:
                    self._give(end, data)
        for end in (self._listener, *self._pairs):
            end.close()

    def _join(self) -> None:
        near, _ = self._listener.accept()
        try:
            far = socket.create_connection(("127.0.0.1", self._to))
        except ConnectionRefusedError:
            near.close()
            return
        self._pairs |= {near: far, far: near}

    def _take(self, end: socket.socket) -> None:
        try:
            data = end.recv(65536)
        except OSError:
            data = b""  # an end that breaks off is an end that closes
        if data:
            self._late.append((time.monotonic() + self._delay, self._pairs[end], data))
        else:
            self._part(end)

    def _give(self, end: socket.socket, data: bytes) -> None:
        try:
            end.sendall(data)
        except OSError:
            self._part(end)

    def _part(self, end: socket.socket) -> None:
        for one in (end, self._pairs[end]):
            del self._pairs[one]
            one.close()
