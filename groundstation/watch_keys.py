"""What keys do at ``pipewright watch``: orders, and the two questions, kill and quit. Pure: the time comes in."""

from __future__ import annotations

from typing import Final

from msgspec import Struct

from groundstation.twice import Twice
from onboard.messages import Request
from onboard.wire import Ask, Mission, Stop

#: The same key again within this time is one that is held down, s.
_HELD: Final = 0.4
KILL, QUIT, YES = "k", "q", "y"


class Order(Struct, frozen=True):
    """To be asked of the vehicle."""

    name: str
    ask: Ask


class Leave(Struct, frozen=True):
    """The screen is to be left."""


ORDERS: Final = {
    "h": Order("hold", Mission(Request.HOLD)),
    "r": Order("retreat", Mission(Request.RETREAT)),
    "s": Order("stop", Stop()),
    "space": Order("stop", Stop()),
    "l": Order("land", Mission(Request.LAND)),
    "u": Order("resume", Mission(Request.RESUME)),
}


_KILLS: Final = Order("kill", Mission(Request.KILL))


class Hand:
    """Remembers what was pressed before."""

    def __init__(self) -> None:
        self._kill = Twice()
        self._leaving = False
        self._last = ("", 0)

    def press(self, key: str, now_ns: int, *, needed: bool) -> Order | Leave | None:
        """What a key asks for. needed: the vehicle flies and this station commands it, so leaving is asked about."""
        key = key.lower() if len(key) == 1 else key
        held = key == self._last[0] and now_ns - self._last[1] < _HELD * 1e9
        self._last = (key, now_ns)
        leaving, self._leaving = self._leaving, False  # any other key is no to either question
        if key == KILL:
            return _KILLS if self._kill.press(now_ns * 1e-9) else None
        self._kill.forget()
        if key == QUIT:
            self._leaving = needed
            return None if needed else Leave()
        if key == YES and leaving:
            return Leave()
        if not held:
            return ORDERS.get(key)
        return None

    def due(self, now_ns: int) -> Order | None:
        """What is to be asked without another key: a kill whose second press was no repetition of the first."""
        return _KILLS if self._kill.due(now_ns * 1e-9) else None

    def question(self, now_ns: int) -> str:
        """What is asked of the person; empty: nothing."""
        if left := self._kill.left(now_ns * 1e-9):
            return f"KILL?  k again within {left:.1f} s cuts motors and servo torque: in the air it FALLS"
        if self._leaving:
            return "QUIT?  It flies, and you command it: without you it holds, then lands.  y quit   n stay"
        return ""
