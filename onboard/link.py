"""The vehicle's end of the link: telemetry, events and pulses out, orders in.

The loop never waits for any of it: ``tick`` leaves the newest tick where a thread finds it, ``event`` and ``settle``
put into bounded queues, ``state`` reads one value. Orders arrive on Zenoh's threads, of which each way to ask has its
own; answers leave from yet another. What one station may send in a second, and how large, is limited by Zenoh itself,
before any Python runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from threading import Event as Flag
from threading import Lock, Thread
from typing import Any, Final

import msgspec
import zenoh
from msgspec import Struct

from drivers.mailbox import Level, Notice, Notices, Teller
from onboard import lease as leases
from onboard.core.mission import GROUND
from onboard.core.types import Event, LinkState, Tick
from onboard.endpoints import ZenohConfig, open_session
from onboard.lease import Lease, Watch
from onboard.link_settings import LinkSettings
from onboard.outbox import Outbox
from onboard.sessions import MOST, Answers, Sessions
from onboard.wire import (
    LARGEST,
    Ack,
    Ask,
    Keys,
    Order,
    Outcome,
    Place,
    ReleaseLease,
    ShowEvents,
    TakeLease,
    Telemetry,
    Told,
    VehiclePulse,
    Way,
    WireError,
    encode,
    read_order,
    read_station_pulse,
    refusal,
    way_of,
)

#: Messages that one station may send in a second, by the last part of their key. Who asks more often asks in vain.
_RATES: Final = {Way.SAFETY: 100.0, Way.COMMAND: 50.0, Way.VIEW: 20.0, "pulse": 100.0}
_EVENTS, _ANSWERS = 256, 256
#: Events that are shown to who comes later: the newest.
_REMEMBERED: Final = 50
_CLOSING = 0.5


class Asked(Struct, frozen=True):
    """An order that may be carried out: its sender is entitled to it, and it was not asked before."""

    station: str
    id: str
    ask: Ask

    def accepted(self, text: str = "") -> Ack:
        """Taken on; ``Link.settle`` must follow."""
        return Ack(self.id, Outcome.ACCEPTED, text)

    def refused(self, why: str) -> Ack:
        """Not to be done, and why."""
        return Ack(self.id, Outcome.REFUSED, why)

    def done(self, text: str = "", data: bytes = b"") -> Ack:
        """Done, with what was asked to be shown."""
        return Ack(self.id, Outcome.DONE, text, data)


class Link:
    """One vehicle's link to any number of stations.

    on_order: called for each order on one of Zenoh's threads; gives the answer, and may only touch mailboxes and
    queues. security: Zenoh configuration for TLS and access control; empty without.
    """

    def __init__(
        self, settings: LinkSettings, on_order: Callable[[Asked], Ack], security: ZenohConfig | None = None
    ) -> None:
        self._settings, self._on_order, self._security = settings, on_order, security or {}
        self._keys = Keys(settings.vehicle)
        self._lock = Lock()
        self._lease = Lease()
        self._sessions = Sessions()
        self._answered = Answers()
        self._watch = Watch(round(settings.silence * 1e9))
        self._state = LinkState()
        self._newest: Tick | None = None
        self._telling = Lock()
        """Held for the change of what follows, and never longer."""
        self._told = 0
        self._recent: tuple[Told, ...] = ()
        self._notices = Notices()
        self._teller = Teller(self._notices, time.monotonic_ns, "link")
        self._closing = Flag()
        self._events = Outbox("link.events", _EVENTS, self._failed)
        self._answers = Outbox("link.answers", _ANSWERS, self._failed)
        self._sender = Thread(target=self._send, name="link.telemetry", daemon=True)
        self._session: zenoh.Session | None = None

    def start(self) -> None:
        """Listen. Raises LinkError when that cannot be."""
        self._open()
        for thread in (self._events, self._answers, self._sender):
            thread.start()

    def reopen(self, security: ZenohConfig | None) -> None:
        """Listen anew, with another security; all stations have to come again, and who commands goes on commanding.

        Raises LinkError when that cannot be; it may be tried again. Nothing is done after ``stop``.
        """
        if self._closing.is_set():
            return
        old, self._session = self._session, None
        if old is not None:
            old.close()
        self._security = security or {}
        with self._lock:
            self._sessions = Sessions()
            self._hold(self._lease)
        self._open()

    def _open(self) -> None:
        settings, keys = self._settings, self._keys
        session = open_session(
            "router",
            settings.listen,
            plain=settings.plain,
            lease=settings.peer_lease,
            security=self._security,
            more=_limits(keys),
        )
        for way in Way:
            session.declare_queryable(keys.stations(way), partial(self._hear_order, way))
        session.declare_subscriber(keys.stations("pulse"), self._hear_pulse)
        alive = session.liveliness()
        alive.declare_subscriber(keys.stations("alive"), self._hear_alive, history=True)
        self._token = alive.declare_token(keys.alive)
        self._session = session

    def stop(self) -> None:
        """Send what waits, for a moment at most, and close; safe to call twice."""
        if self._closing.is_set() or not self._sender.is_alive():
            return
        for outbox in (self._answers, self._events):
            outbox.close(_CLOSING)
        self._closing.set()
        session, self._session = self._session, None
        if session is not None:
            session.close()
        self._sender.join(_CLOSING)

    # --- from the loop; no call waits ---------------------------------------------------------------------------------

    def tick(self, tick: Tick) -> None:
        """Leave the newest tick for whoever sends it; the one before is gone."""
        self._newest = tick

    def event(self, event: Event) -> None:
        """Tell all stations, at once; when too many wait, it is dropped and counted. For any thread."""
        with self._telling:
            self._told += 1
            told = Told(self._told, event)
            self._recent = (*self._recent[1 - _REMEMBERED :], told)
            self._events.put(lambda: self._publish(self._keys.event, told, _SURE))

    def settle(self, asked: Asked, ack: Ack) -> None:
        """What has become of an order that was accepted. Not to be called from within ``on_order``."""
        self._answers.put(lambda: self._settle(asked, ack))

    def state(self) -> LinkState:
        """What is known of the commander."""
        return self._state

    def notices(self) -> tuple[Notice, ...]:
        """What there has been to tell since the last call."""
        return self._notices.take()

    @property
    def dropped(self) -> int:
        """Events and answers that were not sent."""
        return self._events.dropped + self._answers.dropped

    # --- on Zenoh's threads -------------------------------------------------------------------------------------------

    def _hear_order(self, way: Way, query: zenoh.Query) -> None:
        key = str(query.key_expr)
        try:
            place = self._keys.place(key)
            order = read_order(query.payload.to_bytes() if query.payload else b"")
            answer = partial(query.reply, key, encode(self._answer(place.station, way, order)))
        except WireError as error:
            answer = partial(query.reply_err, refusal(str(error)))
        except Exception as error:  # a fault in carrying out an order is told to both sides
            self._teller.once("fault", Level.ERROR, f"an order has failed: {type(error).__name__}: {error}")
            answer = partial(query.reply_err, refusal(f"failed on the vehicle: {type(error).__name__}: {error}"))

        def send() -> None:
            answer()
            query.drop()

        self._answers.put(send)

    def _answer(self, station: str, way: Way, order: Order) -> Ack:
        asked = Asked(station, order.id, order.ask)
        if (right := way_of(order.ask)) is not way:
            return asked.refused(f"{type(order.ask).__name__} is to be asked on {right}, not on {way}.")
        with self._lock:
            if (known := self._answered.get(station, order.id)) is not None:
                return known
            now = time.monotonic_ns()
            heard = _credible(order.heard_ns, now)
            self._hold(leases.keep(self._lease, station, heard))
            age = (now - heard) * 1e-9
            if way is Way.COMMAND and age > self._settings.order_age:
                since = f"{age:.1f} s ago" if heard else "never"
                return asked.refused(
                    f"Too old: {station} had last heard the vehicle {since} when it sent this; "
                    f"at most {self._settings.order_age:g} s are allowed."
                )
            if isinstance(asked.ask, ShowEvents):
                return asked.done(data=msgspec.json.encode(self._recent))
            if way is not Way.VIEW:
                ack = self._rule(asked, now, heard) if way is Way.COMMAND else self._on_order(asked)
                self._answered.put(station, ack)
                return ack
        # A look changes nothing, so its answer need not be remembered; and it may have to wait for a disk, which must
        # hold up nobody who asks to stop.
        return self._on_order(asked)

    def _rule(self, asked: Asked, now: int, heard: int) -> Ack:
        """What the commander may do, and who is to be it."""
        match asked.ask:
            case TakeLease(seize=seize):
                patience = round(self._settings.patience * 1e9)
                ruling = leases.take(self._lease, asked.station, now, heard, patience, seize=seize)
            case ReleaseLease():
                ruling = leases.release(self._lease, asked.station, flying=self._flying())
            case _:
                refusal = leases.commands(self._lease, asked.station)
                return asked.refused(refusal) if refusal else self._on_order(asked)
        if not ruling.granted:
            return asked.refused(ruling.text)
        if ruling.lease.holder != self._lease.holder:
            robbed = self._lease.holder and ruling.lease.holder
            self._teller.tell(Level.WARNING if robbed else Level.INFO, ruling.text)
        self._hold(ruling.lease)
        return asked.done(ruling.text)

    def _hear_pulse(self, sample: zenoh.Sample) -> None:
        try:
            place = self._keys.place(str(sample.key_expr))
            pulse = read_station_pulse(sample.payload.to_bytes())
        except WireError as error:
            self._teller.once("pulse", Level.WARNING, f"a station's sign of life is not understood: {error}")
            return
        now = time.monotonic_ns()
        with self._lock:
            kept = self._sessions.pulse(place.station, place.session, pulse.sent_ns, now)
            self._hold(leases.keep(self._lease, place.station, _credible(pulse.heard_ns, now)))
        self._room(kept, place)

    def _hear_alive(self, sample: zenoh.Sample) -> None:
        try:
            place = self._keys.place(str(sample.key_expr))
        except WireError as error:
            self._teller.once("alive", Level.WARNING, f"a station is not understood: {error}")
            return
        kept = True
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                kept = self._sessions.come(place.station, place.session, time.monotonic_ns())
            else:
                self._sessions.gone(place.station, place.session)
            self._hold(self._lease)
        self._room(kept, place)

    def _room(self, kept: bool, place: Place) -> None:
        if not kept:
            self._teller.once(
                "room", Level.WARNING, f"too many sessions of stations: {place.station} is not kept track of."
            )

    def _hold(self, lease: Lease) -> None:
        """Put a lease into force, and what the core reads of it. With the lock."""
        self._lease = lease
        self._state = LinkState(lease.holder, lease.heard_ns, self._sessions.present(lease.holder))

    def _flying(self) -> bool:
        return self._newest is not None and self._newest.outputs.phase not in GROUND

    # --- on the link's own threads ------------------------------------------------------------------------------------

    def _send(self) -> None:
        telemetry_ns = round(1e9 / self._settings.telemetry_rate)
        pulse_ns = round(self._settings.pulse_period * 1e9)
        telemetry_due = pulse_due = time.monotonic_ns()
        sent: Tick | None = None
        while not self._closing.wait(max(0, min(telemetry_due, pulse_due) - time.monotonic_ns()) * 1e-9):
            now = time.monotonic_ns()
            try:
                if now >= pulse_due:
                    pulse_due = max(pulse_due + pulse_ns, now)
                    self._publish(self._keys.pulse, self._pulse(now), _NOW)
                if now >= telemetry_due:
                    telemetry_due = max(telemetry_due + telemetry_ns, now)
                    if (tick := self._newest) is not None and tick is not sent:
                        sent = tick
                        self._publish(self._keys.telemetry, Telemetry(now, tick), _NEWEST)
            except Exception as error:  # whatever it is, the next one is sent, and this one is told of
                self._failed(error)

    def _pulse(self, now: int) -> VehiclePulse:
        with self._lock:
            lease, heard = self._lease, self._sessions.heard(now)
            present = self._sessions.present(lease.holder)
        bad, text = self._watch.look(lease, present=present, t_ns=now)
        if text:
            self._teller.tell(Level.WARNING if bad else Level.INFO, text)
        tick_ns = self._newest.inputs.t_ns if self._newest is not None else 0
        return VehiclePulse(now, time.time_ns(), tick_ns, lease.holder, heard, self._told, self.dropped)

    def _settle(self, asked: Asked, ack: Ack) -> None:
        with self._lock:
            self._answered.put(asked.station, ack)
        self._publish(self._keys.ack(asked.station), ack, _SURE)

    def _publish(self, key: str, message: Struct, how: dict[str, Any]) -> None:
        if (session := self._session) is not None:  # else it is being opened anew
            session.put(key, encode(message), **how)

    def _failed(self, error: Exception) -> None:
        if not self._closing.is_set():
            self._teller.once("send", Level.ERROR, f"nothing can be sent: {type(error).__name__}: {error}")


#: How Zenoh treats what is sent: signs of life before all else, telemetry after all else, events never dropped by it.
_NOW: Final[dict[str, Any]] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "express": True,
}
_SURE: Final[dict[str, Any]] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.DATA_HIGH,
    "express": True,
}
_NEWEST: Final[dict[str, Any]] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.DATA_LOW,
}


def _credible(stamp_ns: int, now: int) -> int:
    """A stamp of ours that came back; 0 if it cannot be: of before a restart of the machine, or made up."""
    return stamp_ns if stamp_ns <= now else 0


def _limits(keys: Keys) -> ZenohConfig:
    rules = [{"key_expr": keys.stations(what), "freq": rate} for what, rate in _RATES.items()]
    return {
        "transport/link/rx/max_message_size": 1 << 20,
        "transport/unicast/max_sessions": 2 * MOST,
        "downsampling": [{"flows": ["ingress"], "messages": ["put", "query"], "rules": rules}],
        "low_pass_filter": [
            {
                "flows": ["ingress"],
                "messages": ["put", "query"],
                "key_exprs": [keys.stations(what) for what in _RATES],
                "size_limit": LARGEST,
            }
        ],
    }
