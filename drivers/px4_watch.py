"""How the link to PX4 does, and what PX4 measures: trouble is told once when it begins, and once when it is over."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from drivers.mailbox import Level, Trouble

#: Without any message, after which the link counts as lost, ns. MAVSDK itself waits for three seconds.
SILENT_NS = 500_000_000
#: Round trips that are longer than this are no jitter, ns.
SLOW_NS = 50_000_000
_RATE_PERIOD_NS = 1_000_000_000
_ENOUGH = 0.8
_REPEATS = 10
_TRIPS = 3

Tell = Callable[[Level, str], None]


class LinkWatch:
    """Hears of everything that comes from PX4, at times in nanoseconds. Any thread may report; one checks."""

    def __init__(self, tell: Tell, rate: float) -> None:
        """``rate``: asked for the streams that are judged, Hz."""
        self._tell = tell
        self._rate = rate
        self.linked = True
        """Something has come within the last half second."""
        self._heard_ns = 0
        self._lost_ns = 0
        self._repeated = 0
        self._frozen = Trouble(tell, "PX4's attitude moves again")
        self._unusable = Trouble(tell, "what PX4 measures is usable again; {count} messages were not")
        self._slow = Trouble(tell, "PX4's messages come at the rates asked for again")
        self._late = Trouble(tell, "PX4 answers in time again")
        self._rates_due_ns = 0
        self._slow_before: frozenset[str] = frozenset()
        self._trips: deque[int] = deque(maxlen=_TRIPS)
        self.lateness = 0
        """How late messages are, ns: the least of the last round trips, if that is no jitter; else 0.

        On which of the two ways the time is lost cannot be known; the worse is taken.
        """

    def begin(self, now: int) -> None:
        """The link works at ``now``."""
        self._heard_ns, self.linked = now, True
        self._rates_due_ns = now + _RATE_PERIOD_NS
        self.lateness = 0

    # -- what is reported -----------------------------------------------------------------------------------------

    def heard(self, now: int) -> None:
        """A message has come."""
        self._heard_ns = now

    def unusable(self, now: int, name: str) -> None:
        """One of this name held a number that is not finite."""
        self._unusable.happened(now, f"{name} holds numbers that are not finite and is not used: land, restart PX4")

    def moves(self, now: int, same: bool) -> None:
        """An attitude has come in the air; ``same``: to the bit as the one before, which no measurement ever is."""
        self._repeated = self._repeated + 1 if same else 0
        if self._repeated >= _REPEATS:
            self._frozen.happened(now, "PX4 tells the same attitude over and over: its estimator hangs; land")

    def answered(self, now: int, asked_ns: int) -> None:
        """PX4 has answered a question that left at ``asked_ns``."""
        self._trips.append(now - asked_ns)
        trip = min(self._trips) if len(self._trips) == _TRIPS else 0
        self.lateness = trip if trip > SLOW_NS else 0
        if self.lateness:
            self._late.happened(
                now,
                f"PX4's answers take {trip * 1e-6:.0f} ms: the link is congested; "
                "ask for fewer messages, or raise its baud rate",
            )

    # -- what is judged -------------------------------------------------------------------------------------------

    def check(self, now: int) -> bool:
        """Tell what is over, and the loss and return of the link; whether it has just come back."""
        for trouble in (self._frozen, self._unusable, self._late):
            trouble.check(now)
        silent = now - self._heard_ns > SILENT_NS
        if silent and self.linked:
            self.linked, self._lost_ns = False, self._heard_ns
            self.lateness = 0  # three answers will tell
            self._tell(Level.ERROR, "the link to PX4 is lost: nothing comes any more; check its cable and power")
        elif not silent and not self.linked:
            self.linked = True
            self._tell(Level.WARNING, f"the link to PX4 is back after {(now - self._lost_ns) * 1e-9:.1f} s")
            return True
        return False

    def judge_rates(self, now: int, achieved: Callable[[], Mapping[str, float]]) -> bool:
        """Once a second: whether to ask for the rates again, since streams have been slow in two seconds on end.

        ``achieved`` gives the rate (Hz) of each stream by name; asked only when it is looked at. Of what is lost,
        frozen or unusable the reason was told already.
        """
        if now < self._rates_due_ns:
            return False
        self._rates_due_ns = now + _RATE_PERIOD_NS
        told = not self.linked or self._frozen.active or self._unusable.active
        slow = {} if told else {name: rate for name, rate in achieved().items() if rate < _ENOUGH * self._rate}
        still = [f"{name} comes at {rate:.0f} Hz" for name, rate in slow.items() if name in self._slow_before]
        self._slow_before = frozenset(slow)
        if still:
            self._slow.happened(now, f"{' and '.join(still)}, asked for {self._rate:g} Hz; asking again")
        self._slow.check(now)
        return bool(still)
