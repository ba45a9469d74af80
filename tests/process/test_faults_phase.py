"""Faults that the configuration declares for phases of the mission, met in them; an unattended flight goes on after."""

from __future__ import annotations

import pytest

from onboard.core.types import Action, Phase
from tests.process.book import Book, Told
from tests.process.flying import Flying
from tests.realtime import REALTIME

pytestmark = REALTIME

FAULTS = (
    "faults=[{device: autopilot, kind: nan, phase: approach, start: 0.5, duration: 0.2},"
    " {device: odometry, kind: silent, phase: adhesive, start: 0.5, duration: 0.3},"
    " {device: servos, kind: corrupt, value: 0.05, phase: adhesive, start: 0.5, duration: 2.0}]"
)


def mission(flight: Flying) -> None:
    """As far as the adhesive, and there until it is dispensed again after the hold."""
    dispensing = flight.wait("adhesive", lambda look: look.phase == Phase.ADHESIVE)
    held = flight.wait("hold", lambda look: look.phase == Phase.HOLD, since=dispensing)
    flight.wait("adhesive again", lambda look: look.phase == Phase.ADHESIVE, since=held)
    flight.rest(1.0)
    flight.land()


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Told:
    folder = tmp_path_factory.mktemp("phase")
    book = Book(
        folder, {"mission": mission}, FAULTS, begin=lambda flight: flight.wait_said("ready"), arguments=("--mission",)
    )
    return book["mission"]


def test_each_is_met_in_its_phase(told: Told) -> None:
    told.lives_on()
    told.says("autopilot: ATTITUDE_QUATERNION holds numbers that are not finite", "The autopilot's attitude is")
    told.says("Odometry is 0.15 s old")
    told.says("servo bus: a reading of the servos failed")
    first = {code: next(tick for tick in told.ticks if code in tick.outputs.verdict.reasons) for code in told.demands}
    for code, phase in (("autopilot_late", Phase.APPROACH), ("odometry_late", Phase.ADHESIVE)):
        entered = next(tick for tick in told.ticks if tick.outputs.phase is phase)
        assert 0.5 < (first[code].inputs.t_ns - entered.inputs.t_ns) * 1e-9 < 2.0
        assert first[code].outputs.verdict.action is Action.HOLD


def test_the_mission_goes_on_after_each_hold(told: Told) -> None:
    assert told.phases[told.phases.index(Phase.TAKEOFF) :] == [
        Phase.TAKEOFF, Phase.APPROACH, Phase.HOLD, Phase.APPROACH, Phase.ALIGN,
        Phase.ADHESIVE, Phase.HOLD, Phase.ADHESIVE, Phase.LAND, Phase.STOPPED,
    ]  # fmt: skip
