"""The tracker fails."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import cos, dist, sin

import pytest

from onboard.core.types import Action, Phase, Request
from tests.stories.conftest import At
from tests.stories.flight import NAN_POSITION, PERIOD, Spoil, frozen, hanging, moved, silent, with_

SILENCES: dict[str, Callable[[], Spoil]] = {"frozen": frozen, "hanging": hanging, "silent": lambda: silent}


@pytest.mark.parametrize("kind", SILENCES)
@pytest.mark.parametrize("moment", ["takeoff", "approach"])
def test_silent_in_free_flight_it_holds_and_then_the_autopilot_lands(at: At, moment: str, kind: str) -> None:
    flight = at(moment)
    limits = flight.config.safety
    flight.odometry.spoil = SILENCES[kind]()
    flight.meets("odometry_late", Action.HOLD, limits.odometry_late + 0.02)
    flight.is_in(Phase.HOLD)
    flight.meets("odometry_lost", Action.LAND, limits.odometry_lost)
    flight.stands()
    assert "autoland_blind" in flight.said
    assert "stopped" in flight.said


@pytest.mark.parametrize("kind", SILENCES)
def test_silent_in_press_the_force_is_taken_back_before_the_autopilot_lands(at: At, kind: str) -> None:
    flight = at("press")
    limits = flight.config.safety
    flight.odometry.spoil = SILENCES[kind]()
    flight.meets("odometry_late", Action.RETREAT, limits.odometry_late + 0.02)
    flight.is_in(Phase.RETREAT_HOLD)
    flight.meets("odometry_lost", Action.LAND, limits.odometry_lost)
    flight.is_in(Phase.RETREAT_LAND)
    references = [flight.tick().reference for _ in range(round(flight.config.guidance.force_down / PERIOD))]
    forces = [reference.force for reference in references if reference.pressing]
    assert len(forces) > 100
    assert all(after <= before for before, after in pairwise(forces))
    assert (references[-1].force, references[-1].pressing) == (0.0, False)
    flight.stands()
    assert "autoland_blind" in flight.said


def test_back_in_time_the_mission_can_be_resumed(at: At) -> None:
    flight = at("approach")
    flight.odometry.spoil = frozen()
    flight.meets("odometry_late", Action.HOLD, 0.3).run(0.1)
    flight.odometry.spoil = None
    flight.until(lambda outputs: not outputs.verdict.reasons, 3.0)
    assert "odometry_late_cleared" in flight.said
    flight.hovers()
    flight.tick(Request.RESUME)
    flight.reach(Phase.APPROACH, Phase.ALIGN, within=20.0)


WAYS = {"ahead": (0.3, 0.0, 0.0), "back": (-0.3, 0.0, 0.0), "aside": (0.0, 0.3, 0.0), "up": (0.0, 0.0, 0.3)}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("moment", ["approach", "adhesive"])
def test_a_jump_does_not_move_the_vehicle(at: At, moment: str, way: str) -> None:
    flight = at(moment)
    healthy = at(moment)
    healthy.tick(Request.HOLD)
    healthy.hovers()
    flight.odometry.spoil = moved(*WAYS[way])
    flight.meets("odometry_jump", Action.HOLD, 0.02)
    flight.hovers()
    assert dist(flight.truth.p_WB, healthy.truth.p_WB) < 0.02
    assert "odometry_jump_cleared" in flight.said


@pytest.mark.parametrize("way", WAYS)
def test_a_jump_in_press_leads_back_from_the_pipe(at: At, way: str) -> None:
    flight = at("press")
    flight.odometry.spoil = moved(*WAYS[way])
    flight.meets("odometry_jump", Action.RETREAT, 0.02)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    flight.hovers()
    assert flight.from_pipe == pytest.approx(flight.config.plan.retreat, abs=0.03)
    assert flight.truth.p_WB[1] == pytest.approx(0.0, abs=0.02)


def test_a_moved_frame_is_told_and_does_not_move_the_vehicle(at: At) -> None:
    flight = at("adhesive")
    place = flight.truth.p_WB
    shift = moved(0.05, -0.04, 0.03)  # less than what counts as a jump
    flight.odometry.spoil = lambda sample: with_(reset_counter=1)(shift(sample))
    flight.meets("odometry_reset", Action.HOLD, 0.02)
    flight.hovers()
    assert dist(flight.truth.p_WB, place) < 0.01


def test_a_wild_jump_is_a_lost_position(at: At) -> None:
    flight = at("approach")
    flight.odometry.spoil = moved(0.0, 2.0, 0.0)
    flight.meets("odometry_wild", Action.LAND, 0.02)
    flight.stands()
    assert "autoland_blind" in flight.said


def test_one_nan_is_told_and_changes_nothing(at: At) -> None:
    flight = at("approach")
    flight.odometry.spoil = NAN_POSITION
    flight.tick()
    flight.odometry.spoil = None
    assert flight.said == ["non_finite"]
    flight.until(lambda outputs: not outputs.verdict.reasons, 2.0)
    assert set(flight.phases) == {Phase.APPROACH}
    flight.reach(Phase.ALIGN, within=20.0)


@pytest.mark.parametrize(("moment", "by_way_of"), [("approach", Phase.LAND), ("press", Phase.RETREAT_LAND)])
def test_nan_after_nan_the_autopilot_lands(at: At, moment: str, by_way_of: Phase) -> None:
    flight = at(moment)
    flight.odometry.spoil = NAN_POSITION
    flight.meets("non_finite", Action.WARN, 0.02)
    flight.meets("non_finite_sustained", Action.LAND, flight.config.safety.non_finite_time + 0.02)
    flight.is_in(by_way_of)
    flight.stands()
    assert "autoland_blind" in flight.said


@pytest.mark.parametrize(
    ("confidence", "code", "action", "by_way_of"),
    [
        (1, "odometry_unsure", Action.RETREAT, Phase.RETREAT_HOLD),
        (0, "odometry_failed", Action.LAND, Phase.RETREAT_LAND),
    ],
)
def test_low_confidence_in_press(at: At, confidence: int, code: str, action: Action, by_way_of: Phase) -> None:
    flight = at("press")
    flight.odometry.spoil = with_(confidence=confidence)
    flight.meets(code, action, 0.6)
    flight.is_in(by_way_of)
    if action is Action.LAND:
        flight.stands()
    else:
        flight.reach(Phase.HOLD, within=20.0).hovers()


def test_a_tracker_that_sees_another_vertical_is_not_believed(at: At) -> None:
    flight = at("approach")
    half = 0.5 * 1.2 * flight.config.safety.disagreement
    turned = (cos(half), sin(half), 0.0, 0.0)
    flight.odometry.spoil = with_(q_WB=turned)
    flight.meets("odometry_disagrees", Action.LAND, flight.config.safety.disagreement_time + 0.1)
    flight.stands()
    assert "autoland_blind" in flight.said


def test_silent_on_the_ground_the_start_is_refused(at: At) -> None:
    flight = at("spool")
    flight.tick(Request.HOLD)
    flight.stands()
    flight.tick(Request.RESET)
    flight.run(0.1)
    spoil: Spoil = frozen()
    flight.odometry.spoil = spoil
    flight.run(0.3)
    flight.tick(Request.START)
    assert flight.said[-1] == "refused_not_ready"
    flight.is_in(Phase.PREFLIGHT)
    flight.is_down()
