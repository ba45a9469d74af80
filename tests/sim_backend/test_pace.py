"""A world on the wall clock: faces are called at their due times, and a stall is given up, not made up for."""

from __future__ import annotations

import time

import pytest

from onboard.config import load_config
from sim_backend import pace
from sim_backend.pace import Pace
from sim_backend.world import World


class Watch:
    """A face that notes the world's time whenever it is called."""

    def __init__(self, world: World, period: float, until: float, pace: list[Pace]) -> None:
        self.period, self._world, self._until, self._pace = period, world, until, pace
        self.published: list[float] = []
        self.received: list[float] = []

    def receive(self) -> None:
        self.received.append(self._world.time)

    def publish(self) -> None:
        self.published.append(self._world.time)
        if self._world.time >= self._until - 1e-9:
            self._pace[0].stop()


class WallTime:
    """``time`` as the pace sees it: sleeping passes it, and nothing else but ``lose``."""

    def __init__(self) -> None:
        self.now = 5_000_000_000
        self.lose: dict[int, int] = {}
        self._slept = 0

    def monotonic_ns(self) -> int:
        return self.now

    def sleep(self, duration: float) -> None:
        self._slept += 1
        self.now += round(duration * 1e9) + self.lose.get(self._slept, 0)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> WallTime:
    wall = WallTime()
    monkeypatch.setattr(pace, "time", wall)
    return wall


@pytest.fixture
def world() -> World:
    return World(load_config().vehicle)


def test_each_face_is_called_at_its_own_times(world: World, wall: WallTime) -> None:
    paces: list[Pace] = []
    slow, fast = Watch(world, 0.005, 1.0, paces), Watch(world, 0.004, 0.04, paces)
    paces.append(Pace(world, (slow, fast)))
    began = wall.now
    paces[0].run()
    assert slow.published == pytest.approx([0.005 * n for n in range(1, 9)])
    assert fast.published == pytest.approx([0.004 * n for n in range(1, 11)])
    assert slow.received == fast.received
    assert sorted({0.0, *slow.published, *fast.published})[:-1] == pytest.approx(slow.received)
    assert (wall.now - began) * 1e-9 == pytest.approx(0.04)
    assert paces[0].slipped == 0.0


def test_a_short_stall_is_made_up_for(world: World, wall: WallTime) -> None:
    paces: list[Pace] = []
    paces.append(Pace(world, (Watch(world, 0.004, 0.4, paces),)))
    began = wall.now
    wall.lose[3] = 50_000_000
    paces[0].run()
    assert (wall.now - began) * 1e-9 == pytest.approx(0.4)
    assert paces[0].slipped == 0.0
    assert paces[0].clock(0) == began


def test_a_long_stall_is_given_up_and_told(world: World, wall: WallTime) -> None:
    paces: list[Pace] = []
    paces.append(Pace(world, (Watch(world, 0.004, 0.4, paces),)))
    began = wall.now
    wall.lose[3] = 2_000_000_000
    paces[0].run()
    assert paces[0].slipped == pytest.approx(2.0, abs=0.005)
    assert (wall.now - began) * 1e-9 == pytest.approx(2.4, abs=0.005)
    assert paces[0].clock(world.snapshot.t_ns) == pytest.approx(wall.now, abs=1_000)


def test_it_follows_the_machines_own_clock(world: World) -> None:
    paces: list[Pace] = []
    watch = Watch(world, 0.004, 0.1, paces)
    paces.append(Pace(world, (watch,)))
    began = time.monotonic()
    paces[0].run()
    assert time.monotonic() - began >= 0.099
