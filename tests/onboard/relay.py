"""A stretch of network on this machine that can be cut as Wi-Fi is: nothing passes, and nobody is told."""

from __future__ import annotations

import select
import socket
from threading import Event, Thread
from types import TracebackType
from typing import Self


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Relay:
    """Carries TCP connections from ``port`` to another port of loopback. Use as a context manager."""

    def __init__(self, to: int) -> None:
        self._to = to
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._whole = Event()
        self._whole.set()
        self._closing = Event()
        self._pairs: dict[socket.socket, socket.socket] = {}
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

    def _carry(self) -> None:
        while not self._closing.is_set():
            self._whole.wait()
            ready, _, _ = select.select([self._listener, *self._pairs], [], [], 0.02)
            for end in ready:
                if not self._whole.is_set():
                    break
                if end is self._listener:
                    self._join()
                elif end in self._pairs:
                    self._pass(end)
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

    def _pass(self, end: socket.socket) -> None:
        other = self._pairs[end]
        try:
            if data := end.recv(65536):
                other.sendall(data)
                return
        except OSError:
            pass  # an end that breaks off is an end that closes
        for one in (end, other):
            del self._pairs[one]
            one.close()
