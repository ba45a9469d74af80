"""Stop and kill from a station while the loop of the flight process is stuck, in flight."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from msgspec.structs import replace

from groundstation.client import Client, StationSettings
from groundstation.urgent import Urgent
from onboard.core.types import Request
from onboard.wire import Mission, Outcome, Stop
from tests.process.flying import flying
from tests.realtime import REALTIME
from tests.waiting import seconds_until
from tests.zenoh_sessions import free_port

pytestmark = REALTIME

#: COM_OF_LOSS_T, after which PX4 lands by itself, s.
LOSS = 0.5
#: From the order to what comes of it in the world, s: well before the failsafe.
SOON = 0.3
PATIENCE = 20.0


def station(port: int) -> StationSettings:
    return StationSettings(connect=(f"tcp/127.0.0.1:{port}",), station="anna", plain=True)


def known(urgent: Urgent) -> None:
    """The vehicle has answered over these connections, and its loop has taken part: clear of the pipe, it refuses."""
    assert urgent.ask(Mission(Request.RETREAT), timeout=PATIENCE, settled=True).outcome is Outcome.REFUSED


def test_a_kill_with_the_loop_stuck(tmp_path: Path) -> None:
    """The thread of the loop spins in Python; the motors stop in the air, and the joints let go."""
    port = free_port()
    with flying(tmp_path, f"link.listen=[tcp/127.0.0.1:{port}]") as flight, Urgent(station(port)) as urgent:
        flight.hover()
        # all connections are known to the vehicle, and the order that follows is the first that finds the loop stuck
        known(urgent)
        flight.signal(signal.SIGUSR1)
        before = flight.look()
        asked = time.monotonic_ns()
        urgent.ask(Mission(Request.KILL), timeout=PATIENCE)
        cut = flight.wait("motors cut", lambda look: not look.armed, since=before)
        assert not cut.truth.on_ground
        assert (cut.t_ns - asked) * 1e-9 < SOON
        limp = flight.wait("joints that let go", lambda look: not any(look.truth.servo_current), since=before)
        assert (limp.t_ns - asked) * 1e-9 < SOON
        flight.signal(signal.SIGKILL)  # nothing else would end what spins


def test_a_stop_with_the_loop_stuck(tmp_path: Path) -> None:
    """The autopilot lands when it is told to, and not only when it has missed the set-points for long enough."""
    port = free_port()
    with (
        flying(tmp_path, f"link.listen=[tcp/127.0.0.1:{port}]") as flight,
        Urgent(station(port)) as urgent,
        Client(replace(station(port), station="bob"), timeout=PATIENCE) as bob,
    ):
        flight.hover()
        known(urgent)
        flight.signal(signal.SIGUSR1)
        before = flight.look()
        asked = time.monotonic_ns()
        urgent.ask(Stop(), timeout=PATIENCE)
        lands = flight.wait("a landing", lambda look: look.mode == "land", since=before)
        assert (lands.t_ns - asked) * 1e-9 < LOSS - 0.1
        seconds_until(lambda: any("has made no tick" in told.event.text for told in bob.events))
        flight.ended_safely()
        flight.signal(signal.SIGKILL)
