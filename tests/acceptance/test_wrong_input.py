"""Wrong input: exit code 2, one clear message, nothing written."""

from __future__ import annotations

from pathlib import Path

import pytest

from onboard import simulate as simulating
from onboard.config import load_config
from tests.acceptance.flights import pipewright


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The first seconds of a mission, recorded."""
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulating, "LONGEST", 4.0)
        simulating.simulate(load_config(), path)
    return path.read_bytes()


def refused(folder: Path, *arguments: str, lines: int = 1) -> str:
    """The message, after everything that holds for each refusal was asserted."""
    before = {path: path.read_bytes() for path in folder.rglob("*")}
    done = pipewright(*arguments, cwd=folder)
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") == lines, done.stderr
    assert {path: path.read_bytes() for path in folder.rglob("*")} == before
    return done.stderr


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--set=pipe.radios=0.1", ["pipe.radios: no such parameter", "nearest: pipe.radius"]),
        ("--set=repair.force=9", ["repair.force = 9", "from 0.5 to 4 N"]),
        ("--set=pipe.position=[2,0,0.3]", ["pipe.position z = 0.3 m", "at least 0.62 m is needed"]),
        ("--set=pipe.position=[30,0,1.5]", ["outside of the fence", "safety.fence_high (10.0, 10.0, 6.0)"]),
        ("--law=tund", ["no law of the name 'tund'", "tuned, paper"]),
        ("--scenario=papr", ["no scenario of the name 'papr'", "paper, realistic, desk"]),
        ("--scenario=none.yaml", ["none.yaml: cannot be read", "No such file"]),
    ],
)
def test_sim(tmp_path: Path, option: str, words: list[str]) -> None:
    message = refused(tmp_path, "sim", option)
    assert all(word in message for word in words), message


def test_broken_yaml(tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text("pipe:\n  radius: [0.08\nrepair: {force: 2}\n")
    assert "broken.yaml:3:7: not valid YAML: expected ',' or ']'" in refused(tmp_path, "sim", "--scenario=broken.yaml")


def test_all_errors_of_a_file_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "wrong.yaml").write_text("pipe:\n  radius: 0.2\n  colour: red\nrepair:\n  force: nine\n")
    message = refused(tmp_path, "sim", "--scenario=wrong.yaml", lines=3)
    for words in (
        "wrong.yaml:2: pipe.radius = 0.2: must be a number from 0.03 to 0.15 m",
        "wrong.yaml:3: pipe.colour: no such parameter",
        "wrong.yaml:5: repair.force = 'nine': must be a number from 0.5 to 4 N",
    ):
        assert words in message


def test_desk_takes_no_wrench(tmp_path: Path) -> None:
    assert "choose attitude or body_rate" in refused(tmp_path, "desk", "--set=interface=wrench")


@pytest.mark.parametrize("out", ["notes.txt", "notes.txt/run"])
def test_a_folder_that_cannot_be(tmp_path: Path, out: str) -> None:
    (tmp_path / "notes.txt").write_text("precious")
    assert out in refused(tmp_path, "sim", f"--out={out}")


@pytest.mark.parametrize("command", ["replay", "report"])
def test_truncated_log(tmp_path: Path, log: bytes, command: str) -> None:
    (tmp_path / "log.mcap").write_bytes(log[: 3 * len(log) // 4])
    message = refused(tmp_path, command, "log.mcap")
    assert "log.mcap: the log was cut off" in message
    assert "--partial reads them" in message


@pytest.mark.parametrize("command", ["replay", "report"])
def test_missing_log(tmp_path: Path, command: str) -> None:
    assert "none.mcap: no such log; give the log.mcap of a run folder" in refused(tmp_path, command, "none.mcap")


@pytest.mark.parametrize("command", ["replay", "report"])
def test_what_is_no_log(tmp_path: Path, command: str) -> None:
    (tmp_path / "log.mcap").write_text("time,force\n0,0\n")
    assert "not an MCAP file" in refused(tmp_path, command, ".")


def test_replay_from_beyond_the_end(tmp_path: Path, log: bytes) -> None:
    (tmp_path / "log.mcap").write_bytes(log)
    assert "no keyframe at or before 60 s; give a time from 0 s to" in refused(tmp_path, "replay", ".", "--from=60")
