"""The autopilot, its link, or this process's hold on it fails."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.samples import Engage, FlightMode
from onboard.core.types import Action, Phase, Request
from tests.stories.conftest import At
from tests.stories.flight import NAN_ATTITUDE, PERIOD, Flight, Spoil, frozen, silent

SILENCES: dict[str, Callable[[], Spoil]] = {"frozen": frozen, "silent": lambda: silent}


@pytest.mark.parametrize("kind", SILENCES)
@pytest.mark.parametrize(
    ("moment", "action", "by_way_of"),
    [
        ("approach", Action.HOLD, [Phase.HOLD, Phase.LAND]),
        ("press", Action.RETREAT, [Phase.RETREAT_HOLD, Phase.RETREAT_LAND, Phase.LAND]),
    ],
)
def test_silent_it_is_asked_to_land_and_no_motion_is_flown_without_attitude(
    at: At, moment: str, action: Action, by_way_of: list[Phase], kind: str
) -> None:
    flight = at(moment)
    limits = flight.config.safety
    flight.autopilot.spoil = SILENCES[kind]()
    flight.meets("autopilot_late", action, limits.autopilot_late + 0.02)
    flight.meets("autopilot_lost", Action.LAND, limits.autopilot_lost)
    flight.run(0.05)
    assert flight.phases[1:] == by_way_of
    assert flight.outputs is not None
    assert flight.outputs.autopilot.engage is Engage.LAND
    flight.run(10.0)
    flight.is_down()
    # nothing tells the mission that it is over; a person does, at the latest by cutting the motors
    flight.is_in(Phase.LAND)


def test_the_link_comes_back_after_the_landing(at: At) -> None:
    flight = at("approach")
    flight.autopilot.spoil = frozen()
    flight.run(10.0)
    flight.autopilot.spoil = None
    flight.stands(within=1.0)


@pytest.mark.parametrize(("moment", "by_way_of"), [("approach", Phase.LAND), ("press", Phase.RETREAT_LAND)])
def test_an_attitude_of_nan_is_no_attitude(at: At, moment: str, by_way_of: Phase) -> None:
    flight = at(moment)
    flight.autopilot.spoil = NAN_ATTITUDE
    flight.meets("non_finite", Action.WARN, 0.02)
    flight.meets("non_finite_sustained", Action.LAND, flight.config.safety.non_finite_time + 0.02)
    flight.is_in(by_way_of)
    flight.run(10.0)
    flight.is_down()


def take_over(flight: Flight, mode: FlightMode) -> None:
    """The autopilot changes its mode by itself, and tells so."""
    flight.world.autopilot.mode = mode
    flight.world.advance(PERIOD)


@pytest.mark.parametrize("moment", ["approach", "press", "landing"])
def test_a_pilot_takes_over_and_keeps_command(at: At, moment: str) -> None:
    flight = at(moment)
    autopilot = flight.world.autopilot
    take_over(flight, FlightMode.HOLD)
    flight.meets("offboard_lost", Action.LAND, 0.02).tick()
    flight.is_in(Phase.LAND)
    for _ in range(500):
        assert flight.tick().autopilot.engage is Engage.IDLE
        assert autopilot.mode is FlightMode.HOLD
    assert not flight.truth.on_ground
    flight.tick(Request.HOLD)
    assert flight.said[-1] == "refused_outranked"
    autopilot.mode = FlightMode.LAND
    flight.stands()


def test_its_own_failsafe_lands(at: At) -> None:
    flight = at("press")
    take_over(flight, FlightMode.LAND)
    flight.meets("offboard_lost", Action.LAND, 0.02)
    flight.stands()
    assert "completed" not in flight.said


def test_disarmed_in_flight_the_motors_stay_cut(at: At) -> None:
    flight = at("approach")
    low = flight.truth.p_WB[2]
    flight.world.autopilot.kill()
    flight.until(lambda outputs: outputs.phase is Phase.STOPPED, flight.config.safety.disarmed_time + 0.1)
    assert "disarmed" in flight.said
    assert flight.outputs is not None
    assert flight.outputs.autopilot.engage is Engage.KILL
    flight.run(1.0)
    assert not flight.world.autopilot.armed
    assert flight.truth.p_WB[2] < low


@pytest.mark.parametrize("moment", ["approach", "advance", "press", "release"])
def test_the_loop_stops_and_the_autopilot_lands_by_itself(at: At, moment: str) -> None:
    flight = at(moment)
    world = flight.world
    world.advance(world.params.autopilot.offboard_timeout + 0.1)
    assert world.autopilot.mode is FlightMode.LAND
    world.advance(10.0)
    flight.is_down()


@pytest.mark.parametrize("moment", ["approach", "press"])
def test_the_loop_hangs_and_comes_back_to_an_autopilot_that_lands(at: At, moment: str) -> None:
    flight = at(moment)
    flight.tick(period=flight.world.params.autopilot.offboard_timeout + 0.2)
    flight.run(0.02)
    assert {"tick_late", "offboard_lost"} <= set(flight.said)
    flight.is_in(Phase.LAND)
    assert flight.world.autopilot.mode is FlightMode.LAND
    flight.stands()


def test_the_loop_stops_in_hover(hover: Flight) -> None:
    hover.world.advance(10.0)
    assert hover.world.autopilot.mode is FlightMode.LAND
    hover.is_down()


def test_it_never_arms(at: At) -> None:
    flight = at("spool")
    flight.tick(Request.HOLD)
    flight.stands()
    flight.tick(Request.RESET)
    flight.run(0.1)
    flight.world.autopilot.arm = lambda: False  # type: ignore[method-assign]
    flight.tick(Request.START)
    flight.reach(Phase.LAND, within=flight.config.mission.takeoff_timeout + 1.0)
    assert "timeout_takeoff" in flight.said
    flight.stands()
