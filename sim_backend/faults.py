"""Faults of devices, declared beforehand or injected on command: which device, what, when, how much.

An emulator holds one ``Faults``, asks it at each step what is in force, and spoils its own bytes accordingly. Times are
seconds of the world. A fault with a phase begins when that phase of the mission is entered for the first time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
    """The device reports the error bits ``value``."""
    SILENT = "silent"
    """Nothing comes, but the device is there."""
    UNPLUGGED = "unplugged"
    """The device is not there."""
    REBOOT = "reboot"
    """The device falls silent for the duration and forgets what it was told."""


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


class Faults:
    """The faults of one device. One thread may ask while another injects or tells the phase."""

    def __init__(self, device: str, kinds: Iterable[Kind], declared: Sequence[Fault] = ()) -> None:
        """Take those of ``declared`` that strike this device. Raises ValueError for a kind that is not in ``kinds``."""
        self._device = device
        self._kinds = frozenset(kinds)
        self._faults: tuple[Fault, ...] = ()
        self._entered: dict[str, float] = {}
        for fault in declared:
            if fault.device == device:
                self.add(fault)

    def add(self, fault: Fault) -> None:
        """Declare one more."""
        if fault.device != self._device or fault.kind not in self._kinds:
            raise ValueError(
                f"fault {fault.kind} of {fault.device}: {self._device} can show {', '.join(sorted(self._kinds))}"
            )
        self._faults = (*self._faults, fault)

    def inject(self, t: float, kind: Kind, duration: float | None = None, value: float = 0.0, part: str = "") -> None:
        """One that begins now, at world time t."""
        self.add(Fault(self._device, kind, t, duration, value, None, part))

    def clear(self) -> None:
        """The device is healthy from now on."""
        self._faults = ()

    def enter(self, phase: str, t: float) -> None:
        """The mission is in this phase at world time t. May be told at every step."""
        self._entered.setdefault(phase, t)

    def active(self, t: float) -> tuple[Fault, ...]:
        """What is in force at world time t, each with ``start`` as world time."""
        found = []
        for fault in self._faults:
            begin = fault.start + (0.0 if fault.phase is None else self._entered.get(fault.phase, inf))
            end = inf if fault.duration is None else begin + fault.duration
            if begin <= t < end:
                found.append(fault if fault.phase is None else replace(fault, start=begin))
        return tuple(found)

    def find(self, kind: Kind, t: float, part: str = "") -> Fault | None:
        """The fault of this kind that is in force at t and strikes this part."""
        for fault in self.active(t):
            if fault.kind is kind and fault.part in ("", part):
                return fault
        return None


def read_faults(text: str, source: str) -> tuple[Fault, ...]:
    """Faults from YAML: one mapping, or a list of them. Raises ValueError with every error; ``source`` is named."""
    try:
        items = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"{source}: not YAML: {error}") from error
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
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}; want a YAML list of faults") from error
    return read_faults(text, str(path))
