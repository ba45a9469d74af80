"""How long calls take: by probes that stand in for functions, and call by call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from statistics import median
from time import perf_counter_ns
from timeit import repeat
from typing import Any
from unittest.mock import patch

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

Where = tuple[Any, str]
"""A module or class, and the name of a function in it."""


class Stat(Struct, frozen=True):
    """What a set of durations comes to, us."""

    median: float
    p99: float
    mean: float
    count: int


def stat(durations_ns: Sequence[int] | NDArray[np.int64]) -> Stat:
    """Median, 99th percentile and mean of durations in ns; ValueError when there are none."""
    if not len(durations_ns):
        raise ValueError("no durations: nothing was called")
    us = np.asarray(durations_ns) * 1e-3
    return Stat(float(np.median(us)), float(np.percentile(us, 99.0)), float(np.mean(us)), len(us))


def _timed(function: Callable[..., Any], spans: list[int]) -> Callable[..., Any]:
    def call(*arguments: Any, **named: Any) -> Any:
        start = perf_counter_ns()
        result = function(*arguments, **named)
        spans.append(perf_counter_ns() - start)
        return result

    return call


def _nothing(a: int, b: int, c: int, d: int) -> None: ...


@cache
def cost_of_looking() -> int:
    """What a probe adds to the duration of a call, ns: taken off again everywhere."""
    spans: list[int] = []
    call = _timed(_nothing, spans)
    for _ in range(20_000):
        call(1, 2, 3, 4)
    rounds = 100
    plain = repeat("f(1, 2, 3, 4)", globals={"f": _nothing}, repeat=200, number=rounds)
    return round(median(spans[1000:]) - 1e9 * median(plain) / rounds)


class Probe:
    """Durations (ns) of every call to some functions, while ``watching``."""

    def __init__(self, *where: Where) -> None:
        self._where = where
        self.spans: list[int] = []

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Put timed functions in the place of the real ones."""
        with ExitStack() as stack:
            for owner, name in self._where:
                stack.enter_context(patch.object(owner, name, _timed(getattr(owner, name), self.spans)))
            yield

    def take(self) -> int:
        """Time in all calls since the last take, ns."""
        total = sum(self.spans) - cost_of_looking() * len(self.spans)
        self.spans.clear()
        return max(0, total)

    def all(self) -> list[int]:
        """Duration of each call, ns."""
        return [max(0, span - cost_of_looking()) for span in self.spans]


def calls(function: Callable[..., Any], inputs: Sequence[tuple[Any, ...]], repeats: int) -> list[int]:
    """Duration of each call with each of the inputs, ns, ``repeats`` times over, after one round to warm up."""
    spans: list[int] = []
    call = _timed(function, spans)
    for round_ in range(repeats + 1):
        for arguments in inputs:
            call(*arguments)
        if round_ == 0:
            spans.clear()
    return [max(0, span - cost_of_looking()) for span in spans]
