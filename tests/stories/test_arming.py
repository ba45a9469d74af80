"""Armed on the ground: the motors idle until the takeoff, or until something breaks it off."""

from __future__ import annotations

from math import dist

import pytest

from drivers.samples import Engage, FlightMode
from onboard.core.types import Phase, Request
from tests.stories.flight import Flight


@pytest.fixture
def armed(ground: Flight) -> Flight:
    """Standing with the motors idling."""
    place = ground.truth.p_WB
    ground.tick(Request.ARM)
    ground.until(lambda outputs: "armed" in ground.said, within=5.0).run(2.0)
    assert ground.said == ["arm", "armed"]
    ground.is_in(Phase.ARMED)
    assert ground.world.autopilot.armed
    assert ground.world.autopilot.mode is FlightMode.OFFBOARD
    assert ground.outputs is not None
    assert (ground.outputs.autopilot.engage, ground.outputs.autopilot.thrust) == (Engage.OFFBOARD, 0.0)
    assert ground.outputs.autopilot.torque_B == (0.0, 0.0, 0.0)
    assert max(ground.truth.rotor_thrust) < 0.01
    assert dist(ground.truth.p_WB, place) < 1e-3
    return ground


def test_armed_then_takeoff_hovers(armed: Flight) -> None:
    armed.run(8.0)
    armed.tick(Request.TAKEOFF)
    armed.reach(Phase.TAKEOFF, Phase.HOLD, within=20.0).hovers()
    assert armed.said[2:] == ["takeoff", "hover"]


def test_armed_then_start_flies_to_the_pipe(armed: Flight) -> None:
    armed.tick(Request.START)
    armed.reach(Phase.TAKEOFF, Phase.APPROACH, Phase.ALIGN, within=40.0)


def test_takeoff_may_be_asked_for_before_the_autopilot_has_armed(ground: Flight) -> None:
    ground.tick(Request.ARM)
    ground.tick(Request.TAKEOFF)
    ground.reach(Phase.TAKEOFF, Phase.HOLD, within=20.0).hovers()


def test_nobody_asks_for_the_takeoff(armed: Flight) -> None:
    limit = armed.config.mission.armed_timeout
    armed.run(limit - 2.5).is_in(Phase.ARMED)
    armed.stands(within=5.0)
    assert armed.said[2:] == ["timeout_armed", "stopped"]
    assert armed.tick(Request.ARM).events[-1].code == "refused_ended"
    armed.tick(Request.RESET)
    armed.run(0.5).tick(Request.ARM)
    armed.run(1.5).is_in(Phase.ARMED)


@pytest.mark.parametrize("request_", [Request.HOLD, Request.RETREAT, Request.LAND, Request.STOP])
def test_broken_off_by_a_person(armed: Flight, request_: Request) -> None:
    armed.tick(request_)
    armed.stands(within=5.0)
    assert armed.said[2:] == ["disarm", "stopped"]


def test_killed(armed: Flight) -> None:
    armed.tick(Request.KILL)
    armed.run(0.2).is_down()
    assert armed.phases[-1] is Phase.STOPPED


def test_broken_off_by_safety(armed: Flight) -> None:
    armed.odometry.spoil = lambda sample: None
    armed.run(1.0).stands(within=5.0)
    assert {"odometry_late", "disarm"} <= set(armed.said)


def test_the_autopilot_disarms_by_itself(armed: Flight) -> None:
    armed.world.autopilot.disarm()
    armed.stands(within=5.0)
    assert armed.said[2:] == ["disarmed", "stopped"]


def test_a_pilot_takes_over_on_the_ground(armed: Flight) -> None:
    armed.world.autopilot.switch(FlightMode.HOLD, armed.world.time)
    armed.stands(within=5.0)
    assert armed.said[2:] == ["disarmed", "stopped"]


def test_the_autopilot_does_not_arm(ground: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground.world.autopilot, "arm", lambda: False)
    ground.tick(Request.ARM)
    limit = ground.config.mission.armed_timeout
    ground.run(limit - 0.5).is_in(Phase.ARMED)
    ground.stands(within=5.0)
    assert ground.said == ["arm", "timeout_arming", "stopped"]
