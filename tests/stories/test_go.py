"""A person sends the vehicle to a phase."""

from __future__ import annotations

import pytest

from onboard.core.types import Phase, Request
from tests.stories.conftest import At
from tests.stories.flight import Flight

AT_THE_PIPE = [Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE]
NEXT = {
    Phase.APPROACH: Phase.ALIGN, Phase.ALIGN: Phase.ADHESIVE, Phase.ADHESIVE: Phase.TOOL_CHANGE,
    Phase.TOOL_CHANGE: Phase.TARE, Phase.TARE: Phase.ADVANCE, Phase.RETURN: Phase.LAND,
}  # fmt: skip


def refused(flight: Flight, go: Phase | None) -> str:
    """The code of the refusal; nothing else happens."""
    before = flight.phases[-1]
    said = [event.code for event in flight.tick(Request.GO, go=go).events]
    flight.is_in(before)
    assert len(said) == 1
    return said[0]


def test_from_hover_to_the_pipe_and_on(hover: Flight) -> None:
    for go in AT_THE_PIPE:
        assert refused(hover, go) == "refused_go_far_off"
    assert refused(hover, Phase.PRESS) == "refused_go_to_contact"
    assert refused(hover, Phase.LAND) == "refused_go_elsewhere"
    assert refused(hover, None) == "refused_go_nowhere"
    hover.tick(Request.GO, go=Phase.APPROACH)
    hover.reach(Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, within=40.0)
    assert refused(hover, Phase.TARE) == "refused_hold_first"
    assert hover.truth.crashed == ""


def test_from_hover_home_is_a_landing_and_no_completed_mission(hover: Flight) -> None:
    hover.tick(Request.GO, go=Phase.RETURN)
    hover.reach(Phase.RETURN, Phase.LAND, within=30.0).stands()
    assert "stopped" in hover.said
    assert "completed" not in hover.said


@pytest.mark.parametrize("go", [Phase.APPROACH, *AT_THE_PIPE, Phase.RETURN])
@pytest.mark.parametrize("moment", ["adhesive", "advance"])
def test_from_beside_the_pipe_after_a_retreat(at: At, moment: str, go: Phase) -> None:
    flight = at(moment)
    flight.tick(Request.HOLD)
    flight.run(1.0)
    assert refused(flight, go) == "refused_beside"
    flight.tick(Request.RETREAT)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    flight.tick(Request.GO, go=go)
    flight.reach(go, NEXT[go], within=100.0)
    assert flight.truth.crashed == ""
    assert flight.truth.payload


def test_sent_to_the_tare_it_presses_again_and_completes(at: At) -> None:
    flight = at("press")
    flight.tick(Request.HOLD)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    flight.tick(Request.GO, go=Phase.TARE)
    flight.reach(Phase.TARE, Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, within=60.0)
    assert flight.truth.sleeve_on_pipe


def test_with_the_sleeve_on_the_pipe_home_is_all_that_is_left_and_completes(at: At) -> None:
    flight = at("retreat")
    flight.tick(Request.STOP)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    for go in (Phase.APPROACH, *AT_THE_PIPE):
        assert refused(flight, go) == "refused_without_sleeve"
    flight.tick(Request.GO, go=Phase.RETURN)
    flight.reach(Phase.RETURN, Phase.LAND, within=60.0).stands()
    assert "completed" in flight.said
    assert flight.truth.sleeve_on_pipe
