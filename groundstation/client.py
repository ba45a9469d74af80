"""A station's end of the link: what the vehicle tells, and what it is asked.

Zenoh connects again by itself when the network comes back; ``contact`` tells how the vehicle is heard meanwhile.
"""

from __future__ import annotations

import math
import re
import socket
import time
import uuid
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from getpass import getuser
from queue import Empty, SimpleQueue
from threading import Condition, Thread
from threading import Event as Flag
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self, TypeVar

import zenoh
from msgspec import Struct

from groundstation.asking import AGAIN, ASK_AFTER, PEER_LEASE, SOON, keys_of, send
from onboard.endpoints import NoVehicleError, ZenohConfig, open_session
from onboard.wire import (
    Ack,
    Ask,
    Order,
    Outcome,
    StationPulse,
    Telemetry,
    Told,
    VehiclePulse,
    Way,
    WireError,
    encode,
    read_ack,
    read_telemetry,
    read_told,
    read_vehicle_pulse,
    way_of,
)

if TYPE_CHECKING:
    from groundstation.urgent import Urgent

T = TypeVar("T")

_PULSE_PERIOD: Final = 0.1
#: Round trips of which the shortest is told: the newest.
_ROUND_TRIPS: Final = 20
_KEPT_EVENTS: Final = 1000


class NoAnswerError(Exception):
    """The vehicle is there, but gave no answer in time."""


class StationSettings(Struct, frozen=True):
    """Which vehicle is meant, how it is reached, and who asks."""

    vehicle: str = "pipewright"
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    station: str = ""
    """Name of the station; all sessions of one name command together. Empty: user and machine."""
    plain: bool = False
    """Allow endpoints without TLS, on loopback only."""


class Contact(Struct, frozen=True):
    """How the vehicle is heard."""

    present: bool = False
    """It is connected. It is not once it has closed or died, or was frozen or out of reach for two seconds."""
    age: float = math.inf
    """What was last heard of it was certainly sent at most so long ago, s."""
    round_trip: float = math.inf
    """Shortest of late, s."""
    clock_offset: float = math.nan
    """Its UTC clock minus ours, s; wrong by half the round trip at most."""
    missed: int = 0
    """Events that it told and that never came."""
    pulse: VehiclePulse | None = None
    """The newest."""

    def when(self, t_ns: int) -> datetime | None:
        """UTC of a time on the vehicle's monotonic clock, by our clock: the vehicle's stops without power.

        By the vehicle's own while the offset is not known; None before its first pulse.
        """
        if self.pulse is None:
            return None
        offset = self.clock_offset if math.isfinite(self.clock_offset) else 0.0
        return datetime.fromtimestamp((t_ns + self.pulse.wall_ns - self.pulse.sent_ns) * 1e-9 - offset, UTC)


def default_name() -> str:
    """A station's name, from user and machine."""
    return re.sub(r"[^a-z0-9_-]", "-", f"{getuser()}-{socket.gethostname()}".lower()).lstrip("-_")[:32]


