"""The moments at which the stories begin, flown to once per process."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest

from onboard.config import load_config
from onboard.core.types import Phase, Request
from tests.stories.flight import Flight

#: Name, phase, and time in it: the moments of one flight, in their order.
MOMENTS = (
    ("spool", Phase.TAKEOFF, 0.3),
    ("takeoff", Phase.TAKEOFF, 4.0),
    ("approach", Phase.APPROACH, 2.0),
    ("align", Phase.ALIGN, 0.5),
    ("adhesive", Phase.ADHESIVE, 8.0),
    ("advance", Phase.ADVANCE, 2.0),
    ("press", Phase.PRESS, 8.5),
    ("release", Phase.RELEASE, 0.08),
    ("retreat", Phase.RETREAT, 1.0),
    ("landing", Phase.LAND, 1.5),
)
#: The paper's mission with a short hold; PIPEWRIGHT_PLANT=pybullet tells all stories in that world.
SETS = ("repair.hold=2.0", f"world.plant.kind={os.environ.get('PIPEWRIGHT_PLANT', 'rigid')}")

At = Callable[[str], Flight]


class Log:
    """One flight, and a copy of it at every moment that has been asked for."""

    def __init__(self) -> None:
        self._flight = Flight(load_config("paper", sets=SETS))
        self._flight.run(0.4).tick(Request.START)
        self._left = list(MOMENTS)
        self._kept: dict[str, Flight] = {}

    def at(self, name: str) -> Flight:
        """A flight of its own that begins at the moment of that name."""
        while name not in self._kept:
            next_name, phase, time = self._left[0]
            flight = self._flight
            flight.until(lambda o, phase=phase, time=time: o.phase is phase and o.phase_time >= time, 60.0)  # type: ignore[misc]
            self._kept[next_name] = flight.copy()
            del self._left[0]
        return self._kept[name].copy()


@pytest.fixture(scope="session")
def at() -> At:
    """``at(name)``: a flight that begins at that moment of ``MOMENTS``."""
    return Log().at


@pytest.fixture
def ground() -> Flight:
    """On the ground, preflight passed."""
    return Flight(load_config("paper", sets=SETS)).run(0.4)


@pytest.fixture(scope="session")
def _hover() -> Flight:
    flight = Flight(load_config("paper", sets=SETS)).run(0.4)
    flight.tick(Request.TAKEOFF)
    return flight.until(lambda outputs: outputs.phase is Phase.HOLD, 20.0).run(1.0)


@pytest.fixture
def hover(_hover: Flight) -> Flight:
    """Hovering after a takeoff that was all that was asked for."""
    return _hover.copy()
