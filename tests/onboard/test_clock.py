"""The two clocks of the loop."""

from __future__ import annotations

import asyncio
import time

import pytest

from onboard.clock import VirtualClock, WallClock


def test_virtual_time_passes_only_in_sleep_and_moves_the_world() -> None:
    moved: list[float] = []
    clock = VirtualClock(moved.append)
    assert clock.now_ns() == 0

    asyncio.run(clock.sleep_until(4_000_000))
    asyncio.run(clock.sleep_until(4_000_001))
    assert clock.now_ns() == 4_000_001
    assert moved == pytest.approx([0.004, 1e-9])


def test_virtual_time_never_goes_back() -> None:
    moved: list[float] = []
    clock = VirtualClock(moved.append)
    asyncio.run(clock.sleep_until(1_000))
    asyncio.run(clock.sleep_until(1_000))
    asyncio.run(clock.sleep_until(0))
    assert clock.now_ns() == 1_000
    assert moved == [pytest.approx(1e-6)]


def test_when_the_world_fails_its_time_has_not_passed() -> None:
    def fails(duration: float) -> None:
        raise FloatingPointError(f"not finite after {duration}")

    clock = VirtualClock(fails)
    with pytest.raises(FloatingPointError, match="not finite after"):
        asyncio.run(clock.sleep_until(1_000))
    assert clock.now_ns() == 0


def test_wall_clock_sleeps_until_a_moment_and_not_less() -> None:
    clock = WallClock()
    before = clock.now_ns()
    asyncio.run(clock.sleep_until(before + 3_000_000))
    after = clock.now_ns()
    assert after >= before + 3_000_000
    assert abs(after - time.monotonic_ns()) < 1_000_000_000


def test_wall_clock_gives_way_even_when_late() -> None:
    async def main() -> list[str]:
        order: list[str] = []

        async def other() -> None:
            order.append("other")

        task = asyncio.ensure_future(other())
        await WallClock().sleep_until(0)
        order.append("loop")
        await task
        return order

    assert asyncio.run(main()) == ["other", "loop"]
