"""The paper's experiment: what the tuned law must reach, that the printed law completes it, and that it repeats."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from groundstation.metrics import PAPER
from onboard.messages import Phase
from tests.acceptance.flights import (
    FORCE_ROWS,
    Flown,
    Hangar,
    completed,
    contact_kept,
    in_limits,
    look,
    pipewright,
    within,
)

FORCE = 2.5
"""Set force of the scenario, N."""


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """The run folder of ``pipewright sim``, without any option but where to write."""
    with TemporaryDirectory(prefix="pipewright-") as name:
        done = pipewright("sim", "--out", "run", cwd=Path(name))
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert "mission completed" in done.stdout
        yield Path(name) / "run"


@pytest.fixture(scope="module")
def tuned(folder: Path) -> Flown:
    return look(folder / "log.mcap")


@pytest.fixture(scope="module")
def told(folder: Path) -> dict[str, Any]:
    figures: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return figures


# --- the tuned law ------------------------------------------------------------------------------------------------


def test_the_command_completes_the_mission(folder: Path, tuned: Flown, told: dict[str, Any]) -> None:
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.yaml",
        "costs.json",
        "log.mcap",
        "metrics.json",
        "report.html",
    ]
    assert completed(tuned)
    assert (told["scenario"], told["law"], told["seed"]) == ("paper", "tuned", 0)
    assert {**told, "wall_s": None} == tuned.metrics
    # A tenth is what is asked of a quiet core; this machine may be neither quiet nor fast.
    assert 0.0 < told["wall_s"] < 0.5 * told["sim_s"]
    assert 90.0 < told["sim_s"] < 150.0


def test_force_rows(told: dict[str, Any]) -> None:
    assert within(told["force_rmse"], FORCE_ROWS)


def test_the_force_is_held(told: dict[str, Any]) -> None:
    assert told["contact"]["hold_mean"] == pytest.approx(FORCE, abs=0.03)


def test_state_rows_are_not_above_those_of_the_paper(told: dict[str, Any]) -> None:
    assert len(PAPER["state_rmse"]) == 9
    assert within(told["state_rmse"]["flight"], PAPER["state_rmse"])


def test_touchdown_is_soft(tuned: Flown, told: dict[str, Any]) -> None:
    run = tuned.run
    assert run.truth is not None
    trigger = run.t[run.where(Phase.PRESS)][0]
    first = run.t[run.truth.peak > 0.0][0]
    assert first < trigger, "the trigger fires upon contact"
    touchdown = (run.t >= first) & (run.t <= trigger + 1.0)
    assert 0.0 < run.truth.peak[touchdown].max() <= 3.0
    assert np.nanmax(run.truth.peak) <= 3.0
    assert told["contact"]["peak"] <= 3.0


def test_contact_is_kept_and_the_tip_stays(tuned: Flown, told: dict[str, Any]) -> None:
    assert contact_kept(tuned)
    assert told["contact"]["tip_slip"] <= 0.005


def test_actuators_stay_within_their_data_sheets(tuned: Flown) -> None:
    assert in_limits(tuned)


# --- the printed law ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def printed(fly: Hangar) -> Flown:
    return fly(law="paper")


def test_the_printed_law_completes(printed: Flown) -> None:
    assert completed(printed)
    assert in_limits(printed)
    assert printed.metrics["law"] == "paper"
    assert printed.metrics["force_rmse"]["est_meas"] <= PAPER["force_rmse"]["est_meas"]


def test_the_printed_law_stands_beside_the_tuned_one_in_the_report(folder: Path, printed: Flown) -> None:
    done = pipewright("report", "run", "--beside", printed.log, cwd=folder.parent)
    assert done.returncode == 0, done.stderr
    page = (folder / "report.html").read_text()
    assert "law paper" in page
    assert "law tuned" in page
    for row in ("est_des", "meas_des", "est_meas"):
        assert f"{printed.metrics['force_rmse'][row]:.5f}" in page


# --- it repeats ---------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_bytes(folder: Path, fly: Hangar) -> None:
    assert (folder / "log.mcap").read_bytes() == fly().log.read_bytes()


def test_replay_of_the_whole_mission_finds_no_difference(folder: Path, tuned: Flown) -> None:
    done = pipewright("replay", "run", cwd=folder.parent)
    assert done.returncode == 0, done.stdout
    assert f"{len(tuned.run.t)} ticks" in done.stdout
    assert "no difference" in done.stdout


def test_replay_from_the_middle_of_the_press_finds_no_difference(folder: Path, tuned: Flown) -> None:
    pressing = tuned.run.t[tuned.run.where(Phase.PRESS)]
    middle = 0.5 * (pressing[0] + pressing[-1])
    done = pipewright("replay", "run", "--from", f"{middle:.3f}", cwd=folder.parent)
    assert done.returncode == 0, done.stdout
    assert f"from t = {int(middle)}.000 s on: no difference" in done.stdout
