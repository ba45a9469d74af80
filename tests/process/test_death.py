"""The flight process hangs or dies: nothing leaves after its last tick, the autopilot lands, the servos let go."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from onboard.replay import replay
from tests.process.flying import flying
from tests.realtime import REALTIME

pytestmark = REALTIME

#: COM_OF_LOSS_T, and what may come on top of it, s.
LOSS, MARGIN = 0.5, 0.2
#: The servos' watchdog, the patience of the driver, and what may come on top of them, s.
LET_GO = 0.6
SET_POINT = "SET_ATTITUDE_TARGET"

WAYS = {"stopped": signal.SIGSTOP, "stuck in a loop": signal.SIGUSR1, "killed": signal.SIGKILL}


@pytest.mark.parametrize("where", ["hover", "press"])
@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_the_vehicle_ends_on_the_ground(tmp_path: Path, way: int, where: str) -> None:
    with flying(tmp_path) as flight:
        if where == "hover":
            flight.take_off()
        else:
            flight.press()
        flight.signal(way)
        last = flight.silent_since(SET_POINT)
        failsafe = flight.wait("failsafe", lambda look: look.mode == "land", since=last)
        assert (failsafe.t_ns - last.t_ns) * 1e-9 < LOSS + MARGIN
        limp = flight.wait("joints that let go", lambda look: not any(look.truth.servo_current), since=last)
        assert (limp.t_ns - last.t_ns) * 1e-9 < LET_GO
        down = flight.ended_safely()
        assert down.received[SET_POINT] == last.received[SET_POINT]
        assert down.received.get("ODOMETRY") == last.received.get("ODOMETRY")
        if way == signal.SIGUSR1:
            flight.signal(signal.SIGKILL)  # nothing else would end what spins
    assert flight.flight.returncode is not None
    ticks = replay(tmp_path / "log.mcap", partial=True)
    assert ticks.same, ticks
    assert not _children_of(flight.flight.pid)


def _children_of(pid: int) -> list[int]:
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended meanwhile
            continue
        if int(fields[1]) == pid or int(fields[2]) == pid:
            found.append(int(entry.parent.name))
    return [child for child in found if child != os.getpid()]
