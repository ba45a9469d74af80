"""Somebody wants the process to end while the vehicle flies."""

from __future__ import annotations

import pytest

from onboard.core.types import Phase, Request
from onboard.ending import Ending
from tests.stories.conftest import At


@pytest.mark.parametrize("moment", ["spool", "takeoff", "adhesive", "press", "release", "landing"])
def test_the_way_out_leads_to_the_ground(at: At, moment: str) -> None:
    flight = at(moment)
    asked: list[Request] = []
    ending = Ending(asked.append)
    ending.ask("SIGTERM")
    flight.tick()
    assert flight.outputs is not None
    while ending.goes_on(flight.outputs, flight.world.time):
        flight.tick(asked.pop() if asked else None)
    flight.run(0.5).is_down()
    assert ending.handed_over is None
    contact = [Phase.RETREAT_LAND] if moment in ("press", "release") else []
    assert flight.phases[1:] == [*contact, *([] if moment == "landing" else [Phase.LAND]), Phase.STOPPED]
