"""How the process asks the kernel and the interpreter for punctuality.

What the kernel refuses is told as a sentence, and the process goes on without it.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import os
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from selectors import SelectSelector
from types import TracebackType
from typing import Annotated, Final, Self

from msgspec import Meta, Struct

from onboard.core.mission import GROUND
from onboard.core.types import Phase

#: Between two collections on the ground, ticks.
COLLECT_EVERY: Final = 2500
_PR_SET_TIMERSLACK, _MCL_CURRENT, _MCL_FUTURE, _CAP_IPC_LOCK = 29, 1, 2, 14


def _meta(unit: str, low: float, high: float, doc: str) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


def _note(doc: str) -> Meta:
    return Meta(description=doc, extra={"unit": "", "in_flight": False})


class ProcessParams(Struct, frozen=True, forbid_unknown_fields=True):
    """What the flight process asks of the kernel and of the interpreter."""

    realtime_priority: Annotated[
        int, _meta("1", 0, 99, "SCHED_FIFO priority of the loop's thread; 0: scheduled as any other")
    ] = 0
    cpu: tuple[Annotated[int, _meta("1", 0, 1023, "processors that the loop's thread may run on; none: all")], ...] = ()
    lock_memory: Annotated[bool, _note("keep the memory of the process from being paged out")] = False
    timer_slack: Annotated[float, _meta("s", 1e-9, 1e-3, "by which the kernel may be late with the loop's timer")] = (
        1e-6
    )
    switch_interval: Annotated[
        float, _meta("s", 1e-5, 0.1, "after which a busy thread hands the interpreter to the loop")
    ] = 0.0005
    gc: Annotated[bool, _note("let the garbage collector run at any time, in flight too")] = False
    gc_growth: Annotated[
        int, _meta("1", 1000, 10_000_000, "objects that may pile up in flight before the newest are looked through")
    ] = 20_000


def event_loop() -> asyncio.SelectorEventLoop:
    """An event loop whose timers are as fine as the kernel's: epoll, asyncio's choice, only counts milliseconds.

    For ``asyncio.Runner(loop_factory=event_loop)``. It can wait for file descriptors below 1024 only.
    """
    return asyncio.SelectorEventLoop(SelectSelector())


def ask(params: ProcessParams) -> tuple[str, ...]:
    """Ask for what ``params`` says, for the calling thread; returns a sentence for each thing that was refused.

    To be called by the loop's thread once the other threads run: a thread takes over processors and timer slack from
    the one that starts it, though not the priority.
    """
    sys.setswitchinterval(params.switch_interval)
    asked: list[tuple[str, Callable[[], None], str]] = [
        (
            f"process.timer_slack = {params.timer_slack:g} s",
            lambda: _call("prctl", _PR_SET_TIMERSLACK, round(params.timer_slack * 1e9), 0, 0, 0),
            "the kernel is older than 2.6.28",
        )
    ]
    if params.cpu:
        there = sorted(os.sched_getaffinity(0))
        asked.append(
            (
                f"process.cpu = {list(params.cpu)}",
                lambda: os.sched_setaffinity(0, params.cpu),
                f"the process may use {there}",
            )
        )
    if params.lock_memory:
        asked.append(("process.lock_memory", _lock_memory, "set LimitMEMLOCK=infinity in the unit"))
    if params.realtime_priority:
        asked.append(
            (
                f"process.realtime_priority = {params.realtime_priority}",
                lambda: os.sched_setscheduler(
                    0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(params.realtime_priority)
                ),
                "set LimitRTPRIO=99 in the unit, or give the process CAP_SYS_NICE",
            )
        )
    refused = []
    for what, request, remedy in asked:
        try:
            request()
        except OSError as error:
            refused.append(f"{what}: refused by the kernel ({error.strerror}); {remedy}")
    return tuple(refused)


def _call(name: str, *arguments: int) -> None:
    """A call of the C library. Raises OSError."""
    function = getattr(ctypes.CDLL(None, use_errno=True), name)
    if function(*(ctypes.c_ulong(argument) for argument in arguments)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _lock_memory() -> None:
    # With a limit the call succeeds, and it is a later allocation that fails: in flight.
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and not _capable(_CAP_IPC_LOCK):
        raise OSError(0, f"only {limit // 1024} KiB may be locked")
    _call("mlockall", _MCL_CURRENT | _MCL_FUTURE)


def _capable(capability: int) -> bool:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> capability & 1)
    return False


class Collector:
    """Keeps Python's garbage collector out of the flight. Use as a context manager around the loop.

    What lives at the beginning is not looked at any more, and nothing is collected at the interpreter's own bidding:
    the whole rest in regular intervals on the ground; in flight, only the newest objects, and only once
    ``gc_growth`` of them have piled up (reference counting frees almost everything, so that takes long).
    """

    def __init__(self, params: ProcessParams) -> None:
        self._free = params.gc
        self._growth = params.gc_growth
        self._ticks = 0
        self._was_enabled = True
        self.in_flight = 0
        """Collections that had to be made in flight."""

    def __enter__(self) -> Self:
        self._was_enabled = gc.isenabled()
        gc.collect()
        gc.freeze()
        if not self._free:
            gc.disable()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        gc.unfreeze()
        if self._was_enabled:
            gc.enable()

    def tick(self, phase: Phase) -> None:
        """Collect if it is time to; to be called when a tick's commands are out."""
        if self._free:
            return
        if phase in GROUND:
            self._ticks += 1
            if self._ticks % COLLECT_EVERY == 0:
                gc.collect()
        elif gc.get_count()[0] > self._growth:
            gc.collect(0)
            self.in_flight += 1
