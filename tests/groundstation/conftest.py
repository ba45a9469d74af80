"""A vehicle for the commands of a station, and one who commands it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from groundstation import station
from groundstation.client import Client, StationSettings
from onboard.wire import TakeLease
from tests.groundstation.craft import Craft, craft
from tests.waiting import LONG


@pytest.fixture
def vehicle(monkeypatch: pytest.MonkeyPatch) -> Iterator[Craft]:
    """Reached by the commands without an option, and without keys."""
    with craft() as flying:
        monkeypatch.setenv(station.CONNECT, flying.endpoint)
        monkeypatch.setenv(station.VEHICLE, "x500")
        monkeypatch.delenv(station.KEYS, raising=False)
        yield flying


@pytest.fixture
def commanding(vehicle: Craft) -> Iterator[Client]:
    """Somebody of the name alice has the lease and stays."""
    with Client(StationSettings("x500", (vehicle.endpoint,), "alice", plain=True), timeout=LONG) as client:
        client.ask(TakeLease())
        yield client
