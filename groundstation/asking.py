"""One order on its way over one session, which is a query; and what all sessions of stations have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import zenoh

from onboard.endpoints import LinkError
from onboard.wire import Ack, Keys, Order, Outcome, Way, WireError, encode, read_ack, read_refusal, way_of

#: An order without an answer is sent again after this time, s; the same, so it is not carried out twice.
AGAIN: Final = 0.25
#: One that nobody took, since the vehicle was not there or takes no more in so short a time, after this time, s.
SOON: Final = 0.03
#: One that was accepted is asked after this often, s, should the word of its end have been lost.
ASK_AFTER: Final = 1.0
#: Without a sign of the other machine, then it is gone, s.
PEER_LEASE: Final = 2.0
_PRIORITY: Final = {
    Way.SAFETY: zenoh.Priority.REAL_TIME,
    Way.COMMAND: zenoh.Priority.INTERACTIVE_HIGH,
    Way.VIEW: zenoh.Priority.INTERACTIVE_LOW,
}


def keys_of(vehicle: str, station: str) -> Keys:
    """The keys on which they speak. Raises LinkError for a name that cannot be."""
    try:
        keys = Keys(vehicle)
        keys.ack(station)
    except WireError as error:
        raise LinkError(str(error)) from None
    return keys


def send(
    session: zenoh.Session, key: str, order: Order, answered: Callable[[Ack | None], object], timeout: float
) -> None:
    """Ask at ``key``, and wait for nothing: ``answered`` is called on one of Zenoh's threads, with None by nobody."""
    heard = False

    def hear(reply: zenoh.Reply) -> None:
        nonlocal heard
        heard = True
        if reply.ok is not None:
            try:
                answered(read_ack(reply.ok.payload.to_bytes()))
            except WireError as error:
                answered(Ack(order.id, Outcome.REFUSED, str(error)))
        elif reply.err is not None and (why := read_refusal(reply.err.payload.to_bytes())):
            answered(Ack(order.id, Outcome.REFUSED, why))

    def end() -> None:
        if not heard:
            answered(None)

    session.get(
        key,
        zenoh.handlers.Callback(hear, end),
        payload=encode(order),
        timeout=timeout,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=_PRIORITY[way_of(order.ask)],
        express=True,
    )
