"""The errand of an unattended run: ask for the mission once preflight passes, and know when the run is over.

A hold is what a person would end: it is resumed when nothing is the matter any more, a few times, else it is landed.
"""

from __future__ import annotations

from collections.abc import Callable

from onboard.core.types import Action, Outputs, Phase, Request

#: Rest on the ground before the start is asked for, s.
START_AT = 0.4
#: Preflight that does not pass within this time is given up, s.
PATIENCE = 60.0
#: Nothing has been the matter for this long in a hold when it is resumed, s.
CALM = 2.0
#: A hold that goes on for longer is landed, s.
LONGEST_HOLD = 30.0
#: Holds that are resumed in one run.
RESUMES = 5


class Errand:
    """Watches the ticks of one run.

    request: hands a request to the loop. longest: a mission that has not ended by then is broken off, s. commanded:
    whether a person commands, who then ends the holds.
    """

    def __init__(
        self, request: Callable[[Request], None], longest: float, commanded: Callable[[], bool] = lambda: False
    ) -> None:
        self._request, self._commanded = request, commanded
        self._longest = longest
        self._asked: set[Request] = set()
        self._calm_since: float | None = None
        self._resumes = RESUMES

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
        if outputs.phase is Phase.HOLD and not self._commanded():
            self._end_hold(outputs, t)
        return outputs.phase is not Phase.STOPPED and t < self._longest

    def _end_hold(self, outputs: Outputs, t: float) -> None:
        if outputs.verdict.action > Action.WARN or self._calm_since is None:
            self._calm_since = t
        if outputs.phase_time > LONGEST_HOLD or not self._resumes:
            self.ask_once(Request.LAND)
        elif outputs.phase_time > CALM and t - self._calm_since > CALM:
            self._calm_since = None
            self._resumes -= 1
            self._request(Request.RESUME)
