"""The commanding station falls silent: for a moment, for long, for good; in hover, at work and on the ground."""

from __future__ import annotations

import pytest

from drivers.samples import Engage
from onboard.core.types import Action, LinkState, Phase, Request
from tests.stories.conftest import At
from tests.stories.flight import Flight

#: Where the flight waits after the first loss: by the moment in which the link is cut.
HELD = {
    "hover": [], "takeoff": [Phase.HOLD], "approach": [Phase.HOLD], "adhesive": [Phase.HOLD],
    "advance": [Phase.RETREAT_HOLD, Phase.HOLD], "press": [Phase.RETREAT_HOLD, Phase.HOLD],
    "release": [Phase.RETREAT, Phase.RETREAT_HOLD, Phase.HOLD], "retreat": [Phase.RETREAT_HOLD, Phase.HOLD],
}  # fmt: skip
MOMENTS = [*HELD, "landing"]


@pytest.fixture
def moment(request: pytest.FixtureRequest, at: At, hover: Flight) -> Flight:
    """A flight at the moment of that name, commanded from a station."""
    flight = hover if request.param == "hover" else at(request.param)
    flight.command_from("bench").tick()
    return flight


def link_words(flight: Flight) -> list[str]:
    """What has been said of the link."""
    return [code for code in flight.said if code.startswith("link")]


@pytest.mark.parametrize("moment", MOMENTS, indirect=True)
def test_a_second_of_silence_is_nothing(moment: Flight) -> None:
    undisturbed = moment.copy()
    undisturbed.run(1.5)
    moment.without_link(1.0).run(0.5)
    assert moment.phases == undisturbed.phases
    assert moment.truth.p_WB == undisturbed.truth.p_WB
    assert link_words(moment) == []


@pytest.mark.parametrize(("moment", "way"), HELD.items(), indirect=["moment"])
def test_five_seconds_hold_and_nothing_resumes_by_itself(moment: Flight, way: list[Phase]) -> None:
    before = moment.phases[-1]
    moment.without_link(5.0)
    assert link_words(moment) == ["link_silent"]
    assert "bench" in next(event.text for event in moment.events if event.code == "link_silent")
    moment.run(1.1)
    assert link_words(moment) == ["link_silent", "link_silent_cleared"]
    if way:
        moment.until(lambda outputs: outputs.phase is Phase.HOLD, within=15.0)
    moment.hovers(5.0)
    assert moment.phases == [before, *way]
    assert link_words(moment) == ["link_silent", "link_silent_cleared"]
    if before is Phase.APPROACH:
        moment.tick(Request.RESUME)
        moment.reach(Phase.APPROACH, Phase.ALIGN, within=30.0)


@pytest.mark.parametrize("seconds", [12.0, 60.0], ids=["12 s", "for good"])
@pytest.mark.parametrize(("moment", "way"), HELD.items(), indirect=["moment"])
def test_longer_lands_and_the_landing_goes_on(moment: Flight, way: list[Phase], seconds: float) -> None:
    before = moment.phases[-1]
    moment.without_link(10.1)
    assert link_words(moment) == ["link_silent", "link_lost"]
    moment.without_link(seconds - 10.1)
    moment.until(lambda outputs: outputs.phase is Phase.STOPPED, within=30.0).run(1.5)
    retreating = [before, Phase.RETREAT_HOLD, Phase.RETREAT_LAND, Phase.LAND, Phase.STOPPED]
    assert moment.phases in ([before, *way, Phase.LAND, Phase.STOPPED], retreating)
    moment.is_down()
    assert set(link_words(moment)[2:]) == {"link_silent_cleared", "link_lost_cleared"}
    assert "stopped" in moment.said
    truth = moment.truth
    assert truth.payload or truth.sleeve_on_pipe


@pytest.mark.parametrize("seconds", [5.0, 12.0, 60.0])
@pytest.mark.parametrize("moment", ["landing"], indirect=True)
def test_a_landing_goes_on_whatever_the_link(moment: Flight, seconds: float) -> None:
    moment.without_link(seconds)
    moment.until(lambda outputs: outputs.phase is Phase.STOPPED, within=30.0).run(1.5)
    assert moment.phases == [Phase.LAND, Phase.STOPPED]
    assert "completed" in moment.said
    moment.is_down()


def test_a_takeoff_on_the_ground_is_broken_off(at: At) -> None:
    flight = at("spool").command_from("bench")
    flight.link = LinkState("bench", flight.link.heard_ns - 1_500_000_000)
    flight.without_link(0.6)
    assert flight.said[:2] == ["link_silent", "takeoff_aborted"]
    flight.until(lambda outputs: outputs.phase is Phase.STOPPED, within=5.0).is_down()


def test_in_release_the_sleeve_is_not_dropped(at: At) -> None:
    flight = at("release").command_from("bench")
    flight.link = LinkState("bench", flight.link.heard_ns - 1_900_000_000)
    flight.reached = False
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    truth = flight.truth
    assert truth.payload or truth.sleeve_on_pipe


def test_on_hold_while_lost_it_is_not_resumed_and_the_landing_is_not_held(hover: Flight) -> None:
    hover.command_from("bench").without_link(10.5)
    hover.is_in(Phase.LAND)
    hover.tick(Request.HOLD)
    assert hover.said[-1] == "refused_outranked", "the loss clears only after a while"
    hover.run(1.2)
    hover.tick(Request.HOLD)
    hover.is_in(Phase.HOLD)
    hover.hovers()


def test_a_station_that_seizes_command_ends_the_loss(hover: Flight) -> None:
    hover.command_from("bench").without_link(6.0)
    hover.command_from("tower").run(20.0)
    assert link_words(hover) == ["link_silent", "link_silent_cleared"]
    hover.is_in(Phase.HOLD)


def test_where_nobody_commands_nobody_is_lost(at: At) -> None:
    flight = at("approach").run(15.0)
    assert link_words(flight) == []
    assert Phase.HOLD not in flight.phases


def test_on_the_ground_a_silent_commander_warns_and_keeps_the_vehicle_there(ground: Flight) -> None:
    ground.command_from("bench").without_link(3.0)
    assert ground.outputs is not None
    assert ground.outputs.verdict.action is Action.WARN
    assert ground.tick(Request.TAKEOFF).events[-1].code == "refused_not_ready"
    ground.without_link(20.0)
    assert ground.outputs.verdict.action is Action.WARN
    assert ground.outputs.autopilot.engage is Engage.IDLE
    ground.run(1.1)
    ground.tick(Request.TAKEOFF)
    ground.is_in(Phase.TAKEOFF)


def test_armed_on_the_ground_it_disarms(ground: Flight) -> None:
    ground.command_from("bench").tick(Request.ARM)
    ground.run(1.5).is_in(Phase.ARMED)
    ground.without_link(2.5)
    ground.until(lambda outputs: outputs.phase is Phase.STOPPED, within=5.0).run(1.1).is_down()
    assert ground.said == ["arm", "armed", "link_silent", "disarm", "stopped", "link_silent_cleared"]