class Client:
    """One session of a station with one vehicle. Use as a context manager, or close it.

    timeout: to find the vehicle, s. on_told: called with each event, on one of Zenoh's threads. security: Zenoh
    configuration for TLS; empty without. forbids: why something need not be asked, since the vehicle would not even
    answer; empty when it may be.
    Raises LinkError for settings that cannot be, NoVehicleError when the vehicle is not there or does not admit us.
    """

    def __init__(
        self,
        settings: StationSettings,
        *,
        timeout: float = 3.0,
        on_told: Callable[[Told], None] | None = None,
        security: ZenohConfig | None = None,
        forbids: Callable[[Ask], str] | None = None,
    ) -> None:
        self._settings, self._on_told, self._forbids = settings, on_told, forbids
        self.vehicle = settings.vehicle
        self.urgent: Urgent | None = None
        """Who asks for us what is urgent; None: we do."""
        self.station = settings.station or default_name()
        self.session = uuid.uuid4().hex[:12]
        """Name of this session among those of the station."""
        self._keys = keys_of(settings.vehicle, self.station)
        self._changed = Condition()
        self._present = False
        self._pulse: VehiclePulse | None = None
        self._echo_ns = 0
        """Newest of our stamps that the vehicle has heard."""
        self._trips: deque[tuple[int, int]] = deque(maxlen=_ROUND_TRIPS)
        """Round trips and clock offsets, ns."""
        self._told = 0
        self._missed = 0
        self._misread = ""
        self._telemetry: Telemetry | None = None
        self._orders: dict[str, SimpleQueue[Ack | None]] = {}
        self.events: deque[Told] = deque(maxlen=_KEPT_EVENTS)
        """The newest events since we are here, oldest first."""
        self._closing = Flag()
        self._sender = Thread(target=self._send_pulses, name="station.pulse", daemon=True)
        deadline = time.monotonic() + timeout
        self._session = self._open(timeout, security or {})
        try:
            self._declare()
            if not self.wait(lambda contact: math.isfinite(contact.age), deadline - time.monotonic()):
                raise NoVehicleError(self._why())
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave; safe to call twice."""
        self._closing.set()
        with suppress(zenoh.ZError):  # a connection that stands still cannot say goodbye
            self._session.close()
        if self._sender.is_alive():
            self._sender.join()

    # --- what the vehicle tells ---------------------------------------------------------------------------------------

    def contact(self) -> Contact:
        """How the vehicle is heard at this moment."""
        with self._changed:
            return self._contact()

    def wait(self, until: Callable[[Contact], bool], timeout: float) -> bool:
        """Wait until the contact is as wanted, at most ``timeout`` seconds; whether it is."""
        end = time.monotonic() + timeout
        with self._changed:
            while not until(self._contact()):
                if (left := end - time.monotonic()) <= 0.0:
                    return False
                self._changed.wait(min(left, _PULSE_PERIOD))  # ages grow without a word
        return True

    def telemetry(self) -> Telemetry | None:
        """The newest tick that has come."""
        return self._telemetry

    # --- what it is asked ---------------------------------------------------------------------------------------------

    def ask(self, ask: Ask, *, timeout: float = 5.0, settled: bool = False) -> Ack:
        """Ask the vehicle, and give its answer; with ``settled``, what has become of it in the end.

        Sent again until there is an answer. Raises NoVehicleError when the vehicle has gone, NoAnswerError when it does
        not answer within ``timeout`` seconds (then it may or may not do what was asked).
        """
        identity = uuid.uuid4().hex
        if self._forbids is not None and (why := self._forbids(ask)):
            return Ack(identity, Outcome.REFUSED, why)
        if self.urgent is not None and way_of(ask) is Way.SAFETY:
            return self.urgent.ask(ask, timeout=timeout, settled=settled)
        key = self._keys.station(self.station, self.session, way_of(ask))
        answers: SimpleQueue[Ack | None] = SimpleQueue()
        self._orders[identity] = answers
        end, due, accepted = time.monotonic() + timeout, 0.0, False
        try:
            while (now := time.monotonic()) < end:
                if now >= due:
                    due = now + (ASK_AFTER if accepted else AGAIN)
                    order = Order(identity, ask, self._pulse.sent_ns if self._pulse else 0)
                    send(self._session, key, order, answers.put, end - now)
                try:
                    answer = answers.get(timeout=max(0.0, min(due, end) - time.monotonic()))
                except Empty:
                    continue
                if answer is None:
                    due = min(due, time.monotonic() + SOON)
                elif not (settled and answer.outcome is Outcome.ACCEPTED):
                    return answer
                else:
                    accepted = True
        finally:
            del self._orders[identity]
        if not self._present:
            raise NoVehicleError(f"{self._settings.vehicle} has gone: no answer within {timeout:g} s")
        what = "it was accepted, but is not done" if accepted else "no answer"
        raise NoAnswerError(f"{self._settings.vehicle}: {what} within {timeout:g} s")

    # --- the session --------------------------------------------------------------------------------------------------

    def _open(self, timeout: float, security: ZenohConfig) -> zenoh.Session:
        settings = self._settings
        return open_session(
            "client",
            settings.connect,
            plain=settings.plain,
            lease=PEER_LEASE,
            security=security,
            timeout=timeout,
        )

    def _declare(self) -> None:
        session, keys = self._session, self._keys
        session.declare_subscriber(keys.pulse, self._reading(read_vehicle_pulse, self._hear_pulse))
        session.declare_subscriber(keys.telemetry, self._reading(read_telemetry, self._hear_telemetry))
        session.declare_subscriber(keys.event, self._reading(read_told, self._hear_told))
        session.declare_subscriber(keys.ack(self.station), self._reading(read_ack, self._hear_ack))
        liveliness = session.liveliness()
        liveliness.declare_subscriber(keys.alive, self._hear_alive, history=True)
        self._token = liveliness.declare_token(keys.station(self.station, self.session, "alive"))
        self._sender.start()

    def _reading(self, read: Callable[[bytes], T], hear: Callable[[T], None]) -> Callable[[zenoh.Sample], None]:
        def on_sample(sample: zenoh.Sample) -> None:
            try:
                message = read(sample.payload.to_bytes())
            except WireError as error:
                self._misread = str(error)
                return
            hear(message)

        return on_sample

    def _hear_pulse(self, pulse: VehiclePulse) -> None:
        now, wall = time.monotonic_ns(), time.time_ns()
        with self._changed:
            self._pulse = pulse
            for heard in pulse.stations:
                if heard.session == self.session and 0 < heard.heard_ns <= now:
                    self._echo_ns = max(self._echo_ns, heard.heard_ns)
                    trip = max(0, now - heard.heard_ns - heard.held_ns)
                    self._trips.append((trip, pulse.wall_ns - wall + trip // 2))
            self._changed.notify_all()

    def _hear_telemetry(self, telemetry: Telemetry) -> None:
        self._telemetry = telemetry

    def _hear_told(self, told: Told) -> None:
        if self._told:
            self._missed += max(0, told.number - self._told - 1)
        self._told = told.number
        self.events.append(told)
        if self._on_told is not None:
            self._on_told(told)

    def _hear_ack(self, ack: Ack) -> None:
        if (waiting := self._orders.get(ack.id)) is not None:
            waiting.put(ack)

    def _hear_alive(self, sample: zenoh.Sample) -> None:
        with self._changed:
            self._present = sample.kind == zenoh.SampleKind.PUT
            self._changed.notify_all()

    def _contact(self) -> Contact:
        age = (time.monotonic_ns() - self._echo_ns) * 1e-9 if self._echo_ns else math.inf
        trip, offset = min(self._trips, default=(math.inf, math.nan))
        return Contact(self._present, age, trip * 1e-9, offset * 1e-9, self._missed, self._pulse)

    def _send_pulses(self) -> None:
        key = self._keys.station(self.station, self.session, "pulse")
        while not self._closing.is_set():
            pulse = StationPulse(time.monotonic_ns(), self._pulse.sent_ns if self._pulse else 0)
            with suppress(zenoh.ZError):  # closed, or out of reach, which the age of the contact tells
                self._session.put(
                    key,
                    encode(pulse),
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.INTERACTIVE_HIGH,
                    express=True,
                )
            self._closing.wait(_PULSE_PERIOD)

    def _why(self) -> str:
        where, vehicle = ", ".join(self._settings.connect), self._settings.vehicle
        if self._misread:
            return f"{vehicle} at {where} is not understood: {self._misread}"
        if self._present:
            return f"{vehicle} at {where} is there, but does not hear this station: is {self.station} admitted?"
        there = _vehicles(self._session)
        if there:
            return f"no vehicle {vehicle!r} at {where}; there: {', '.join(there)}"
        return f"no vehicle is seen at {where}: is the link of {vehicle} on, and is {self.station} admitted?"


def _vehicles(session: zenoh.Session) -> list[str]:
    replies = session.liveliness().get("pipewright/*/alive", timeout=1.0)
    return sorted(str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None)
