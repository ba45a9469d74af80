"""On a real PX4 in software: the whole repair, and a flight process that hangs or dies. Wants PIPEWRIGHT_PX4.

The bounds of the figures are wide, for a busy machine; docs/px4.md tells those of a quiet one.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from onboard.replay import replay
from sim_backend.px4_sitl import VARIABLE, build_folder
from tests.acceptance.flights import Flown, completed, look, pipewright, within
from tests.process.flying import PATIENCE, Flying
from tests.px4_traffic import GroundStation
from tests.realtime import REALTIME, alone

pytestmark = [
    *REALTIME,
    pytest.mark.skipif(build_folder() is None, reason=f"no PX4: {VARIABLE} names no build folder of one (docs/px4.md)"),
]

#: COM_OF_LOSS_T, and what may come on top of it, s.
LOSS, MARGIN = 0.5, 0.2
#: What PX4 may do on its own: LAND where it has a position, else Descend.
DOWN = ("land", "descend")


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """The run folder of ``pipewright desk --config sitl``."""
    with TemporaryDirectory(prefix="pipewright-") as name:
        with alone():
            done = pipewright("desk", "--config", "sitl", "--out", "run", cwd=Path(name), timeout=400.0)
        assert done.returncode == 0, done.stdout + done.stderr
        yield Path(name) / "run"


@pytest.fixture(scope="module")
def flown(folder: Path) -> Flown:
    return look(folder / "log.mcap")


@pytest.fixture(scope="module")
def told(folder: Path) -> dict[str, Any]:
    figures: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return figures


def test_the_repair_is_completed(flown: Flown, told: dict[str, Any]) -> None:
    assert completed(flown)
    assert told["contact"]["source"] == "truth"
    assert told["contact"]["hold_mean"] == pytest.approx(2.5, abs=0.15)
    assert within(told["force_rmse"], {"meas_des": 0.3, "est_meas": 0.2})


def test_the_same_core_replays_it_without_difference(flown: Flown) -> None:
    found = replay(flown.log)
    assert found.same, str(found)
    assert found.ticks == len(flown.run.t)


@pytest.mark.parametrize("where", ["hover", "press"])
@pytest.mark.parametrize("way", [signal.SIGSTOP, signal.SIGKILL], ids=["stopped", "killed"])
def test_px4_brings_the_vehicle_down_when_the_process_falls_silent(
    tmp_path: Path, way: int, where: str, record_property: Callable[[str, object], None]
) -> None:
    # A busy machine holds back the bytes of a servo bus on a pseudo-terminal, which is not what is looked at here.
    servos = "devices.servos.kind=mock"
    with alone(), GroundStation() as ground, Flying(tmp_path, servos, config="sitl") as flight:
        if where == "hover":
            flight.hover()
        else:
            flight.press()
        flight.signal(way)
        silent = time.monotonic_ns()
        failsafe = ground.wait("failsafe", lambda packet: packet.mode in DOWN, PATIENCE, since=silent)
        record_property("failsafe_after_s", (failsafe.t_ns - silent) * 1e-9)
        assert (failsafe.t_ns - silent) * 1e-9 < LOSS + MARGIN
        flight.ended_safely()
        # One late set-point, of a library or of an orphan, and PX4 would be back in offboard. (Disarmed, it is: it goes
        # back to the mode that was last asked for.)
        later = [packet for packet in ground.packets if packet.t_ns >= failsafe.t_ns and packet.mode]
        assert {packet.mode for packet in later if packet.armed} <= {*DOWN}
    ticks = replay(tmp_path / "log.mcap", partial=True)
    assert ticks.same, ticks
