"""Which servos are missing, in few words: those that come and go are told once, until they have stayed for a second."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.dynamixel_setup import Servo
from drivers.mailbox import Level, Teller

_STAYS_NS = 1_000_000_000


class Absences:
    """The servos of ``servos`` that are told to be missing. Times in nanoseconds."""

    def __init__(self, servos: Sequence[Servo], teller: Teller) -> None:
        self._servos = servos
        self._teller = teller
        #: Since when each missing servo answers again; None: it does not.
        self._away: dict[int, int | None] = {}
        self._restarted: set[int] = set()

    def __bool__(self) -> bool:
        """Some servo is missing, or has only just come back."""
        return bool(self._away)

    def known(self, lost: Sequence[Servo]) -> None:
        """They are missing, and why was told."""
        self._away.update((servo.index, None) for servo in lost)

    def lost(self, lost: Sequence[Servo]) -> None:
        """They do not answer any more."""
        new = [servo for servo in lost if servo.index not in self._away]
        self.known(lost)
        if not new:
            return
        self._teller.tell(
            Level.ERROR,
            f"{_names(new)} {'does' if len(new) == 1 else 'do'} not answer any more; the others go on"
            if any(servo.answers for servo in self._servos)
            else "no servo answers any more: is the 5 V supply on, and is the data cable plugged in?",
        )

    def back(self, servo: Servo, restarted: bool, now: int) -> None:
        """It answers again."""
        self._away[servo.index] = now
        if restarted:
            self._restarted.add(servo.index)

    def check(self, now: int) -> None:
        """Tell who is back to stay, all of them together."""
        if not self._away:
            return
        since = [at for at in self._away.values() if at is not None]
        if not since or now - max(since) < _STAYS_NS:
            return
        back = [servo for servo in self._servos if self._away.get(servo.index) is not None]
        for again, how in ((False, ""), (True, ", restarted")):
            of_them = [servo for servo in back if (servo.index in self._restarted) is again]
            if of_them:
                self._teller.tell(Level.INFO, f"{_names(of_them)} answer{'s' * (len(of_them) == 1)} again{how}")
        for servo in back:
            del self._away[servo.index]
            self._restarted.discard(servo.index)


def _names(servos: Sequence[Servo]) -> str:
    return ", ".join(servo.name for servo in servos)
