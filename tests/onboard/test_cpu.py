"""Whose work is whose: shares by hand, and of threads that really work."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.threads import named
from onboard.cpu import OTHER, PARTS, CpuMeter, Used, part, shares, threads

#: Never set: a wait for it passes time.
PAUSE = threading.Event()


@pytest.mark.parametrize(
    ("name", "owner"),
    [
        ("MainThread", "loop"), ("dynamixel", "dynamixel"), ("recorder", "recorder"), ("mavsdk", "mavsdk"),
        ("realsense", "realsense"), ("t265 open", "realsense"), ("world link", "world"), ("python", OTHER),
        ("asyncio_0", OTHER), ("", OTHER),
    ],
)  # fmt: skip
def test_parts_go_by_the_names_of_threads(name: str, owner: str) -> None:
    assert part(name) == owner


def test_shares_by_hand() -> None:
    before = {1: Used("MainThread", 10.0), 2: Used("mavsdk", 1.0), 3: Used("mavsdk", 2.0), 4: Used("gone", 7.0)}
    after = {1: Used("MainThread", 11.0), 2: Used("mavsdk", 1.1), 3: Used("mavsdk", 2.2), 5: Used("new", 0.4)}
    found = shares(before, after, 2.0)
    assert set(found) == {*PARTS, OTHER}
    assert found == pytest.approx(
        {"loop": 0.5, "mavsdk": 0.15, "other": 0.2, "dynamixel": 0.0, "recorder": 0.0, "realsense": 0.0, "world": 0.0}
    )


@contextmanager
def working(name: str, work: Callable[[], object]) -> Iterator[threading.Thread]:
    """A thread that does ``work`` over and over."""
    over = threading.Event()

    def run() -> None:
        while not over.is_set():
            work()

    thread = threading.Thread(target=run, name=name)
    thread.start()
    yield thread
    over.set()
    thread.join()


def test_threads_are_found_by_name_and_with_what_they_used() -> None:
    with working("recorder", lambda: PAUSE.wait(0.001)) as thread:
        assert thread.native_id is not None
        found = threads()[thread.native_id]
        assert found.name == "recorder"
        assert 0.0 <= found.seconds < 5.0
    assert thread.native_id not in threads()
    assert threads()[threading.get_native_id()].name == "MainThread"


def test_a_name_with_blanks_and_brackets_does_not_disturb() -> None:
    with named("a) b (c"):
        assert threads()[threading.get_native_id()].seconds > 0.0


def test_the_one_that_works_has_the_share() -> None:
    with working("dynamixel", lambda: sum(range(1000))):
        meter = CpuMeter()
        end = time.monotonic() + 30.0
        while not meter.latest():
            assert time.monotonic() < end
            PAUSE.wait(0.05)
        latest, mean = meter.latest(), meter.mean()
    meter.stop()
    meter.stop()
    for found in (latest, mean):
        assert found["dynamixel"] == max(found.values())
        assert 0.02 < found["dynamixel"] < 2.0, "of one core; a busy machine reads clock and time apart"


def test_what_is_started_inside_bears_the_name_and_the_caller_has_its_own_again() -> None:
    own = Path("/proc/thread-self/comm")
    before = own.read_text()
    names: list[str] = []

    def look() -> None:
        names.append(own.read_text().strip())
        if len(names) < 2:  # what it starts in turn
            inner = threading.Thread(target=look)
            inner.start()
            inner.join()

    thread = threading.Thread(target=look)
    with named("a long name of a library"):
        thread.start()
    thread.join()
    assert names == ["a long name of "] * 2 or names == ["a long name of"] * 2
    assert own.read_text() == before
