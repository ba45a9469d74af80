"""One vehicle with certificates, two who may command it, one who may watch, and some who may not: in one flight.

``PIPEWRIGHT_FLOOD=600`` floods it for so many seconds.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from msgspec import Struct

from groundstation.authority import Authority
from groundstation.client import Client, StationSettings
from onboard.admission import station_security
from onboard.core.types import Request
from onboard.identity import load_identity
from onboard.logfile import LogReader
from onboard.messages import Role
from onboard.records import TICK, TIMING, Timing
from onboard.wire import Outcome, Stop
from tests.link.terminals import TIMEOUT, Desk, Keeper, Terminal, desk
from tests.realtime import REALTIME
from tests.waiting import LONG, pause

pytestmark = REALTIME

VEHICLE = "falcon"
#: To look for a vehicle that is not shown, s.
IN_VAIN = 3.0
#: s, of the flood; and of the calm before it.
FLOOD = float(os.environ.get("PIPEWRIGHT_FLOOD", "10"))
CALM = min(FLOOD, 60.0)
#: A hover may last, and so may the battery.
PATIENT = ("mission.hold_timeout=3600", "vehicle.battery.capacity=100")
#: For a stop to be answered by the mission, in the flood, s.
ANSWERED = 1.0
#: A tick that comes this much later than without the flood is no matter of the flood, s: a sleep is not more exact.
EXACT = 0.001


class Aviary(Struct):
    """The desk, and who holds which keys."""

    desk: Desk
    folder: Path

    def keys(self, name: str) -> Path:
        """The folder that was handed to somebody."""
        return self.folder / ("others" if name == "mallory" else "authority") / name

    def __getitem__(self, name: str) -> Terminal:
        timeout = IN_VAIN if name == "mallory" else TIMEOUT
        return self.desk.terminal(f"--vehicle={VEHICLE}", f"--keys={self.keys(name)}", timeout=timeout)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Aviary]:
    folder = tmp_path_factory.mktemp("admitted")
    authority = Authority.init(folder / "authority")
    authority.add(VEHICLE, Role.VEHICLE)
    for name, role in (("alice", Role.OPERATOR), ("bob", Role.OPERATOR), ("victor", Role.VIEWER)):
        authority.add(name, role)
    Authority.init(folder / "others").add("mallory", Role.OPERATOR)
    keys = folder / "authority" / VEHICLE
    (keys / "roster.json").write_bytes((folder / "authority" / "roster.json").read_bytes())
    with desk(
        folder, f"link.vehicle={VEHICLE}", f"link.keys={keys}", "devices.servos.kind=mock", *PATIENT, tls=True
    ) as waiting:
        yield Aviary(waiting, folder)


def test_who_is_not_admitted_sees_nothing_and_is_told_why(flown: Aviary) -> None:
    wrong = flown["mallory"]("status", code=5)
    assert "certificate" in wrong.err
    assert "phase" not in wrong.out
    plain = f"--connect={flown.desk.endpoint.replace('tls/', 'tcp/')}"
    nothing = Terminal(flown.folder, plain, "--plain", f"--vehicle={VEHICLE}", timeout=IN_VAIN)("status", code=5)
    assert "the vehicle wants certificates: connect to tls/" in nothing.err
    assert "phase" not in nothing.out
    assert flown["victor"]("status").json["phase"] == "preflight"
    refused = flown["victor"]("lease", "take", "--seize", code=3)
    assert "victor is a viewer: for this an operator's certificate is needed" in refused.err


def test_one_commands_another_seizes_and_anyone_stops(flown: Aviary) -> None:
    alice, bob, victor = flown["alice"], flown["bob"], flown["victor"]
    with Keeper(alice) as first:
        assert "alice commands" in bob("lease", "take", code=3).err
        alice.insist("takeoff", "--wait")
        assert "alice commands, not bob" in bob("land", code=3).err
        with Keeper(bob, "--seize") as second:
            assert "bob has taken command" in first.running.end().err
            assert "bob commands, not alice" in alice("land", code=3).err
            assert "operator's certificate" in victor("land", code=3).err
            seen = len(second.phases())
            bob("start")
            second.until("approach", seen)
            assert victor("stop", "--wait").json["phase"] == "hold"
            assert victor("stop", "--wait").json["phase"] == "stopped"
            bob("reset")


def test_a_flood_drops_no_stop_and_makes_no_tick_late(flown: Aviary) -> None:
    bob = flown["bob"]
    with Keeper(bob) as kept:
        bob.insist("takeoff", "--wait")
        with viewer(flown) as victor:
            began = time.monotonic_ns()
            pause(CALM)
            with flood(flown) as flooder:
                flooded = time.monotonic_ns()
                pause(FLOOD)
                asked, answers, slowest = 0, [], 0.0
                while "stopped" not in kept.phases() or asked < 30:
                    asked += 1
                    before = time.monotonic()
                    answers.append(victor.ask(Stop(), timeout=LONG, settled=True))
                    slowest = max(slowest, time.monotonic() - before)
                    pause(0.05)
                over = time.monotonic_ns()
                out, _ = flooder.communicate(timeout=LONG)
        bob("reset")
    sent = int(out.split()[-1])
    assert sent > 100 * FLOOD
    assert answers[0].outcome is Outcome.DONE
    assert slowest < ANSWERED
    idle, busy = late(flown.desk.log, began, flooded), late(flown.desk.log, flooded, over)
    told = f"{sent} messages; late p99 {idle[0]:.4f} s and {busy[0]:.4f} s, max {idle[1]:.4f} s and {busy[1]:.4f} s"
    assert busy[0] < 2.0 * idle[0] + EXACT, told
    assert stops(flown.desk.log, flooded) == asked, told


@contextmanager
def viewer(flown: Aviary) -> Iterator[Client]:
    """Another session of the one who floods."""
    security = station_security(VEHICLE, load_identity(flown.keys("victor")))
    settings = StationSettings(VEHICLE, (flown.desk.endpoint,), "victor")
    with Client(settings, timeout=LONG, security=security) as client:
        yield client


@contextmanager
def flood(flown: Aviary) -> Iterator[subprocess.Popen[str]]:
    """From when it floods; it has less of the processor than what flies, as a machine elsewhere has none of it."""
    command = [sys.executable, "-m", "tests.link.flood", str(flown.keys("victor")), VEHICLE, flown.desk.endpoint]
    root = Path(__file__).parents[2]
    with subprocess.Popen(
        command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.nice(19)
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "flooding\n"
            yield process
        finally:
            process.kill()


def late(log: Path, begin_ns: int, end_ns: int) -> tuple[float, float]:
    """How late the ticks of a time were, s: all but one of a hundred, and all."""
    with LogReader(log, partial=True) as reader:
        found = sorted(timing.late for timing in reader.one(TIMING, Timing) if begin_ns <= timing.t_ns < end_ns)
    assert len(found) > 0.8 * 250 * (end_ns - begin_ns) * 1e-9 - 250
    return found[int(0.99 * len(found))], found[-1]


class _Inputs(Struct):
    t_ns: int
    request: Request | None


class _Tick(Struct):
    inputs: _Inputs


def stops(log: Path, begin_ns: int) -> int:
    """How many reached the mission."""
    with LogReader(log, partial=True) as reader:
        ticks = [tick.inputs for tick in reader.one(TICK, _Tick)]
    return sum(inputs.request is Request.STOP and inputs.t_ns >= begin_ns for inputs in ticks)
