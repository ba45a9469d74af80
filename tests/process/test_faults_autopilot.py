"""Each fault of the autopilot in flight, from its bytes to the ground.

Without an attitude for 0.4 s the autopilot is asked to land; where it hears nothing either, it does so by itself.
"""

from __future__ import annotations

import pytest

from onboard.core.types import Action, Phase
from sim_backend.px4_faults import KINDS
from tests.process.book import PATIENT_BUS, Book, again, down, lands, strikes
from tests.process.flying import Flying
from tests.realtime import REALTIME

pytestmark = REALTIME

PX4 = "autopilot"


def reboot(flight: Flying) -> None:
    """From the ground. Its motors stop: only just above it that ends well."""
    flight.ask("takeoff")
    low = flight.look().truth.p_WB[2]
    flight.wait("off the ground", lambda look: look.truth.p_WB[2] > low + 0.08)
    flight.inject(device=PX4, kind="reboot", duration=1.0)
    flight.stopped()
    flight.rest(3.0)


STORIES = {
    "drop": strikes(PX4, "drop", 6.0, value=0.4, duration=3.5),
    "corrupt": strikes(PX4, "corrupt", 6.0, value=0.4, duration=3.5),
    "delay": strikes(PX4, "delay", 3.0, value=0.2, duration=1.5),
    "freeze": strikes(PX4, "freeze", 2.2, duration=0.3),
    "nan": strikes(PX4, "nan", 2.2, duration=0.3),
    "silent": strikes(PX4, "silent", 2.0, duration=0.3),
    "frozen for long": lands(PX4, "freeze", 3.0),
    "again 1": again,
    "nan for long": lands(PX4, "nan", 2.0),
    "again 2": again,
    "silent for long": lands(PX4, "silent", 2.0),
    "again 3": again,
    "unplugged": lands(PX4, "unplugged", 2.0),
    "again 4": again,
    "down": down,
    "reboot": reboot,
}
#: Words of the safety table.
OLD = "The autopilot's attitude is"
LOST = ("The autopilot is silent: asking it to land", "the autopilot lands by itself")


@pytest.fixture(scope="module")
def book(tmp_path_factory: pytest.TempPathFactory) -> Book:
    return Book(tmp_path_factory.mktemp("autopilot"), STORIES, *PATIENT_BUS, "plan.takeoff_height=0.5")


def test_every_fault_has_its_story() -> None:
    assert {kind.value for kind in KINDS} <= set(STORIES)


@pytest.mark.parametrize("name", ["drop", "corrupt"])
def test_messages_are_lost(book: Book, name: str) -> None:
    """Three of five are enough to fly; a damaged one counts as lost."""
    told = book[name]
    told.lives_on()
    told.says("autopilot: ATTITUDE_QUATERNION comes at", "autopilot: PX4's messages come at the rates asked for again")
    told.says_no(OLD)
    told.hovers()


def test_delay(book: Book) -> None:
    told = book["delay"]
    told.lives_on()
    told.says(OLD, "autopilot: PX4's answers take", "autopilot: PX4 answers in time again")
    told.acts("autopilot_late", Action.HOLD, 0.1)
    told.calms_down()
    told.hovers()


def test_freeze(book: Book) -> None:
    told = book["freeze"]
    told.lives_on()
    told.says("autopilot: PX4 tells the same attitude over and over", OLD, "autopilot: PX4's attitude moves again")
    told.acts("autopilot_late", Action.HOLD, 0.1)
    told.calms_down()
    told.hovers()


def test_nan(book: Book) -> None:
    told = book["nan"]
    told.lives_on()
    told.says("numbers that are not finite", OLD, "autopilot: what PX4 measures is usable again")
    told.acts("autopilot_late", Action.HOLD, 0.1)
    told.calms_down()
    told.hovers()


def test_silent_for_a_moment(book: Book) -> None:
    """Less than PX4's own patience with set-points."""
    told = book["silent"]
    told.lives_on()
    told.says(OLD)
    told.acts("autopilot_late", Action.HOLD, 0.1)
    told.calms_down()
    told.hovers()


@pytest.mark.parametrize(("name", "words"), [
    ("frozen for long", ("autopilot: PX4 tells the same attitude over and over", "autopilot: PX4's attitude moves")),
    ("nan for long", ("numbers that are not finite", "autopilot: what PX4 measures is usable again")),
    ("silent for long", ("autopilot: the link to PX4 is lost: nothing comes any more", "the link to PX4 is back")),
    ("unplugged", ("autopilot: the link to PX4 is lost: nothing comes any more", "the link to PX4 is back")),
])  # fmt: skip
def test_lost(book: Book, name: str, words: tuple[str, ...]) -> None:
    told = book[name]
    told.lives_on()
    told.says(OLD, *LOST)
    told.says(*words)
    told.acts("autopilot_late", Action.HOLD, 0.1)
    told.acts("autopilot_lost", Action.LAND, 0.4)
    told.lands()


@pytest.mark.parametrize("name", ["silent for long", "unplugged"])
def test_without_a_word_from_us_it_lands_by_itself(book: Book, name: str) -> None:
    """COM_OF_LOSS_T is 0.5 s."""
    told = book[name]
    landing = next(look for look in told.looks if look.mode == "land")
    assert (landing.t_ns - told.began_ns) * 1e-9 < 0.5 + 0.5


def test_reboot(book: Book) -> None:
    told = book["reboot"]
    told.lives_on()
    told.says(OLD, *LOST, "the link to PX4 is lost", "PX4 has rebooted: its time began anew")
    told.says("the link to PX4 is back")
    assert "autopilot_lost" in told.demands
    assert Phase.TAKEOFF in told.phases
    assert told.phases[-2:] == [Phase.LAND, Phase.STOPPED]


@pytest.mark.parametrize("name", [name for name in STORIES if name.startswith("again")])
def test_it_flies_again(book: Book, name: str) -> None:
    """After a reset on the ground all is as before."""
    told = book[name]
    told.lives_on()
    told.says("ready to fly: preflight passes")
    told.calms_down()
    assert told.phases[-3:] == [Phase.PREFLIGHT, Phase.TAKEOFF, Phase.HOLD]
