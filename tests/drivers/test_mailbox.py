"""Newest wins, nothing is lost uncounted, and the achieved rate is the true one."""

from __future__ import annotations

from threading import Thread

import pytest

from drivers.mailbox import Level, Mailbox, Notices

MS = 1_000_000


def test_empty_then_newest() -> None:
    box: Mailbox[int] = Mailbox()
    assert box.latest() is None
    box.put(1, 0)
    box.put(2, MS)
    assert box.latest() == 2
    assert box.latest() == 2
    counts = box.counts(MS)
    assert (counts.received, counts.overwritten, counts.rejected) == (2, 1, 0)


def test_read_samples_are_not_counted_as_overwritten() -> None:
    box: Mailbox[int] = Mailbox()
    for i in range(5):
        box.put(i, i * MS)
        box.latest()
    assert box.counts(5 * MS).overwritten == 0


def test_rejected() -> None:
    box: Mailbox[int] = Mailbox()
    box.reject()
    assert box.counts(0).rejected == 1
    assert box.latest() is None


def test_rate_and_its_decay() -> None:
    box: Mailbox[int] = Mailbox()
    for i in range(1001):
        box.put(i, i * 4 * MS)
    assert box.counts(4000 * MS).rate == pytest.approx(250.0)
    assert box.counts(24_000 * MS).rate < 1.0


def test_many_threads_lose_no_count() -> None:
    box: Mailbox[int] = Mailbox()

    def put() -> None:
        for i in range(2000):
            box.put(i, i * MS)

    threads = [Thread(target=put) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert box.counts(0).received == 8000


def test_notices_are_taken_once_and_bounded() -> None:
    notices = Notices()
    notices.tell(1, Level.INFO, "a")
    notices.tell(2, Level.ERROR, "b")
    assert [n.text for n in notices.take()] == ["a", "b"]
    assert notices.take() == ()
    for i in range(1000):
        notices.tell(i, Level.INFO, str(i))
    kept = notices.take()
    assert len(kept) == 256
    assert kept[-1].text == "999"
