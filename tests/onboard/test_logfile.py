from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from msgspec import Struct

from onboard.logfile import LogError, LogReader
from onboard.records import TICK, TRUTH
from tests.synthetic import mission, record

CYCLES = list(mission())[:400]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("log") / "log.mcap", CYCLES)


def test_header_and_contents(whole: Path) -> None:
    with LogReader(whole) as log:
        assert log.complete
        assert (log.info.scenario, log.info.law, log.info.seed) == ("paper", "tuned", 7)
        assert log.config_yaml == "pipe: {}\n"
        assert log.duration == pytest.approx(399 * 0.004)
        assert list(log.ticks()) == [tick for tick, _ in CYCLES]
        assert list(log.truths()) == [truth for _, truth in CYCLES]
        assert not list(log.timings())


def test_slim_types_read_what_they_name(whole: Path) -> None:
    class Slim(Struct):
        index: int

    with LogReader(whole) as log:
        assert [message.index for _, message in log.read({TICK: Slim})] == list(range(400))


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such log"):
        LogReader(tmp_path / "none.mcap")


def test_folder_instead_of_file(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be opened"):
        LogReader(tmp_path)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"hello, this is text" * 10])
def test_something_else(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match="not an MCAP file"):
        LogReader(path)


def test_somebody_elses_mcap(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    writer = Writer(str(path))
    writer.start()
    writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(LogError, match="not a log of Pipewright"):
        LogReader(path)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(share=st.floats(min_value=0.0, max_value=0.9999))
def test_log_cut_off_anywhere(whole: Path, share: float) -> None:
    cut = whole.with_name("cut.mcap")
    cut.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    with pytest.raises(LogError) as strict:
        LogReader(cut)
    if "readable" not in str(strict.value):
        with pytest.raises(LogError, match=r"cut off before its first record|not an MCAP"):
            LogReader(cut, partial=True)
        return
    with LogReader(cut, partial=True) as log:
        ticks = list(log.ticks())
        assert ticks == [tick for tick, _ in CYCLES[: len(ticks)]]
        assert not log.complete


def test_cut_off_log_says_what_can_be_read(whole: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    with LogReader(cut, partial=True) as log:
        seconds = log.duration
    assert seconds > 0.2
    with pytest.raises(LogError, match=rf"{seconds:.1f} s are readable; --partial reads them"):
        LogReader(cut)


def test_damaged_chunk(whole: Path, tmp_path: Path) -> None:
    content = bytearray(whole.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with LogReader(path) as log, pytest.raises(LogError, match="chunk at byte"):
        list(log.ticks())


def test_record_of_another_version(whole: Path) -> None:
    class Other(Struct):
        wind: float

    with LogReader(whole) as log, pytest.raises(LogError, match=r"/tick does not fit this version.*0\.1\.0.*wind"):
        list(log.one(TICK, Other))


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
def test_other_compressions(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "log.mcap"
    writer = Writer(str(path), compression=compression)
    writer.start()
    writer.add_metadata("run", {"version": "0", "scenario": "paper", "law": "tuned", "seed": "1"})
    writer.add_attachment(0, 0, "config.yaml", "application/yaml", b"")
    channel = writer.register_channel(TRUTH, "json", writer.register_schema("Truth", "jsonschema", b"{}"))
    writer.add_message(channel, 0, b"{}", 0)
    writer.finish()  # type: ignore[no-untyped-call]
    with LogReader(path) as log:
        if compression is CompressionType.NONE:
            assert list(log.one(TRUTH, dict)) == [{}]
        else:
            with pytest.raises(LogError, match="lz4"):
                list(log.one(TRUTH, dict))
