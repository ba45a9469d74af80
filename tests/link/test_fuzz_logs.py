"""Logs that were damaged on their way, or made to hurt: read as far as they are right, or refused in words."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from onboard.logfile import LogError, LogReader
from onboard.mcapfile import _RECORD, MAGIC, McapScan, _record
from onboard.records import DEVICES, NONFINITE, TICK, DeviceReport, NonFinite
from onboard.replay import replay
from tests.link.wrong_input import damaged, examples, plain, spoilt, taken
from tests.synthetic import mission, record


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A small whole log."""
    cycles = [cycle for cycle, _ in zip(mission(), range(12), strict=False)]
    return record(tmp_path_factory.mktemp("log") / "log.mcap", cycles).read_bytes()


def pieces(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The records of a file: number and content."""
    position = len(MAGIC)
    while position + _RECORD.size <= len(data) - len(MAGIC):
        opcode, length = _RECORD.unpack_from(data, position)
        position += _RECORD.size
        yield opcode, data[position : position + length]
        position += length


def repacked(log: bytes, content: bytes) -> bytes:
    """The log with this as the content of its chunk, of which no checksum tells anything."""
    made = bytearray(MAGIC)
    for opcode, body in pieces(log):
        if opcode == Opcode.CHUNK:
            made += _record(records.Chunk("", content, 0, 0, 0, len(content)))
        elif opcode < Opcode.CHUNK or opcode in (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.FOOTER):
            made += _RECORD.pack(opcode, len(body)) + body
    return bytes(made + MAGIC)


def unpacked(log: bytes) -> bytes:
    """The content of its chunks."""
    return b"".join(bytes(_chunk(log, body)) for opcode, body in pieces(log) if opcode == Opcode.CHUNK)


def _chunk(log: bytes, body: bytes) -> bytes:
    return McapScan(BytesIO(log))._unpacked(log.index(body), len(body))


def read(path: Path, data: bytes) -> int:
    """Read all there is to read, in every way; gives how many records were right."""
    path.write_bytes(data)
    found = 0

    def everything() -> None:
        nonlocal found
        with LogReader(path, partial=True) as reader:
            assert reader.duration >= 0.0
            for _ in reader.timed({TICK: Any, DEVICES: DeviceReport, "/event": Any, "/truth": Any, "/params": Any}):
                found += 1
            for _ in reader.ticks():
                found += 1

    taken(everything, LogError)
    taken(lambda: LogReader(path).close(), LogError)
    taken(lambda: replay(path, partial=True), LogError)
    return found


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged") / "log.mcap"


def test_what_is_whole_is_read(log: bytes, path: Path) -> None:
    assert read(path, log) > 24
    assert read(path, repacked(log, unpacked(log))) > 24


def test_damaged_files(log: bytes, path: Path) -> None:
    @examples(150)
    @given(damaged([log, MAGIC, log[:400]]))
    def feed(data: bytes) -> None:
        read(path, data)

    feed()


def test_damaged_heads(log: bytes, path: Path) -> None:
    """The damage strikes what comes before the first chunk, which no checksum covers."""
    head = len(MAGIC) + sum(_RECORD.size + len(body) for opcode, body in pieces(log) if opcode < Opcode.CHUNK)

    @examples(150)
    @given(damaged([log[:head]]))
    def feed(data: bytes) -> None:
        read(path, data + log[head:])

    feed()


def test_damaged_records(log: bytes, path: Path) -> None:
    """The damage strikes inside of a chunk, and the checksum does not tell."""
    content = unpacked(log)

    @examples(200)
    @given(damaged([content, content[:2000]]))
    def feed(data: bytes) -> None:
        read(path, repacked(log, data))

    feed()


def test_records_of_wrong_values(log: bytes, path: Path) -> None:
    numbers = {
        channel.topic: channel.id
        for opcode, body in pieces(log)
        if opcode == Opcode.CHANNEL
        for channel in [records.Channel.read(ReadDataStream(BytesIO(body)))]
    }
    tick, _ = next(mission())
    extra = _record(records.Channel(99, NONFINITE, "json", {}, 1))
    note = msgspec.to_builtins(NonFinite(TICK, 0, {"inputs/odometry/p_WB/2": "nan", "x/9/y": "inf", "index/a": "x"}))

    def message(number: int, value: Any) -> bytes:
        return _record(records.Message(number, 5, msgspec.json.encode(value, enc_hook=str), 5, 0))

    @examples(150)
    @given(spoilt(msgspec.to_builtins(tick), plain), spoilt(note, plain | st.sampled_from([TICK, "nan", "0"])))
    def feed(wrong: Any, words: Any) -> None:
        noted = {**words, "topic": TICK, "sequence": 0} if isinstance(words, dict) else words
        read(path, repacked(log, extra + message(99, noted) + message(numbers[TICK], wrong)))
        read(path, repacked(log, extra + message(99, words) + message(numbers[TICK], msgspec.to_builtins(tick))))

    feed()


def test_pits_of_json(log: bytes, path: Path) -> None:
    for body in (b"[" * 100_000, b'{"x":' * 100_000, b'{"index":1e999}', b'{"a":"\xff"}', b""):
        content = _record(records.Message(1, 5, body, 5, 0)) + _record(records.Message(0xFFFF, 5, body, 5, 0))
        assert read(path, repacked(log, content)) == 0
