"""What becomes of an order between the link and the loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from onboard.config import Config, load_config
from onboard.core.params import Params
from onboard.core.types import Event, Outputs, Phase, Request, Severity
from onboard.layers import ConfigError
from onboard.link import Asked
from onboard.orders import NotShownError, Orders
from onboard.params import Change
from onboard.reload import Done
from onboard.wire import (
    Ack,
    Arm,
    Ask,
    Go,
    ListLogs,
    Mission,
    Outcome,
    ReloadParams,
    SaveParams,
    SetParams,
    ShowParams,
    ShowPreflight,
    Stop,
    Tare,
)
from tests.synthetic import change_outputs, mission

TICK, _ = next(iter(mission()))
HOVERING = Event(1, "hold", Severity.INFO, "Hovering in place. Ask to resume, retreat or land.")
REFUSED = Event(1, "refused_grounded", Severity.WARNING, "hold refused. The vehicle is not flying.")
ALARM = Event(1, "servos_late", Severity.WARNING, "The servo bus is 0.11 s behind.")


class House:
    """All that orders are handed to, and what was."""

    def __init__(self) -> None:
        self.params = load_config("paper")
        self.asked: list[tuple[Any, ...]] = []
        self.done: Callable[[Outputs], None] | None = None
        self.instead: Callable[[str], None] | None = None
        self.changed: Done | None = None
        self.load: Callable[[], Params] | None = None
        self.settled: list[Ack] = []
        self.saved: list[Params] = []
        shows = {ShowParams: lambda _: b"yaml", ListLogs: self._no_logs}
        self.orders = Orders(self, self, self, lambda _, ack: self.settled.append(ack), self.save, shows)

    def _no_logs(self, _: object) -> bytes:
        raise NotShownError("there is no folder of runs")

    # the loop
    def request(
        self, request: Request, *, go: Phase | None = None, done: Callable[[Outputs], None] | None = None
    ) -> None:
        self.asked.append((request, go))
        self.done = done

    # the emergency
    def stop(self, done: Callable[[Outputs], None] | None = None, instead: Callable[[str], None] | None = None) -> None:
        self.asked.append(("stop",))
        self.done, self.instead = done, instead

    def kill(self) -> None:
        self.asked.append(("kill",))

    # the reloader
    def ask(self, load: Callable[[], Params] | None = None, done: Done | None = None) -> None:
        self.load, self.changed = load, done

    def ask_to(self, save: Callable[[Params], Sequence[Change]], done: Done) -> None:
        save(self.params)
        self.changed = done

    def save(self, params: Params) -> Sequence[Change]:
        self.saved.append(params)
        return []

    def order(self, ask: Ask) -> Ack:
        return self.orders(Asked("anna", "o1", ask))

    def tick(self, *events: Event) -> Ack:
        assert self.done is not None
        self.done(change_outputs(TICK, events=events).outputs)
        return self.settled[-1]


@pytest.fixture
def house() -> House:
    return House()


@pytest.mark.parametrize(
    ("ask", "handed_on"),
    [
        (Mission(Request.TAKEOFF), (Request.TAKEOFF, None)),
        (Mission(Request.HOLD), (Request.HOLD, None)),
        (Go(Phase.TARE), (Request.GO, Phase.TARE)),
        (Arm(), (Request.ARM, None)),
        (Tare(), (Request.TARE, None)),
        (Stop(), ("stop",)),
    ],
)
def test_it_is_handed_on_and_settled_by_the_tick_that_took_it(
    house: House, ask: Ask, handed_on: tuple[Any, ...]
) -> None:
    assert house.order(ask) == Ack("o1", Outcome.ACCEPTED)
    assert house.asked == [handed_on]
    assert house.settled == []
    assert house.tick(ALARM, HOVERING) == Ack("o1", Outcome.DONE, HOVERING.text)


def test_a_stop_that_a_stuck_loop_does_not_take_is_settled_by_the_landing(house: House) -> None:
    house.order(Stop())
    assert house.instead is not None
    house.instead("The autopilot is told to land.")
    assert house.settled == [Ack("o1", Outcome.DONE, "The autopilot is told to land.")]


def test_a_kill_is_done_whatever_the_loop_does(house: House) -> None:
    assert house.order(Mission(Request.KILL)).outcome is Outcome.DONE
    assert house.asked == [("kill",)]


def test_what_the_mission_refuses_is_refused_with_its_words(house: House) -> None:
    house.order(Mission(Request.HOLD))
    assert house.tick(ALARM, REFUSED) == Ack("o1", Outcome.REFUSED, REFUSED.text)


def test_what_is_taken_without_a_word_is_done(house: House) -> None:
    house.order(Mission(Request.HOLD))
    assert house.tick().outcome is Outcome.DONE


def test_values_are_laid_over_the_parameters_in_force(house: House) -> None:
    assert house.order(SetParams(("repair.force=3", "safety.tilt=0.5"))).outcome is Outcome.ACCEPTED
    assert house.load is not None
    wanted = house.load()
    assert isinstance(wanted, Config)
    assert wanted.repair.force == 3.0
    assert wanted.safety.tilt == 0.5
    assert wanted.plan == house.params.plan


def test_wrong_values_are_told_all_at_once(house: House) -> None:
    house.order(SetParams(("repair.force=-1", "safety.tilt=upright")))
    assert house.load is not None
    with pytest.raises(ConfigError) as told:
        house.load()
    assert len(told.value.errors) == 2
    assert "repair.force" in str(told.value)
    assert "safety.tilt" in str(told.value)


@pytest.mark.parametrize("ask", [SetParams(("repair.force=3",)), ReloadParams(), SaveParams()])
def test_a_change_of_parameters_is_settled_by_what_came_of_it(house: House, ask: Ask) -> None:
    house.order(ask)
    assert house.changed is not None
    house.changed(True, ["revision 2", "repair.force = 2.5 -> 3.0"])
    house.changed(False, ["pipe.radius: may change on the ground only"])
    done, refused = house.settled
    assert done == Ack("o1", Outcome.DONE, "revision 2\nrepair.force = 2.5 -> 3.0")
    assert refused == Ack("o1", Outcome.REFUSED, "pipe.radius: may change on the ground only")


def test_files_are_read_again_by_the_reloader_itself(house: House) -> None:
    house.order(ReloadParams())
    assert house.load is None


def test_what_is_in_force_is_saved(house: House) -> None:
    house.order(SaveParams())
    assert house.saved == [house.params]


def test_what_is_asked_to_be_shown_is_the_answer(house: House) -> None:
    assert house.order(ShowParams()) == Ack("o1", Outcome.DONE, data=b"yaml")


def test_what_is_not_there_is_refused(house: House) -> None:
    assert house.order(ListLogs()) == Ack("o1", Outcome.REFUSED, "there is no folder of runs")
    assert house.order(ShowPreflight()).outcome is Outcome.REFUSED
