"""What the vehicle keeps in mind about its stations: who is there, and what they were answered. No clock, no wire.

All of it is bounded, whatever a station sends.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from msgspec import Struct

from onboard.wire import Ack, Heard

#: Sessions of one station, sessions of all, and answers to one station that are kept in mind.
MOST_OF_ONE: Final = 8
MOST: Final = 64
ANSWERS: Final = 64
#: A session that is heard but never declares itself is forgotten after this silence, ns.
_FORGOTTEN: Final = 10_000_000_000


class _Session(Struct):
    received_ns: int
    sent_ns: int = 0
    present: bool = False


class Sessions:
    """Which sessions of which stations are heard."""

    def __init__(self) -> None:
        self._sessions: dict[tuple[str, str], _Session] = {}

    def pulse(self, station: str, session: str, sent_ns: int, t_ns: int) -> bool:
        """A sign of life, stamped ``sent_ns`` by the station and received at ``t_ns``; False: one session too many."""
        known = self._at(station, session, t_ns)
        if known is not None and sent_ns > known.sent_ns:
            known.sent_ns, known.received_ns = sent_ns, t_ns
        return known is not None

    def come(self, station: str, session: str, t_ns: int) -> bool:
        """Its liveliness token has come; False: one session too many."""
        known = self._at(station, session, t_ns)
        if known is not None:
            known.present = True
        return known is not None

    def gone(self, station: str, session: str) -> None:
        """Its liveliness token has gone: it was closed, killed, frozen, or is out of reach."""
        self._sessions.pop((station, session), None)

    def present(self, station: str) -> bool:
        """Whether any session of this station is there."""
        return any(known.present for (name, _), known in self._sessions.items() if name == station)

    def heard(self, t_ns: int) -> tuple[Heard, ...]:
        """All that are there or were heard lately."""
        for key, known in list(self._sessions.items()):
            if not known.present and t_ns - known.received_ns > _FORGOTTEN:
                del self._sessions[key]
        return tuple(
            Heard(*key, known.sent_ns, max(0, t_ns - known.received_ns), known.present)
            for key, known in self._sessions.items()
        )

    def _at(self, station: str, session: str, t_ns: int) -> _Session | None:
        known = self._sessions.get((station, session))
        if known is None:
            of_one = sum(name == station for name, _ in self._sessions)
            if of_one < MOST_OF_ONE and len(self._sessions) < MOST:
                known = self._sessions[station, session] = _Session(t_ns)
        return known


class Answers:
    """The newest answers to each station: an order that comes again is answered again, and not carried out twice."""

    def __init__(self) -> None:
        self._stations: OrderedDict[str, OrderedDict[str, Ack]] = OrderedDict()

    def get(self, station: str, order: str) -> Ack | None:
        """What ``station`` was answered to ``order``."""
        of_one = self._stations.get(station)
        return of_one.get(order) if of_one is not None else None

    def put(self, station: str, ack: Ack) -> None:
        """Remember what it is answered; the oldest answer to this station, and the oldest station, make way."""
        of_one = self._stations.setdefault(station, OrderedDict())
        self._stations.move_to_end(station)
        of_one[ack.id] = ack
        if len(of_one) > ANSWERS:
            of_one.popitem(last=False)
        if len(self._stations) > MOST:
            self._stations.popitem(last=False)
