"""What ``pipewright watch`` asks of the vehicle's configuration: where the pipe is, and the bounds of safety."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread
from typing import Final

import msgspec

from groundstation.watch_model import Known
from groundstation.watch_orders import Asker
from onboard.wire import Outcome, ShowParams

#: After a failure it is asked again after this time, ns.
_AGAIN_NS: Final = 2_000_000_000
_TIMEOUT: Final = 5.0


class UnknownError(Exception):
    """The vehicle does not tell its configuration; the text says why."""


class Knowledge:
    """Asks in the background, and again for each other parameter set. clock: monotonic, ns."""

    def __init__(self, asker: Asker, clock: Callable[[], int]) -> None:
        self._asker, self._clock = asker, clock
        self._wanted: tuple[int, int] | None = None
        self._thread: Thread | None = None
        self._due_ns = 0
        self.known: Known | None = None
        """None: nothing yet."""
        self.why = ""
        """Why the last question had no answer; empty: it had."""

    def look(self, parameters: tuple[int, int]) -> None:
        """Ask if this parameter set (which start of the vehicle, which revision) is not known. Does not wait."""
        if self._thread is not None and self._thread.is_alive():
            return
        if parameters != self._wanted:
            self._wanted, self.known, self._due_ns = parameters, None, 0
        if self.known is None and self._clock() >= self._due_ns:
            self._thread = Thread(target=self._ask, name="watch.known", daemon=True)
            self._thread.start()

    def _ask(self) -> None:
        try:
            ack = self._asker.ask(ShowParams(), timeout=_TIMEOUT, settled=True)
            if ack.outcome is Outcome.REFUSED:
                raise UnknownError(ack.text)
            self.known, self.why = msgspec.yaml.decode(ack.data, type=Known), ""
        except Exception as error:  # it is told, and asked again
            self.why, self._due_ns = str(error) or type(error).__name__, self._clock() + _AGAIN_NS
