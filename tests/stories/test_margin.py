"""How late the arm may be: base and arm do not swing each other, however hard they are struck."""

from __future__ import annotations

from collections import deque
from math import radians
from typing import Any

import pytest

from onboard.config import load_config
from onboard.core.types import Phase, Request
from sim_backend import layout as at_
from tests.stories.conftest import SETS
from tests.stories.flight import Flight, Spoil

#: Joint readings three ticks (12 ms) old; a bus, its driver and the servos' own loops are 4 to 8 ms late.
LATE_TICKS = 3
#: Pitch rate of a strike, rad/s, and what is left of the swing a second and a half later.
STRIKE, LEFT = 1.0, radians(0.3)


def late(ticks: int) -> Spoil:
    """Readings that are so many ticks old, fresh stamps and all."""
    under_way: deque[Any] = deque()

    def spoil(sample: Any) -> Any:
        under_way.append(sample)
        return under_way.popleft() if len(under_way) > ticks else under_way[0]

    return spoil


@pytest.fixture(scope="module", params=["attitude", "body_rate"])
def arm_out(request: pytest.FixtureRequest) -> Flight:
    """Before the pipe with the arm in the pose of the press, real motors and servos, the rate loop slow."""
    slow = ("world.plant.ideal_motors=false", "world.plant.ideal_servos=false", "world.loops.bandwidth=20")
    flight = Flight(load_config("paper", sets=(*SETS, *slow, f"interface={request.param}"))).run(0.4)
    flight.tick(Request.START)
    return flight.until(lambda outputs: outputs.phase is Phase.TARE and outputs.phase_time >= 1.0, 120.0)


def test_a_strike_dies_out_with_a_late_bus(arm_out: Flight) -> None:
    flight = arm_out.copy()
    flight.servos.spoil = late(LATE_TICKS)
    flight.run(1.0)
    flight.world.plant.x[at_.RATE + 1] += STRIKE
    flight.run(1.5)
    swing = []
    for _ in range(100):
        flight.tick()
        assert flight.outputs is not None
        swing.append(flight.outputs.estimate.rpy[1])
    assert max(swing) - min(swing) < LEFT
    assert flight.truth.crashed == ""
