"""The pipe is not where it should be, or the contact is not as it should be."""

from __future__ import annotations

from msgspec.structs import replace

from drivers.samples import AutopilotState
from onboard.core.types import Action, Phase
from sim_backend import layout as at_
from tests.stories.conftest import At
from tests.stories.flight import Flight

HOMEWARD = (Phase.RETREAT_HOLD, Phase.RETURN, Phase.LAND, Phase.STOPPED)


def comes_home_undone(flight: Flight) -> None:
    flight.reach(*HOMEWARD, within=40.0).run(0.5)
    flight.is_down()
    assert "completed" not in flight.said
    assert flight.truth.payload
    x, y, _ = flight.truth.p_WB
    assert abs(x) < 0.05
    assert abs(y) < 0.05


def test_no_pipe_there(at: At) -> None:
    flight = at("advance")
    flight.move_pipe(3.0)
    plan = flight.config.plan
    longest = 3.0 + (plan.gap + plan.overtravel) / plan.advance_speed
    flight.reach(Phase.RETREAT_HOLD, within=longest)
    assert "no_contact" in flight.said
    assert flight.from_pipe > -plan.overtravel - 0.02  # it does not go on looking for the pipe
    comes_home_undone(flight)


def test_the_pipe_a_little_nearer(at: At) -> None:
    """Within what the trigger takes for the crack, the repair goes on."""
    flight = at("advance")
    flight.move_pipe(-0.5 * flight.config.contact.tolerance)
    flight.reach(Phase.PRESS, Phase.RELEASE, Phase.RETREAT, within=60.0)
    assert flight.truth.sleeve_on_pipe
    assert flight.truth.crashed == ""


def test_the_pipe_gives_way_in_press_for_a_moment(at: At) -> None:
    """Contact is lost: it backs off, tares, advances and presses again, and completes."""
    flight = at("press")
    flight.move_pipe(0.5)
    flight.reach(Phase.TARE, within=10.0)
    assert "press_again" in flight.said
    flight.run(4.0).move_pipe(-0.5)
    flight.reach(Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, Phase.RETURN, within=60.0)
    assert flight.truth.sleeve_on_pipe
    assert flight.truth.crashed == ""


def test_the_pipe_is_gone_in_press(at: At) -> None:
    flight = at("press")
    flight.move_pipe(3.0)
    flight.reach(Phase.TARE, Phase.ADVANCE, within=20.0)
    flight.until(lambda outputs: outputs.phase is Phase.RETREAT_HOLD, flight.config.mission.advance_timeout + 1.0)
    assert "no_contact" in flight.said
    comes_home_undone(flight)


def test_contact_lost_too_often(at: At) -> None:
    flight = at("press")
    flight.config = replace(flight.config, mission=replace(flight.config.mission, max_attempts=0))
    flight.move_pipe(0.5)
    flight.reach(Phase.RETREAT_HOLD, within=10.0)
    assert "press_given_up" in flight.said
    comes_home_undone(flight)


def test_nothing_flies_into_the_gap_when_the_pipe_is_gone(at: At) -> None:
    flight = at("press")
    start = flight.truth.p_WB[0]
    flight.move_pipe(3.0)
    farthest = start
    while flight.outputs is not None and flight.outputs.phase is Phase.PRESS:
        flight.tick()
        farthest = max(farthest, flight.truth.p_WB[0])
    flight.run(2.0)
    assert max(farthest, flight.truth.p_WB[0]) < start + 0.25


def test_blown_off_the_pipe_it_does_not_run_into_it(at: At) -> None:
    """A gust lifts the tip over the pipe: nothing holds the push any more."""
    flight = at("press")
    flight.world.plant.x[at_.VELOCITY + 2] = 1.0
    flight.reach(Phase.TARE, within=2.0)
    flight.reach(Phase.ADVANCE, within=40.0)
    assert flight.truth.crashed == ""


def test_the_pipe_pushes_back_hard(at: At) -> None:
    flight = at("press")
    flight.move_pipe(-0.03)
    flight.meets("force_high", Action.RETREAT, flight.config.safety.force_time + 0.5)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    flight.hovers()
    assert "force_high_cleared" in flight.said


def test_a_force_where_none_should_be(at: At) -> None:
    """Something pulls at the vehicle in free flight, or its accelerometer says so: back, and hold."""
    flight = at("approach")
    limits = flight.config.safety
    bias = 1.5 * limits.free_force / 2.4

    def pulled(sample: AutopilotState) -> AutopilotState:
        x, y, z = sample.f_B
        return replace(sample, f_B=(x, y + bias, z))

    flight.autopilot.spoil = pulled
    flight.meets("contact_stray", Action.RETREAT, limits.free_force_time + 0.5)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    flight.hovers()
