"""The repair in both worlds: the rows of Table II side by side, the forces within 0.03 N of each other; and its film.

From the advance to the retreat PyBullet moves the vehicle; docs/worlds.md has whole missions.
"""

from __future__ import annotations

from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image

from groundstation import cli, film, report, table
from groundstation.run import read_run
from onboard import simulate
from onboard.config import load_config
from sim_backend.array_plant import PlantKind
from sim_backend.world import World
from tests.acceptance.flights import FORCE_ROWS, SHORT, Flown, Hangar, completed, look, pipewright, within
from tests.sim_backend.flying import to_bullet

#: Between the worlds, N.
APART = 0.03


@pytest.fixture(scope="module")
def rigid(fly: Hangar) -> Flown:
    return fly(*SHORT)


@pytest.fixture(scope="module")
def bullet(rigid: Flown, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """The same mission, broken off in the retreat; from just before the advance on it is PyBullet's."""
    log = tmp_path_factory.mktemp("bullet") / "log.mcap"
    start = {phase["name"]: phase["start"] for phase in rigid.metrics["phases"]}
    advance = World.advance

    def hand_over(world: World, duration: float) -> None:
        if world.time > start["advance"] - 0.5 and world.plant.params.kind is PlantKind.RIGID:
            to_bullet(world)
        advance(world, duration)

    with patch.object(World, "advance", hand_over), patch.object(simulate, "LONGEST", start["retreat"] + 1.0):
        simulate.simulate(load_config("paper", None, SHORT), log)
    return look(log)


def test_the_sleeve_is_pressed_on_and_left_in_both(rigid: Flown, bullet: Flown) -> None:
    assert completed(rigid)
    assert bullet.codes == rigid.codes[: len(bullet.codes)]
    assert bullet.codes[-1] == "retreat"
    for flown in (rigid, bullet):
        assert within(flown.metrics["force_rmse"], FORCE_ROWS)
        assert flown.run.truth is not None
        assert flown.run.truth.sleeve_on_pipe


def test_the_forces_agree(rigid: Flown, bullet: Flown) -> None:
    one, other = (flown.metrics["force_rmse"] for flown in (rigid, bullet))
    assert {row: abs(one[row] - other[row]) for row in one if not abs(one[row] - other[row]) <= APART} == {}
    assert one != other, "they are two worlds"


def test_the_states_agree(rigid: Flown, bullet: Flown) -> None:
    one, other = (flown.metrics["state_rmse"]["contact"] for flown in (rigid, bullet))
    for row, value in one.items():
        assert other[row] == pytest.approx(value, rel=0.05, abs=1e-4), row


def test_the_report_shows_both(rigid: Flown, bullet: Flown, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    beside = {**bullet.metrics, "plant": "pybullet"}
    report.write(rigid.run, rigid.metrics, page, [beside])
    text = page.read_text(encoding="utf-8")
    assert table.name(beside) in text
    assert table.name(beside).endswith("pybullet")
    assert f"{bullet.metrics['force_rmse']['est_meas']:.5f}" in text


def test_frames_are_spread_over_the_run(rigid: Flown) -> None:
    frames = film.frames(rigid.run, 2.0)
    assert len(frames) == int(rigid.run.t[-1] / 2.0) + 1
    assert np.diff([frame.t for frame in frames]) == pytest.approx(2.0, abs=0.01)
    pressing = [frame for frame in frames if frame.phase == "press"]
    assert all(frame.force > 0.2 for frame in pressing[1:])
    assert frames[0].payload
    assert not frames[-1].payload


def test_each_phase_gets_a_picture_and_the_film_moves(rigid: Flown, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["film", str(rigid.log), "--speed", "40", "--fps", "5", "--width", "160"]) == 0
    told = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert told[-1].name == film.FILM
    assert all(path.is_file() for path in told)
    phases = dict.fromkeys(rigid.run.phase.tolist())
    names = [path.name for path in told]
    assert all(any(phase.replace("_", "-") in name for name in names) for phase in phases)
    with Image.open(told[-1]) as gif:
        assert gif.size == (160, 90)
        count = getattr(gif, "n_frames", 1)
        assert count == len(film.frames(read_run(rigid.log), 8.0))
        first = np.asarray(gif.convert("RGB"), dtype=float)
        gif.seek(count // 2)
        middle = np.asarray(gif.convert("RGB"), dtype=float)
    assert np.abs(first - middle).mean() > 2.0
    colours = middle.reshape(-1, 3)
    red, green, blue = colours[:, 0], colours[:, 1], colours[:, 2]
    assert ((red > 1.5 * blue) & (green > 1.2 * blue)).any(), "the arm's orange is in the film"
    assert ((green > 1.5 * red) & (green > 1.2 * blue)).any(), "and the sleeve's green"


def test_the_command_takes_the_plant(tmp_path: Path) -> None:
    done = pipewright("sim", "--plant", "gazebo", cwd=tmp_path)
    assert done.returncode == 2
    assert "rigid" in done.stderr
    assert "pybullet" in done.stderr
    options = cli._parser().parse_args(["sim", "--plant", "pybullet", "--set", "repair.hold=3"])
    assert cli._common(options) == ["--set=repair.hold=3", "--set=world.plant.kind=pybullet"]
