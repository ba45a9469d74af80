"""Waiting for something that another thread, process or machine brings about."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event

#: Whatever is waited for comes well before this, s: the machine may be busy.
LONG = 60.0
_never = Event()


def pause(seconds: float) -> None:
    """Let others work, as a person or a device does who sends something now and then."""
    _never.wait(seconds)


def seconds_until(condition: Callable[[], bool]) -> float:
    """How long it takes until ``condition`` comes true. Raises TimeoutError when it does not."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > LONG:
            raise TimeoutError(f"it did not come true within {LONG:g} s")
        pause(0.005)
    return time.monotonic() - began
