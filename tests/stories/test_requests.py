"""A person interferes."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from drivers.samples import Engage
from onboard.core.types import Phase, Request
from tests.stories.conftest import At
from tests.stories.flight import Flight

IN_AIR = ["takeoff", "approach", "adhesive", "advance", "press", "release", "landing"]
IN_CONTACT = ("press", "release")


@pytest.mark.parametrize("moment", IN_AIR)
def test_hold(at: At, moment: str) -> None:
    flight = at(moment)
    flight.tick(Request.HOLD)
    if moment in IN_CONTACT:
        flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
        assert flight.from_pipe > 0.8 * flight.config.plan.retreat
    else:
        flight.is_in(Phase.HOLD)
    flight.hovers()


@pytest.mark.parametrize("moment", ["approach", "adhesive", "advance", "press", "release"])
def test_retreat(at: At, moment: str) -> None:
    flight = at(moment)
    before = flight.from_pipe
    flight.tick(Request.RETREAT)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    flight.hovers()
    assert flight.from_pipe - before > 0.8 * flight.config.plan.retreat


@pytest.mark.parametrize("moment", ["takeoff", "approach", "adhesive", "advance", "press", "release"])
def test_land(at: At, moment: str) -> None:
    flight = at(moment)
    flight.tick(Request.LAND)
    flight.is_in(Phase.RETREAT_LAND if moment in IN_CONTACT else Phase.LAND)
    flight.stands()
    assert "stopped" in flight.said


@pytest.mark.parametrize("moment", ["spool", *IN_AIR, "retreat"])
def test_stop_and_stop_again(at: At, moment: str) -> None:
    flight = at(moment)
    before = flight.phases[-1]
    flight.tick(Request.STOP)
    first = {
        "spool": Phase.LAND, "landing": Phase.LAND, "press": Phase.RETREAT_HOLD, "release": Phase.RETREAT_HOLD,
        "retreat": Phase.RETREAT_HOLD,
    }.get(moment, Phase.HOLD)  # fmt: skip
    flight.is_in(first)
    flight.run(1.0).tick(Request.STOP)
    if first is Phase.LAND:
        assert flight.said[-1] in ("refused_landing_already", "refused_grounded")
    else:
        flight.is_in(Phase.RETREAT_LAND if first is Phase.RETREAT_HOLD else Phase.LAND)
    flight.until(lambda outputs: outputs.phase is Phase.STOPPED, 30.0).run(0.5).is_down()
    assert flight.tick(Request.STOP).events[-1].code == "refused_grounded"
    assert before not in flight.phases[1:] or before is Phase.LAND


@pytest.mark.parametrize("moment", IN_AIR)
def test_kill(at: At, moment: str) -> None:
    flight = at(moment)
    height = flight.truth.p_WB[2]
    outputs = flight.tick(Request.KILL)
    assert outputs.phase is Phase.STOPPED
    assert outputs.autopilot.engage is Engage.KILL
    assert not flight.world.autopilot.armed
    flight.run(1.0)
    assert max(flight.truth.rotor_thrust) == 0.0
    assert flight.truth.p_WB[2] < height - 0.1
    assert flight.tick().autopilot.engage is Engage.KILL


def test_hold_and_resume_where_it_was(at: At) -> None:
    flight = at("adhesive")
    flight.tick(Request.HOLD)
    flight.hovers()
    flight.tick(Request.RESUME)
    flight.reach(Phase.ADHESIVE, Phase.TOOL_CHANGE, within=60.0)
    assert flight.truth.crashed == ""


def test_hold_in_press_and_resume_presses_again(at: At) -> None:
    flight = at("press")
    flight.tick(Request.HOLD)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0).hovers()
    flight.tick(Request.RESUME)
    flight.reach(Phase.TARE, Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, within=60.0)
    assert flight.truth.sleeve_on_pipe
    assert flight.truth.crashed == ""


def test_hold_in_release_and_resume_does_not_drop_the_sleeve(at: At) -> None:
    flight = at("release")
    flight.tick(Request.HOLD)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0).hovers()
    truth = flight.truth
    assert truth.payload or truth.sleeve_on_pipe


@pytest.mark.parametrize("late", [Request.HOLD, Request.RETREAT, Request.LAND])
def test_asked_twice_in_press_the_force_goes_on_being_taken_back(at: At, late: Request) -> None:
    flight = at("press")
    flight.tick(Request.HOLD)
    flight.run(0.5 * flight.config.guidance.force_down)
    assert flight.outputs is not None
    before = flight.outputs.reference.force
    assert before > 0.0
    after = flight.tick(late).reference.force
    assert 0.9 * before < after < before
    flight.run(flight.config.guidance.force_down)
    assert flight.outputs.reference.force == 0.0


def test_hold_on_the_ground_breaks_the_takeoff_off(at: At) -> None:
    flight = at("spool")
    flight.tick(Request.HOLD)
    assert flight.said == ["takeoff_aborted"]
    flight.stands()


def test_takeoff_alone_hovers_and_then_starts_or_lands(hover: Flight) -> None:
    on = hover.copy()
    on.tick(Request.START)
    on.reach(Phase.APPROACH, Phase.ALIGN, within=20.0)
    hover.tick(Request.LAND)
    hover.stands()


def test_nobody_asks_for_anything_in_hover(hover: Flight) -> None:
    left = hover.config.mission.hold_timeout
    hover.state = replace(hover.state, mission=replace(hover.state.mission, phase_time=left - 1.0))
    hover.reach(Phase.LAND, within=2.0)
    assert "timeout_hold" in hover.said
    hover.stands()
