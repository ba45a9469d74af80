"""The histogram of durations."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.spread import Spread


def test_nothing_yet() -> None:
    summary = Spread().summary()
    assert (summary.count, summary.mean, summary.p50, summary.p99, summary.max) == (0, 0.0, 0.0, 0.0, 0.0)


def test_mean_and_maximum_are_exact() -> None:
    spread = Spread()
    for duration in (1_000_000, 2_000_000, 6_000_000):
        spread.add(duration)
    summary = spread.summary()
    assert summary.count == 3
    assert summary.mean == pytest.approx(0.003)
    assert summary.max == pytest.approx(0.006)


@given(st.lists(st.integers(2_000, 100_000_000), min_size=1, max_size=200), st.floats(0.0, 1.0))
def test_percentiles_are_right_to_a_quarter(durations: list[int], share: float) -> None:
    spread = Spread()
    for duration in durations:
        spread.add(duration)
    told = spread.percentile(share)
    ordered = sorted(durations)
    # The duration that so many do not exceed, as the list has it.
    rank = next(k for k in range(len(ordered)) if k + 1 >= share * len(ordered))
    assert ordered[rank] * 1e-9 <= told * (1.0 + 1e-12)
    assert told <= 1.2501 * ordered[rank] * 1e-9


@given(st.lists(st.integers(0, 10**12), max_size=100))
def test_every_duration_is_in_a_bin(durations: list[int]) -> None:
    spread = Spread()
    for duration in durations:
        spread.add(duration)
    histogram = spread.histogram()
    assert sum(count for _, count in histogram) == len(durations)
    assert list(histogram) == sorted(histogram)
