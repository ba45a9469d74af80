"""The force estimators in whole missions, each one in the loop, and side by side."""

from __future__ import annotations

import pytest

from onboard.replay import replay
from tests.acceptance.flights import SHORT, Hangar, completed


# every other mission is flown with the paper's
@pytest.mark.parametrize("selected", ["momentum", "kalman"])
def test_the_mission_is_flown_with_each_of_them_in_the_loop(fly: Hangar, selected: str) -> None:
    """Ideal sensors: all see the same force, and none reads one where none is."""
    flown = fly(*SHORT, f"estimators.selected={selected}")
    assert completed(flown)
    told = flown.metrics["estimators"]
    assert told["selected"] == selected
    assert (told["false_contacts"], told["alarms"]) == (0, 0)
    for name in ("paper", "body", "momentum", "kalman"):
        row = told["table"][name]
        assert row["rmse"] < 0.06, name
        assert abs(row["bias"]) < 0.03, name
        assert 0.0 <= row["delay"] < 0.1, name
    assert told["table"]["momentum"]["free_rms"] < 0.005, "it knows the arm"
    assert told["table"]["kalman"]["free_rms"] == 0.0, "its gate is closed"
    assert replay(flown.log).same
