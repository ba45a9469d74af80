"""A repair by commands alone: the desk in one terminal, a station in others."""

from __future__ import annotations

import signal
from pathlib import Path

from onboard.core.types import Phase, Request
from onboard.logfile import LogReader
from onboard.replay import replay
from tests.link.terminals import Keeper, desk
from tests.realtime import REALTIME

pytestmark = REALTIME

CONFIG = """\
interface: attitude
world:
  plant: {ideal_motors: false, ideal_servos: false}
  loops: {bandwidth: 20.0}
  autopilot: {command_delay: 0.004}
force_profile:
  lead: 0.08
safety:
  tilt: 0.60   # rad
devices:
  autopilot: {kind: emulated, parameters: x500.params}
  odometry: {kind: emulated}
  servos: {kind: emulated, baud: 4000000, reply_margin: 0.02, silent_after: 0.4}
"""
PHASES = [
    Phase.PREFLIGHT, Phase.ARMED, Phase.TAKEOFF, Phase.HOLD, Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE,
    Phase.TOOL_CHANGE, Phase.TARE, Phase.ADVANCE, Phase.PRESS, Phase.RETREAT_HOLD, Phase.HOLD, Phase.TARE,
    Phase.ADVANCE, Phase.PRESS, Phase.RETREAT_HOLD, Phase.HOLD, Phase.LAND, Phase.STOPPED,
]  # fmt: skip
ASKED = [
    Request.ARM, Request.TAKEOFF, Request.START, Request.HOLD, Request.RESUME, Request.RETREAT, Request.LAND,
]  # fmt: skip


def test_a_repair_by_commands_alone(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(CONFIG)
    with desk(tmp_path, config="mine.yaml") as flown:
        alice = flown.terminal("--station=alice")
        assert all(row["ok"] for row in alice("preflight", "--wait=60").json["checks"])
        assert alice("arm", code=3).json["outcome"] == "refused", "nobody commands yet"
        with Keeper(alice) as kept:
            alice.insist("arm")
            kept.until("armed")
            alice("takeoff", "--wait")

            file.write_text(CONFIG.replace("tilt: 0.60", "tilt: 0.55"))
            (change,) = alice("params", "reload").json
            assert (change["path"], change["old"], change["new"]) == ("safety.tilt", 0.6, 0.55)
            file.write_text(CONFIG.replace("tilt: 0.60", "tilt: 55"))
            refused = alice("params", "reload", code=3)
            assert "safety.tilt = 55: must be" in refused.err
            assert alice("status").json["revision"] == 1

            alice("start")
            seen = kept.until("press")
            assert alice("hold", "--wait").json["phase"] == "hold"
            alice("resume")
            kept.until("press", seen)
            assert alice("retreat", "--wait").json["phase"] == "hold"
            assert alice("land", "--wait").json["phase"] == "stopped"
            assert kept.running.end(signal.SIGINT).code == 0

        (entry,) = alice("log", "list").json["logs"]
        assert (entry["name"], entry["writing"]) == ("flight/log.mcap", True)
        fetched = alice("log", "fetch", "flight").json
        assert not fetched["whole"]
        copy = (tmp_path / fetched["path"]).read_bytes()
        assert len(copy) >= entry["size"]
        assert flown.log.read_bytes()[: len(copy)] == copy

    assert flown.running.process.returncode == 3, "ended safely, not completed"
    with LogReader(flown.log) as log:
        phases: list[Phase] = []
        asked: list[Request] = []
        revisions = set()
        for tick in log.ticks():
            revisions.add(tick.revision)
            asked += [tick.inputs.request] if tick.inputs.request is not None else []
            if not phases or phases[-1] is not tick.outputs.phase:
                phases.append(tick.outputs.phase)
        commanders = {tick.inputs.link.commander for tick in log.ticks()}
    assert phases == PHASES
    assert asked == ASKED
    assert revisions == {0, 1}
    assert commanders == {"", "alice"}
    again = replay(flown.log)
    assert again.same, again
