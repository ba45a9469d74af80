"""A station, and a vehicle, in a process of its own that freezes or dies: noticed at the other end within a second."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from groundstation.client import Client, StationSettings
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.wire import Ack, Outcome, Stop, TakeLease
from tests.waiting import LONG, seconds_until
from tests.zenoh_sessions import free_port

#: How soon a peer that is frozen or dead is noticed, s; and how often that is tried, for a busy machine may be late.
SOON, TIMES = 1.0, 3
_STATION = """
import sys, time
from groundstation.client import Client, StationSettings
from onboard.wire import TakeLease
with Client(StationSettings("x500", (sys.argv[1],), "alice", plain=True), timeout=60.0) as client:
    print(client.ask(TakeLease()).text, flush=True)
    sys.stdin.read()
"""
_VEHICLE = """
import sys
from onboard.link import Link
from onboard.link_settings import LinkSettings
link = Link(LinkSettings(vehicle="x500", listen=(sys.argv[1],), plain=True), lambda asked: asked.done("so be it"))
link.start()
print("here", flush=True)
sys.stdin.read()
link.stop()
"""


@contextmanager
def process(script: str, endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """Another process, from when it says that it is there."""
    command = [sys.executable, "-c", script, endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as peer:
        try:
            assert peer.stdout is not None
            assert peer.stdout.readline().strip() in ("here", "alice commands.")
            yield peer
        finally:
            peer.kill()


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def link(endpoint: str) -> Iterator[Link]:
    def answer(asked: Asked) -> Ack:
        return asked.done()

    link = Link(LinkSettings(vehicle="x500", listen=(endpoint,), plain=True), answer)
    link.start()
    yield link
    link.stop()


def test_a_station_that_freezes_thaws_and_dies(link: Link, endpoint: str) -> None:
    with process(_STATION, endpoint) as station:
        seconds_until(lambda: link.state().present)
        link.notices()
        took = []
        for _ in range(TIMES):
            station.send_signal(signal.SIGSTOP)
            took.append(seconds_until(lambda: any("alice is silent" in notice.text for notice in link.notices())))
            seconds_until(lambda: not link.state().present)
            assert link.state().commander == "alice"
            station.send_signal(signal.SIGCONT)
            seconds_until(lambda: link.state().present and link.state().age(time.monotonic_ns()) < 0.5)
            seconds_until(lambda: any("alice is back" in notice.text for notice in link.notices()))
        assert min(took) < SOON
        station.send_signal(signal.SIGKILL)
        assert seconds_until(lambda: not link.state().present) < SOON
        with Client(StationSettings("x500", (endpoint,), "bob", plain=True), timeout=LONG) as bob:
            assert bob.ask(Stop()).outcome is Outcome.DONE
            assert bob.ask(TakeLease()).outcome is Outcome.REFUSED
            assert bob.ask(TakeLease(seize=True)).outcome is Outcome.DONE


def test_a_station_that_ends_in_order(link: Link, endpoint: str) -> None:
    with process(_STATION, endpoint) as station:
        assert station.stdin is not None
        station.stdin.close()
        assert station.wait(LONG) == 0
        seconds_until(lambda: not link.state().present)


def test_a_vehicle_that_freezes_thaws_and_dies(endpoint: str) -> None:
    with (
        process(_VEHICLE, endpoint) as vehicle,
        Client(StationSettings("x500", (endpoint,), "alice", plain=True), timeout=LONG) as alice,
    ):
        took = []
        for _ in range(TIMES):
            vehicle.send_signal(signal.SIGSTOP)
            took.append(seconds_until(lambda: alice.contact().age > 0.8))
            seconds_until(lambda: not alice.contact().present)
            vehicle.send_signal(signal.SIGCONT)
            assert alice.wait(lambda contact: contact.present and contact.age < 0.5, LONG)
        assert min(took) < SOON
        assert alice.ask(Stop(), timeout=LONG).text == "so be it"
        vehicle.send_signal(signal.SIGKILL)
        assert seconds_until(lambda: not alice.contact().present) < SOON


def test_a_vehicle_that_ends_in_order(endpoint: str) -> None:
    with process(_VEHICLE, endpoint) as vehicle:
        assert vehicle.stdin is not None
        vehicle.stdin.close()
        assert vehicle.wait(LONG) == 0
