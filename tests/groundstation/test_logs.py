"""Logs are fetched whole and unharmed, whatever happens on the way, or it is said what lacks."""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from groundstation import codes, logs
from onboard.logs import Logs
from onboard.wire import ListLogs, LogFile, ReadLog
from tests.groundstation.vehicle import run, showing
from tests.onboard.relay import Relay
from tests.waiting import pause

CONTENT = bytes(range(256)) * 4096 + b"the end"
NAME = "desk-007/log.mcap"
Fetch = Callable[..., int]


class Vessel:
    """The runs of a vehicle, and what happens when they are read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "desk-007").mkdir(parents=True)
        self.log = folder / NAME
        self.log.write_bytes(CONTENT)
        self.logs = Logs(folder)
        self.reads: list[ReadLog] = []
        self.on_read: Callable[[ReadLog, bytes], bytes] = lambda ask, piece: piece

    def list(self, ask: ListLogs) -> bytes:
        return msgspec.json.encode(self.logs.files())

    def read(self, ask: ReadLog) -> bytes:
        self.reads.append(ask)
        return self.on_read(ask, self.logs.read(ask.name, ask.offset, ask.size))


@pytest.fixture
def vessel(tmp_path: Path) -> Vessel:
    return Vessel(tmp_path / "runs")


@pytest.fixture
def port(vessel: Vessel) -> Iterator[int]:
    with showing({ListLogs: vessel.list, ReadLog: vessel.read}) as port:
        yield port


@pytest.fixture
def fetch(port: int, tmp_path: Path) -> Fetch:
    def fetching(name: str = NAME, *more: str, port: int = port) -> int:
        return run(logs.add_parser, port, "log", "fetch", name, "--out", str(tmp_path / "here"), *more)

    return fetching


def here(tmp_path: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(tmp_path / "here")): path.read_bytes()
        for path in (tmp_path / "here").rglob("*")
        if path.is_file()
    }


def test_a_log_by_the_name_of_its_folder(fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fetch("desk-007") == codes.DONE
    assert here(tmp_path) == {NAME: CONTENT}
    assert "1.0 MB, unharmed (sha256" in capsys.readouterr().out


def test_what_there_is(vessel: Vessel, port: int, capsys: pytest.CaptureFixture[str]) -> None:
    vessel.logs = Logs(vessel.folder, writing="desk-007")
    assert run(logs.add_parser, port, "log", "list") == codes.DONE
    out = capsys.readouterr().out
    assert out.startswith(NAME)
    assert "still being recorded" in out
    assert run(logs.add_parser, port, "log", "list", "--json") == codes.DONE
    (told,) = json.loads(capsys.readouterr().out)["logs"]
    assert (told["name"], told["size"], told["writing"]) == (NAME, len(CONTENT), True)


def test_a_vehicle_without_logs(vessel: Vessel, port: int, capsys: pytest.CaptureFixture[str]) -> None:
    vessel.logs = Logs(vessel.folder / "nowhere")
    assert run(logs.add_parser, port, "log", "list") == codes.DONE
    assert capsys.readouterr().out == "the vehicle has no logs\n"


def test_it_goes_on_where_it_was_cut(
    vessel: Vessel, fetch: Fetch, port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Relay(port) as relay:

        def cut(ask: ReadLog, piece: bytes) -> bytes:
            if ask.offset:
                relay.cut()
            return piece

        vessel.on_read = cut
        code = fetch(NAME, "--timeout", "2", port=relay.port)
    assert code in (codes.TIMED_OUT, codes.NOT_THERE)
    assert "the same command goes on there" in capsys.readouterr().err
    first = vessel.reads[0].size
    assert here(tmp_path) == {f"{NAME}.part": CONTENT[:first]}
    vessel.on_read = lambda ask, piece: piece
    vessel.reads.clear()
    assert fetch() == codes.DONE
    assert vessel.reads[0].offset == first
    assert here(tmp_path) == {NAME: CONTENT}


def test_pieces_are_as_large_as_the_link_takes_quickly(vessel: Vessel, fetch: Fetch) -> None:
    """A slow link is not held up: the answer to a stop travels behind a piece."""
    vessel.log.write_bytes(CONTENT * 4)
    assert fetch() == codes.DONE
    assert 4 * vessel.reads[0].size <= max(ask.size for ask in vessel.reads) <= logs.PIECE
    vessel.log.write_bytes(CONTENT[:100_000])
    vessel.reads.clear()

    def slow(ask: ReadLog, piece: bytes) -> bytes:
        pause(2e-5 * len(piece))
        return piece

    vessel.on_read = slow
    assert fetch(NAME, "--out", str(vessel.folder.parent / "slowly")) == codes.DONE
    assert max(ask.size for ask in vessel.reads[3:]) <= 8 * 1024


def test_a_damaged_piece_is_found_out(
    vessel: Vessel, fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vessel.on_read = lambda ask, piece: piece if ask.offset else b"\0" + piece[1:]
    (tmp_path / "here").mkdir()
    vessel.log.write_bytes(b"a" + CONTENT)
    assert fetch() == codes.REFUSED
    assert "a piece was damaged" in capsys.readouterr().err
    assert here(tmp_path) == {}
    vessel.on_read = lambda ask, piece: piece
    assert fetch() == codes.DONE
    assert here(tmp_path) == {NAME: b"a" + CONTENT}


def test_a_damaged_part_of_before_is_found_out(fetch: Fetch, tmp_path: Path) -> None:
    part = tmp_path / "here" / f"{NAME}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"of another log")
    assert fetch() == codes.REFUSED
    assert fetch() == codes.DONE
    assert here(tmp_path) == {NAME: CONTENT}


def test_a_part_that_is_larger_than_the_log(fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = tmp_path / "here" / f"{NAME}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(CONTENT + b"!")
    assert fetch() == codes.WRONG_INPUT
    assert "it is of another log; remove it" in capsys.readouterr().err
    assert part.read_bytes() == CONTENT + b"!"


def test_a_piece_that_is_too_short_or_too_long(
    vessel: Vessel, fetch: Fetch, capsys: pytest.CaptureFixture[str]
) -> None:
    vessel.on_read = lambda ask, piece: piece + b"!"
    assert fetch() == codes.REFUSED
    assert (
        f"gave {vessel.reads[0].size + 1} bytes where {vessel.reads[0].size} were asked for" in capsys.readouterr().err
    )
    vessel.on_read = lambda ask, piece: b""
    assert fetch() == codes.REFUSED
    assert "gave 0 bytes" in capsys.readouterr().err


def test_what_is_here_already(vessel: Vessel, fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fetch() == codes.DONE
    vessel.reads.clear()
    assert fetch() == codes.DONE
    assert len(vessel.reads) == 1
    assert "is here already, and unharmed" in capsys.readouterr().out
    (tmp_path / "here" / NAME).write_bytes(CONTENT[:-1] + b"!")
    assert fetch() == codes.WRONG_INPUT
    assert "is another log; move it away" in capsys.readouterr().err


def test_a_log_that_grows(vessel: Vessel, fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a log that is being recorded there is what it held; when it is finished, the rest comes."""
    vessel.logs = Logs(vessel.folder, writing="desk-007")
    assert fetch() == codes.DONE
    assert "is still being recorded" in capsys.readouterr().out
    assert here(tmp_path) == {f"{NAME}.part": CONTENT}
    vessel.log.write_bytes(CONTENT + b"rest")
    vessel.logs = Logs(vessel.folder)
    vessel.reads.clear()
    assert fetch() == codes.DONE
    assert vessel.reads[0].offset == len(CONTENT)
    assert here(tmp_path) == {NAME: CONTENT + b"rest"}


