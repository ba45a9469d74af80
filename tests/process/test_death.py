"""The flight process hangs or dies: nothing leaves after its last tick, the autopilot lands, the servos let go."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.process.flying import Flying, flying

#: COM_OF_LOSS_T, and what may come on top of it, s.
LOSS, MARGIN = 0.5, 0.2
SET_POINT = "SET_ATTITUDE_TARGET"


def stop(flight: Flying) -> None:
    flight.signal(signal.SIGSTOP)


def kill(flight: Flying) -> None:
    flight.signal(signal.SIGKILL)


def stick(flight: Flying) -> None:
    """An endless loop in the interpreter, the global lock held: what a fault in our own code would look like."""
    flight.ask("stick")


WAYS = {"stopped": stop, "killed": kill}


@pytest.mark.parametrize("where", ["hover", "press"])
@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_the_vehicle_ends_on_the_ground(tmp_path: Path, way: Callable[[Flying], None], where: str) -> None:
    with flying(tmp_path) as flight:
        if where == "hover":
            flight.take_off()
        else:
            flight.press()
        way(flight)
        last = flight.silent_since(SET_POINT)
        failsafe = flight.wait("failsafe", lambda look: look.mode == "land", since=last)
        assert (failsafe.t_ns - last.t_ns) * 1e-9 < LOSS + MARGIN
        down = flight.ended_safely()
        assert down.received[SET_POINT] == last.received[SET_POINT]
        assert not down.torque_on or where == "hover"
