"""A run that is broken off: what was recorded stays readable, and its end is told."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest

from onboard.messages import LogReader
from tests.acceptance.flights import Watched, pipewright

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds the flight process by /proc")


def broken_off(folder: Path, shown: str) -> float:
    """The run in this folder ended early, but was recorded up to what was shown last; gives its length, s."""
    told = json.loads((folder / "metrics.json").read_text())
    assert told["outcome"] == "unfinished"
    seconds = float(re.findall(r"([\d.]+) s flown", shown)[-1])
    assert told["sim_s"] > seconds - 1.0, "what is not yet written is less than a second"
    return float(told["sim_s"])


def test_a_killed_run_is_readable_as_far_as_it_came(tmp_path: Path) -> None:
    run = Watched("sim", "--out", "run", cwd=tmp_path)
    run.until("adhesive")
    flight = run.flight
    run.process.kill()
    os.kill(flight, signal.SIGKILL)
    assert run.end()[0] == -signal.SIGKILL
    folder = tmp_path / "run"
    assert sorted(path.name for path in folder.iterdir()) == ["config.yaml", "log.mcap"]

    assert pipewright("report", "run", cwd=tmp_path).returncode == 2
    report = pipewright("report", "run", "--partial", cwd=tmp_path)
    assert report.returncode == 0, report.stderr
    assert "broken off" in report.stdout
    assert (folder / "report.html").is_file()
    broken_off(folder, run.shown)

    replay = pipewright("replay", "run", "--partial", cwd=tmp_path)
    assert replay.returncode == 0, replay.stderr
    assert "no difference" in replay.stdout


def test_the_command_reports_a_flight_process_that_was_killed(tmp_path: Path) -> None:
    run = Watched("sim", "--out", "run", cwd=tmp_path)
    run.until("adhesive")
    os.kill(run.flight, signal.SIGKILL)
    code, printed = run.end()
    assert code == 1
    assert "the flight process failed (code -9); what it recorded is reported" in run.shown
    assert "broken off" in printed
    broken_off(tmp_path / "run", run.shown)


def test_an_interrupt_ends_the_run_in_order(tmp_path: Path) -> None:
    run = Watched("sim", "--out", "run", cwd=tmp_path)
    run.until("adhesive")
    run.process.send_signal(signal.SIGINT)
    code, printed = run.end()
    assert code == 130
    assert "Traceback" not in run.shown
    assert "broken off" in printed
    assert broken_off(tmp_path / "run", run.shown) < 60.0
    with LogReader(tmp_path / "run" / "log.mcap") as log:
        assert log.complete


def test_the_code_of_an_interrupt_is_documented(tmp_path: Path) -> None:
    assert re.search(r"^ *130 .*interrupt", pipewright("--help", cwd=tmp_path).stdout, re.MULTILINE)
