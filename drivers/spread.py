"""How durations spread: a histogram that costs nothing to add to."""

from __future__ import annotations

from msgspec import Struct

#: Bins per octave; a percentile is told to within a quarter of its value.
_SHARE = 4
_SMALLEST_NS = 1024
_BINS = 80


class Summary(Struct, frozen=True, gc=False):
    """What a set of durations comes to, s."""

    count: int
    mean: float
    p50: float
    p99: float
    max: float


class Spread:
    """Durations in bins whose width grows with them. One thread adds, any may read."""

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self._count = 0
        self._total = 0
        self._max = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        self._count += 1
        self._total += duration_ns
        if duration_ns > self._max:
            self._max = duration_ns
        self._bins[_bin(duration_ns)] += 1

    def percentile(self, share: float) -> float:
        """Duration, s, that ``share`` (0..1) of all do not exceed: the upper edge of its bin; 0 when there are none."""
        left = share * self._count
        for index, count in enumerate(self._bins):
            left -= count
            if count and left <= 0.0:
                return min(edge(index + 1), self._max) * 1e-9
        return self._max * 1e-9

    def summary(self) -> Summary:
        """Count, mean, median, 99th percentile and maximum."""
        mean = self._total / self._count * 1e-9 if self._count else 0.0
        return Summary(self._count, mean, self.percentile(0.5), self.percentile(0.99), self._max * 1e-9)

    def histogram(self) -> tuple[tuple[float, int], ...]:
        """Lower edge, s, and count of every bin that is not empty."""
        return tuple((edge(index) * 1e-9, count) for index, count in enumerate(self._bins) if count)


def _bin(duration_ns: int) -> int:
    octave = (duration_ns // _SMALLEST_NS).bit_length()
    if octave == 0:
        return 0
    within = (duration_ns >> (octave - 1)) * _SHARE // _SMALLEST_NS - _SHARE
    return min((octave - 1) * _SHARE + within + 1, _BINS - 1)


def edge(index: int) -> float:
    """Lower edge of a bin, ns."""
    if index == 0:
        return 0.0
    octave, within = divmod(index - 1, _SHARE)
    return _SMALLEST_NS * 2.0**octave * (1.0 + within / _SHARE)
