"""What keys do at ``pipewright watch``: orders, and the two questions, kill and quit. Pure: the time comes in."""

from __future__ import annotations

from typing import Final

from msgspec import Struct

from onboard.messages import Request
from onboard.wire import Ask, Mission, Stop

#: Kill is to be pressed again within this time, s.
CONFIRM: Final = 2.0
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


class Hand:
    """Remembers what was pressed before."""

    def __init__(self) -> None:
        self._kill_ns: int | None = None
        self._leaving = False
        self._last = ("", 0)

    def press(self, key: str, now_ns: int, *, needed: bool) -> Order | Leave | None:
        """What a key asks for. needed: the vehicle flies and this station commands it, so leaving is asked about."""
        key = key.lower() if len(key) == 1 else key
        held = key == self._last[0] and now_ns - self._last[1] < _HELD * 1e9
        self._last = (key, now_ns)
        killing, leaving = self.killing(now_ns) > 0.0, self._leaving
        self._kill_ns, self._leaving = None, False  # any other key is no to either question
        if key == KILL:
            if killing:
                return Order("kill", Mission(Request.KILL))
            self._kill_ns = now_ns
        elif key == QUIT:
            self._leaving = needed
            return None if needed else Leave()
        elif key == YES and leaving:
            return Leave()
        elif not held:
            return ORDERS.get(key)
        return None

    def killing(self, now_ns: int) -> float:
        """Time left to press kill again, s; 0: it was not pressed."""
        return max(0.0, CONFIRM - (now_ns - self._kill_ns) * 1e-9) if self._kill_ns is not None else 0.0

    def question(self, now_ns: int) -> str:
        """What is asked of the person; empty: nothing."""
        if left := self.killing(now_ns):
            return f"KILL?  k again within {left:.1f} s cuts motors and servo torque: in the air it FALLS"
        if self._leaving:
            return "QUIT?  It flies, and you command it: without you it holds, then lands.  y quit   n stay"
        return ""
