from __future__ import annotations

import errno
import io
import json
import math
import os
import threading
import time
from pathlib import Path
from typing import BinaryIO

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from msgspec.structs import replace

from onboard import recorder as recorder_module
from onboard.core.types import Event, Inputs, Severity, Tick
from onboard.logfile import LogReader
from onboard.mcapfile import McapScan, McapWriter, flat_schema
from onboard.recorder import Recorder
from onboard.records import EVENT, KEYFRAME, PARAMS, TICK, TRUTH, Keyframe, RunInfo, Timing
from sim_backend.plant import Truth
from tests.synthetic import DT_NS, ConfigStub, change_outputs, mission, record


class StateStub(msgspec.Struct, frozen=True):
    level: float
    history: tuple[float, ...]


CYCLES = list(mission())
INFO = RunInfo(version="0.1.0", scenario="paper", law="tuned", seed=7)


def test_reference_reader_finds_everything(tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap")
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        topics = {channel.topic: channel.id for channel in summary.channels.values()}
        counts = summary.statistics.channel_message_counts
        assert counts[topics[TICK]] == counts[topics[TRUTH]] == len(CYCLES)
        ticks = [json.loads(message.data) for _, _, message in reader.iter_messages(topics=[TICK])]
        some = [
            m.log_time for _, _, m in reader.iter_messages(topics=[TRUTH], starting_at=10**9, ending_before=2 * 10**9)
        ]
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
    assert [tick["index"] for tick in ticks] == list(range(len(CYCLES)))
    assert len(some) == 250
    assert some[0] == 10**9
    assert attachment.name == "config.yaml"
    assert attachment.data == b"pipe: {}\n"
    assert metadata.metadata["seed"] == "7"


def test_events_of_the_core_stand_on_their_own_topic(tmp_path: Path) -> None:
    with LogReader(record(tmp_path / "log.mcap")) as log:
        assert [event.text for event in log.events()] == [
            event.text for tick, _ in CYCLES for event in tick.outputs.events
        ]


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    assert record(tmp_path / "a" / "log.mcap").read_bytes() == record(tmp_path / "other.mcap").read_bytes()


def test_older_file_is_replaced(tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap", CYCLES[:50])
    record(path, CYCLES[:1])
    with LogReader(path) as log:
        assert [tick.index for tick in log.ticks()] == [0]


def test_what_was_written_before_a_kill_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    recorder = Recorder(path, INFO, ConfigStub(), "")
    for tick, truth in CYCLES[:500]:
        recorder.tick(tick, truth)
    killed = tmp_path / "killed.mcap"
    killed.write_bytes(path.read_bytes())
    recorder.close()
    with LogReader(killed, partial=True) as log:
        ticks = list(log.ticks())
    assert ticks == [tick for tick, _ in CYCLES[: len(ticks)]]
    assert len(ticks) >= 500 - 63


@settings(deadline=None, max_examples=60, derandomize=True)
@given(values=st.lists(st.floats(allow_nan=False), min_size=3, max_size=3))
def test_floats_come_back_to_the_bit(values: list[float]) -> None:
    truth = CYCLES[700][1]
    x, y, z = values
    marked = replace(truth, contact_W=(x, y, z))
    stream = io.BytesIO()
    writer = McapWriter(stream, "test")
    channel = writer.channel(TRUTH, Truth)
    writer.add(channel, 0, marked)
    writer.finish()
    (message,) = McapScan(stream).messages()
    if all(map(math.isfinite, values)):
        assert msgspec.json.decode(message.data, type=Truth).contact_W == (x, y, z)
        assert [math.copysign(1, v) for v in msgspec.json.decode(message.data)["contact_W"]] == [
            math.copysign(1, v) for v in values
        ]


def test_what_is_absent_is_not_searched_for_what_is_not_finite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking through a whole tick costs more than recording it."""
    searched: list[object] = []

    def search(message: object) -> dict[str, str]:
        searched.append(message)
        return {}

    monkeypatch.setattr(recorder_module, "nonfinite", search)
    ticks = [CYCLES[2][0], replace(CYCLES[3][0], inputs=Inputs(3 * DT_NS, 0.004, None, None, None))]
    record(tmp_path / "log.mcap", [(tick, CYCLES[2][1]) for tick in ticks])
    assert searched == []


def test_values_that_json_cannot_say_come_back(tmp_path: Path) -> None:
    tick, truth = CYCLES[3]
    odometry = tick.inputs.odometry
    assert odometry is not None
    bad = replace(
        tick, inputs=replace(tick.inputs, odometry=replace(odometry, p_WB=(math.nan, math.inf, -math.inf)), servos=None)
    )
    bad = change_outputs(bad, events=(Event(0, "x", Severity.INFO, "null and void"),))
    path = record(tmp_path / "log.mcap", [CYCLES[2], (bad, replace(truth, contact_force=math.nan)), CYCLES[4]])
    with LogReader(path) as log:
        ticks = list(log.ticks())
        truths = list(log.truths())
    assert ticks[0] == CYCLES[2][0]
    assert ticks[2] == CYCLES[4][0]
    back = ticks[1].inputs.odometry
    assert back is not None
    assert math.isnan(back.p_WB[0])
    assert back.p_WB[1:] == (math.inf, -math.inf)
    assert ticks[1].inputs.servos is None
    assert ticks[1].outputs == bad.outputs
    assert math.isnan(truths[1].contact_force)


def test_keyframes_and_revisions_come_back(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    state = StateStub(-math.inf, (1.0, math.nan))
    with Recorder(path, INFO, ConfigStub(), "", t_ns=5, revision=1) as recorder:
        recorder.keyframe(0, 5, state)
        recorder.revision(1, 9, 2, ConfigStub())
    with LogReader(path) as log:
        found = dict(log.read({KEYFRAME: Keyframe[StateStub]}))[KEYFRAME]
        revisions = [(m["index"], m["t_ns"], m["revision"]) for _, m in log.read({PARAMS: dict})]
        assert log.start_ns == 5
    assert found.state.level == -math.inf
    assert math.isnan(found.state.history[1])
    assert revisions == [(0, 5, 1), (1, 9, 2)]


def test_schemas_are_flat(tmp_path: Path) -> None:
    schema = json.dumps(flat_schema(Tick))
    for word in ("$ref", "$defs", "anyOf", "prefixItems"):
        assert word not in schema
    properties = flat_schema(Tick)["properties"]
    assert properties["inputs"]["properties"]["odometry"]["properties"]["p_WB"] == {
        "type": "array",
        "items": {"type": "number"},
    }
    assert properties["outputs"]["properties"]["verdict"]["properties"]["action"]["type"] == "integer"


def test_background_writes_the_same_file(tmp_path: Path) -> None:
    one = record(tmp_path / "a.mcap", CYCLES[:300])
    two = record(tmp_path / "b.mcap", CYCLES[:300], background=True)
    assert one.read_bytes() == two.read_bytes()


class StuckStream:
    """A disk that takes nothing until released, and then may say that it is full."""

    def __init__(self, stream: BinaryIO, failure: OSError | None = None) -> None:
        self.stream = stream
        self.failure = failure
        self.entered = threading.Event()
        self.released = threading.Event()
        self.closed = False

    def write(self, data: bytes) -> int:
        self.entered.set()
        self.released.wait()
        if self.failure is not None:
            raise self.failure
        return self.stream.write(data)

    def flush(self) -> None:
        self.stream.flush()

    def close(self) -> None:
        self.closed = True
        self.stream.close()


def stick(recorder: Recorder, failure: OSError | None = None) -> StuckStream:
    """Replace the disk under a recorder."""
    stuck = StuckStream(recorder._stream, failure)
    recorder._writer._stream = stuck  # type: ignore[assignment]
    return stuck


def told_within(recorder: Recorder, text: str, seconds: float = 30.0) -> None:
    """Ticks go on, each in no time, until the recorder has told of ``text``."""
    tick, longest, end = CYCLES[0][0], 0.0, time.monotonic() + seconds
    while text not in recorder.trouble():
        begun = time.monotonic()
        recorder.tick(tick)
        longest = max(longest, time.monotonic() - begun)
        assert time.monotonic() < end, "never told"
        threading.Event().wait(0.004)  # the loop's period
    assert longest < 0.5


def test_a_stuck_disk_is_told_in_flight_before_anything_is_lost(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap", INFO, ConfigStub(), "", background=True)
    stuck = stick(recorder)
    recorder.event(Event(0, "x", Severity.INFO, "opens a topic, which writes"))
    assert stuck.entered.wait(10)
    told_within(recorder, "does not take the log")
    assert recorder.dropped == 0
    assert recorder.trouble() == "", "told once"
    for _ in range(3000):
        recorder.tick(CYCLES[0][0])
    assert "records are being lost" in recorder.trouble()
    assert recorder.trouble() == ""
    stuck.released.set()
    recorder.close()
    assert recorder.trouble() == ""


def test_a_full_disk_is_told_in_flight(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap", INFO, ConfigStub(), "", background=True)
    assert recorder.trouble() == ""
    stick(recorder, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))).released.set()
    recorder.event(Event(0, "x", Severity.INFO, "opens a topic, which writes"))
    told_within(recorder, "No space left on device")
    assert recorder.trouble() == ""
    recorder.close()


def test_a_healthy_disk_is_never_told_of(tmp_path: Path) -> None:
    with Recorder(tmp_path / "log.mcap", INFO, ConfigStub(), "", background=True) as recorder:
        for tick, truth in CYCLES[:500]:
            recorder.tick(tick, truth)
            assert recorder.trouble() == ""
    assert recorder.trouble() == ""


def test_slow_disk_drops_and_counts_and_never_blocks(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap", INFO, ConfigStub(), "", background=True)
    stuck = stick(recorder)
    tick = CYCLES[0][0]
    recorder.event(Event(0, "x", Severity.INFO, "opens a topic, which writes"))
    assert stuck.entered.wait(10)
    for index in range(3000):
        recorder.tick(replace(tick, index=index))
    assert recorder.dropped == 500
    stuck.released.set()
    recorder.close()
    assert recorder.error is None
    with LogReader(tmp_path / "log.mcap") as log:
        assert [t.index for t in log.ticks()] == list(range(2500))


def test_full_disk_is_told_and_the_flight_goes_on(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap", INFO, ConfigStub(), "", background=True)
    stick(recorder, OSError(28, "No space left on device")).released.set()
    for tick, truth in CYCLES[:200]:
        recorder.tick(tick, truth)
    recorder.timing(Timing(0, 0, 0.0, 0.0, 0.0))
    recorder.close()
    assert isinstance(recorder.error, OSError)
    assert recorder.dropped > 0


def test_full_disk_is_raised_when_writing_at_once(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "log.mcap", INFO, ConfigStub(), "")
    stick(recorder, OSError(28, "No space left on device")).released.set()

    def fly() -> None:
        for tick, truth in CYCLES[:200]:
            recorder.tick(tick, truth)

    with pytest.raises(OSError, match="No space left"):
        fly()
    with pytest.raises(OSError, match="No space left"):
        recorder.close()
    recorder.close()


def test_unknown_topics_do_not_disturb(tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap", CYCLES[:10])
    with LogReader(path) as log:
        assert not list(log.read({"/nowhere": dict}))
        assert {topic for topic, _ in log.read({EVENT: dict, TICK: dict})} == {EVENT, TICK}
