"""A device's own clock, mapped to the clock of the process by the samples that took the shortest way."""

from __future__ import annotations

from collections import deque

WINDOW_NS = 2_000_000_000
#: A sample that seems to have been under way for longer, or to come from the future, says that the clock was set.
STEP_NS = 500_000_000
#: No clock is faster or slower than this, s/s: what comes later than that explains is late.
MAX_DRIFT = 1e-3
_KEPT_WINDOWS = 8


class DeviceClock:
    """Maps device time to process time, both ns.

    The way from device to process takes a constant time and a varying one. The least difference between arrival and
    device time in the current and the last window (2 s each) is free of the varying part; the constant part stays in
    the result, as if the sample had been taken that much later. A clock that runs fast or slow is followed, but no
    faster than clocks run, so that samples which begin to come late are seen to be old. A clock that was set is
    noticed by the first sample after that, and the map begins anew.
    """

    def __init__(self) -> None:
        #: How often the device's clock was set, so far.
        self.steps = 0
        self._current = self._last = 0
        self._window_ns: int | None = None
        self._minima: deque[tuple[int, int]] = deque(maxlen=_KEPT_WINDOWS)

    def map(self, device_ns: int, arrival_ns: int) -> int:
        """Process time of a sample with this device time that has arrived now; never later than its arrival."""
        difference = arrival_ns - device_ns
        if self._window_ns is None:
            self._begin(difference, arrival_ns)
        elif abs(difference - min(self._current, self._last)) > STEP_NS:
            self.steps += 1
            self._begin(difference, arrival_ns)
        elif arrival_ns - self._window_ns > WINDOW_NS:
            self._minima.append((self._window_ns, self._current))
            rise = round(MAX_DRIFT * (arrival_ns - self._window_ns))
            self._last = min(self._current, self._last + rise)
            self._current, self._window_ns = difference, arrival_ns
        else:
            self._current = min(self._current, difference)
        return device_ns + min(self._current, self._last)

    def drift(self) -> float:
        """How much slower the device's clock runs than the process's, s/s, over the last 14 s; 0 before that."""
        if len(self._minima) < _KEPT_WINDOWS:
            return 0.0
        (t0, first), (t1, newest) = self._minima[0], self._minima[-1]
        return (newest - first) / (t1 - t0)

    def _begin(self, difference: int, arrival_ns: int) -> None:
        self._current = self._last = difference
        self._window_ns = arrival_ns
        self._minima.clear()
