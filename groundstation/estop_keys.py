"""What keys and a button mean to the emergency stop's panel. Times are given, in s; nothing is asked or shown here."""

from __future__ import annotations

from enum import Enum, auto
from math import inf
from typing import Final

#: The same key within this time is the key that repeats because it is held, not one that was pressed again.
REPEATS: Final = 0.7
#: A second k counts for so long.
TWICE: Final = 2.0
#: No keyboard begins to repeat a held key sooner than this, and all that do, repeat it faster than the other.
_SOONEST: Final = 0.2
_FASTER: Final = 0.12


class Action(Enum):
    """What is to be done."""

    STOP = auto()
    KILL = auto()
    LEAVE = auto()


class Keys:
    """Space stops, k twice kills, q leaves.

    A terminal tells no key's release, only that it repeats. A space bar that is held, or hit in panic, is one stop:
    the second one lands. A k that is held, by whatever lies on the keyboard, does not kill: of two that are as far
    apart as a key needs to begin to repeat, the second counts only when no third follows at once.
    """

    def __init__(self) -> None:
        self._space = self._k = -inf
        self._kill_at: float | None = None
        self._held = False

    def press(self, key: str, t: float) -> Action | None:
        """A key has come."""
        match key:
            case " ":
                since, self._space = t - self._space, t
                return Action.STOP if since > REPEATS else None
            case "k" | "K":
                return self._kill(t)
            case "q" | "Q":
                return Action.LEAVE
        return None

    def _kill(self, t: float) -> Action | None:
        since, self._k = t - self._k, t
        if self._kill_at is not None:
            self._kill_at, self._held = None, True
        elif self._held:
            self._held = since < REPEATS
        elif since < _SOONEST:
            return Action.KILL
        elif since < TWICE:
            self._kill_at = t + _FASTER
        return None

    def due(self, t: float) -> Action | None:
        """What is to be done without another key."""
        if self._kill_at is None or t < self._kill_at:
            return None
        self._kill_at, self._k = None, -inf
        return Action.KILL

    def waits(self, t: float) -> bool:
        """Another k would kill."""
        return not self._held and t - self._k < TWICE

    def land_next(self, t: float) -> bool:
        """Another space is a stop of its own by now."""
        return t - self._space > REPEATS


class DeadMan:
    """Holding the button means fly: letting go of it, or its cable, is a stop. It counts once it was pressed."""

    def __init__(self) -> None:
        self.armed = False

    def changed(self, down: bool) -> Action | None:
        """It went down, or up."""
        before, self.armed = self.armed, down
        return Action.STOP if before and not down else None

    def gone(self) -> Action | None:
        """It was unplugged."""
        return self.changed(False)

    def left(self) -> Action | None:
        """Nobody listens to it any more, which is as if it was let go."""
        return self.changed(False)


class Pushed:
    """The other kind: pushing the button is a stop, and so is pulling its cable, since it can stop nothing then."""

    armed = True

    def changed(self, down: bool) -> Action | None:
        """It went down, or up."""
        return Action.STOP if down else None

    def gone(self) -> Action | None:
        """It was unplugged."""
        return Action.STOP

    def left(self) -> Action | None:
        """Nobody listens to it any more; it was not pushed."""
        return None
