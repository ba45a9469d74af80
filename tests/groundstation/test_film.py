"""Pictures and film of a recorded run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from groundstation import cli, film
from groundstation.run import read_run
from onboard.config import load_config
from onboard.simulate import simulate
from tests.acceptance.flights import SHORT


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flown") / "log.mcap"
    simulate(load_config("paper", None, SHORT), path)
    return path


def test_frames_are_spread_over_the_run(log: Path) -> None:
    run = read_run(log)
    frames = film.frames(run, 2.0)
    assert len(frames) == int(run.t[-1] / 2.0) + 1
    assert np.diff([frame.t for frame in frames]) == pytest.approx(2.0, abs=0.01)
    pressing = [frame for frame in frames if frame.phase == "press"]
    assert all(frame.force > 0.5 for frame in pressing[1:])
    assert frames[0].payload
    assert not frames[-1].payload


def test_each_phase_gets_a_picture_and_the_film_moves(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["film", str(log), "--speed", "40", "--fps", "5", "--width", "160"]) == 0
    told = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert told[-1].name == film.FILM
    assert all(path.is_file() for path in told)
    phases = dict.fromkeys(read_run(log).phase.tolist())
    names = [path.name for path in told]
    assert all(any(phase.replace("_", "-") in name for name in names) for phase in phases)
    with Image.open(told[-1]) as gif:
        assert gif.size == (160, 90)
        count = getattr(gif, "n_frames", 1)
        assert count == len(film.frames(read_run(log), 8.0))
        first = np.asarray(gif.convert("RGB"), dtype=float)
        gif.seek(count // 2)
        middle = np.asarray(gif.convert("RGB"), dtype=float)
    assert np.abs(first - middle).mean() > 2.0
    with Image.open(next(path for path in told if "press" in path.name)) as press:
        assert len(press.convert("RGB").getcolors(100_000) or ()) > 50, "there is something to see"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["nowhere.mcap"], "nowhere.mcap"), (["x", "--width", "10"], "160 to 1920"), (["x", "--speed", "0"], "above 0")],
)
def test_wrong_input_is_told(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = cli.main(["film", *arguments])
    except SystemExit as end:
        code = int(end.code or 0)
    assert code == 2
    assert words in capsys.readouterr().err
