"""A foreign clock is mapped by the fastest samples, followed when it drifts, and begun anew when it was set."""

from __future__ import annotations

from random import Random

import pytest

from drivers.device_clock import MAX_DRIFT, DeviceClock

MS = 1_000_000
S = 1_000_000_000
PERIOD = 5 * MS
AHEAD = 1_700_000_000 * S  # the device's clock counts from another year


def test_jitter_is_taken_out() -> None:
    """Ways of 2 to 8 ms: after the first fast one, each sample is placed 2 ms after it was taken."""
    clock, random = DeviceClock(), Random(1)
    clock.map(AHEAD, 2 * MS)
    for k in range(1, 2000):
        taken = k * PERIOD
        way = random.randint(2 * MS, 8 * MS)
        mapped = clock.map(AHEAD + taken, taken + way)
        assert taken + 2 * MS <= mapped <= taken + 2 * MS + MS // 10
    assert clock.steps == 0
    assert clock.drift() == pytest.approx(0.0, abs=1e-5)


def test_never_later_than_the_arrival() -> None:
    clock, random = DeviceClock(), Random(2)
    for k in range(2000):
        arrival = k * PERIOD + random.randint(0, 20 * MS)
        assert clock.map(AHEAD + k * PERIOD, arrival) <= arrival


@pytest.mark.parametrize("rate", [-2e-4, 2e-4])
def test_a_clock_that_runs_wrong_is_followed_and_measured(rate: float) -> None:
    clock = DeviceClock()
    for k in range(6000):
        taken = k * PERIOD
        mapped = clock.map(AHEAD + round(taken * (1.0 - rate)), taken + MS)
        assert abs(mapped - taken - MS) <= 5 * S * abs(rate)
    assert clock.drift() == pytest.approx(rate, rel=0.05)
    assert clock.steps == 0


def test_samples_that_begin_to_come_late_stay_old() -> None:
    """Late by 0.2 s for 30 s: no clock drifts so far, so at most the share that one could is taken for drift."""
    clock = DeviceClock()
    for k in range(1000):
        clock.map(k * PERIOD, k * PERIOD + MS)
    for k in range(1000, 7000):
        taken = k * PERIOD
        mapped = clock.map(taken, taken + 200 * MS)
        assert mapped - taken - MS <= MAX_DRIFT * (taken - 1000 * PERIOD + 5 * S)


@pytest.mark.parametrize("step", [3600 * S, -3600 * S, S, -S])
def test_a_clock_that_was_set_is_noticed_at_once(step: int) -> None:
    clock = DeviceClock()
    for k in range(1000):
        clock.map(AHEAD + k * PERIOD, k * PERIOD + MS)
    for k in range(1000, 2000):
        assert clock.map(AHEAD + step + k * PERIOD, k * PERIOD + MS) == k * PERIOD + MS
    assert clock.steps == 1
