"""Many flights in one onboard process, each with a station that comes and goes: nothing is left of any.

``PIPEWRIGHT_SOAK=1000`` flies that many.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from statistics import median

import msgspec

from tests.link.soak import Left

FLIGHTS = int(os.environ.get("PIPEWRIGHT_SOAK", "30"))
#: Of these, the first are not judged: code is compiled, pools of threads and memory are filled.
WARM_UP = 10
#: A flight may leave this in memory for good, bytes: what the recorder must remember of it to finish its file. A
#: session of Zenoh that stays is several times as much.
LEFT = 15_000
#: How noisy the memory of a process is, bytes.
NOISE = 1_500_000


def soaked(folder: Path) -> list[Left]:
    """What a process has after each flight: one of its own, for here other tests have left theirs."""
    command = [sys.executable, "-m", "tests.link.soak", str(FLIGHTS), str(folder)]
    found = subprocess.run(command, stdout=subprocess.PIPE, check=True, timeout=60.0 + 10.0 * FLIGHTS).stdout
    return msgspec.json.decode(found, type=list[Left])


def test_nothing_is_left_of_any_flight(tmp_path: Path) -> None:
    found = soaked(tmp_path)
    assert len(found) == FLIGHTS
    warm, judged = found[:WARM_UP], found[WARM_UP:]
    few = len(judged) // 4
    before, after = (median(each.memory for each in part) for part in (judged[:few], judged[-few:]))
    assert after - before < NOISE + LEFT * len(judged), f"{(after - before) / 1e6:.1f} MB more"
    assert {each.sessions for each in found} == {0}
    assert {each.files for each in judged} <= {each.files for each in warm}
    # Zenoh's own pools of threads breathe; one that stays of every flight is not that.
    assert min(each.threads for each in judged[-few:]) <= max(each.threads for each in warm) + len(judged) // 5
    assert judged[-1].objects - judged[0].objects < 50 + 3 * len(judged), "objects that nobody lets go of"
