"""A key that must be pressed twice, at a terminal that tells no key's release. Times are given, in s."""

from __future__ import annotations

from math import inf
from typing import Final

#: The same key within this time is the key that repeats because it is held, not one that was pressed again.
REPEATS: Final = 0.7
#: A second press counts for so long.
TWICE: Final = 2.0
#: No keyboard begins to repeat a held key sooner than this, and all that do, repeat it faster than the other.
_SOONEST: Final = 0.2
FASTER: Final = 0.12


class Twice:
    """Tells two presses from a key that is held, by whatever lies on the keyboard.

    Of two that are as far apart as a key needs to begin to repeat, the second counts only when no third follows at
    once: ``due`` says so then.
    """

    def __init__(self) -> None:
        self._last = -inf
        self._due_at: float | None = None
        self._held = False

    def press(self, t: float) -> bool:
        """The key has come; whether it counts as the second press already."""
        since, self._last = t - self._last, t
        if self._due_at is not None:
            self._due_at, self._held = None, True
        elif self._held:
            self._held = since < REPEATS
        elif since < _SOONEST:
            self._last = -inf
            return True
        elif since < TWICE:
            self._due_at = t + FASTER
        return False

    def due(self, t: float) -> bool:
        """Whether the second press, which may have been a repetition, counts by now; true once."""
        if self._due_at is None or t < self._due_at:
            return False
        self.forget()
        return True

    def forget(self) -> None:
        """Nothing was pressed."""
        self._due_at, self._last = None, -inf

    def left(self, t: float) -> float:
        """Time in which another press counts, s; 0: it would be the first."""
        return 0.0 if self._held else max(0.0, TWICE - (t - self._last))
