"""Things are sent in order by a thread of its own; what does not fit, and what fails, is counted."""

from __future__ import annotations

from functools import partial
from threading import Event

from onboard.outbox import Outbox
from tests.waiting import LONG


def test_in_order_and_before_it_closes() -> None:
    sent: list[int] = []
    outbox = Outbox("test", 10, lambda error: None)
    for i in range(5):
        outbox.put(partial(sent.append, i))
    assert sent == []
    outbox.start()
    outbox.close(LONG)
    assert sent == [0, 1, 2, 3, 4]
    assert outbox.dropped == 0


def test_what_does_not_fit_or_comes_too_late_is_counted_and_nobody_waits() -> None:
    sent: list[int] = []
    outbox = Outbox("test", 2, lambda error: None)
    for i in range(5):
        outbox.put(partial(sent.append, i))
    assert outbox.dropped == 3
    outbox.start()
    outbox.close(LONG)
    outbox.put(partial(sent.append, 5))
    assert outbox.dropped == 4
    assert sent == [0, 1]


def test_what_fails_is_told_and_the_next_is_sent() -> None:
    def fail() -> None:
        raise ValueError

    errors: list[Exception] = []
    sent: list[int] = []
    outbox = Outbox("test", 10, errors.append)
    outbox.put(fail)
    outbox.put(partial(sent.append, 1))
    outbox.start()
    outbox.close(LONG)
    assert [type(error) for error in errors] == [ValueError]
    assert outbox.dropped == 1
    assert sent == [1]


def test_closing_does_not_wait_for_ever() -> None:
    release, begun = Event(), Event()

    def stuck() -> None:
        begun.set()
        release.wait(LONG)

    after: list[int] = []
    outbox = Outbox("test", 1, lambda error: None)
    outbox.start()
    outbox.put(stuck)
    assert begun.wait(LONG)
    outbox.put(partial(after.append, 1))
    outbox.close(0.05)
    release.set()
    assert after == []
