"""What stations may see of the folder of runs, and what is removed from it."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import pytest

from onboard.logs import KEPT, PIECE, Logs
from onboard.orders import NotShownError
from tests.waiting import seconds_until


def a_run(folder: Path, name: str, content: bytes = b"log", age: float = 0.0) -> Path:
    run = folder / name
    run.mkdir(parents=True)
    (run / "config.yaml").write_bytes(b"c" * 100)
    (run / "log.mcap").write_bytes(content)
    written = time.time() - age
    os.utime(run / "log.mcap", (written, written))
    return run


def summed(logs: Logs, name: str) -> str:
    """The sum of a log, once it is there."""
    seconds_until(lambda: bool(_sum(logs, name)))
    return _sum(logs, name)


def _sum(logs: Logs, name: str) -> str:
    (file,) = [file for file in logs.files() if file.name == name]
    return file.sha256


def test_the_newest_run_comes_first(tmp_path: Path) -> None:
    a_run(tmp_path, "desk-001", b"one", age=100.0)
    a_run(tmp_path, "desk-002", b"three", age=1.0)
    (tmp_path / "a file").write_text("")
    (tmp_path / "no-run").mkdir()
    files = Logs(tmp_path, writing="desk-002").files()
    assert [(file.name, file.size, file.sha256, file.writing) for file in files] == [
        ("desk-002/log.mcap", 5, "", True),
        ("desk-001/log.mcap", 3, "", False),
    ]
    assert files[1].modified_ns == (tmp_path / "desk-001/log.mcap").stat().st_mtime_ns


def test_there_is_no_run_yet(tmp_path: Path) -> None:
    assert Logs(tmp_path / "runs").files() == ()
    assert Logs(tmp_path / "runs").prune(1.0) == ()


def test_pieces_make_the_log(tmp_path: Path) -> None:
    content = os.urandom(2 * PIECE + 17)
    a_run(tmp_path, "desk-001", content)
    logs, name = Logs(tmp_path), "desk-001/log.mcap"
    assert logs.read(name, 0, 10 * PIECE) == content[:PIECE]
    assert b"".join(logs.read(name, at, PIECE) for at in range(0, len(content), PIECE)) == content
    assert logs.read(name, len(content), 1) == b""
    assert summed(logs, name) == hashlib.sha256(content).hexdigest()


def test_a_sum_is_of_the_log_as_it_is(tmp_path: Path) -> None:
    run = a_run(tmp_path, "desk-001", b"before", age=10.0)
    logs, name = Logs(tmp_path), "desk-001/log.mcap"
    logs.read(name, 0, 1)
    assert summed(logs, name) == hashlib.sha256(b"before").hexdigest()
    (run / "log.mcap").write_bytes(b"after!")
    assert logs.files()[0].sha256 == ""
    logs.read(name, 0, 1)
    assert summed(logs, name) == hashlib.sha256(b"after!").hexdigest()


def test_of_a_log_that_is_being_written_there_is_no_sum(tmp_path: Path) -> None:
    run = a_run(tmp_path, "desk-001", b"before")
    logs = Logs(tmp_path, writing="desk-001")
    with (run / "log.mcap").open("ab") as log:
        log.write(b", after")
        log.flush()
        assert logs.read("desk-001/log.mcap", 0, PIECE) == b"before, after"
    assert not logs._summing
    assert not logs._sums


@pytest.mark.parametrize(
    "name",
    [
        "",
        "log.mcap",
        "/etc/passwd",
        "../secret/log.mcap",
        "..",
        "../log.mcap",
        "./log.mcap",
        "desk-001/../../secret/log.mcap",
        "desk-001/config.yaml",
        "desk-001//log.mcap",
        "desk-001/log.mcap/",
        "desk-001\0/log.mcap",
        "desk-001",
        "nowhere/log.mcap",
        "linked/log.mcap",
        "link-in-it/log.mcap",
        "pipe-in-it/log.mcap",
        "folder-in-it/log.mcap",
        "\udcff/log.mcap",
        "x" * 1000 + "/log.mcap",
    ],
)
def test_no_name_leads_out_of_the_folder(tmp_path: Path, name: str) -> None:
    runs = tmp_path / "runs"
    a_run(runs, "desk-001")
    secret = a_run(tmp_path, "secret", b"secret")
    (runs / "linked").symlink_to(secret)
    for inner in ("link-in-it", "pipe-in-it", "folder-in-it"):
        (runs / inner).mkdir()
    (runs / "link-in-it/log.mcap").symlink_to(secret / "log.mcap")
    os.mkfifo(runs / "pipe-in-it/log.mcap")
    (runs / "folder-in-it/log.mcap").mkdir()
    logs = Logs(runs)
    with pytest.raises(NotShownError, match=r"is no log|is not there|cannot be read"):
        logs.read(name, 0, 100)
    assert [file.name for file in logs.files()] == ["desk-001/log.mcap"]


def test_names_that_cannot_be_told_are_left_out(tmp_path: Path) -> None:
    os.mkdir(os.fsencode(tmp_path) + b"/\xff")
    (Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff")) / "log.mcap").write_bytes(b"")
    assert Logs(tmp_path).files() == ()


def test_the_oldest_make_way(tmp_path: Path) -> None:
    for k in range(8):
        a_run(tmp_path, f"desk-{k}", b"x" * 900, age=1000.0 - k)
    told = Logs(tmp_path, writing="desk-0").prune(5000.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"desk-{k}" for k in (0, 4, 5, 6, 7)]
    assert [text.split("(")[0] for text in told] == ["Run desk-1 ", "Run desk-2 ", "Run desk-3 "]
    assert Logs(tmp_path).prune(0.0) == ()


def test_the_newest_are_never_removed(tmp_path: Path) -> None:
    for k in range(5):
        a_run(tmp_path, f"desk-{k}", b"x" * 1000, age=1000.0 - k)
    told = Logs(tmp_path).prune(1.0)
    assert len(list(tmp_path.iterdir())) == KEPT
    assert told[-1] == "The runs take 0.00 GB, and logs.budget is 1e-09 GB."


def test_what_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    for k in range(6):
        a_run(tmp_path, f"desk-{k}", b"x" * 1000, age=1000.0 - k)
    (tmp_path / "desk-0/thesis.tex").write_text("years of work")
    outside = tmp_path.parent / f"{tmp_path.name}-outside"
    outside.mkdir()
    (tmp_path / "desk-1/report.html").symlink_to(outside)
    told = Logs(tmp_path).prune(100.0)
    assert "desk-0 should make way for new logs, but holds thesis.tex" in told[0]
    assert (tmp_path / "desk-0/log.mcap").exists()
    assert not (tmp_path / "desk-1").exists()
    assert outside.exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may remove everything")
def test_a_folder_that_may_not_be_written(tmp_path: Path) -> None:
    for k in range(4):
        a_run(tmp_path, f"desk-{k}", b"x" * 1000, age=1000.0 - k)
    (tmp_path / "desk-0").chmod(0o500)
    told = Logs(tmp_path).prune(100.0)
    (tmp_path / "desk-0").chmod(0o700)
    assert "cannot be removed: Permission denied" in told[0]


def test_a_disk_that_refuses_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(5):
        a_run(tmp_path, f"desk-{k}", b"x" * 1000, age=1000.0 - k)

    def refuse(path: str, *, dir_fd: int) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "unlink", refuse)
    told = Logs(tmp_path).prune(100.0)
    assert [text.endswith("cannot be removed: Permission denied.") for text in told] == [True, True, False]


def test_a_run_that_somebody_else_takes_away_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(5):
        a_run(tmp_path, f"desk-{k}", b"x" * 1000, age=1000.0 - k)
    logs = Logs(tmp_path)
    runs = logs._runs()
    monkeypatch.setattr(logs, "_runs", lambda: runs)
    for path in (tmp_path / "desk-0").iterdir():
        path.unlink()
    (tmp_path / "desk-0").rmdir()
    told = logs.prune(100.0)
    assert "desk-0 should make way for new logs, but cannot be removed: No such file" in told[0]
    assert "desk-1 (0.00 GB) was removed" in told[1]


def test_room_on_the_disk(tmp_path: Path) -> None:
    assert Logs(tmp_path).free() > 0
    with pytest.raises(FileNotFoundError):
        Logs(tmp_path / "nowhere").free()
