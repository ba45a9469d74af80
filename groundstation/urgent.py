"""Stop, retreat and kill over several connections at once.

On a bad network a TCP connection stands still for a second and more whenever a packet is lost twice, and all that was
sent after it waits. So the same order goes over several connections, which carry nothing else, and the vehicle, which
knows its id, carries out the copy that comes first. Measured in docs/benchmarks.md.
"""

from __future__ import annotations

import time
import uuid
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from threading import Condition, Thread
from types import TracebackType
from typing import Final, Self

import zenoh
from msgspec import Struct

from groundstation.asking import AGAIN, SOON, keys_of, send
from groundstation.client import NoAnswerError, StationSettings, default_name
from onboard.endpoints import LinkError, NoVehicleError, ZenohConfig, open_session
from onboard.wire import Ack, Ask, Order, Outcome, Way, way_of

#: Each stands still by itself, and costs a sign of life every 2.5 s.
CONNECTIONS: Final = 8
#: The vehicle keeps a silent one for so long, s: a packet that is lost three times is silent for five.
_LEASE: Final = 10.0
#: An order without an answer is sent again after this time, s, then after half as much more, up to ``AGAIN``. What
#: follows a lost packet soon tells TCP of the loss, which otherwise only a timeout does.
_SOON_AGAIN: Final = 0.04
#: Then another connection is made beside those that there are, so many in all: after a cut they may sleep on for as
#: long as it was; s. It is kept, since to close one that stands still can hold up the others.
_SPARE: Final = 1.0
_MOST: Final = 12
#: One attempt to connect; a handshake with TLS may need that long where packets are lost, s.
_ATTEMPT: Final = 5.0
_REST: Final = 0.2
#: An order that nobody has taken so often finds nobody; on a new connection the vehicle is not known at once.
_OFTEN: Final = 10


class _Pending(Struct):
    order: Order
    answers: SimpleQueue[Ack]
    end: float
    untaken: int = 0
    """How often nobody has taken it."""


class Urgent:
    """Connections to one vehicle that are kept for what is urgent. Use as a context manager, or close it.

    It needs no ``Client`` beside it and does not wait for the vehicle: an order leaves over each connection as soon as
    that is there. Raises LinkError for a name that cannot be.
    """

    def __init__(
        self, settings: StationSettings, *, security: ZenohConfig | None = None, connections: int = CONNECTIONS
    ) -> None:
        self._settings, self._security = settings, security or {}
        self.vehicle, self.station = settings.vehicle, settings.station or default_name()
        keys = keys_of(self.vehicle, self.station)
        self._key = keys.station(self.station, uuid.uuid4().hex[:12], Way.SAFETY)
        self._changed = Condition()
        self._orders: dict[str, _Pending] = {}
        self._closing = False
        self._open = 0
        self._unreached: NoVehicleError | None = None
        self._wrong: LinkError | None = None
        self._lanes: list[Thread] = []
        for _ in range(connections):
            self._add()

    def _add(self) -> None:
        lane = Thread(target=self._work, name="urgent", daemon=True)
        self._lanes.append(lane)
        lane.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave; an attempt to connect is waited for. Safe to call twice."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for lane in self._lanes:
            lane.join()

    @property
    def connections(self) -> int:
        """Connections that were made; Zenoh mends one that has broken."""
        return self._open

    def ask(self, ask: Ask, *, timeout: float = 5.0, settled: bool = False) -> Ack:
        """Ask the vehicle, and give the first answer; with ``settled``, what has become of it in the end.

        Raises ValueError for what is not urgent, LinkError for settings that cannot be, NoVehicleError when no
        connection could be made, NoAnswerError when there is no answer within ``timeout`` seconds.
        """
        if way_of(ask) is not Way.SAFETY:
            raise ValueError(f"{ask} is not urgent: ask it with Client.ask")
        order = Order(uuid.uuid4().hex, ask)
        pending = _Pending(order, SimpleQueue(), time.monotonic() + timeout)
        with self._changed:
            self._orders[order.id] = pending
            self._changed.notify_all()
        accepted, spare = False, time.monotonic() + _SPARE
        try:
            while self._wrong is None and (left := pending.end - time.monotonic()) > 0.0:
                if self._open and not accepted and time.monotonic() > spare and len(self._lanes) < _MOST:
                    spare = pending.end
                    self._add()
                try:
                    answer = pending.answers.get(timeout=min(left, _REST))
                except Empty:
                    continue
                if not settled or answer.outcome is not Outcome.ACCEPTED:
                    return answer
                accepted = True
        finally:
            with self._changed:
                del self._orders[order.id]
                self._changed.notify_all()
        if self._wrong is not None:
            raise self._wrong
        if not self._open and self._unreached is not None:
            raise self._unreached
        if not accepted and pending.untaken >= _OFTEN:
            raise NoVehicleError(
                f"nobody at {', '.join(self._settings.connect)} takes orders for {self.vehicle} from {self.station}: "
                "is that its name, is its link on, and is this station admitted?"
            )
        what = "it was accepted, but is not done" if accepted else "no answer"
        raise NoAnswerError(f"{self.vehicle}: {what} within {timeout:g} s")

    # --- one connection, in a thread of its own, so that one that blocks keeps no other -------------------------------

    def _work(self) -> None:
        session = self._connect()
        if session is None:
            return
        self._count(1)
        try:
            self._serve(session)
        finally:
            self._count(-1)
            with suppress(zenoh.ZError):  # a connection that stands still cannot say goodbye
                session.close()

    def _connect(self) -> zenoh.Session | None:
        settings = self._settings
        while not self._closing:
            try:
                return open_session(
                    "client",
                    settings.connect,
                    plain=settings.plain,
                    lease=_LEASE,
                    security=self._security,
                    timeout=_ATTEMPT,
                )
            except NoVehicleError as error:
                self._unreached = error
            except LinkError as error:
                self._wrong = error
                return None
        return None

    def _serve(self, session: zenoh.Session) -> None:
        """Send what is pending, again and again, until it is answered."""
        due: dict[str, float] = {}
        pauses: dict[str, float] = {}

        def answered(pending: _Pending, ack: Ack | None) -> None:
            if ack is not None:
                pending.answers.put(ack)
                return
            now = time.monotonic()
            with self._changed:
                if (name := pending.order.id) in due and now < pending.end:
                    pending.untaken += 1
                    due[name] = min(due[name], now + SOON)
                    self._changed.notify_all()

        while (pending := self._next(due, pauses)) is not None:
            left = max(pending.end - time.monotonic(), SOON)
            with suppress(zenoh.ZError):  # then it is sent again, here and elsewhere
                send(session, self._key, pending.order, partial(answered, pending), left)

    def _next(self, due: dict[str, float], pauses: dict[str, float]) -> _Pending | None:
        """Wait for what is to be sent next, and note when to send it again; None: no more."""
        with self._changed:
            while not self._closing:
                for name in due.keys() - self._orders.keys():
                    del due[name], pauses[name]
                now = time.monotonic()
                for name, pending in self._orders.items():
                    if due.get(name, now) <= now < pending.end:
                        pause = pauses.get(name, _SOON_AGAIN)
                        due[name], pauses[name] = now + pause, min(1.5 * pause, AGAIN)
                        return pending
                rest = min((at for at in due.values() if at > now), default=None)
                self._changed.wait(None if rest is None else rest - now)
        return None

    def _count(self, more: int) -> None:
        with self._changed:
            self._open += more
