"""A thread that sends what it is given, in order, so that nobody else ever waits for a link."""

from __future__ import annotations

import queue
from collections.abc import Callable
from threading import Thread


class Outbox:
    """Takes things to send, from any thread; what does not fit is dropped and counted. No call waits.

    size: things that may wait. failed: told why one could not be sent, in the outbox's thread; it is dropped.
    """

    def __init__(self, name: str, size: int, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue(size)
        self._closed = False
        self.dropped = 0
        """Things that were not sent."""
        self._thread = Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, send: Callable[[], None]) -> None:
        """Send by calling ``send``, later and elsewhere."""
        try:
            self._waiting.put_nowait(send)
        except queue.Full:
            self.dropped += 1

    def close(self, timeout: float) -> None:
        """Send what waits for at most ``timeout`` seconds, then nothing any more."""
        try:
            self._waiting.put(None, timeout=timeout)
        except queue.Full:
            self._closed = True
        self._thread.join(timeout)
        self._closed = True

    def _work(self) -> None:
        while not self._closed and (send := self._waiting.get()) is not None:
            try:
                send()
            except Exception as error:  # one that cannot be sent must not keep the next ones
                self.dropped += 1
                self._failed(error)
