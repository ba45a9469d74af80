"""Faults of devices, declared beforehand or injected on command: which device, what, when, how much.

An emulator holds one ``Faults``, asks it at each step what is in force, and spoils its own bytes accordingly. Times are
seconds of the world. A fault with a phase begins when that phase of the mission is entered for the first time. What
strikes single samples or packets may be limited to a ``count`` of them.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from enum import StrEnum
from math import inf
from pathlib import Path
from typing import Annotated

import msgspec
import yaml
from msgspec import Struct
from msgspec.structs import replace

from sim_backend.knob import knob


class Kind(StrEnum):
    """What goes wrong. Each emulator names the kinds it can show."""

    DROP = "drop"
    """A share ``value`` (0..1) of the samples or packets is missing."""
    DELAY = "delay"
    """Everything comes ``value`` seconds late."""
    CORRUPT = "corrupt"
    """A share ``value`` (0..1) of the packets is damaged."""
    TRUNCATE = "truncate"
    """A share ``value`` (0..1) of the packets breaks off in the middle."""
    WRONG_ID = "wrong_id"
    """A share ``value`` (0..1) of the packets names a wrong sender."""
    FREEZE = "freeze"
    """The same values over and over, with fresh times."""
    JUMP = "jump"
    """What is measured moves by ``value`` at the start, for good."""
    DRIFT = "drift"
    """What is measured creeps by ``value`` a second; what has gathered stays."""
    NAN = "nan"
    """Numbers that are not finite."""
    CONFIDENCE = "confidence"
    """The device trusts itself this little: ``value``."""
    ERROR_BIT = "error_bit"
    """The device reports the error bits ``value``; at a duration of 0, once."""
    SILENT = "silent"
    """Nothing comes, but the device is there."""
    UNPLUGGED = "unplugged"
    """The device is not there."""
    REBOOT = "reboot"
    """The device falls silent for the duration and forgets what it was told."""


_SHARES = frozenset((Kind.DROP, Kind.CORRUPT, Kind.TRUNCATE, Kind.WRONG_ID))
_COUNTED = _SHARES | {Kind.DELAY}


def _text(doc: str) -> msgspec.Meta:
    return msgspec.Meta(description=doc, extra={"unit": "", "in_flight": False})


class Fault(Struct, frozen=True, forbid_unknown_fields=True):
    """One fault of one device."""

    device: Annotated[str, _text("autopilot, odometry or servos")]
    kind: Kind
    start: Annotated[float, knob("s", "since the world began, or since the phase was entered", 0.0, 1e5)] = 0.0
    duration: Annotated[float, knob("s", "how long; none: for good", 0.0, 1e5)] | None = None
    value: Annotated[float, knob("", "how much, in the unit of the kind", -1e9, 1e9)] = 0.0
    phase: Annotated[str, _text("phase of the mission")] | None = None
    part: Annotated[str, _text("servo or message that it strikes; empty: all")] = ""
    count: Annotated[int, knob("1", "samples or packets that it strikes; none: all", 1, 1_000_000)] | None = None


class Faults:
    """The faults of one device. One thread may ask while another injects or tells the phase."""

    def __init__(
        self, device: str, kinds: Iterable[Kind], declared: Sequence[Fault] = (), parts: Sequence[str] = ()
    ) -> None:
        """Take those of ``declared`` that strike this device; ``parts`` are the names it knows (none: any).

        Raises ValueError for a kind that is not in ``kinds``, and as ``add`` does.
        """
        self._device = device
        self._kinds = frozenset(kinds)
        self._parts = frozenset(parts)
        self._faults: tuple[Fault, ...] = ()
        self._entered: dict[str, float] = {}
        self._struck: Counter[Fault] = Counter()
        self._begun: set[Fault] = set()
        for fault in declared:
            if fault.device == device:
                self.add(fault)

    def add(self, fault: Fault) -> None:
        """Declare one more. Raises ValueError for one that this device cannot show."""
        what = f"fault {fault.kind} of {fault.device}"
        if fault.device != self._device or fault.kind not in self._kinds:
            raise ValueError(f"{what}: {self._device} can show {', '.join(sorted(self._kinds))}")
        if fault.part and self._parts and fault.part not in self._parts:
            raise ValueError(f"{what}: no part {fault.part!r}; want one of {', '.join(sorted(self._parts))}")
        if fault.kind in _SHARES and not 0.0 < fault.value <= 1.0:
            raise ValueError(f"{what}: value {fault.value:g}; want a share, above 0 and up to 1")
        if fault.kind is Kind.DELAY and fault.value <= 0.0:
            raise ValueError(f"{what}: value {fault.value:g}; want seconds, above 0")
        if fault.kind is Kind.ERROR_BIT and fault.value not in range(1, 256):
            raise ValueError(f"{what}: value {fault.value:g}; want bits, 1 to 255")
        if fault.count is not None and fault.kind not in _COUNTED:
            raise ValueError(f"{what}: has no count; only {', '.join(sorted(_COUNTED & self._kinds))} have one")
        self._faults = (*self._faults, fault)

    def inject(
        self,
        t: float,
        kind: Kind,
        duration: float | None = None,
        value: float = 0.0,
        part: str = "",
        count: int | None = None,
    ) -> None:
        """One that begins now, at world time t."""
        self.add(Fault(self._device, kind, t, duration, value, None, part, count))

    def clear(self, kind: Kind | None = None) -> None:
        """The device is healthy from now on, or at least free of faults of this kind."""
        self._faults = tuple(fault for fault in self._faults if kind is not None and fault.kind is not kind)

    def enter(self, phase: str, t: float) -> None:
        """The mission is in this phase at world time t. May be told at every step."""
        self._entered.setdefault(phase, t)

    def _begin(self, fault: Fault) -> float:
        return fault.start + (0.0 if fault.phase is None else self._entered.get(fault.phase, inf))

    def _in_force(self, t: float) -> Iterator[tuple[Fault, float]]:
        """Each fault that is in force, and the world time of its beginning."""
        for fault in self._faults:
            begin = self._begin(fault)
            end = inf if fault.duration is None else begin + fault.duration
            if begin <= t < end and (fault.count is None or self._struck[fault] < fault.count):
                yield fault, begin

    def active(self, t: float) -> tuple[Fault, ...]:
        """What is in force at world time t, each with ``start`` as world time."""
        return tuple(
            fault if fault.phase is None else replace(fault, start=begin) for fault, begin in self._in_force(t)
        )

    def begun(self, kind: Kind, t: float) -> tuple[Fault, ...]:
        """The faults of this kind that have begun by t, each told once, however short it was."""
        found = tuple(
            fault
            for fault in self._faults
            if fault.kind is kind and fault not in self._begun and self._begin(fault) <= t
        )
        self._begun.update(found)
        return found

    def strike(self, kind: Kind, t: float, part: str = "", chance: float = 0.0) -> Fault | None:
        """The fault of this kind that strikes this one sample or packet; it is counted.

        ``chance``: a random number from 0 to 1, for the kinds whose value is a share.
        """
        for fault, _ in self._in_force(t):
            if fault.kind is kind and fault.part in ("", part) and (kind not in _SHARES or chance < fault.value):
                self._struck[fault] += 1
                return fault
        return None

    def find(self, kind: Kind, t: float, part: str = "") -> Fault | None:
        """The fault of this kind that is in force at t and strikes this part."""
        for fault in self.active(t):
            if fault.kind is kind and fault.part in ("", part):
                return fault
        return None


class _Loader(yaml.SafeLoader):
    """Merges nothing: a few lines of ``<<`` would stand for more than fits into memory."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave it as it is; ``<<`` is then a key that no fault has."""


