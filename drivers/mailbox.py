"""One slot, newest wins: how a driver's thread hands samples to the control loop without either ever waiting."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import StrEnum
from threading import Lock
from typing import Generic, TypeVar

from msgspec import Struct

T = TypeVar("T")

_WINDOW_NS = 1_000_000_000
_KEPT_NOTICES = 256
_TELL_AGAIN_NS = 10_000_000_000
_CALM_NS = 1_000_000_000


class MailboxCounts(Struct, frozen=True, gc=False):
    """What has passed through a mailbox."""

    received: int
    overwritten: int
    """Samples that nobody read before the next one came."""
    rejected: int
    """Samples that could not be used: not decodable or not finite."""
    rate: float
    """Achieved rate, 1/s: of the last whole second, or lower if nothing has come since."""


class Mailbox(Generic[T]):
    """Holds the newest sample. Any thread may put and any thread may read."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._value: T | None = None
        self._unread = False
        self._received = 0
        self._overwritten = 0
        self._rejected = 0
        self._window_start: int | None = None
        self._in_window = 0
        self._rate = 0.0

    def put(self, value: T, t_ns: int) -> None:
        """Store a sample that arrived at ``t_ns``; the one before is gone."""
        with self._lock:
            self._value = value
            self._received += 1
            self._overwritten += self._unread
            self._unread = True
            if self._window_start is None:
                self._window_start = t_ns
                return
            self._in_window += 1
            if t_ns - self._window_start >= _WINDOW_NS:
                self._rate = self._in_window * 1e9 / (t_ns - self._window_start)
                self._window_start = t_ns
                self._in_window = 0

    def reject(self) -> None:
        """Count a sample that could not be used."""
        with self._lock:
            self._rejected += 1

    def latest(self) -> T | None:
        """The newest sample, or None before the first. Reading does not empty the slot."""
        with self._lock:
            self._unread = False
            return self._value

    def counts(self, t_ns: int) -> MailboxCounts:
        """Counters and achieved rate at ``t_ns``."""
        with self._lock:
            rate = self._rate
            if self._window_start is not None and t_ns - self._window_start > 2 * _WINDOW_NS:
                rate = min(rate, self._in_window * 1e9 / (t_ns - self._window_start))
            return MailboxCounts(self._received, self._overwritten, self._rejected, rate)


class Level(StrEnum):
    """How loud a notice is."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Notice(Struct, frozen=True, gc=False):
    """A sentence that a driver tells a person."""

    t_ns: int
    level: Level
    text: str


class Notices:
    """The newest sentences of a driver, until somebody takes them. Any thread may tell and any thread may take."""

    def __init__(self) -> None:
        self._notices: deque[Notice] = deque(maxlen=_KEPT_NOTICES)

    def tell(self, t_ns: int, level: Level, text: str) -> None:
        """Add one sentence; the oldest goes when nobody takes them."""
        self._notices.append(Notice(t_ns, level, text))

    def take(self) -> tuple[Notice, ...]:
        """All sentences not taken yet, oldest first."""
        taken: list[Notice] = []
        while self._notices:
            taken.append(self._notices.popleft())
        return tuple(taken)


class Teller:
    """Tells sentences of a device with the time of a clock; what happens again and again, once in ten seconds."""

    def __init__(self, notices: Notices, clock: Callable[[], int], device: str) -> None:
        """``device`` begins every sentence."""
        self._notices = notices
        self._clock = clock
        self._device = device
        self._told: dict[str, tuple[int, int]] = {}

    def tell(self, level: Level, text: str) -> None:
        """Tell it."""
        self._notices.tell(self._clock(), level, f"{self._device}: {text}")

    def once(self, key: str, level: Level, text: str) -> None:
        """Tell it, unless the same was told within the last ten seconds; then count it for the next time."""
        now = self._clock()
        since, more = self._told.get(key, (now - _TELL_AGAIN_NS, 0))
        if now - since < _TELL_AGAIN_NS:
            self._told[key] = (since, more + 1)
            return
        self._told[key] = (now, 0)
        self.tell(level, f"{text} (and {more} times since it was last told)" if more else text)


class Trouble:
    """What may go wrong again and again: told when it begins, and when it has been over for a second."""

    def __init__(self, tell: Callable[[Level, str], None], over: str) -> None:
        """``over`` is said at the end; ``{count}`` in it is how often it has happened."""
        self._tell = tell
        self._over = over
        self._count = 0
        self._last_ns = 0

    @property
    def active(self) -> bool:
        """It has happened, and has not been over for long enough."""
        return self._count > 0

    def happened(self, now: int, text: str) -> None:
        """Once more, at ``now`` in ns."""
        self._last_ns = now
        self._count += 1
        if self._count == 1:
            self._tell(Level.WARNING, text)

    def check(self, now: int) -> None:
        """Tell the end, if this is it."""
        if self._count and now - self._last_ns > _CALM_NS:
            count, self._count = self._count, 0
            self._tell(Level.INFO, self._over.format(count=count))
