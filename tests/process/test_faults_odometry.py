"""Each fault of the tracking camera in flight, from its bytes to the ground.

What lasts less than half a second is flown through in a hold; without a position for longer the autopilot lands.
"""

from __future__ import annotations

import pytest

from onboard.core.types import Action, Phase
from sim_backend.tracker import KINDS
from tests.process.book import PATIENT_BUS, Book, Told, again, lands, strikes
from tests.realtime import REALTIME

pytestmark = REALTIME

CAMERA = "odometry"
STORIES = {
    "drop": strikes(CAMERA, "drop", 5.5, value=0.6, duration=4.0),
    "delay": strikes(CAMERA, "delay", 3.0, value=0.25, duration=1.0),
    "freeze": strikes(CAMERA, "freeze", 2.0, duration=0.3),
    "nan": strikes(CAMERA, "nan", 2.0, duration=0.3),
    "confidence": strikes(CAMERA, "confidence", 2.5, value=1, duration=1.0),
    "silent": strikes(CAMERA, "silent", 2.0, duration=0.3),
    "drift": strikes(CAMERA, "drift", 3.0, value=0.05, duration=2.0),
    "jump": strikes(CAMERA, "jump", 2.5, value=0.3),
    "jump away": lands(CAMERA, "jump", 0.0, value=1.5),
    "again 1": again,
    "silent for long": lands(CAMERA, "silent", 2.0),
    "again 2": again,
    "frozen for long": lands(CAMERA, "freeze", 2.0),
    "again 3": again,
    "nan for long": lands(CAMERA, "nan", 2.0),
    "again 4": again,
    "no confidence": lands(CAMERA, "confidence", 2.0, value=0),
    "again 5": again,
    "unplugged": lands(CAMERA, "unplugged", 2.0),
    "again 6": again,
    "reboot": lands(CAMERA, "reboot", 1.0),
}
#: Words of the safety table.
OLD = "s old: the tracker is silent, late, or repeats itself"
LOST = ("Odometry is lost: position control is impossible", "the autopilot lands by itself")
AGAIN = "tracker: no usable pose for 0.5 s; opening it again"
BACK = "its frame begins where it was lost"


@pytest.fixture(scope="module")
def book(tmp_path_factory: pytest.TempPathFactory) -> Book:
    return Book(tmp_path_factory.mktemp("odometry"), STORIES, *PATIENT_BUS, "plan.takeoff_height=0.5")


def test_every_fault_has_its_story() -> None:
    assert {kind.value for kind in KINDS} <= set(STORIES)


def test_drop(book: Book) -> None:
    """Two poses of five are enough to fly."""
    told = book["drop"]
    told.lives_on()
    told.says("Hz, want 200 Hz: check USB 3", "tracker: its poses come at 200 Hz again")
    told.says_no(OLD)
    told.hovers()


@pytest.mark.parametrize("name", ["delay", "freeze", "silent"])
def test_late_for_a_moment(book: Book, name: str) -> None:
    told = book[name]
    told.lives_on()
    told.says(OLD)
    told.acts("odometry_late", Action.HOLD, 0.15)
    told.calms_down()
    told.hovers()


def test_nan(book: Book) -> None:
    told = book["nan"]
    told.lives_on()
    told.says("tracker: a pose is not used: it is not finite", OLD, "tracker: its poses are usable again")
    told.acts("odometry_late", Action.HOLD, 0.15)
    told.calms_down()
    told.hovers()


def test_confidence(book: Book) -> None:
    told = book["confidence"]
    told.lives_on()
    told.says("The tracker's confidence is 1. Give it light and texture.")
    told.acts("odometry_unsure", Action.HOLD, 0.5)
    told.calms_down()
    told.hovers()


def test_drift(book: Book) -> None:
    """Nobody can tell: the vehicle goes along."""
    told = book["drift"]
    told.lives_on()
    assert told.lines == [line for line in told.lines if "tracker" not in line]
    assert "odometry" not in " ".join(told.demands)
    told.hovers()


def test_jump(book: Book) -> None:
    """The vehicle has not jumped, and does not: the frame has."""
    told = book["jump"]
    told.lives_on()
    told.says("tracker: its pose has jumped by 0.30 m", "tracker: no more jumps; there were 1")
    told.says("Odometry jumped by 0.30 m. Check that the pipe is where the mission believes it.")
    told.acts("odometry_jump", Action.HOLD, 0.0)
    told.calms_down()
    told.hovers()


def test_jump_away(book: Book) -> None:
    told = book["jump away"]
    told.lives_on()
    told.says("tracker: its pose has jumped by 1.50 m", "tracker: no more jumps; there were 1")
    told.says("m: the position is lost", "the autopilot lands by itself")
    told.acts("odometry_wild", Action.LAND, 0.0)
    told.lands()


def lost(told: Told) -> None:
    """Half a second without a usable pose."""
    told.lives_on()
    told.says(OLD, *LOST)
    told.acts("odometry_late", Action.HOLD, 0.15)
    told.acts("odometry_lost", Action.LAND, 0.5)
    told.lands()


def test_silent_for_long(book: Book) -> None:
    told = book["silent for long"]
    lost(told)
    told.says(AGAIN, BACK)


def test_frozen_for_long(book: Book) -> None:
    lost(book["frozen for long"])


def test_nan_for_long(book: Book) -> None:
    told = book["nan for long"]
    lost(told)
    told.says("tracker: a pose is not used: it is not finite", AGAIN, BACK, "tracker: its poses are usable again")


def test_no_confidence(book: Book) -> None:
    told = book["no confidence"]
    told.lives_on()
    told.says("The tracker has lost itself: position control is impossible.", "the autopilot lands by itself")
    told.acts("odometry_failed", Action.LAND, 0.3)
    told.lands()


@pytest.mark.parametrize("name", ["unplugged", "reboot"])
def test_gone(book: Book, name: str) -> None:
    told = book[name]
    lost(told)
    told.says(AGAIN, "tracker: cannot open it again: no T265 found", BACK)


@pytest.mark.parametrize("name", [name for name in STORIES if name.startswith("again")])
def test_it_flies_again(book: Book, name: str) -> None:
    """After a reset on the ground all is as before."""
    told = book[name]
    told.lives_on()
    told.says("ready to fly: preflight passes")
    told.calms_down()
    assert told.phases[-3:] == [Phase.PREFLIGHT, Phase.TAKEOFF, Phase.HOLD]
