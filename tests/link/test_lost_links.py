"""A station is killed, and the network is cut: in contact and in a hover, for a moment, longer, and for good.

The times after which the table acts are shorter here than on the vehicle; the stories of the core fly all phases with
those of the vehicle.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from onboard.core.types import Action, Phase
from tests.link.terminals import Keeper, Terminal
from tests.onboard.relay import Relay
from tests.process.book import Book
from tests.process.flying import PATIENCE, Flying
from tests.realtime import REALTIME
from tests.zenoh_sessions import free_port

pytestmark = REALTIME

#: After which silence the table holds and lands, s.
SILENT, LOST = 1.2, 4.0
#: Cuts, s: nothing comes of one, and a hold of the other.
SHORT, LONGER = 0.7, 2.5
#: Nothing resumes by itself for so long after the link is back, s.
AFTERWARDS = 1.5


class Link:
    """A station, and the network between it and the vehicle."""

    def __init__(self, folder: Path, relay: Relay) -> None:
        self.relay = relay
        self._terminal = Terminal(folder, f"--connect=tcp/127.0.0.1:{relay.port}", "--station=alice")
        self._keeper: Keeper | None = None

    def come(self) -> None:
        """Take the lease, and keep it."""
        self._keeper = Keeper(self._terminal).__enter__()

    def kill(self) -> None:
        """With no time for a last word."""
        assert self._keeper is not None
        keeper, self._keeper = self._keeper, None
        keeper.running.end(signal.SIGKILL)

    def close(self) -> None:
        """Whoever is left goes."""
        if self._keeper is not None:
            self.relay.mend()
            self.kill()

    # -- stories ------------------------------------------------------------------------------------------------------

    def begin(self, flight: Flying) -> None:
        """Somebody commands, and the vehicle presses."""
        flight.wait_said("ready")
        self.come()
        flight.hover()
        flight.ask("start")
        self._press(flight)

    def cut_for_a_moment(self, flight: Flying) -> None:
        """Shorter than what is called silence."""
        self.relay.cut()
        flight.rest(SHORT)
        self.relay.mend()
        flight.rest(AFTERWARDS)

    def cut_in_press(self, flight: Flying) -> None:
        """Long enough to be held, and then it is back."""
        self._cut(flight)
        flight.wait("the hold", lambda look: look.phase == Phase.HOLD)
        flight.rest(AFTERWARDS)

    def killed_in_press(self, flight: Flying) -> None:
        """From the hold back to the pipe; then nobody is there any more."""
        flight.ask("resume")
        self._press(flight)
        self.kill()
        flight.stopped()
        flight.rest(AFTERWARDS)

    def back_on_the_ground(self, flight: Flying) -> None:
        """The same station comes again: nothing moves before it asks."""
        self.come()
        flight.rest(AFTERWARDS)

    def cut_in_hover(self, flight: Flying) -> None:
        """As in press."""
        self._cut(flight)
        flight.rest(AFTERWARDS)

    def killed_in_hover(self, flight: Flying) -> None:
        """It comes again in time."""
        self.kill()
        flight.rest(SILENT + 0.5)
        self.come()
        flight.rest(AFTERWARDS)

    def cut_for_good(self, flight: Flying) -> None:
        """In a hover; what waited in the network arrives when all is over."""
        self.relay.cut()
        flight.stopped()
        self.relay.mend()
        flight.rest(AFTERWARDS)

    def fly_again(self, flight: Flying) -> None:
        """Up to the hover."""
        flight.reset()
        flight.hover()

    def _cut(self, flight: Flying) -> None:
        self.relay.cut()
        flight.rest(LONGER)
        self.relay.mend()

    def _press(self, flight: Flying) -> None:
        flight.wait("press", lambda look: look.phase == Phase.PRESS and look.truth.contact_force > 1.2, 3 * PATIENCE)


@pytest.fixture(scope="module")
def book(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Book]:
    folder, port = tmp_path_factory.mktemp("links"), free_port()
    sets = (
        f"link.listen=[tcp/127.0.0.1:{port}]", "link.plain=true",
        f"safety.link_silent={SILENT}", f"safety.link_lost={LOST}", "devices.servos.kind=mock",
    )  # fmt: skip
    with Relay(port) as relay:
        link = Link(folder, relay)
        stories = {
            "moment in press": link.cut_for_a_moment,
            "cut in press": link.cut_in_press,
            "killed in press": link.killed_in_press,
            "back on the ground": link.back_on_the_ground,
            "again": link.fly_again,
            "moment in hover": link.cut_for_a_moment,
            "cut in hover": link.cut_in_hover,
            "killed in hover": link.killed_in_hover,
            "cut for good": link.cut_for_good,
        }
        try:
            yield Book(folder, stories, *sets, begin=link.begin)
        finally:
            link.close()


@pytest.mark.parametrize(("name", "phase"), [("moment in press", Phase.PRESS), ("moment in hover", Phase.HOLD)])
def test_a_moment_is_told_and_nothing_comes_of_it(book: Book, name: str, phase: Phase) -> None:
    told = book[name]
    told.lives_on()
    assert told.phases == [phase]
    assert not {"link_silent", "link_lost"} & told.demands


def test_a_cut_in_press_leads_to_a_hold_clear_of_the_pipe_and_nothing_resumes(book: Book) -> None:
    told = book["cut in press"]
    told.acts("link_silent", Action.RETREAT, SILENT)
    assert told.phases == [Phase.PRESS, Phase.RETREAT_HOLD, Phase.HOLD]
    assert "link_lost" not in told.demands
    told.says("commands, and is silent for", "is back after")
    told.calms_down()
    assert told.looks[-1].truth.contact_force == 0.0


def test_a_station_that_dies_in_press_leaves_a_vehicle_that_retreats_and_lands(book: Book) -> None:
    told = book["killed in press"]
    told.lives_on()
    assert told.phases[:4] == [Phase.HOLD, Phase.TARE, Phase.ADVANCE, Phase.PRESS]
    ways = ([Phase.RETREAT_HOLD, Phase.HOLD, Phase.LAND], [Phase.RETREAT_HOLD, Phase.RETREAT_LAND, Phase.LAND])
    assert told.phases[4:] in [[*way, Phase.STOPPED] for way in ways]
    assert {"link_silent", "link_lost"} <= told.demands
    told.says("the commanding station alice is gone", "commands, and is silent for", "commands, and is lost")
    last = told.looks[-1]
    assert last.truth.on_ground
    assert not last.armed


def test_a_station_that_comes_back_moves_nothing(book: Book) -> None:
    told = book["back on the ground"]
    assert told.phases == [Phase.STOPPED]
    told.calms_down()


def test_a_cut_in_hover_is_held_and_told(book: Book) -> None:
    told = book["cut in hover"]
    told.acts("link_silent", Action.HOLD, SILENT)
    told.hovers()
    told.calms_down()


def test_a_station_that_dies_in_hover_and_comes_back_in_time(book: Book) -> None:
    told = book["killed in hover"]
    told.acts("link_silent", Action.HOLD, SILENT)
    told.hovers()
    told.calms_down()


def test_a_cut_for_good_lands(book: Book) -> None:
    told = book["cut for good"]
    told.acts("link_lost", Action.LAND, LOST)
    told.lands()
    assert told.phases[-1] is Phase.STOPPED, "and stays there when the network is back"
