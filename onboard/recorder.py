"""The flight recorder: everything that happened in a run, as one MCAP file that any MCAP reader opens."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec
from msgspec import Struct

from onboard.core.types import Event, Tick
from onboard.mcapfile import Channel, McapWriter
from onboard.records import (
    CONFIG_NAME,
    DEVICES,
    EVENT,
    INFO_NAME,
    KEYFRAME,
    NONFINITE,
    PARAMS,
    TICK,
    TIMING,
    TRUTH,
    DeviceReport,
    Keyframe,
    NonFinite,
    Revision,
    RunInfo,
    Timing,
)
from sim_backend.plant import Truth

_CHUNK_NS = 250_000_000
_CHUNK_BYTES = 1 << 20
_QUEUE = 2500
_PATIENCE = 10.0
#: A disk that takes nothing for this long is told of, s.
_STUCK = 0.5


def nonfinite(value: object) -> dict[str, str]:
    """Paths ("outputs/estimate/p_WB/2") of all floats in a message that are not finite, with their values as text."""
    found: dict[str, str] = {}

    def walk(node: object, path: str) -> None:
        if isinstance(node, float):
            if not math.isfinite(node):
                found[path] = str(node)
        elif isinstance(node, dict):
            for key, child in node.items():
                walk(child, f"{path}/{key}" if path else str(key))
        elif isinstance(node, list | tuple):
            for i, child in enumerate(node):
                walk(child, f"{path}/{i}")

    walk(msgspec.to_builtins(value), "")
    return found


class Recorder:
    """Writes ``log.mcap``. Use as a context manager; leaving it finishes the file.

    With ``background`` the encoding and writing happen in a thread of their own: no call ever waits, a full or slow
    disk loses records instead (``trouble`` tells of it in flight; ``dropped`` and ``error`` are the sum of it). Without
    it, calls write at once and errors are raised.
    A killed process loses at most the last quarter of a second.

    Args:
        path: the file; an older one is replaced.
        info: what the run is.
        config: the parameter set in force at the start.
        config_yaml: the same as text, for people.
        revision: its number.
        t_ns: time of the start on the clock of the ticks.
        background: encode and write in a thread.

    Raises:
        OSError: the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        info: RunInfo,
        config: Struct,
        config_yaml: str,
        *,
        revision: int = 0,
        t_ns: int = 0,
        background: bool = False,
    ) -> None:
        self.dropped = 0
        """Records lost to a full queue or a failed disk (background only)."""
        self.error: Exception | None = None
        """Why the background writer gave up."""
        self._since = 0.0
        """When the writer began with what it is writing, s; 0 while it waits for more."""
        self._told: set[str] = set()
        self._stream = path.open("wb")
        self._writer = McapWriter(self._stream, f"pipewright {info.version}")
        self._ticks = self._writer.channel(TICK, Tick)
        self._truths = self._writer.channel(TRUTH, Truth)
        self._channels: dict[str, Channel] = {TRUTH: self._truths}
        self._queue: queue.Queue[Callable[[], None] | None] | None = None
        self._writer.metadata(INFO_NAME, {key: str(value) for key, value in msgspec.to_builtins(info).items()})
        self._writer.attachment(CONFIG_NAME, "application/yaml", config_yaml.encode())
        self.revision(0, t_ns, revision, config)
        self._writer.flush()
        if background:
            self._queue = queue.Queue(_QUEUE)
            self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
            self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def tick(self, tick: Tick, truth: Truth | None = None) -> None:
        """Record one cycle, its events, and what was true in the world."""
        if self._queue is None:
            self._write_tick(tick, truth)
        else:
            self._enqueue(lambda: self._write_tick(tick, truth))

    def keyframe(self, index: int, t_ns: int, state: Struct) -> None:
        """Record the core's state just before tick ``index``."""
        self._do(KEYFRAME, t_ns, Keyframe(index, t_ns, state), Keyframe[type(state)])  # type: ignore[misc]

    def revision(self, index: int, t_ns: int, revision: int, config: Struct) -> None:
        """Record the parameter set that is in force from tick ``index`` on."""
        self._do(PARAMS, t_ns, Revision(index, t_ns, revision, config), Revision[type(config)])  # type: ignore[misc]

    def event(self, event: Event) -> None:
        """Record an event from outside the core."""
        self._do(EVENT, event.t_ns, event, Event)

    def truth(self, t_ns: int, truth: Truth) -> None:
        """Record what was true at ``t_ns`` in a world that moves by itself, at its own times."""
        self._do(TRUTH, t_ns, truth, Truth)

    def timing(self, timing: Timing) -> None:
        """Record how punctual a tick was (wall-clock runs)."""
        self._do(TIMING, timing.t_ns, timing, Timing)

    def devices(self, report: DeviceReport) -> None:
        """Record how the devices do (wall-clock runs)."""
        self._do(DEVICES, report.t_ns, report, DeviceReport)

    def trouble(self) -> str:
        """What has gone wrong with the log in the background: each kind once, as soon as it is seen; else empty.

        Looked at in every tick, so that it is told in flight. Never waits.
        """
        since = self._since
        if self.error is not None:
            return self._once("error", f"The log has ended: {self.error}. The flight goes on without a record.")
        if self.dropped:
            return self._once("dropped", "The disk is too slow for the log: records are being lost.")
        if since and time.monotonic() - since > _STUCK:
            return self._once("stuck", "The disk does not take the log: records will be lost if this stays.")
        return ""

    def _once(self, kind: str, text: str) -> str:
        if kind in self._told:
            return ""
        self._told.add(kind)
        return text

    def close(self) -> None:
        """Finish the file; safe to call twice. In the background mode waits a while for what is queued."""
        if self._stream.closed:
            return
        if self._queue is None:
            with self._stream:
                self._writer.finish()
            return
        try:
            self._queue.put(None, timeout=_PATIENCE)
            self._thread.join(timeout=_PATIENCE)
            if self._thread.is_alive():
                raise queue.Full
        except queue.Full:
            self.error = self.error or TimeoutError(f"the disk took nothing for {_PATIENCE} s")

    def _do(self, topic: str, t_ns: int, message: object, kind: Any) -> None:
        if self._queue is None:
            self._put(topic, t_ns, message, kind)
        else:
            self._enqueue(lambda: self._put(topic, t_ns, message, kind))

    def _enqueue(self, job: Callable[[], None]) -> None:
        assert self._queue is not None
        try:
            self._queue.put_nowait(job)
        except queue.Full:
            self.dropped += 1

    def _run(self) -> None:
        assert self._queue is not None
        try:
            while (job := self._queue.get()) is not None:
                if self.error is not None:
                    self.dropped += 1
                    continue
                self._since = time.monotonic()
                try:
                    job()
                except Exception as error:  # a flight goes on without its log
                    self.error = error
                    self.dropped += 1
                self._since = 0.0
            with self._stream:
                if self.error is None:
                    self._writer.finish()
        except OSError as error:
            self.error = self.error or error

    def _write_tick(self, tick: Tick, truth: Truth | None) -> None:
        t_ns = tick.inputs.t_ns
        writer = self._writer
        if writer.pending and (t_ns - writer.pending_since_ns >= _CHUNK_NS or writer.pending > _CHUNK_BYTES):
            writer.flush()
        inputs = tick.inputs
        optional = (inputs.odometry, inputs.autopilot, inputs.servos, inputs.request, inputs.go)
        absent = sum(value is None for value in optional)
        self._add(self._ticks, t_ns, tick, absent)
        if truth is not None:
            self._add(self._truths, t_ns, truth, 0)
        for event in tick.outputs.events:
            self._put(EVENT, event.t_ns, event, Event)

    def _put(self, topic: str, t_ns: int, message: object, kind: Any) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.channel(topic, kind)
        self._add(self._channels[topic], t_ns, message, 0)

    def _add(self, channel: Channel, t_ns: int, message: object, absent: int) -> None:
        """Append a message that has ``absent`` values of None; what is not finite goes before it in words."""
        if self._writer.add(channel, t_ns, message) != absent and (values := nonfinite(message)):
            self._writer.take_back(channel)
            self._put(NONFINITE, t_ns, NonFinite(channel.topic, channel.count, values), NonFinite)
            self._writer.add(channel, t_ns, message)
