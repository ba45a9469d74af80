"""The paper's mission in both worlds: every row of Table II side by side, the forces within 0.03 N of each other."""

from __future__ import annotations

from pathlib import Path

import pytest

from groundstation import report, table
from tests.acceptance.flights import FORCE_ROWS, SHORT, Flown, Hangar, completed, pipewright, within

PYBULLET = "world.plant.kind=pybullet"
#: Between the worlds, N.
APART = 0.03


@pytest.fixture(scope="module")
def both(fly: Hangar) -> tuple[Flown, Flown]:
    return fly(), fly(PYBULLET)


def test_the_mission_is_completed_in_both(both: tuple[Flown, Flown]) -> None:
    for flown in both:
        assert completed(flown)
        assert within(flown.metrics["force_rmse"], FORCE_ROWS)


def test_the_forces_agree(both: tuple[Flown, Flown]) -> None:
    rigid, bullet = (flown.metrics["force_rmse"] for flown in both)
    assert {row: abs(rigid[row] - bullet[row]) for row in rigid if not abs(rigid[row] - bullet[row]) <= APART} == {}
    assert rigid != bullet, "they are two worlds"


def test_the_states_agree(both: tuple[Flown, Flown]) -> None:
    rigid, bullet = (table.rows(flown.metrics)[3:] for flown in both)
    for one, other in zip(rigid, bullet, strict=True):
        assert one.value is not None
        assert other.value is not None
        # No row leaves the side of the paper's figure that it is on, and none changes by more than a tenth of that.
        assert one.better is other.better, one.label
        assert abs(one.value - other.value) <= 0.1 * one.paper, one.label


def test_the_report_shows_both(both: tuple[Flown, Flown], tmp_path: Path) -> None:
    rigid, bullet = both
    page = tmp_path / "report.html"
    report.write(rigid.run, rigid.metrics, page, [bullet.metrics])
    text = page.read_text(encoding="utf-8")
    assert "scenario paper, law tuned, seed 0, pybullet" in text
    assert f"{bullet.metrics['force_rmse']['est_meas']:.5f}" in text


def test_two_flights_of_one_seed_give_the_same_log(fly: Hangar) -> None:
    one, other = (fly(PYBULLET, *SHORT, again=again) for again in (0, 1))
    assert completed(one)
    assert one.log.read_bytes() == other.log.read_bytes()


def test_the_command_flies_replays_and_films_it(tmp_path: Path) -> None:
    sets = [f"--set={item}" for item in SHORT]
    done = pipewright("sim", "--plant", "pybullet", "--out", "run", *sets, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "the engine keeps its greetings to itself"
    again = pipewright("replay", "run", cwd=tmp_path)
    assert again.returncode == 0, again.stdout
    filmed = pipewright("film", "run", "--speed", "20", "--width", "160", cwd=tmp_path)
    assert filmed.returncode == 0, filmed.stderr
    names = {path.name for path in (tmp_path / "run" / "film").iterdir()}
    assert {"film.gif", "phases.png"} <= names
    assert any("press" in name for name in names)


def test_an_unknown_plant_is_told(tmp_path: Path) -> None:
    done = pipewright("sim", "--plant", "gazebo", cwd=tmp_path)
    assert done.returncode == 2
    assert "rigid" in done.stderr
    assert "pybullet" in done.stderr
