"""What ``pipewright watch`` has the vehicle show: where the pipe is, the bounds of safety, and events of before."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from threading import Thread
from typing import Final, Generic, TypeVar

import msgspec

from groundstation.watch_model import Known
from groundstation.watch_orders import Asker
from onboard.wire import Ask, Outcome, Told

T = TypeVar("T")

#: After a failure it is asked again after this time, ns.
_AGAIN_NS: Final = 2_000_000_000
_TIMEOUT: Final = 5.0


class RefusedError(Exception):
    """The vehicle does not show it; the text says why."""


class Shown(Generic[T]):
    """One thing that the vehicle shows, asked for in the background. clock: monotonic, ns."""

    def __init__(self, asker: Asker, what: Ask, read: Callable[[bytes], T], clock: Callable[[], int]) -> None:
        self._asker, self._what, self._read, self._clock = asker, what, read, clock
        self._version: Hashable = None
        self._thread: Thread | None = None
        self._due_ns = 0
        self.value: T | None = None
        """None: nothing yet."""
        self.why = ""
        """Why the last question had no answer; empty: it had."""

    def look(self, version: Hashable) -> None:
        """Ask if what there is is of another version. Does not wait."""
        if self._thread is not None and self._thread.is_alive():
            return
        if version != self._version:
            self._version, self.value, self._due_ns = version, None, 0
        if self.value is None and self._clock() >= self._due_ns:
            self._thread = Thread(target=self._ask, name="watch.shown", daemon=True)
            self._thread.start()

    def _ask(self) -> None:
        try:
            ack = self._asker.ask(self._what, timeout=_TIMEOUT, settled=True)
            if ack.outcome is Outcome.REFUSED:
                raise RefusedError(ack.text)
            self.value, self.why = self._read(ack.data), ""
        except Exception as error:  # it is told, and asked again
            self.why, self._due_ns = str(error) or type(error).__name__, self._clock() + _AGAIN_NS


def read_known(data: bytes) -> Known:
    """Of the whole configuration, as YAML, what the screen needs."""
    return msgspec.yaml.decode(data, type=Known)


def read_events(data: bytes) -> tuple[Told, ...]:
    """Events of before we came."""
    return msgspec.json.decode(data, type=tuple[Told, ...])
