"""Both ends of the link in one process, over loopback: what is told, what is asked, and what goes wrong between."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh
from msgspec.structs import replace

from drivers.mailbox import Level
from groundstation.client import Client, NoAnswerError, StationSettings
from onboard.admission import station_security, vehicle_security
from onboard.core.types import Event, Phase, Request, Severity, Tick
from onboard.declared import describe
from onboard.endpoints import LinkError, NoVehicleError, open_session
from onboard.layers import ConfigError
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.params import load
from onboard.roster import Role
from onboard.sessions import MOST_OF_ONE
from onboard.wire import (
    Ack,
    Arm,
    Ask,
    Go,
    Keys,
    Mission,
    Order,
    Outcome,
    ReleaseLease,
    ShowParams,
    StationPulse,
    Stop,
    TakeLease,
    Telemetry,
    Told,
    Way,
    encode,
    read_ack,
    read_refusal,
    read_telemetry,
)
from tests.onboard.relay import Relay
from tests.synthetic import mission
from tests.waiting import LONG, pause, seconds_until
from tests.zenoh_sessions import Fleet, free_port

TICKS = [tick for tick, _ in mission()]
ON_GROUND, FLYING = TICKS[0], next(tick for tick in TICKS if tick.outputs.phase is Phase.APPROACH)
KILL, RETREAT, HOLD = Mission(Request.KILL), Mission(Request.RETREAT), Mission(Request.HOLD)


def event(text: str) -> Event:
    return Event(1, "test", Severity.INFO, text)


class Vehicle:
    """A link, and what has come of it."""

    def __init__(self, settings: LinkSettings) -> None:
        self.settings = settings
        self.asked: list[Asked] = []
        self.answer: Callable[[Asked], Ack] = lambda asked: asked.done("so be it")
        self.told: list[tuple[Level, str]] = []
        self.link = Link(settings, self.hear)

    def hear(self, asked: Asked) -> Ack:
        self.asked.append(asked)
        return self.answer(asked)

    def asks(self) -> list[Ask]:
        return [asked.ask for asked in self.asked]

    def says(self, part: str) -> bool:
        """Whether a sentence with ``part`` was told up to now."""
        self.told += [(notice.level, notice.text) for notice in self.link.notices()]
        return any(part in text for _, text in self.told)

    def heard(self) -> float:
        """Age of the commander, s."""
        return self.link.state().age(time.monotonic_ns())


@pytest.fixture
def vehicle() -> Iterator[Vehicle]:
    vehicle = Vehicle(LinkSettings(vehicle="x500", listen=(f"tcp/127.0.0.1:{free_port()}",), plain=True))
    vehicle.link.start()
    yield vehicle
    vehicle.link.stop()


def settings(vehicle: Vehicle, name: str, port: int | None = None) -> StationSettings:
    connect = vehicle.settings.listen if port is None else (f"tcp/127.0.0.1:{port}",)
    return StationSettings("x500", connect, name, plain=True)


@pytest.fixture
def join(vehicle: Vehicle) -> Iterator[Callable[..., Client]]:
    with ExitStack() as stack:
        yield lambda name, port=None: stack.enter_context(Client(settings(vehicle, name, port), timeout=LONG))


@contextmanager
def raw(vehicle: Vehicle) -> Iterator[zenoh.Session]:
    """A session that may send anything."""
    session = open_session("client", vehicle.settings.listen, plain=True, lease=0.6, security={}, timeout=LONG)
    try:
        yield session
    finally:
        session.close()


def query(session: zenoh.Session, way: Way, payload: bytes, *, station: str = "raw") -> Ack | str:
    """The answer of the vehicle to anything."""
    return query_key(session, Keys("x500").station(station, "s1", way), payload)


def query_key(session: zenoh.Session, key: str, payload: bytes) -> Ack | str:
    """The answer at any key; sent until there is one, since too much at once is not taken."""
    end = time.monotonic() + LONG
    while time.monotonic() < end:
        if (answer := query_once(session, key, payload)) is not None:
            return answer
        pause(0.02)
    pytest.fail("no answer")


def query_once(session: zenoh.Session, key: str, payload: bytes) -> Ack | str | None:
    """The answer, if there is one."""
    for reply in session.get(key, payload=payload, timeout=LONG):
        if reply.ok is not None:
            return read_ack(reply.ok.payload.to_bytes())
        assert reply.err is not None
        return read_refusal(reply.err.payload.to_bytes())
    return None


# --- what the vehicle tells -------------------------------------------------------------------------------------------


def test_the_newest_tick_reaches_every_station_at_the_configured_rate(
    vehicle: Vehicle, join: Callable[..., Client]
) -> None:
    alice, bob = join("alice"), join("bob")
    seen: list[Telemetry] = []
    with raw(vehicle) as session:
        session.declare_subscriber(
            Keys("x500").telemetry, lambda sample: seen.append(read_telemetry(sample.payload.to_bytes()))
        )
        for tick in TICKS:
            vehicle.link.tick(tick)
            pause(0.002)
            if len(seen) > 20:
                break
    assert len(seen) > 20
    indices = [telemetry.tick.index for telemetry in seen]
    assert indices == sorted(set(indices)), "none twice, none backwards"
    assert max(b - a for a, b in pairwise(indices)) > 1, "decimated"
    assert (seen[20].sent_ns - seen[0].sent_ns) * 1e-9 > 19 / vehicle.settings.telemetry_rate
    vehicle.link.tick(TICKS[-1])
    for station in (alice, bob):
        seconds_until(lambda station=station: newest(station) == TICKS[-1])  # type: ignore[misc]


def newest(station: Client) -> Tick | None:
    telemetry = station.telemetry()
    return telemetry.tick if telemetry is not None else None


def test_events_come_at_once_in_order_and_without_a_gap(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    alice = join("alice")
    events = [event(str(i)) for i in range(100)]
    for one in events:
        vehicle.link.event(one)
    seconds_until(lambda: len(alice.events) == 100)
    assert list(alice.events) == [Told(i + 1, one) for i, one in enumerate(events)]
    assert alice.contact().missed == 0


def test_events_that_do_not_fit_are_counted_at_both_ends_and_hold_nobody_up(
    vehicle: Vehicle, join: Callable[..., Client]
) -> None:
    alice = join("alice")
    gate, stuck = threading.Event(), threading.Event()

    def block() -> None:
        stuck.set()
        gate.wait(LONG)

    vehicle.link.event(event("first"))
    seconds_until(lambda: len(alice.events) == 1)
    vehicle.link._events.put(block)
    assert stuck.wait(LONG)
    began = time.monotonic()
    for i in range(1000):
        vehicle.link.event(event(str(i)))
        vehicle.link.tick(TICKS[i])
    assert time.monotonic() - began < 5.0
    assert vehicle.link.dropped == 1000 - 256
    gate.set()
    seconds_until(lambda: len(alice.events) == 257)
    vehicle.link.event(event("last"))
    seconds_until(lambda: alice.events[-1].event.text == "last")
    assert alice.contact().missed == 1000 - 256
    assert alice.wait(lambda contact: contact.pulse is not None and contact.pulse.dropped == 1000 - 256, LONG)


def test_stop_is_answered_while_telemetry_and_events_are_stuck(
    vehicle: Vehicle, join: Callable[..., Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    alice = join("alice")
    gate, stuck = threading.Event(), threading.Event()

    def block(*arguments: object) -> None:
        stuck.set()
        gate.wait(LONG)

    monkeypatch.setattr(vehicle.link, "_publish", block)
    try:
        vehicle.link.event(event("stuck"))
        assert stuck.wait(LONG)
        assert alice.ask(Stop(), timeout=LONG).outcome is Outcome.DONE
    finally:
        monkeypatch.undo()
        gate.set()


def test_stop_is_answered_while_a_look_waits_for_a_disk(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    looked, there = threading.Event(), threading.Event()

    def answer(asked: Asked) -> Ack:
        if isinstance(asked.ask, ShowParams):
            looked.set()
            there.wait(LONG)
        return asked.done()

    vehicle.answer = answer
    viewer, operator = join("viewer"), join("operator")
    looking = threading.Thread(target=viewer.ask, args=(ShowParams(),), kwargs={"timeout": LONG})
    looking.start()
    try:
        assert looked.wait(LONG)
        assert operator.ask(Stop(), timeout=LONG).outcome is Outcome.DONE
        assert operator.ask(TakeLease(), timeout=LONG).outcome is Outcome.DONE
        assert not there.is_set()
    finally:
        there.set()
        looking.join()


def test_ages_both_ways_and_the_clocks(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    alice = join("alice")
    assert alice.ask(TakeLease()).outcome is Outcome.DONE
    contact = alice.contact()
    assert contact.present
    assert 0.0 < contact.age < LONG
    assert 0.0 < contact.round_trip < 1.0
    assert abs(contact.clock_offset) < 1.0
    seconds_until(lambda: 0.0 < vehicle.heard() < 0.5)
    seconds_until(lambda: vehicle.link.state().present)
    vehicle.link.tick(FLYING)
    assert alice.wait(lambda now: now.pulse is not None and now.pulse.tick_ns == FLYING.inputs.t_ns, LONG)
    pulse = alice.contact().pulse
    assert pulse is not None
    assert pulse.commander == "alice"


def test_nobody_commands_at_first(vehicle: Vehicle) -> None:
    state = vehicle.link.state()
    assert (state.commander, state.present, state.age(time.monotonic_ns())) == ("", False, 0.0)


# --- who may ask what -------------------------------------------------------------------------------------------------


def test_a_viewer_is_refused_but_stop_retreat_and_kill_pass(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    alice, bob = join("alice"), join("bob")
    assert bob.ask(HOLD).text == "Nobody commands: take the lease first."
    assert alice.ask(TakeLease()).text == "alice commands."
    refused = bob.ask(HOLD)
    assert (refused.outcome, refused.text) == (
        Outcome.REFUSED,
        "alice commands, not bob: seize command first, if you must.",
    )
    assert bob.ask(ReleaseLease()).outcome is Outcome.REFUSED
    assert vehicle.asks() == []
    asks: tuple[Ask, ...] = (Stop(), RETREAT, KILL, ShowParams())
    for ask in asks:
        assert bob.ask(ask).outcome is Outcome.DONE
    assert alice.ask(HOLD).outcome is Outcome.DONE
    assert vehicle.asks() == [*asks, HOLD]
    assert [asked.station for asked in vehicle.asked] == ["bob"] * 4 + ["alice"]


def test_command_is_taken_seized_and_released(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    alice, bob = join("alice"), join("bob")
    alice.ask(TakeLease())
    refused = bob.ask(TakeLease())
    assert refused.outcome is Outcome.REFUSED
    assert refused.text.startswith("alice commands; it was heard")
    assert bob.ask(TakeLease(seize=True)).outcome is Outcome.DONE
    assert vehicle.link.state().commander == "bob"
    assert alice.ask(HOLD).outcome is Outcome.REFUSED
    assert vehicle.says("alice commands.")
    assert (Level.INFO, "link: alice commands.") in vehicle.told
    assert (Level.WARNING, "link: bob has seized command from alice.") in vehicle.told
    vehicle.link.tick(FLYING)
    assert bob.ask(ReleaseLease()).text == "The vehicle flies: land first, or let another station seize command."
    vehicle.link.tick(ON_GROUND)
    assert bob.ask(ReleaseLease()).outcome is Outcome.DONE
    assert vehicle.link.state().commander == ""


def test_sessions_of_one_name_command_together(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    window, other = join("alice"), join("alice")
    assert window.ask(TakeLease()).outcome is Outcome.DONE
    assert other.ask(HOLD).outcome is Outcome.DONE
    window.close()
    seconds_until(lambda: vehicle.heard() < 0.5)
    assert vehicle.link.state().present


def test_each_ask_has_its_way(vehicle: Vehicle) -> None:
    with raw(vehicle) as session:
        answer = query(session, Way.SAFETY, encode(Order("1", Arm(), time.monotonic_ns())))
        assert isinstance(answer, Ack)
        assert answer.text == "Arm is to be asked on command, not on safety."
        answer = query(session, Way.VIEW, encode(Order("2", TakeLease(), time.monotonic_ns())))
        assert isinstance(answer, Ack)
        assert answer.outcome is Outcome.REFUSED
    assert vehicle.asked == []
    assert vehicle.link.state().commander == ""


# --- orders -----------------------------------------------------------------------------------------------------------


def test_an_order_that_comes_again_is_answered_again_and_carried_out_once(vehicle: Vehicle) -> None:
    vehicle.answer = lambda asked: asked.done(f"{len(vehicle.asked)}")
    with raw(vehicle) as session:
        first = query(session, Way.SAFETY, encode(Order("1", Stop())))
        again = query(session, Way.SAFETY, encode(Order("1", Stop())))
        others = query(session, Way.SAFETY, encode(Order("1", Stop())), station="other")
        second = query(session, Way.SAFETY, encode(Order("2", Stop())))
    assert first == again == Ack("1", Outcome.DONE, "1")
    assert others == Ack("1", Outcome.DONE, "2")
    assert second == Ack("2", Outcome.DONE, "3")


def test_accepted_and_later_done(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    alice = join("alice")
    vehicle.answer = lambda asked: asked.accepted("stopping")
    answer = alice.ask(Stop())
    assert (answer.outcome, answer.text) == (Outcome.ACCEPTED, "stopping")
    with pytest.raises(NoAnswerError, match=r"x500: it was accepted, but is not done within 0\.1 s"):
        alice.ask(Stop(), timeout=0.1, settled=True)

    def settle(asked: Asked) -> Ack:
        threading.Timer(0.05, lambda: vehicle.link.settle(asked, asked.refused("on the ground"))).start()
        return asked.accepted()

    vehicle.answer = settle
    end = alice.ask(Stop(), timeout=LONG, settled=True)
    assert (end.outcome, end.text) == (Outcome.REFUSED, "on the ground")


def test_who_missed_the_word_of_the_end_may_ask_after_it(vehicle: Vehicle) -> None:
    vehicle.answer = lambda asked: asked.accepted()
    order = encode(Order("1", Stop()))
    with raw(vehicle) as session:
        assert query(session, Way.SAFETY, order) == Ack("1", Outcome.ACCEPTED)
        (asked,) = vehicle.asked
        vehicle.link.settle(asked, asked.done("holding"))
        seconds_until(lambda: query(session, Way.SAFETY, order) == Ack("1", Outcome.DONE, "holding"))
    assert vehicle.asked == [asked]


@pytest.mark.parametrize(
    ("heard", "since"),
    [(lambda now: 0, "never"), (lambda now: now - 3 * 10**9, "3.0 s ago"), (lambda now: now + 10**12, "never")],
    ids=["never", "long ago", "in the future"],
)
def test_an_order_that_may_have_travelled_long_is_refused_unless_it_stops(
    vehicle: Vehicle, heard: Callable[[int], int], since: str
) -> None:
    stamp = heard(time.monotonic_ns())
    with raw(vehicle) as session:
        late = query(session, Way.COMMAND, encode(Order("1", TakeLease(), stamp)))
        assert isinstance(late, Ack)
        assert late.text == (
            f"Too old: raw had last heard the vehicle {since} when it sent this; at most 2 s are allowed."
        )
        anew = query(session, Way.COMMAND, encode(Order("1", TakeLease(), time.monotonic_ns())))
        assert isinstance(anew, Ack)
        assert anew.outcome is Outcome.DONE
        asks: tuple[Ask, ...] = (Stop(), RETREAT, KILL)
        for number, ask in enumerate(asks):
            answer = query(session, Way.SAFETY, encode(Order(f"s{number}", ask, stamp)))
            assert answer == Ack(f"s{number}", Outcome.DONE, "so be it")


def test_what_cannot_be_understood_is_refused_in_words_and_the_next_is_served(vehicle: Vehicle) -> None:
    order = encode(Order("1", Stop()))
    newer = order[:2] + b"\x09" + order[3:]
    with raw(vehicle) as session:
        assert query(session, Way.SAFETY, b"") == "not a message of Pipewright (0 bytes)"
        assert query(session, Way.SAFETY, newer) == (
            "message of version 9, but here version 1 is spoken: update this end"
        )
        assert "not a valid Order" in str(query(session, Way.SAFETY, order[:-3]))
        everybody = Keys("x500").station("raw", "s1", Way.SAFETY).replace("raw", "*")
        assert "'*' is no name of a station" in str(query_key(session, everybody, order))
        session.put(Keys("x500").station("raw", "s1", "pulse"), b"nonsense")
        seconds_until(lambda: vehicle.says("a station's sign of life is not understood: not a message"))
        assert query(session, Way.SAFETY, order) == Ack("1", Outcome.DONE, "so be it")
    assert len(vehicle.asked) == 1


def test_a_fault_in_carrying_out_is_told_to_both_sides(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    def fail(asked: Asked) -> Ack:
        raise KeyError("left")

    alice = join("alice")
    vehicle.answer = fail
    answer = alice.ask(Stop())
    assert (answer.outcome, answer.text) == (Outcome.REFUSED, "failed on the vehicle: KeyError: 'left'")
    assert vehicle.says("an order has failed: KeyError: 'left'")
    vehicle.answer = lambda asked: asked.done()
    assert alice.ask(Stop()).outcome is Outcome.DONE


def test_a_flood_is_kept_from_the_vehicle_and_keeps_no_stop_from_it(
    vehicle: Vehicle, join: Callable[..., Client]
) -> None:
    alice = join("alice")
    key = Keys("x500").station("mallory", "s1", Way.SAFETY)
    sent, ended = 0, threading.Event()

    def flood(session: zenoh.Session) -> None:
        nonlocal sent
        while not ended.is_set():
            sent += 1
            payload = encode(Order(f"m{sent}", Stop())) if sent % 2 else b"x" * 1000
            session.get(key, lambda reply: None, payload=payload, timeout=1.0)
            pause(0.0005)

    with raw(vehicle) as session:
        flooding = threading.Thread(target=flood, args=(session,))
        began = time.monotonic()
        flooding.start()
        try:
            seconds_until(lambda: sent > 100)
            answers = [alice.ask(Stop(), timeout=LONG) for _ in range(20)]
            seconds_until(lambda: sent > 1000)
        finally:
            ended.set()
            flooding.join()
        seconds = time.monotonic() - began
    assert [answer.outcome for answer in answers] == [Outcome.DONE] * 20
    stations = [asked.station for asked in vehicle.asked]
    assert stations.count("alice") == 20
    assert 0 < stations.count("mallory") <= 100 * seconds + 1


def test_what_is_too_large_never_arrives(vehicle: Vehicle) -> None:
    order, key = encode(Order("1", Stop())), Keys("x500").station("raw", "s1", Way.SAFETY)
    with raw(vehicle) as session:
        for _ in range(5):
            assert query_once(session, key, order + b"x" * 20_000) is None
            pause(0.02)
        assert query(session, Way.SAFETY, order) == Ack("1", Outcome.DONE, "so be it")


# --- what goes wrong between ------------------------------------------------------------------------------------------


def test_a_link_that_is_cut_is_told_and_nothing_is_lost_for_good(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    with Relay(int(vehicle.settings.listen[0].rpartition(":")[2])) as relay:
        alice, bob = join("alice", relay.port), join("bob")
        alice.ask(TakeLease())
        seconds_until(lambda: vehicle.link.state().present)
        relay.cut()
        began = time.monotonic()
        seconds_until(lambda: vehicle.says("the commanding station alice is"))
        seconds_until(lambda: not vehicle.link.state().present)
        assert alice.wait(lambda contact: not contact.present and contact.age > 1.0, LONG)
        seconds_until(lambda: vehicle.heard() > 1.0)
        assert vehicle.heard() <= time.monotonic() - began + 1.0
        with pytest.raises(NoVehicleError, match=r"x500 has gone: no answer within 0\.2 s"):
            alice.ask(Stop(), timeout=0.2)
        assert bob.ask(Stop()).outcome is Outcome.DONE, "the others are still there"
        assert vehicle.link.state().commander == "alice", "silence takes nothing away"
        relay.mend()
        seconds_until(lambda: vehicle.says("alice is back after"))
        seconds_until(lambda: vehicle.heard() < 0.5)
        assert alice.wait(lambda contact: contact.present and contact.age < 0.5, LONG)
        assert alice.ask(HOLD).outcome is Outcome.DONE
        relay.cut()  # what still waits in it is not to be told to anybody
        alice.close()


def test_a_stop_that_is_asked_while_the_link_is_cut_arrives_when_it_is_back(
    vehicle: Vehicle, join: Callable[..., Client]
) -> None:
    with Relay(int(vehicle.settings.listen[0].rpartition(":")[2])) as relay:
        alice = join("alice", relay.port)
        relay.cut()
        assert alice.wait(lambda contact: not contact.present, LONG)
        answers: list[Ack] = []
        asking = threading.Thread(target=lambda: answers.append(alice.ask(Stop(), timeout=LONG)))
        asking.start()
        relay.mend()
        asking.join()
        alice.close()
    assert [answer.outcome for answer in answers] == [Outcome.DONE]
    assert vehicle.asks() == [Stop()]


def test_what_comes_steadily_but_late_is_known_to_be_old(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    late = 0.4
    with Relay(int(vehicle.settings.listen[0].rpartition(":")[2]), late) as relay:
        alice = join("alice", relay.port)
        assert alice.contact().round_trip > 2 * late
        assert alice.ask(TakeLease(), timeout=LONG).outcome is Outcome.DONE
        assert alice.ask(Stop(), timeout=LONG).outcome is Outcome.DONE
        assert vehicle.asks() == [Stop()], "it was repeated before the first answer could come"
        for _ in range(20):
            assert alice.contact().age > 2 * late
            assert vehicle.heard() > 2 * late
            pause(0.01)
        alice.close()


def test_the_vehicle_goes_and_comes_back(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    alice = join("alice")
    vehicle.link.stop()
    assert alice.wait(lambda contact: not contact.present, LONG)
    with pytest.raises(NoVehicleError):
        alice.ask(Stop(), timeout=0.2)
    again = Vehicle(vehicle.settings)
    again.link.start()
    try:
        assert alice.wait(lambda contact: contact.present and contact.age < 0.5, LONG)
        assert alice.ask(Go(Phase.TARE)).outcome is Outcome.REFUSED
        assert alice.ask(TakeLease()).outcome is Outcome.DONE
        assert alice.ask(Go(Phase.TARE)).outcome is Outcome.DONE
        assert again.asks() == [Go(Phase.TARE)]
    finally:
        again.link.stop()


def test_nothing_is_left_when_both_ends_have_closed(vehicle: Vehicle) -> None:
    before = set(threading.enumerate())
    for _ in range(3):
        with Client(settings(vehicle, "alice"), timeout=LONG) as alice:
            assert alice.ask(Stop()).outcome is Outcome.DONE
    seconds_until(lambda: set(threading.enumerate()) <= before)
    seconds_until(lambda: vehicle.link._sessions.heard(time.monotonic_ns()) == ())
    vehicle.link.stop()
    vehicle.link.stop()
    seconds_until(lambda: not any(thread.name.startswith("link.") for thread in threading.enumerate()))
    vehicle.link.event(event("too late"))
    vehicle.link.tick(FLYING)
    assert vehicle.link.dropped == 1


def test_a_commander_that_is_connected_but_says_nothing_is_told(vehicle: Vehicle) -> None:
    with raw(vehicle) as session:
        token = session.liveliness().declare_token(Keys("x500").station("raw", "s1", "alive"))
        query(session, Way.COMMAND, encode(Order("1", TakeLease(), time.monotonic_ns())))
        seconds_until(lambda: vehicle.says("link: the commanding station raw is silent for"))
        assert vehicle.link.state().present
        assert vehicle.heard() > vehicle.settings.silence
        token.undeclare()
    seconds_until(lambda: not vehicle.link.state().present)


def test_a_station_of_too_many_sessions_is_told_and_not_kept_track_of(vehicle: Vehicle) -> None:
    with raw(vehicle) as session:
        for i in range(MOST_OF_ONE + 1):
            session.put(Keys("x500").station("raw", f"s{i}", "pulse"), encode(StationPulse(1)))
            pause(0.02)  # else the vehicle takes them for a flood
        seconds_until(lambda: vehicle.says("too many sessions of stations: raw is not kept track of"))
        assert len(vehicle.link._sessions.heard(time.monotonic_ns())) == MOST_OF_ONE


# --- what cannot be ---------------------------------------------------------------------------------------------------


def test_a_port_that_is_taken(vehicle: Vehicle) -> None:
    with pytest.raises(LinkError, match="Address already in use"):
        Link(vehicle.settings, vehicle.hear).start()


def test_plain_endpoints_must_be_allowed(vehicle: Vehicle) -> None:
    with pytest.raises(LinkError, match="is plain, which is not allowed here"):
        Link(replace(vehicle.settings, plain=False), vehicle.hear).start()
    with pytest.raises(LinkError, match="is plain, which is not allowed here"):
        Client(replace(settings(vehicle, "alice"), plain=False))


def test_nobody_answers() -> None:
    with pytest.raises(
        NoVehicleError, match=r"nothing lets us in at tcp/127\.0\.0\.1:\d+ within 0\.3 s: is the vehicle on\?"
    ):
        Client(StationSettings("x500", (f"tcp/127.0.0.1:{free_port()}",), plain=True), timeout=0.3)


def test_another_vehicle_answers(vehicle: Vehicle) -> None:
    with pytest.raises(NoVehicleError, match=r"no vehicle 'x600' at .*; there: x500"):
        Client(replace(settings(vehicle, "alice"), vehicle="x600"), timeout=0.5)


@pytest.mark.parametrize("wrong", [{"vehicle": "X 500"}, {"station": "Al/ice"}])
def test_names_that_cannot_be(vehicle: Vehicle, wrong: dict[str, str]) -> None:
    with pytest.raises(LinkError, match="is no name of a"):
        Client(replace(settings(vehicle, "alice"), **wrong))


def test_opened_anew_all_come_again_and_who_commands_goes_on(vehicle: Vehicle, join: Callable[..., Client]) -> None:
    alice = join("alice")
    assert alice.ask(TakeLease()).outcome is Outcome.DONE
    vehicle.link.reopen(None)
    assert vehicle.link.state().commander == "alice"
    seconds_until(lambda: vehicle.link.state().present)

    def heard() -> bool:
        vehicle.link.event(event("anew"))
        return any(told.event.text == "anew" for told in alice.events)

    seconds_until(heard)
    assert alice.ask(Mission(Request.HOLD), timeout=LONG).outcome is not Outcome.REFUSED


def test_a_vehicle_of_another_version_is_told(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    session = vehicle.link._session
    assert session is not None
    monkeypatch.setattr(
        vehicle.link, "_publish", lambda key, message, how: session.put(key, b"PW\x02" + encode(message)[3:])
    )
    with pytest.raises(NoVehicleError, match=r"x500 at .* is not understood: message of version 2"):
        Client(settings(vehicle, "alice"), timeout=1.0)


def test_a_station_without_a_name_is_called_after_user_and_machine(vehicle: Vehicle) -> None:
    with Client(settings(vehicle, ""), timeout=LONG) as station:
        assert Keys("x500").ack(station.station)
        assert not math.isinf(station.contact().age)


def test_settings_are_parameters_as_all_others() -> None:
    values = {"vehicle": "x600", "listen": ["tls/0.0.0.0:7447"], "telemetry_rate": 10.0}
    assert load(LinkSettings, values, "here") == LinkSettings("x600", ("tls/0.0.0.0:7447",), telemetry_rate=10.0)
    with pytest.raises(ConfigError) as caught:
        load(LinkSettings, {"vehicle": "X 600", "peer_lease": 0.01, "speed": 3}, "here")
    assert len(caught.value.errors) == 3
    assert all(parameter.doc and not parameter.in_flight for parameter in describe(LinkSettings))


# --- with certificates ------------------------------------------------------------------------------------------------


def test_operator_viewer_and_stranger_with_certificates(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "authority", x500=Role.VEHICLE, alice=Role.OPERATOR, victor=Role.VIEWER)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    admission = vehicle_security("x500", fleet["x500"], fleet.authority.roster)
    link = Link(LinkSettings("x500", (endpoint,)), lambda asked: asked.done(asked.station), admission)

    def station(holder: str, name: str, timeout: float = LONG) -> Client:
        certificate = station_security("x500", fleet[holder])
        return Client(StationSettings("x500", (endpoint,), name), timeout=timeout, security=certificate)

    link.start()
    try:
        with station("alice", "alice") as alice, station("victor", "victor") as victor:
            assert alice.ask(TakeLease()).outcome is Outcome.DONE
            assert alice.ask(HOLD).text == "alice"
            assert victor.ask(Stop()).text == "victor"
            with pytest.raises(NoAnswerError):
                victor.ask(TakeLease(seize=True), timeout=0.3)
            link.tick(FLYING)
            seconds_until(lambda: newest(alice) == newest(victor) == FLYING)
            assert link.state().commander == "alice"
        with pytest.raises(NoVehicleError, match="does not hear this station: is alice admitted"):
            station("victor", "alice", timeout=0.5)
        plain = endpoint.replace("tls", "tcp")
        with pytest.raises(NoVehicleError):
            Client(StationSettings("x500", (plain,), "alice", plain=True), timeout=0.5)
    finally:
        link.stop()
