"""The airframe, its battery, its place, or its computer is not well."""

from __future__ import annotations

from math import hypot

import pytest
from msgspec.structs import replace

from drivers.samples import Engage
from onboard.core.derived import derive
from onboard.core.types import Action, Phase, Request
from sim_backend import layout as at_
from tests.stories.conftest import At
from tests.stories.flight import Flight


def blown_up(flight: Flight, speed: float) -> Flight:
    """The same flight under a ceiling just above its work, gone upwards at that speed (m/s)."""
    safety = flight.config.safety
    high = (*safety.fence_high[:2], derive(flight.config).site.height + 0.01)
    flight.config = replace(flight.config, safety=replace(safety, fence_high=high, fence_margin=0.1))
    flight.world.plant.x[at_.VELOCITY + 2] = speed
    return flight


def test_outside_of_the_fence_it_holds(at: At) -> None:
    flight = blown_up(at("align"), 0.8)
    flight.meets("fence", Action.HOLD, 1.0)
    flight.hovers()
    assert "fence_cleared" in flight.said


def test_far_outside_of_the_fence_it_lands(at: At) -> None:
    flight = blown_up(at("align"), 1.4)
    flight.meets("fence_breached", Action.LAND, 1.0)
    flight.is_in(Phase.LAND)
    flight.stands()


@pytest.mark.parametrize("moment", ["approach", "press"])
def test_battery_low(at: At, moment: str) -> None:
    flight = at(moment)
    limits = flight.config.safety
    flight.charge(limits.battery_low - 0.02)
    flight.meets("battery_low", Action.RETREAT, limits.battery_time + 0.1)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0)
    flight.hovers()
    flight.tick(Request.RESUME)
    assert flight.said[-1] == "refused_outranked"
    flight.tick(Request.LAND)
    flight.stands()


@pytest.mark.parametrize(("moment", "by_way_of"), [("approach", Phase.LAND), ("press", Phase.RETREAT_LAND)])
def test_battery_critical(at: At, moment: str, by_way_of: Phase) -> None:
    flight = at(moment)
    limits = flight.config.safety
    flight.charge(limits.battery_critical - 0.02)
    flight.meets("battery_critical", Action.LAND, limits.battery_time + 0.1)
    flight.is_in(by_way_of)
    flight.stands()


def test_a_gust_tilts_it(at: At) -> None:
    flight = at("approach")
    flight.world.plant.x[at_.RATE] = 9.0
    flight.meets("tilt", Action.HOLD, 0.6)
    flight.run(5.0).hovers()
    assert "tilt_cleared" in flight.said


def test_a_hard_gust_does_not_throw_it_up(at: At) -> None:
    flight = at("approach")
    height = flight.truth.p_WB[2]
    flight.world.plant.x[at_.RATE] = 11.0
    flight.meets("tilt", Action.HOLD, 0.6)
    for _ in range(2000):
        flight.tick()
        assert abs(flight.truth.p_WB[2] - height) < 0.4
    flight.is_in(Phase.HOLD)
    assert flight.truth.crashed == ""
    assert hypot(*flight.truth.v_WB) < 0.1


def test_tipped_over_the_motors_are_cut(at: At) -> None:
    flight = at("approach")
    x = flight.world.plant.x
    for _ in range(250):
        if flight.tick().phase is Phase.STOPPED:
            break
        x[at_.RATE : at_.RATE + 3] = (4.0 if abs(x[at_.ATTITUDE + 1]) < 0.9 else 0.0, 0.0, 0.0)
    assert flight.outputs is not None
    assert flight.outputs.phase is Phase.STOPPED
    assert flight.outputs.autopilot.engage is Engage.KILL
    assert "tipped" in flight.said
    flight.run(1.0)
    assert not flight.world.autopilot.armed


@pytest.mark.parametrize("moment", ["approach", "press"])
def test_a_late_tick_is_told_and_flown_through(at: At, moment: str) -> None:
    flight = at(moment)
    flight.tick(period=2.0 * flight.config.safety.tick_late)
    flight.meets("tick_late", Action.WARN, 0.02)
    flight.until(lambda outputs: not outputs.verdict.reasons, 2.0)
    assert len(set(flight.phases)) == 1
    assert flight.truth.crashed == ""


@pytest.mark.parametrize(("moment", "first", "then"), [
    ("approach", Phase.HOLD, Phase.LAND), ("press", Phase.RETREAT_HOLD, Phase.RETREAT_LAND),
])  # fmt: skip
def test_slow_ticks_hold_and_stalled_ticks_land(at: At, moment: str, first: Phase, then: Phase) -> None:
    flight = at(moment)
    limits = flight.config.safety
    slow = 1.2 * limits.tick_slow
    action = Action.HOLD if moment == "approach" else Action.RETREAT
    flight.meets("tick_slow", action, limits.tick_slow_time + 0.1, period=slow)
    flight.is_in(first)
    flight.meets("tick_stalled", Action.LAND, limits.tick_stalled_time + 0.1, period=slow)
    flight.is_in(then)
    flight.until(lambda outputs: outputs.phase is Phase.STOPPED, 30.0, period=slow)
    flight.run(0.5)
    flight.is_down()


def test_the_loop_recovers_from_slow_ticks(at: At) -> None:
    flight = at("approach")
    flight.meets("tick_slow", Action.HOLD, 1.0, period=1.2 * flight.config.safety.tick_slow)
    flight.hovers()
    flight.tick(Request.RESUME)
    flight.reach(Phase.APPROACH, Phase.ALIGN, within=20.0)
