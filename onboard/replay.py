"""Replay: the recorded inputs through the core again, compared to the bit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from onboard.config import Config
from onboard.core.step import State, initial_state, step
from onboard.core.types import Tick
from onboard.logfile import LogError, LogReader
from onboard.records import KEYFRAME, PARAMS, TICK, Keyframe, Revision


class Field(Struct, frozen=True):
    """One value that differs."""

    path: str
    recorded: Any
    recomputed: Any


class Difference(Struct, frozen=True):
    """The first tick that did not come out as recorded."""

    index: int
    t: float
    """Time since the first tick of the log, s."""
    phase: str
    fields: tuple[Field, ...]


class Replay(Struct, frozen=True):
    """What a replay found."""

    start: float
    """Where it began, s since the first tick of the log."""
    ticks: int
    """Cycles compared."""
    keyframes: int
    """Recorded states of the core that were compared as well."""
    missing: int
    """Cycles that are not in the log; each gap is left at the next keyframe."""
    difference: Difference | None

    @property
    def same(self) -> bool:
        """Everything compared was equal to the bit."""
        return self.difference is None

    def __str__(self) -> str:
        gap = f"; {self.missing} ticks are missing in the log and were passed over" if self.missing else ""
        if self.difference is None:
            return f"{self.ticks} ticks and {self.keyframes} states from t = {self.start:.3f} s on: no difference{gap}"
        found = self.difference
        width = max(len(field.path) for field in found.fields)
        lines = [
            f"first difference at t = {found.t:.3f} s, tick {found.index}, phase {found.phase}, "
            f"after {self.ticks} equal ticks from t = {self.start:.3f} s on{gap}",
            f"  {'field':<{width}}  {'recorded':<24}  recomputed",
            *(f"  {field.path:<{width}}  {field.recorded!r:<24}  {field.recomputed!r}" for field in found.fields),
        ]
        return "\n".join(lines)


class _Mark(Struct):
    index: int
    t_ns: int


class _Stamp(Struct):
    t_ns: int


class _Head(Struct):
    index: int
    inputs: _Stamp


_encode = msgspec.json.Encoder().encode


def replay(
    path: Path,
    start: float | None = None,
    *,
    partial: bool = False,
    on_second: Callable[[float, float], None] | None = None,
) -> Replay:
    """Run a log's inputs through the core again and compare all outputs with the recorded ones.

    Args:
        path: the log.
        start: begin at the last keyframe at or before this time (s since the first tick); None is the very start.
        partial: also accept a log that was cut off.
        on_second: called once per replayed second with that time and the length of the log, s.

    Raises:
        LogError: the log cannot be read, or cannot be replayed from there.
    """
    with LogReader(path, partial=partial) as log:
        first_ns, first_index = _beginning(log, start)
        origin_ns = next(log.one(TICK, _Head)).inputs.t_ns
        expected, state = first_index, None
        params: Config | None = None
        revision = -1
        compared = keyframes = missing = 0
        second = 0
        kinds = {PARAMS: Revision[Config], KEYFRAME: Keyframe[State], TICK: Tick}

        def result(difference: Difference | None) -> Replay:
            return Replay((first_ns - origin_ns) * 1e-9, compared, keyframes, missing, difference)

        for topic, message in log.read(kinds):
            if topic == PARAMS:
                params, revision = message.config, message.revision
            elif topic == KEYFRAME:
                if message.index < first_index:
                    continue
                if state is not None and message.index == expected:
                    if fields := differences(message.state, state):
                        t = (message.t_ns - origin_ns) * 1e-9
                        return result(Difference(message.index, t, state.mission.phase, _under("state", fields)))
                    keyframes += 1
                elif state is None or message.index > expected:
                    missing += message.index - expected
                    expected, state = message.index, message.state
            elif message.index >= first_index:
                tick: Tick = message
                if params is None or tick.revision != revision:
                    raise LogError(
                        f"{path}: tick {tick.index} was made with parameter revision {tick.revision}, "
                        f"which the log does not hold at that point"
                    )
                if state is None and tick.index == 0:
                    state = initial_state(params)
                if state is None or tick.index != expected:
                    continue
                state, outputs = step(state, tick.inputs, params, tick.inputs.dt)
                recorded, recomputed = _encode(tick.outputs), _encode(outputs)
                t = (tick.inputs.t_ns - origin_ns) * 1e-9
                if (recorded != recomputed or b"null" in recorded) and (fields := differences(tick.outputs, outputs)):
                    return result(Difference(tick.index, t, tick.outputs.phase, fields))
                compared += 1
                expected += 1
                if on_second is not None and t >= second:
                    on_second(t, log.duration)
                    second = int(t) + 1
        return result(None)


def _beginning(log: LogReader, start: float | None) -> tuple[int, int]:
    """Time (ns) and index of the first tick to replay."""
    head = next(log.one(TICK, _Head), None)
    if head is None:
        raise LogError(f"{log.path}: holds no tick to replay")
    if start is None and head.index == 0:
        return head.inputs.t_ns, 0
    origin = head.inputs.t_ns
    marks = list(log.one(KEYFRAME, _Mark))
    if not marks:
        raise LogError(f"{log.path}: holds no keyframe to start from")
    if start is None:
        return marks[0].t_ns, marks[0].index
    reachable = [mark for mark in marks if (mark.t_ns - origin) * 1e-9 <= start + 1e-9]
    last = (log.end_ns - origin) * 1e-9
    if not reachable or start > last:
        low = (marks[0].t_ns - origin) * 1e-9
        raise LogError(f"{log.path}: no keyframe at or before {start:g} s; give a time from {low:g} s to {last:g} s")
    return reachable[-1].t_ns, reachable[-1].index


def differences(recorded: object, recomputed: object) -> tuple[Field, ...]:
    """Every value in which two messages differ, sign of zero included; two NaN are equal."""
    return tuple(_walk(msgspec.to_builtins(recorded), msgspec.to_builtins(recomputed), ""))


def _walk(a: Any, b: Any, path: str) -> Iterator[Field]:
    if isinstance(a, dict) and isinstance(b, dict):
        for key in {**a, **b}:
            yield from _walk(a.get(key), b.get(key), f"{path}.{key}" if path else key)
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from _walk(x, y, f"{path}.{i}")
    elif isinstance(a, int | float) and isinstance(b, int | float):
        both_nan = math.isnan(a) and math.isnan(b)
        if not both_nan and (a != b or math.copysign(1.0, a) != math.copysign(1.0, b)):
            yield Field(path, a, b)
    elif a != b:
        yield Field(path, a, b)


def _under(name: str, fields: tuple[Field, ...]) -> tuple[Field, ...]:
    return tuple(Field(f"{name}.{field.path}", field.recorded, field.recomputed) for field in fields)
