"""Reading a log back, exactly as it was recorded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import msgspec

from onboard.core.types import Event, Tick
from onboard.mcapfile import McapScan, Message
from onboard.records import CONFIG_NAME, EVENT, INFO_NAME, NONFINITE, TICK, TIMING, TRUTH, NonFinite, RunInfo, Timing
from sim_backend.plant import Truth

T = TypeVar("T")


class LogError(Exception):
    """A log cannot be read; the text says what, where and what to do."""


class LogReader:
    """An MCAP log made by ``Recorder``. Use as a context manager.

    Args:
        path: the file.
        partial: also read a log that was cut off, up to its last whole chunk.

    Raises:
        LogError: missing file, not an MCAP file, not one of Pipewright's, or cut off and not ``partial``.
    """

    def __init__(self, path: Path, *, partial: bool = False) -> None:
        self.path = path
        try:
            self._stream = path.open("rb")
        except FileNotFoundError:
            raise LogError(f"{path}: no such log; give the log.mcap of a run folder") from None
        except OSError as error:
            raise LogError(f"{path}: cannot be opened ({error.strerror}); give the log.mcap of a run folder") from None
        try:
            self._scan = self._open(partial)
        except BaseException:
            self._stream.close()
            raise

    def _open(self, partial: bool) -> McapScan:
        try:
            scan = McapScan(self._stream)
        except ValueError as error:
            raise LogError(f"{self.path}: not an MCAP file ({error}); give the log.mcap of a run folder") from None
        if INFO_NAME not in scan.metadata or CONFIG_NAME not in scan.attachments:
            what = "not a log of Pipewright" if scan.complete else "cut off before its first record"
            raise LogError(f"{self.path}: {what}; give the log.mcap of a run folder")
        try:
            self.info = msgspec.convert(scan.metadata[INFO_NAME], RunInfo, strict=False)
        except msgspec.ValidationError as error:
            raise LogError(f"{self.path}: the description of the run cannot be read ({error})") from None
        self.config_yaml = scan.attachments[CONFIG_NAME].decode(errors="replace")
        """The configuration in force at the start, as text."""
        self.complete = scan.complete
        """The log was finished properly."""
        self.start_ns = scan.start_ns or 0
        self.end_ns = scan.end_ns
        self.duration = max(0, self.end_ns - self.start_ns) * 1e-9
        """Time from the first to the last readable record, s."""
        if not scan.complete and not partial:
            raise LogError(
                f"{self.path}: the log was cut off (its process did not finish it): "
                f"{self.duration:.1f} s are readable; --partial reads them"
            )
        return scan

    def __enter__(self) -> LogReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self, kinds: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        """All messages of the given topics in order of recording, decoded to the msgspec type named for each.

        A type may hold fewer fields than were recorded, which is faster.

        Raises:
            LogError: a chunk is damaged, or a message does not fit its type.
        """
        for topic, _, message in self.timed(kinds):
            yield topic, message

    def timed(self, kinds: Mapping[str, Any]) -> Iterator[tuple[str, int, Any]]:
        """As ``read``, with the log time (ns) of each message."""
        decoders = {topic: msgspec.json.Decoder(kind) for topic, kind in kinds.items()}
        words = msgspec.json.Decoder(NonFinite)
        pending: dict[str, NonFinite] = {}
        topic = ""
        try:
            for message in self._scan.messages():
                topic = message.topic
                decoder = decoders.get(topic)
                if decoder is not None:
                    if pending and (note := pending.pop(topic, None)) and note.sequence == message.sequence:
                        yield topic, message.t_ns, _restore(message, note.values, kinds[topic])
                    else:
                        yield topic, message.t_ns, decoder.decode(message.data)
                elif topic == NONFINITE:
                    note = words.decode(message.data)
                    pending[note.topic] = note
        except (ValueError, RecursionError) as error:
            text = f"a record on {topic} does not fit this version, it was written by {self.info.version}"
            cause = str(error) if type(error) is ValueError else f"{text} ({error})"
            raise LogError(f"{self.path}: {cause}") from None

    def one(self, topic: str, kind: type[T]) -> Iterator[T]:
        """All messages of one topic."""
        for _, message in self.read({topic: kind}):
            yield message

    def ticks(self) -> Iterator[Tick]:
        """All cycles."""
        return self.one(TICK, Tick)

    def truths(self) -> Iterator[Truth]:
        """What was true, at each cycle of a simulated run; nothing in a log of the real vehicle."""
        return self.one(TRUTH, Truth)

    def events(self) -> Iterator[Event]:
        """All events."""
        return self.one(EVENT, Event)

    def timings(self) -> Iterator[Timing]:
        """Punctuality of each cycle; nothing in a log of a simulated run."""
        return self.one(TIMING, Timing)


def _restore(message: Message, values: Mapping[str, str], kind: Any) -> Any:
    """Decode a message, putting back what JSON could only write as null."""
    tree = msgspec.json.decode(message.data)
    for path, value in values.items():
        *parents, last = path.split("/")
        node = tree
        try:
            for key in parents:
                node = node[int(key) if isinstance(node, list) else key]
            node[int(last) if isinstance(node, list) else last] = float(value)
        except (LookupError, TypeError, ValueError):
            raise ValueError(f"{path} = {value} is no number of the record on {message.topic}") from None
    return msgspec.convert(tree, kind)
