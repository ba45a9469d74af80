"""A thread that sends what it is given, in order, so that nobody else ever waits for a link."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from threading import Thread


class Outbox:
    """Takes things to send, from any thread; what does not fit is dropped and counted. ``put`` never waits.

    size: things that may wait, also before ``start``. failed: told, in the outbox's thread, why one could not be sent.
    """

    def __init__(self, name: str, size: int, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue(size)
        self._closed = self._given_up = False
        self.dropped = 0
        """Things that were not sent."""
        self._thread = Thread(target=self._work, name=name, daemon=True)

    def start(self) -> None:
        """Begin to send."""
        self._thread.start()

    def put(self, send: Callable[[], None]) -> None:
        """Send by calling ``send``, later and elsewhere."""
        if self._closed:
            self.dropped += 1
            return
        try:
            self._waiting.put_nowait(send)
        except queue.Full:
            self.dropped += 1

    def close(self, timeout: float) -> None:
        """Take no more; send what waits for at most ``timeout`` seconds, then nothing any more."""
        self._closed = True
        deadline = time.monotonic() + timeout
        try:
            self._waiting.put(None, timeout=timeout)
        except queue.Full:
            self._given_up = True
        self._thread.join(max(0.0, deadline - time.monotonic()))
        self._given_up = True

    def _work(self) -> None:
        while not self._given_up and (send := self._waiting.get()) is not None:
            try:
                send()
            except Exception as error:  # one that cannot be sent must not keep the next ones
                self.dropped += 1
                self._failed(error)
