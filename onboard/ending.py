"""How a run is ended when somebody asks for it: by a signal, or by closing standard input.

On the ground it ends at once. A flying vehicle is landed first, by the mission, which takes the way out of contact;
asked again, or when the landing takes too long, the process leaves and the autopilot is told to land by itself.
"""

from __future__ import annotations

import asyncio
import signal
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from typing import Final

from msgspec.structs import replace

from drivers.protocols import AutopilotDevice
from drivers.samples import AutopilotCommand, Engage, FlightMode
from onboard.clock import Clock
from onboard.core.mission import GROUND
from onboard.core.types import Event, Outputs, Phase, Request, Severity

#: A landing that takes longer is given up, s: more than the mission itself allows for a retreat and a landing.
PATIENCE: Final = 120.0
#: A request that did not lead to a landing is made again after this time, s.
_AGAIN: Final = 1.0
_LANDING: Final = (Phase.LAND, Phase.RETREAT_LAND)
#: The autopilot is told to land for this long at most, and this often, s.
_TELL_TIME, _TELL_PERIOD = 2.0, 0.02


class _Stage(Enum):
    CONNECTING = "no tick was made yet"
    FLYING = "nobody has asked"
    LANDING = "waiting for the ground"
    ENDED = "no more ticks"


class Ending:
    """Watches the ticks of a run, and says when it is over because somebody has asked for its end.

    request: hands a request to the loop. patience: for the landing, s.
    """

    def __init__(self, request: Callable[[Request], None], patience: float = PATIENCE) -> None:
        self._request, self._patience = request, patience
        self._stage = _Stage.CONNECTING
        self._asks: deque[str] = deque()
        self._said: deque[tuple[str, Severity, str]] = deque()
        self._began = 0.0
        self._asked_at = 0.0
        self.handed_over: AutopilotCommand | None = None
        """What the autopilot is still to be told once the loop has ended; None: nothing."""

    @property
    def connecting(self) -> bool:
        """Nothing ticks yet."""
        return self._stage is _Stage.CONNECTING

    def ask(self, why: str) -> None:
        """Somebody wants the run to end; from any thread."""
        self._asks.append(why)

    def goes_on(self, outputs: Outputs, t: float) -> bool:
        """Whether the run is not over after a tick at ``t`` (s); to be called in every one."""
        if self._stage is _Stage.CONNECTING:
            self._stage = _Stage.FLYING
        while self._asks:
            why = self._asks.popleft()
            if self._stage is _Stage.LANDING and outputs.phase not in GROUND:
                return self._leave(outputs, f"Asked again to end ({why})")
            if self._stage is _Stage.FLYING:
                self._stage, self._began, self._asked_at = _Stage.LANDING, t, -_AGAIN + t
                if outputs.phase not in GROUND:
                    text = f"Asked to end ({why}): landing first. Ask again to leave in flight."
                    self._say("ending", Severity.WARNING, text)
        if self._stage is not _Stage.LANDING:
            return True
        if outputs.phase in GROUND:
            self._stage = _Stage.ENDED
            self._say("ended", Severity.INFO, "Ended as asked, on the ground.")
            return False
        if t - self._began > self._patience:
            return self._leave(outputs, f"The landing has taken more than {self._patience:g} s")
        if outputs.phase not in _LANDING and t - self._asked_at >= _AGAIN:
            self._asked_at = t
            self._request(Request.LAND)
        return True

    def events(self, t_ns: int) -> tuple[Event, ...]:
        """What there has been to tell since the last call, stamped with ``t_ns``."""
        return tuple(Event(t_ns, *self._said.popleft()) for _ in range(len(self._said)))

    def _leave(self, outputs: Outputs, why: str) -> bool:
        self._stage = _Stage.ENDED
        wanted = outputs.autopilot.engage
        if wanted in (Engage.OFFBOARD, Engage.LAND):
            self.handed_over = replace(outputs.autopilot, engage=Engage.LAND, thrust=0.0)
            self._say("left", Severity.ERROR, f"{why}: leaving in flight. The autopilot is told to land by itself.")
        else:
            self._say("left", Severity.ERROR, f"{why}: leaving. The autopilot, or a pilot, has command already.")
        return False

    def _say(self, code: str, severity: Severity, text: str) -> None:
        self._said.append((code, severity, text))


async def hand_over(autopilot: AutopilotDevice, command: AutopilotCommand, clock: Clock) -> str:
    """Tell the autopilot to land by itself until it does, for a moment at most; returns a sentence on what it does."""
    end = clock.now_ns() + round(_TELL_TIME * 1e9)
    while (now := clock.now_ns()) < end:
        autopilot.command(command)
        await clock.sleep_until(now + round(_TELL_PERIOD * 1e9))
        told = autopilot.latest()
        if told is not None and (told.mode is FlightMode.LAND or not told.armed):
            return "The autopilot lands by itself."
    return "The autopilot has not said that it lands: its own failsafe takes over when set-points stay away."


@contextmanager
def signals(ending: Ending, reload: Callable[[], None]) -> Iterator[Callable[[str], None]]:
    """SIGINT and SIGTERM ask for the end, SIGHUP for a reload, within the running event loop.

    While nothing ticks yet, being asked for the end breaks off what is inside (and nothing is raised). Gives a function
    that asks for the end in the same way, with the reason as its argument, from any thread.
    """
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task is not None
    broken_off = False

    def hear(why: str) -> None:
        nonlocal broken_off
        ending.ask(why)
        if ending.connecting and not broken_off:
            broken_off = True
            task.cancel()

    def end(why: str) -> None:
        if not loop.is_closed():  # else the process is ending already
            loop.call_soon_threadsafe(hear, why)

    handlers = {signal.SIGINT: hear, signal.SIGTERM: hear, signal.SIGHUP: lambda name: reload()}
    for number, handler in handlers.items():
        loop.add_signal_handler(number, handler, number.name)
    try:
        yield end
    except asyncio.CancelledError:
        if not broken_off or task.uncancel() > 0:
            raise
    finally:
        for number in handlers:
            loop.remove_signal_handler(number)
