"""The servo bus, or a servo, fails."""

from __future__ import annotations

from collections.abc import Callable
from math import dist

import pytest
from msgspec.structs import replace

from drivers.samples import JointMode
from onboard.core.types import Action, Phase, Request
from tests.stories.conftest import At
from tests.stories.flight import NAN_JOINTS, Flight, Spoil, frozen, silent, with_

SILENCES: dict[str, Callable[[], Spoil]] = {"frozen": frozen, "silent": lambda: silent}


def comes_to_rest(flight: Flight, in_contact: bool) -> None:
    """The way that HOLD, or in contact RETREAT, leads."""
    if in_contact:
        flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=30.0)
        assert flight.from_pipe > 0.8 * flight.config.plan.retreat
    else:
        flight.reach(Phase.HOLD, within=0.1)
    flight.run(1.0).hovers()


@pytest.mark.parametrize("kind", SILENCES)
@pytest.mark.parametrize("moment", ["approach", "adhesive", "advance", "press"])
def test_silent_the_servos_hold_the_arm_by_themselves(at: At, moment: str, kind: str) -> None:
    flight = at(moment)
    limits = flight.config.safety
    contact = moment in ("advance", "press")
    flight.servos.spoil = SILENCES[kind]()
    flight.meets("servos_late", Action.WARN, limits.servos_late + 0.02)
    assert flight.outputs is not None
    assert flight.outputs.servos.mode is JointMode.POSITION
    flight.meets("servos_lost", Action.RETREAT if contact else Action.HOLD, limits.servos_lost)
    comes_to_rest(flight, contact)
    flight.tick(Request.LAND)
    flight.stands()


@pytest.mark.parametrize(("moment", "by_way_of"), [("approach", Phase.LAND), ("press", Phase.RETREAT_LAND)])
def test_joint_angles_of_nan(at: At, moment: str, by_way_of: Phase) -> None:
    flight = at(moment)
    flight.servos.spoil = NAN_JOINTS
    flight.meets("non_finite", Action.WARN, 0.02)
    flight.meets("non_finite_sustained", Action.LAND, flight.config.safety.non_finite_time + 0.02)
    flight.is_in(by_way_of)
    flight.stands()


FAULTS = {
    "servo_error": with_(error=(0, 0x20, 0, 0, 0)),
    "servo_hot": with_(temperature=(40.0, 40.0, 71.0, 40.0, 40.0)),
    "servo_voltage": with_(voltage=(5.0, 3.9, 5.0, 5.0, 5.0)),
}


@pytest.mark.parametrize("code", FAULTS)
@pytest.mark.parametrize("moment", ["approach", "press"])
def test_a_servo_is_not_well(at: At, moment: str, code: str) -> None:
    flight = at(moment)
    flight.servos.spoil = FAULTS[code]
    flight.meets(code, Action.HOLD if moment == "approach" else Action.RETREAT, 1.2)
    comes_to_rest(flight, moment == "press")


def test_a_servo_error_is_remembered_until_the_vehicle_is_reset(at: At) -> None:
    flight = at("approach")
    flight.servos.spoil = FAULTS["servo_error"]
    flight.reach(Phase.HOLD, within=0.2)
    flight.servos.spoil = None
    flight.run(2.0).tick(Request.RESUME)
    assert flight.said[-1] == "refused_outranked"
    flight.tick(Request.LAND)
    flight.stands()
    flight.tick(Request.RESET)
    assert flight.run(1.5).tick().verdict.reasons == ()


@pytest.mark.parametrize("moment", ["approach", "adhesive", "advance", "press", "release"])
def test_the_servos_lose_their_torque(at: At, moment: str) -> None:
    """The arm hangs and swings; the base stays calm, gets away from the pipe, and can be landed."""
    flight = at(moment)
    place = flight.truth.p_WB
    flight.servos.twist = lambda command: replace(command, mode=JointMode.OFF)
    action = Action.HOLD if moment in ("approach", "adhesive") else Action.RETREAT
    flight.meets("servo_torque", action, flight.config.safety.torque_off_time + 0.02)
    for _ in range(3000):
        flight.tick()
        assert dist(flight.truth.p_WB, place) < flight.config.plan.retreat + 0.4
    flight.is_in(Phase.HOLD)
    assert flight.truth.crashed == ""
    assert "joint_error" in flight.said
    flight.tick(Request.LAND)
    flight.stands(within=60.0)


def test_a_blocked_joint_is_seen(at: At) -> None:
    flight = at("adhesive")
    flight.servos.twist = lambda command: replace(
        command, mode=JointMode.POSITION, position=(-0.3, 0.3, -0.5, 0.0, 0.0)
    )
    flight.meets("joint_error", Action.HOLD, 3.0)
    flight.hovers()
    flight.tick(Request.LAND)
    flight.stands()


def test_a_gripper_that_does_not_open_keeps_its_sleeve(at: At) -> None:
    flight = at("press")
    flight.servos.twist = lambda command: replace(command, position=(*command.position[:4], 0.0))
    flight.reach(Phase.RELEASE, within=30.0)
    flight.reach(Phase.RETREAT_HOLD, within=flight.config.mission.release_timeout + 0.1)
    assert "timeout_release" in flight.said
    flight.reach(Phase.HOLD, within=20.0).hovers()
    assert flight.truth.payload
    assert not flight.truth.sleeve_on_pipe
