"""What the person at ``pipewright watch`` asks, and what the vehicle answers: each order in a thread of its own.

An order waits for no other: with the link lost, many may wait for their answer, and the next leaves at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Lock, Thread
from typing import Final, Protocol

from msgspec import Struct
from msgspec.structs import replace

from onboard.wire import Ack, Ask, Outcome, ReleaseLease, TakeLease

_KEPT: Final = 20
#: The lease that is ours to keep is asked for again after this time, ns.
_AGAIN_NS: Final = 2_000_000_000


class Asker(Protocol):
    """The part of the client that asks."""

    def ask(self, ask: Ask, *, timeout: float = ..., settled: bool = ...) -> Ack:
        """Give the answer, or raise why there is none."""


class Order(Struct, frozen=True):
    """What was asked, and what has become of it."""

    name: str
    asked_ns: int
    outcome: Outcome | None = None
    """None: there is no answer."""
    text: str = ""
    """Of the answer, or why there is none; empty: it may still come."""

    @property
    def pending(self) -> bool:
        """The answer may still come."""
        return self.outcome is None and not self.text


class Orders:
    """Asks, and remembers.

    clock: monotonic, ns. timeout: for an answer, s.
    """

    def __init__(self, asker: Asker, clock: Callable[[], int], timeout: float) -> None:
        self._asker, self._clock, self._timeout = asker, clock, timeout
        self._lock = Lock()
        self._orders: deque[list[Order]] = deque(maxlen=_KEPT)

    def give(self, name: str, what: Ask) -> None:
        """Ask at once, and come back at once."""
        slot = [Order(name, self._clock())]
        with self._lock:
            self._orders.append(slot)
        Thread(target=self._ask, args=(slot, what), name=f"order.{name}", daemon=True).start()

    def latest(self) -> tuple[Order, ...]:
        """The newest orders, oldest first."""
        with self._lock:
            return tuple(slot[0] for slot in self._orders)

    def _ask(self, slot: list[Order], what: Ask) -> None:
        try:
            ack = self._asker.ask(what, timeout=self._timeout, settled=True)
            answered = replace(slot[0], outcome=ack.outcome, text=ack.text)
        except Exception as error:  # whatever it is, the person who asked must see it
            answered = replace(slot[0], text=str(error) or type(error).__name__)
        with self._lock:
            slot[0] = answered


class LeaseKeeper:
    """Has the station command while the screen is open, and tells whether the lease is to be given back."""

    NAME: Final = "lease"

    def __init__(self, orders: Orders) -> None:
        self._orders = orders
        self._asked_ns: int | None = None
        self._had = False
        """It was ours before we asked."""

    def look(self, commander: str, station: str, now_ns: int) -> None:
        """Ask for the lease when nobody has it, as after a restart of the vehicle; taken by another, it is let go."""
        first = self._asked_ns is None
        if first:
            self._had = commander == station
        elif commander or now_ns - (self._asked_ns or 0) < _AGAIN_NS:
            return
        self._asked_ns = now_ns
        if not self._had:
            self._orders.give(self.NAME, TakeLease())

    def release(self, commander: str, station: str) -> ReleaseLease | None:
        """What to ask at the end."""
        return ReleaseLease() if commander == station and not self._had else None
