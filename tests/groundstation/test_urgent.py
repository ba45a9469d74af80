"""Stop and kill over several connections: over loopback, and where some of them stand still."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from groundstation.client import NoAnswerError, StationSettings
from groundstation.urgent import CONNECTIONS, Urgent
from onboard.core.types import Request
from onboard.endpoints import LinkError, NoVehicleError
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.wire import Ack, Mission, Outcome, Stop, Tare
from tests.onboard.relay import Relay
from tests.waiting import LONG, pause, seconds_until
from tests.zenoh_sessions import free_port

KILL = Mission(Request.KILL)


class Vehicle:
    """A link that notes what is asked of it."""

    def __init__(self, lease: float = 2.0) -> None:
        self.port = free_port()
        self.asked: list[Asked] = []
        self.answer: Callable[[Asked], Ack] = lambda asked: asked.done("so be it")
        listen = (f"tcp/127.0.0.1:{self.port}",)
        self.link = Link(LinkSettings(vehicle="x500", listen=listen, plain=True, peer_lease=lease), self._hear)

    def _hear(self, asked: Asked) -> Ack:
        self.asked.append(asked)
        return self.answer(asked)


@pytest.fixture
def vehicle() -> Iterator[Vehicle]:
    vehicle = Vehicle()
    vehicle.link.start()
    yield vehicle
    vehicle.link.stop()


@pytest.fixture
def patient() -> Iterator[Vehicle]:
    """One that gives a silent connection up after ten seconds only."""
    vehicle = Vehicle(10.0)
    vehicle.link.start()
    yield vehicle
    vehicle.link.stop()


def station(port: int, name: str = "anna") -> StationSettings:
    return StationSettings("x500", (f"tcp/127.0.0.1:{port}",), name, plain=True)


def test_what_comes_several_times_is_carried_out_once(vehicle: Vehicle) -> None:
    with Urgent(station(vehicle.port)) as urgent:
        seconds_until(lambda: urgent.connections == CONNECTIONS)
        for count in range(1, 11):
            assert urgent.ask(KILL, timeout=LONG).text == "so be it"
            pause(0.02)
            assert len(vehicle.asked) == count
        assert urgent.ask(Stop(), timeout=LONG).outcome is Outcome.DONE
    assert [asked.ask for asked in vehicle.asked] == [KILL] * 10 + [Stop()]
    assert {asked.station for asked in vehicle.asked} == {"anna"}


def test_connections_that_stand_still_do_not_matter(vehicle: Vehicle) -> None:
    with Relay(vehicle.port) as relay, Urgent(station(relay.port)) as urgent:
        seconds_until(lambda: urgent.connections == CONNECTIONS)
        assert urgent.ask(Stop(), timeout=LONG).outcome is Outcome.DONE  # all are known to the vehicle
        relay.hold(CONNECTIONS - 1)
        began = time.monotonic()
        assert urgent.ask(KILL, timeout=LONG).outcome is Outcome.DONE
        assert time.monotonic() - began < 1.5  # Zenoh gives the others up after 2 s
        assert [asked.ask for asked in vehicle.asked] == [Stop(), KILL]


def test_when_all_stand_still_another_is_made(patient: Vehicle) -> None:
    """As TCP does for a while after the network was cut and has come back."""
    with Relay(patient.port) as relay, Urgent(station(relay.port)) as urgent:
        seconds_until(lambda: urgent.connections == CONNECTIONS)
        relay.hold(CONNECTIONS)
        began = time.monotonic()
        assert urgent.ask(KILL, timeout=LONG).outcome is Outcome.DONE
        assert time.monotonic() - began < 4.0
        assert len(patient.asked) == 1
        assert urgent.ask(Stop(), timeout=LONG).outcome is Outcome.DONE
        assert urgent.connections == CONNECTIONS + 1


def test_an_order_waits_for_no_other_connection(vehicle: Vehicle) -> None:
    """The first order of a command, while its connections are still being made."""
    with Urgent(station(vehicle.port)) as urgent:
        assert urgent.ask(KILL, timeout=LONG).outcome is Outcome.DONE


def test_an_order_leaves_when_the_vehicle_comes() -> None:
    vehicle = Vehicle()
    with Urgent(station(vehicle.port)) as urgent, ThreadPoolExecutor(1) as pool:
        answer = pool.submit(urgent.ask, KILL, timeout=LONG)
        pause(0.3)
        assert not answer.done()
        vehicle.link.start()
        try:
            assert answer.result(LONG).outcome is Outcome.DONE
        finally:
            vehicle.link.stop()
    assert [asked.ask for asked in vehicle.asked] == [KILL]


def test_what_became_of_it(vehicle: Vehicle) -> None:
    vehicle.answer = lambda asked: asked.accepted("on its way")
    with Urgent(station(vehicle.port)) as urgent, ThreadPoolExecutor(1) as pool:
        assert urgent.ask(Stop(), timeout=LONG).text == "on its way"
        end = pool.submit(urgent.ask, Stop(), timeout=LONG, settled=True)
        seconds_until(lambda: len(vehicle.asked) == 2)
        asked = vehicle.asked[1]
        vehicle.link.settle(asked, asked.done("it holds"))
        assert end.result(LONG).text == "it holds"
        with pytest.raises(NoAnswerError, match=r"x500: it was accepted, but is not done within 0\.4 s"):
            urgent.ask(Stop(), timeout=0.4, settled=True)


def test_no_answer(vehicle: Vehicle) -> None:
    with Relay(vehicle.port) as relay, Urgent(station(relay.port)) as urgent:
        seconds_until(lambda: urgent.connections == CONNECTIONS)
        relay.cut()
        with pytest.raises(NoAnswerError, match=r"x500: no answer within 0\.5 s"):
            urgent.ask(KILL, timeout=0.5)
        relay.mend()


def test_another_vehicle(vehicle: Vehicle) -> None:
    other = StationSettings("x501", (f"tcp/127.0.0.1:{vehicle.port}",), "anna", plain=True)
    with Urgent(other) as urgent, pytest.raises(NoVehicleError, match="takes orders for x501 from anna: is that"):
        urgent.ask(KILL, timeout=2.0)


def test_nobody_there() -> None:
    with Urgent(station(free_port())) as urgent, pytest.raises(NoVehicleError, match="is the vehicle on"):
        urgent.ask(KILL, timeout=7.0)


def test_settings_that_cannot_be(vehicle: Vehicle) -> None:
    far = StationSettings("x500", ("tcp/10.0.0.1:7447",), plain=True)
    with Urgent(far) as urgent, pytest.raises(LinkError, match="plain TCP is only for loopback"):
        urgent.ask(KILL)
    with pytest.raises(LinkError, match="'Anna' is no name of a station"):
        Urgent(station(vehicle.port, "Anna"))


def test_only_what_is_urgent(vehicle: Vehicle) -> None:
    with Urgent(station(vehicle.port)) as urgent, pytest.raises(ValueError, match=r"Tare.* is not urgent"):
        urgent.ask(Tare())
