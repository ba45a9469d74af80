"""Each fault of the servo bus in flight, from its bytes to the ground.

The base flies on without the arm: whatever happens to it, the vehicle hovers, and is landed by request.
"""

from __future__ import annotations

import pytest

from drivers.xc330 import HardwareError
from onboard.core.types import Action, Phase
from sim_backend.dynamixel_troubles import KINDS
from tests.process.book import Book, Told, again, strikes
from tests.process.flying import Flying
from tests.realtime import REALTIME

pytestmark = REALTIME

BUS = "servos"
#: Of the answers, one in twenty is lost or spoilt: a dozen a second.
FEW = 0.05


def late(flight: Flying) -> None:
    """Answers that come after their time, now and then."""
    for _ in range(3):
        flight.inject(device=BUS, kind="delay", value=0.015, count=1)
        flight.rest(0.3)
    flight.rest(1.5)


STORIES = {
    "drop": strikes(BUS, "drop", 3.0, value=FEW, duration=1.5),
    "corrupt": strikes(BUS, "corrupt", 3.0, value=FEW, duration=1.5),
    "truncate": strikes(BUS, "truncate", 3.0, value=FEW, duration=1.5),
    "wrong_id": strikes(BUS, "wrong_id", 3.0, value=FEW, duration=1.5),
    "delay": late,
    "silent": strikes(BUS, "silent", 3.0, part="theta_2", duration=1.0),
    "again 1": again,
    "all silent": strikes(BUS, "silent", 3.0, duration=1.0),
    "again 2": again,
    "overload": strikes(BUS, "error_bit", 4.0, part="theta_1", value=int(HardwareError.OVERLOAD), duration=0.0),
    "again 3": again,
    "reboot": strikes(BUS, "reboot", 3.0, part="theta_3", duration=0.5),
    "again 4": again,
    "unplugged": strikes(BUS, "unplugged", 3.5, duration=1.0),
    "again 5": again,
    "error_bit": strikes(BUS, "error_bit", 2.0, part="pump", value=int(HardwareError.VOLTAGE), duration=0.0),
}
FAILED = ("servo bus: a reading of the servos failed", "servo bus: every reading of the servos succeeds again")
NOBODY = "servo bus: no servo answers any more: is the 5 V supply on, and is the data cable plugged in?"
#: Words of the safety table.
TROUBLE = "Servo trouble, bits"
SILENT = "The servo bus is silent: the arm cannot be moved."


@pytest.fixture(scope="module")
def book(tmp_path_factory: pytest.TempPathFactory) -> Book:
    return Book(tmp_path_factory.mktemp("servos"), STORIES, "plan.takeoff_height=0.5")


def test_every_fault_has_its_story() -> None:
    assert {kind.value for kind in KINDS} <= set(STORIES)


def flown_through(told: Told) -> None:
    told.lives_on()
    told.hovers()


@pytest.mark.parametrize("name", ["drop", "corrupt", "truncate", "wrong_id", "delay"])
def test_some_answers_are_of_no_use(book: Book, name: str) -> None:
    """Each costs a cycle; the arm is held all the time."""
    told = book[name]
    flown_through(told)
    told.says(*FAILED)
    told.calms_down()
    assert "servo_error" not in told.demands
    assert all(look.torque_on for look in told.looks)


def held(told: Told, bits: int) -> None:
    """A servo in trouble: the vehicle holds, and says so until it has landed."""
    flown_through(told)
    told.says(f"{TROUBLE} {bits:#04x}")
    told.acts("servo_error", Action.HOLD, 0.2)
    assert "servo_error" in told.ticks[-1].outputs.verdict.reasons


def test_silent(book: Book) -> None:
    told = book["silent"]
    held(told, HardwareError.SILENT)
    told.says("theta_2 (id 2) does not answer any more; the others go on", "theta_2 (id 2) answers again")
    told.says_no("is behind")


def test_nobody_answers(book: Book) -> None:
    told = book["all silent"]
    flown_through(told)
    told.says("s behind. Check its cable and latency timer.", SILENT, "gripper (id 5) answer again")
    told.says(NOBODY, SILENT)  # the driver's own patience is configured
    told.acts("servos_lost", Action.HOLD, 0.5)


def test_overload(book: Book) -> None:
    """The servo is rebooted, comes back slowly, and carries on."""
    told = book["overload"]
    held(told, HardwareError.OVERLOAD)
    told.says(
        "theta_1 (id 1): overload; its torque is off, it is rebooted in 1 s",
        "theta_1 (id 1): reboot 1 of 3",
        "theta_1 (id 1) answers again, restarted",
    )
    told.acts("servo_torque", Action.HOLD, 0.1)
    assert told.looks[-1].torque_on


def test_reboot(book: Book) -> None:
    """It has forgotten everything, and is told it again."""
    told = book["reboot"]
    held(told, HardwareError.SILENT)
    told.says("theta_3 (id 3) does not answer any more", "theta_3 (id 3) answers again, restarted")
    assert told.looks[-1].torque_on


def test_unplugged(book: Book) -> None:
    told = book["unplugged"]
    flown_through(told)
    told.says("servos is gone (", SILENT, "servos is back", "gripper (id 5) answer again")
    told.says_no(NOBODY)
    told.acts("servos_lost", Action.HOLD, 0.5)
    assert told.looks[-1].torque_on


def test_error_bit(book: Book) -> None:
    """The servo works on, but for how long: it holds."""
    told = book["error_bit"]
    held(told, HardwareError.VOLTAGE)
    told.says("servo bus: pump (id 4): supply voltage out of its limits")
    assert told.looks[-1].torque_on


@pytest.mark.parametrize("name", [name for name in STORIES if name.startswith("again")])
def test_it_flies_again(book: Book, name: str) -> None:
    """After a reset on the ground all is as before."""
    told = book[name]
    told.lives_on()
    told.says("ready to fly: preflight passes")
    told.calms_down()
    assert told.phases[-3:] == [Phase.PREFLIGHT, Phase.TAKEOFF, Phase.HOLD]
