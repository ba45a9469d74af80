"""The errand of an unattended run: ask for the mission once preflight passes, and know when the run is over."""

from __future__ import annotations

from collections.abc import Callable

from onboard.core.types import Outputs, Phase, Request

#: Rest on the ground before the start is asked for, s.
START_AT = 0.4
#: Preflight that does not pass within this time is given up, s.
PATIENCE = 60.0


class Errand:
    """Watches the ticks of one run.

    request: hands a request to the loop. longest: a mission that has not ended by then is broken off, s.
    """

    def __init__(self, request: Callable[[Request], None], longest: float) -> None:
        self._request = request
        self._longest = longest
        self._asked: set[Request] = set()

    def ask_once(self, request: Request) -> None:
        """Ask for something that has not been asked for yet."""
        if request not in self._asked:
            self._asked.add(request)
            self._request(request)

    def goes_on(self, outputs: Outputs, t: float) -> bool:
        """Whether the run is not over at ``t`` (s since its start); asks for the start when it is time."""
        if outputs.phase is Phase.PREFLIGHT:
            if t >= START_AT and outputs.estimate.valid and not outputs.verdict.reasons:
                self.ask_once(Request.START)
            return t < PATIENCE
        return outputs.phase is not Phase.STOPPED and t < self._longest
