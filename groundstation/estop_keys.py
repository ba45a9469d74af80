"""What keys and a button mean to the emergency stop's panel. Times are given, in s; nothing is asked or shown here."""

from __future__ import annotations

from enum import Enum, auto
from math import inf

from groundstation.twice import REPEATS, Twice


class Action(Enum):
    """What is to be done."""

    STOP = auto()
    KILL = auto()
    LEAVE = auto()


class Keys:
    """Space stops, k twice kills, q leaves. A space bar that is held, or hit in panic, is one stop; another lands."""

    def __init__(self) -> None:
        self._space = -inf
        self._kill = Twice()

    def press(self, key: str, t: float) -> Action | None:
        """A key has come."""
        match key:
            case " ":
                since, self._space = t - self._space, t
                return Action.STOP if since > REPEATS else None
            case "k" | "K":
                return Action.KILL if self._kill.press(t) else None
            case "q" | "Q":
                return Action.LEAVE
        return None

    def due(self, t: float) -> Action | None:
        """What is to be done without another key."""
        return Action.KILL if self._kill.due(t) else None

    def waits(self, t: float) -> bool:
        """Another k would kill."""
        return self._kill.left(t) > 0.0

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
