"""What keys do, and what becomes of what they ask: kill only when meant, nothing that waits for another's answer."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event, Lock

import pytest

from groundstation.client import NoAnswerError
from groundstation.twice import TWICE
from groundstation.watch_keys import ORDERS, Hand, Leave, Order
from groundstation.watch_orders import LeaseKeeper, Orders
from groundstation.watch_shown import Shown, read_events, read_known
from onboard.config import dump_config, load_config
from onboard.core.types import Request
from onboard.wire import Ack, Ask, Mission, Outcome, ReleaseLease, ShowParams, Stop, TakeLease, Way, way_of
from tests.groundstation.watching import START, S
from tests.waiting import seconds_until

KILL = Order("kill", Mission(Request.KILL))


class Person:
    """Presses keys at times of seconds since the start."""

    def __init__(self) -> None:
        self.hand = Hand()

    def __call__(self, key: str, t: float, *, needed: bool = False) -> Order | Leave | None:
        return self.hand.press(key, START + round(t * S), needed=needed)

    def due(self, t: float) -> Order | None:
        return self.hand.due(START + round(t * S))

    def question(self, t: float) -> str:
        return self.hand.question(START + round(t * S))


@pytest.fixture
def press() -> Person:
    return Person()


@pytest.mark.parametrize(
    ("key", "name", "ask"),
    [
        ("h", "hold", Mission(Request.HOLD)),
        ("r", "retreat", Mission(Request.RETREAT)),
        ("s", "stop", Stop()),
        ("space", "stop", Stop()),
        ("l", "land", Mission(Request.LAND)),
        ("u", "resume", Mission(Request.RESUME)),
    ],
)
def test_a_key_asks_at_once(press: Person, key: str, name: str, ask: Ask) -> None:
    assert press(key, 0.0) == Order(name, ask)


def test_capitals_are_the_same_keys(press: Person) -> None:
    """Caps lock must not cost a stop."""
    assert press("S", 0.0) == Order("stop", Stop())
    assert press("K", 1.0) is None
    assert press("K", 1.1) == KILL


def test_other_keys_do_nothing(press: Person) -> None:
    for i, key in enumerate(("x", "y", "n", "enter", "escape", "f1", "up", "é")):
        assert press(key, float(i)) is None
        assert press.question(float(i)) == ""


def test_kill_takes_two_presses(press: Person) -> None:
    assert press("k", 0.0) is None
    assert press.question(0.5).startswith("KILL?  k again within 1.5 s")
    assert press("k", 1.8) is None
    assert press.due(1.85) is None
    assert press.due(1.95) == KILL
    assert press.question(1.95) == ""
    assert press("k", 2.0) is None  # a third is the first of the next


def test_a_fast_double_press_kills_with_the_second(press: Person) -> None:
    press("k", 0.0)
    assert press("k", 0.15) == KILL


def test_a_key_that_is_held_does_not_kill(press: Person) -> None:
    for i in range(40):
        t = 0.0 if i == 0 else 0.5 + 0.033 * (i - 1)
        assert press("k", t) is None
        assert press.due(t + 0.03) is None


def test_a_second_press_that_comes_too_late_is_a_first(press: Person) -> None:
    press("k", 0.0)
    assert press.question(TWICE) == ""
    assert press("k", TWICE + 0.1) is None
    assert press("k", TWICE + 0.2) == KILL


@pytest.mark.parametrize("key", ["h", "s", "x", "escape", "q"])
def test_any_other_key_is_no_to_kill(press: Person, key: str) -> None:
    press("k", 0.0)
    press(key, 0.5, needed=True)
    assert "KILL" not in press.question(0.5)
    assert press("k", 1.0) is None


def test_a_key_that_is_held_down_asks_once(press: Person) -> None:
    """A stop asked twice is a landing."""
    given = [press("s", t) for t in (0.0, 0.35, 0.38, 0.41, 0.44, 0.8, 1.1)]
    assert given == [Order("stop", Stop()), *[None] * 6]
    assert press("s", 1.6) == Order("stop", Stop())


def test_quit_leaves_at_once_when_nothing_hangs_on_it(press: Person) -> None:
    assert press("q", 0.0, needed=False) == Leave()


def test_quit_asks_while_it_flies_by_our_command(press: Person) -> None:
    assert press("q", 0.0, needed=True) is None
    assert press.question(9.0).startswith("QUIT?")
    assert press("q", 10.0, needed=True) is None
    assert press("y", 11.0, needed=True) == Leave()


@pytest.mark.parametrize("key", ["n", "escape", "x"])
def test_any_other_key_stays(press: Person, key: str) -> None:
    press("q", 0.0, needed=True)
    assert press(key, 1.0, needed=True) is None
    assert press.question(1.0) == ""
    assert press("y", 2.0, needed=True) is None


def test_an_order_while_asked_is_an_order(press: Person) -> None:
    press("q", 0.0, needed=True)
    assert press("h", 1.0, needed=True) == Order("hold", Mission(Request.HOLD))


def test_who_does_not_command_may_stop_retreat_and_kill() -> None:
    open_to_all = {key for key, order in ORDERS.items() if way_of(order.ask) is Way.SAFETY}
    assert open_to_all == {"s", "space", "r"}
    assert way_of(KILL.ask) is Way.SAFETY


# --- orders -----------------------------------------------------------------------------------------------------------


class Vehicle:
    """Answers when it is let, or not at all."""

    def __init__(self) -> None:
        self.asked: list[tuple[Ask, float]] = []
        self.silent: set[type] = set()
        self.free = Event()
        self.data = b""
        self.refusal = ""
        self._lock = Lock()

    def ask(self, ask: Ask, *, timeout: float = 0.0, settled: bool = False) -> Ack:
        assert settled
        with self._lock:
            self.asked.append((ask, timeout))
        if type(ask) in self.silent:
            self.free.wait()
            raise NoAnswerError("falcon: no answer within 7 s")
        if self.refusal:
            return Ack("a", Outcome.REFUSED, self.refusal)
        return Ack("a", Outcome.DONE, "So be it.", self.data)

    def asks(self) -> list[Ask]:
        return [ask for ask, _ in self.asked]


@pytest.fixture
def vehicle() -> Iterator[Vehicle]:
    vehicle = Vehicle()
    yield vehicle
    vehicle.free.set()


class Clock:
    now_ns = START

    def __call__(self) -> int:
        return self.now_ns


def test_an_order_waits_for_no_other(vehicle: Vehicle) -> None:
    """With the link lost many orders have no answer; a stop still leaves at once."""
    vehicle.silent = {Mission}
    orders = Orders(vehicle, Clock(), 7.0)
    for _ in range(40):
        orders.give("hold", Mission(Request.HOLD))
    orders.give("stop", Stop())
    seconds_until(lambda: orders.latest()[-1].outcome is Outcome.DONE)
    assert all(order.pending for order in orders.latest()[:-1])
    assert {timeout for _, timeout in vehicle.asked} == {7.0}
    vehicle.free.set()
    seconds_until(lambda: not any(order.pending for order in orders.latest()))
    assert {order.text for order in orders.latest()[:-1]} == {"falcon: no answer within 7 s"}


def test_answers_are_remembered_in_the_order_of_asking(vehicle: Vehicle) -> None:
    orders = Orders(vehicle, Clock(), 7.0)
    vehicle.silent = {Mission}
    orders.give("hold", Mission(Request.HOLD))
    vehicle.refusal = "No."
    orders.give("stop", Stop())
    seconds_until(lambda: not orders.latest()[-1].pending)
    first, second = orders.latest()
    assert (first.name, first.asked_ns, first.outcome) == ("hold", START, None)
    assert (second.name, second.outcome, second.text) == ("stop", Outcome.REFUSED, "No.")


# --- the lease --------------------------------------------------------------------------------------------------------


def keeper(vehicle: Vehicle) -> tuple[LeaseKeeper, Orders]:
    orders = Orders(vehicle, Clock(), 7.0)
    return LeaseKeeper(orders), orders


def test_the_lease_is_taken_once_and_given_back(vehicle: Vehicle) -> None:
    lease, orders = keeper(vehicle)
    lease.look("", "alice", START)
    for i in range(5):
        lease.look("alice", "alice", START + i * 10 * S)
    seconds_until(lambda: not orders.latest()[0].pending)
    assert vehicle.asks() == [TakeLease()]
    assert lease.release("alice", "alice") == ReleaseLease()


def test_a_lease_that_another_has_is_asked_for_once_and_never_seized(vehicle: Vehicle) -> None:
    lease, orders = keeper(vehicle)
    for i in range(5):
        lease.look("bob", "alice", START + i * 10 * S)
    seconds_until(lambda: not orders.latest()[0].pending)
    assert vehicle.asks() == [TakeLease(seize=False)]
    assert lease.release("bob", "alice") is None


def test_a_lease_that_nobody_has_any_more_is_taken_again(vehicle: Vehicle) -> None:
    """The flight process was started anew; but not ten times a second."""
    lease, orders = keeper(vehicle)
    for i in range(41):
        lease.look("", "alice", START + i * S // 10)
    seconds_until(lambda: not any(order.pending for order in orders.latest()))
    assert vehicle.asks() == [TakeLease()] * 3


def test_a_lease_that_was_ours_before_stays_ours(vehicle: Vehicle) -> None:
    """Who types commands in another terminal took it."""
    lease, orders = keeper(vehicle)
    lease.look("alice", "alice", START)
    assert orders.latest() == ()
    assert lease.release("alice", "alice") is None


# --- what the vehicle shows -------------------------------------------------------------------------------------------


def test_the_configuration_is_asked_for_once_for_each_version(vehicle: Vehicle) -> None:
    config = load_config("paper", sets=["pipe.radius=0.1"])
    vehicle.data = dump_config(config).encode() + b"of_tomorrow: {this: 1}\n"
    shown = Shown(vehicle, ShowParams(), read_known, Clock())
    for version in ((0, 1), (0, 1), (0, 2)):
        shown.look(version)
        seconds_until(lambda: shown.value is not None)
    assert vehicle.asks() == [ShowParams()] * 2
    assert shown.value is not None
    assert shown.value.pipe == config.pipe
    for name in shown.value.safety.__struct_fields__:
        assert getattr(shown.value.safety, name) == getattr(config.safety, name)


@pytest.mark.parametrize(
    ("data", "refusal", "why"),
    [(b"pipe: 3", "", "pipe"), (b"a: [", "", ""), (b"", "You may not look.", "You may not look.")],
)
def test_what_is_not_shown_is_told_and_asked_for_again(vehicle: Vehicle, data: bytes, refusal: str, why: str) -> None:
    vehicle.data, vehicle.refusal = data, refusal
    clock = Clock()
    shown = Shown(vehicle, ShowParams(), read_known, clock)
    shown.look(1)
    seconds_until(lambda: bool(shown.why))
    assert why in shown.why
    shown.look(1)
    assert len(vehicle.asked) == 1
    vehicle.data, vehicle.refusal = dump_config(load_config("paper")).encode(), ""
    clock.now_ns += 3 * S
    shown.look(1)
    seconds_until(lambda: shown.value is not None)
    assert shown.why == ""


def test_events_of_before(vehicle: Vehicle) -> None:
    vehicle.data = b'[{"number": 4, "event": {"t_ns": 7, "code": "start", "severity": "info", "text": "Off we go."}}]'
    shown = Shown(vehicle, ShowParams(), read_events, Clock())
    shown.look(0)
    seconds_until(lambda: shown.value is not None)
    assert shown.value is not None
    assert [told.event.text for told in shown.value] == ["Off we go."]