#: What PyYAML raises for text that is none; all but the first for what it takes for right, such as ``!!bool x``.
_NOT_YAML = (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, OverflowError, RecursionError)


def read_faults(text: str, source: str) -> tuple[Fault, ...]:
    """Faults from YAML: one mapping, or a list of them. Raises ValueError with every error; ``source`` is named."""
    try:
        items = yaml.load(text, Loader=_Loader)
    except _NOT_YAML as error:
        raise ValueError(f"{source}: not YAML: {str(error) or type(error).__name__}") from error
    items = [] if items is None else items if isinstance(items, list) else [items]
    faults, errors = [], []
    for number, item in enumerate(items, 1):
        try:
            faults.append(msgspec.convert(item, Fault))
        except msgspec.ValidationError as error:
            errors.append(f"{source}: fault {number}: {error}")
    if errors:
        raise ValueError("\n".join(errors))
    return tuple(faults)


def read_fault_file(path: Path) -> tuple[Fault, ...]:
    """Faults from a YAML file. Raises ValueError, also when there is no such file."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"{path}: {reason}; want a YAML list of faults") from error
    return read_faults(text, str(path))


def add_fault_options(parser: ArgumentParser) -> None:
    """The options with which an emulator that runs alone is told its faults."""
    parser.add_argument("--fault", action="append", default=[], help="as YAML: '{device: servos, kind: silent}'")
    parser.add_argument("--faults", type=Path, help="YAML file with a list of faults")


def given_faults(given: Namespace) -> tuple[Fault, ...]:
    """The faults of these options. Raises ValueError with what is wrong with them."""
    faults = [fault for text in given.fault for fault in read_faults(text, f"--fault {text}")]
    return (*faults, *(read_fault_file(given.faults) if given.faults else ()))