def test_a_log_that_is_empty(vessel: Vessel, fetch: Fetch, tmp_path: Path) -> None:
    vessel.log.write_bytes(b"")
    assert fetch() == codes.DONE
    assert here(tmp_path) == {NAME: b""}


def test_a_log_that_goes_away_meanwhile(
    vessel: Vessel, fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def gone(ask: ReadLog, piece: bytes) -> bytes:
        vessel.log.unlink(missing_ok=True)
        return piece

    vessel.on_read = gone
    assert fetch() == codes.REFUSED
    assert "not there, or not any more" in capsys.readouterr().err
    assert here(tmp_path) == {f"{NAME}.part": CONTENT[: vessel.reads[0].size]}


@pytest.mark.parametrize("name", ["desk-08", "../runs/desk-007/log.mcap", "", "/etc/passwd"])
def test_a_name_that_there_is_not(fetch: Fetch, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fetch(name) == codes.WRONG_INPUT
    assert f"no log {name!r} on the vehicle; there are, for example: {NAME}" in capsys.readouterr().err
    assert not (tmp_path / "here").exists()


@pytest.mark.parametrize("name", ["../../secret/log.mcap", "/secret/log.mcap"])
def test_a_vehicle_whose_names_lead_elsewhere(
    vessel: Vessel, fetch: Fetch, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = LogFile(name, len(CONTENT), "", 0)
    monkeypatch.setattr(vessel.logs, "files", lambda: (told,))
    assert fetch(name) == codes.WRONG_INPUT
    assert not (tmp_path / "secret").exists()


def test_a_disk_that_is_full(fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, hard))
    try:
        code = fetch()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == codes.REFUSED
    assert "log.mcap.part: cannot be written: File too large; what has come stays" in capsys.readouterr().err
    assert fetch() == codes.DONE
    assert here(tmp_path) == {NAME: CONTENT}


def test_a_place_that_cannot_be_written(fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "here").write_text("a file")
    assert fetch() == codes.REFUSED
    assert "cannot be written" in capsys.readouterr().err


def test_for_a_program(fetch: Fetch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fetch(NAME, "--json") == codes.DONE
    told = json.loads(capsys.readouterr().out)
    assert told["outcome"] == "done"
    assert told["whole"]
    assert os.path.samefile(told["path"], tmp_path / "here" / NAME)
