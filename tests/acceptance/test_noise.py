"""With noisy sensors a run still repeats to the bit, replays without difference, and depends on the seed."""

from __future__ import annotations

import pytest

from onboard.replay import replay
from tests.acceptance.flights import SHORT, Flown, Hangar, completed
from tests.sim_backend.noisy import NOISY_SET

NOISY = (*SHORT, "interface=attitude", NOISY_SET)


@pytest.fixture(scope="module")
def noisy(fly: Hangar) -> Flown:
    return fly(*NOISY, seed=1)


def test_the_mission_completes_all_the_same(noisy: Flown) -> None:
    assert completed(noisy)


def test_replay_finds_no_difference(noisy: Flown) -> None:
    found = replay(noisy.log)
    assert found.same, str(found)
    assert (found.ticks, found.missing) == (len(noisy.run.t), 0)


def test_one_seed_gives_the_same_bytes(noisy: Flown, fly: Hangar) -> None:
    assert noisy.log.read_bytes() == fly(*NOISY, seed=1, again=1).log.read_bytes()


def test_another_seed_gives_another_run(noisy: Flown, fly: Hangar) -> None:
    other = fly(*NOISY, seed=2)
    assert completed(other)
    assert other.metrics["force_rmse"] != noisy.metrics["force_rmse"]
