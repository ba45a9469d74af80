"""What is asked of the kernel and of the garbage collector, and what becomes of a refusal."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import os
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from threading import Thread
from typing import Any

import pytest

from onboard.core.types import Phase
from onboard.layers import ConfigError
from onboard.params import load
from onboard.scheduling import COLLECT_EVERY, Collector, ProcessParams, ask, event_loop

PR_GET_TIMERSLACK = 30


def in_thread(function: Callable[[], Any]) -> Any:
    """The result of ``function`` in a thread of its own, whose scheduling dies with it."""
    results = []
    thread = Thread(target=lambda: results.append(function()))
    thread.start()
    thread.join(30.0)
    return results[0]


@pytest.fixture(autouse=True)
def _interval() -> Iterator[None]:
    before = sys.getswitchinterval()
    yield
    sys.setswitchinterval(before)


def test_by_default_only_timers_and_the_interpreter_are_asked_for() -> None:
    before = os.sched_getaffinity(0)

    def default() -> tuple[Any, ...]:
        slack = ctypes.CDLL(None).prctl
        refused = ask(ProcessParams())
        return refused, os.sched_getscheduler(0), os.sched_getaffinity(0), slack(PR_GET_TIMERSLACK, 0, 0, 0, 0)

    refused, policy, affinity, slack = in_thread(default)
    assert refused == ()
    assert (policy, affinity) == (os.SCHED_OTHER, before)
    assert slack == 1000
    assert sys.getswitchinterval() == pytest.approx(0.0005)


def test_the_loop_s_thread_is_bound_and_the_others_are_not() -> None:
    before = os.sched_getaffinity(0)
    last = max(before)
    assert in_thread(lambda: (ask(ProcessParams(cpu=(last,))), os.sched_getaffinity(0))) == ((), {last})
    assert os.sched_getaffinity(0) == before


def test_a_refusal_names_what_why_and_the_remedy() -> None:
    (told,) = in_thread(lambda: ask(ProcessParams(cpu=(1023,))))
    assert "process.cpu = [1023]: refused by the kernel (Invalid argument)" in told
    assert str(sorted(os.sched_getaffinity(0))) in told


def test_everything_refused_is_told_at_once_and_the_process_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr("onboard.scheduling._lock_memory", refuse)
    told = in_thread(lambda: ask(ProcessParams(realtime_priority=20, cpu=(0,), lock_memory=True)))
    assert [sentence.split(":")[0].split(" ")[0] for sentence in told] == [
        "process.cpu", "process.lock_memory", "process.realtime_priority",
    ]  # fmt: skip
    assert all("Operation not permitted" in sentence and ";" in sentence for sentence in told)


def test_the_real_time_priority_is_the_loop_s_alone() -> None:
    def with_child() -> tuple[Any, ...]:
        refused = ask(ProcessParams(realtime_priority=7))
        here = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(0).sched_priority
        return refused, here, in_thread(lambda: os.sched_getscheduler(0))

    refused, here, child = in_thread(with_child)
    if refused:
        assert "LimitRTPRIO" in refused[0]
        assert here == (os.SCHED_OTHER, 0)
    else:
        assert here == (os.SCHED_FIFO, 7)
    assert child == os.SCHED_OTHER


#: In a process of its own, whose limits and locked memory are its own: prints the refusals and what is locked.
LOCK = """
import resource, sys
from onboard.scheduling import ProcessParams, ask
from pathlib import Path
if sys.argv[1] == "limited":
    import onboard.scheduling as scheduling
    scheduling._capable = lambda capability: False
    _, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, hard))
for sentence in ask(ProcessParams(lock_memory=True)):
    print(sentence)
print(next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmLck")))
"""


@pytest.mark.parametrize("how", ["limited", "free"])
def test_memory_is_locked_wholly_or_not_at_all(how: str) -> None:
    """Under a limit the lock would succeed, and an allocation in flight would fail."""
    done = subprocess.run([sys.executable, "-c", LOCK, how], capture_output=True, text=True, check=True, timeout=120)
    *refused, locked = done.stdout.splitlines()
    kilobytes = int(locked.split()[1])
    if how == "limited":
        assert "only 64 KiB may be locked" in refused[0]
        assert "LimitMEMLOCK=infinity" in refused[0]
    assert (kilobytes == 0) == bool(refused)


def test_parameters_are_declared_with_bounds() -> None:
    assert load(ProcessParams, {"cpu": [0, 3], "realtime_priority": 80}, "a.yaml").cpu == (0, 3)
    with pytest.raises(ConfigError, match=r"realtime_priority = 100"):
        load(ProcessParams, {"realtime_priority": 100}, "a.yaml")


# --- the event loop ---------------------------------------------------------------------------------------------------


def lateness(runner: asyncio.Runner) -> float:
    """Least lateness of a timer that is never due at a whole millisecond, s."""

    async def ticking() -> list[float]:
        late = []
        for _ in range(60):
            due = time.monotonic() + 0.0023
            await asyncio.sleep(0.0023)
            late.append(time.monotonic() - due)
        return late

    with runner:
        return min(runner.run(ticking()))


def test_timers_are_finer_than_a_millisecond() -> None:
    """Epoll rounds 2.3 ms up to 3 ms, every time; what a busy machine adds, it does not add every time."""
    assert lateness(asyncio.Runner(loop_factory=event_loop)) < 0.0006


# --- the collector ----------------------------------------------------------------------------------------------------


class Node:
    """Something that only the collector can free."""

    def __init__(self) -> None:
        self.itself = self


def cycle() -> weakref.ref[Node]:
    return weakref.ref(Node())


def test_in_flight_nothing_is_collected_until_much_has_piled_up() -> None:
    with Collector(ProcessParams(gc_growth=5000)) as collector:
        assert not gc.isenabled()
        first = cycle()
        for _ in range(1000):
            collector.tick(Phase.PRESS)
        assert first() is not None
        assert collector.in_flight == 0
        kept = [[i] for i in range(6000)]
        collector.tick(Phase.PRESS)
        assert first() is None
        assert collector.in_flight == 1
        collector.tick(Phase.PRESS)
        assert collector.in_flight == 1, "what survives is not looked at again"
        assert len(kept) == 6000
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_memory_is_bounded_in_flight() -> None:
    with Collector(ProcessParams(gc_growth=1000)) as collector:
        living = []
        for _ in range(300):
            living += [cycle() for _ in range(50)]
            collector.tick(Phase.HOLD)
        assert sum(node() is not None for node in living) < 1200
        assert collector.in_flight > 5


@pytest.mark.parametrize("phase", [Phase.PREFLIGHT, Phase.STOPPED])
def test_on_the_ground_it_collects_now_and_then(phase: Phase) -> None:
    with Collector(ProcessParams()) as collector:
        node = cycle()
        for _ in range(COLLECT_EVERY - 1):
            collector.tick(phase)
        assert node() is not None
        collector.tick(phase)
        assert node() is None
        assert collector.in_flight == 0


def test_it_may_be_left_to_itself() -> None:
    with Collector(ProcessParams(gc=True, gc_growth=1000)) as collector:
        assert gc.isenabled()
        kept = [[i] for i in range(3000)]
        collector.tick(Phase.PRESS)
        assert collector.in_flight == 0
        assert len(kept) == 3000


def test_what_lived_before_is_not_looked_at() -> None:
    before = cycle_kept()
    with Collector(ProcessParams()):
        frozen = gc.get_freeze_count()
        assert frozen > 1000
        assert not any(thing is before for thing in gc.get_objects())
    assert any(thing is before for thing in gc.get_objects())


def cycle_kept() -> list[object]:
    return [object()]
