"""Time for the loop: the wall clock for flight, a virtual clock that moves a simulated world for the desk."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Protocol

#: The virtual clock gives way to other tasks once in so many sleeps.
GIVE_WAY = 50


class Clock(Protocol):
    """What the loop knows of time."""

    def now_ns(self) -> int:
        """Nanoseconds on a clock that never goes back."""

    async def sleep_until(self, t_ns: int) -> None:
        """Return at ``t_ns`` or, when that has passed, at once."""


class WallClock:
    """The machine's monotonic clock."""

    def now_ns(self) -> int:
        """Nanoseconds since some moment of the past."""
        return time.monotonic_ns()

    async def sleep_until(self, t_ns: int) -> None:
        """Sleep; gives way to other tasks at least once, even when late."""
        await asyncio.sleep(max(0, t_ns - time.monotonic_ns()) * 1e-9)


class VirtualClock:
    """Time that passes only while somebody sleeps, by moving the world: deterministic and as fast as it computes.

    advance: called with the seconds to move the world by.
    """

    def __init__(self, advance: Callable[[float], None]) -> None:
        self._now_ns = 0
        self._advance = advance
        self._sleeps = 0

    def now_ns(self) -> int:
        """Simulated nanoseconds since the start."""
        return self._now_ns

    async def sleep_until(self, t_ns: int) -> None:
        """Move the world to ``t_ns``. Gives way now and then, so that an interrupt is heard."""
        self._sleeps += 1
        if self._sleeps % GIVE_WAY == 0:
            await asyncio.sleep(0)
        if t_ns > self._now_ns:
            self._advance((t_ns - self._now_ns) * 1e-9)
            self._now_ns = t_ns
