"""What passes between a vehicle and its stations: every message, its version, and the keys it travels on.

A message is two bytes that say whose it is, one that says its version, and MessagePack. Within a version, fields may
be added that have a default; any other change is a new version, and the two ends refuse each other in words.

Keys, below ``pipewright/<vehicle>/``. All that a station may write stands below its own name, so that access control
can tell stations, and ways to ask, apart::

    alive  pulse  telemetry  event            the vehicle's: liveliness token, VehiclePulse, Telemetry, Told
    ack/<station>                             the vehicle's: what became of an order later on, Ack
    station/<name>/<session>/alive  pulse     a station's: liveliness token, StationPulse
    station/<name>/<session>/<way>            a query with an Order, answered with an Ack: safety, command, view

No clocks are compared. Each end stamps its pulses by its own monotonic clock, and tells the newest stamp of the other
end that it has heard: what is then received was certainly sent after that stamp, so now minus the stamp bounds its age
from above, in whatever queue it has stood.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import StrEnum
from typing import Annotated, Final, Generic, TypeVar

import msgspec
from msgspec import Meta, Struct

from onboard.core.types import Event, Phase, Request, Tick

VERSION: Final = 1
_MARK: Final = b"PW"
_REFUSAL: Final = b"pipewright: "
#: Of a message that a station sends, bytes.
LARGEST: Final = 16 * 1024
#: Names of vehicles, stations and sessions.
NAME: Final = r"^[a-z0-9][a-z0-9_-]{0,31}\Z"
NAME_RULE: Final = "it takes small letters, digits, - and _, 32 at most, a letter or a digit first"

Text = Annotated[str, Meta(max_length=1000)]
Name = Annotated[str, Meta(pattern=NAME)]
#: On the clock of the end that is named with it.
Stamp = Annotated[int, Meta(ge=0)]

T = TypeVar("T")


class WireError(Exception):
    """A message cannot be understood; the text says why."""


# --- what a station asks ----------------------------------------------------------------------------------------------


class Way(StrEnum):
    """Ways to ask, each a key of its own."""

    SAFETY = "safety"
    """Stop, retreat, kill: from anyone admitted, lease or not, and however long it has travelled."""
    COMMAND = "command"
    """From the station that commands."""
    VIEW = "view"
    """From anyone admitted; changes nothing."""


class Mission(Struct, frozen=True, tag=True):
    """A request to the mission."""

    request: Request


class Stop(Struct, frozen=True, tag=True):
    """Hold (in contact: retreat); asked again: land."""


class Go(Struct, frozen=True, tag=True):
    """Go on in this phase."""

    phase: Phase


class Arm(Struct, frozen=True, tag=True):
    """Arm, and stay on the ground."""


class Tare(Struct, frozen=True, tag=True):
    """Take the estimated force for zero."""


class SetParams(Struct, frozen=True, tag=True):
    """Change parameters, all or none: ``path=value``, the value as YAML."""

    values: Annotated[tuple[Text, ...], Meta(min_length=1, max_length=100)]


class ReloadParams(Struct, frozen=True, tag=True):
    """Read the files of the configuration again."""


class SaveParams(Struct, frozen=True, tag=True):
    """Write the parameters in force into the files of the configuration."""


class TakeLease(Struct, frozen=True, tag=True):
    """Command the vehicle; with ``seize`` even if another station does."""

    seize: bool = False


class ReleaseLease(Struct, frozen=True, tag=True):
    """Command it no more."""


class ShowParams(Struct, frozen=True, tag=True):
    """The parameters in force, as YAML."""


class ShowPreflight(Struct, frozen=True, tag=True):
    """The checklist."""


class ShowEvents(Struct, frozen=True, tag=True):
    """The newest events, as JSON of ``tuple[Told, ...]``, oldest first."""


class ListLogs(Struct, frozen=True, tag=True):
    """The logs that the vehicle holds."""


class ReadLog(Struct, frozen=True, tag=True):
    """A piece of a log."""

    name: Text
    offset: Annotated[int, Meta(ge=0)]
    size: Annotated[int, Meta(ge=1, le=256 * 1024)]


Command = Mission | Stop | Go | Arm | Tare | SetParams | ReloadParams | SaveParams | TakeLease | ReleaseLease
View = ShowParams | ShowPreflight | ShowEvents | ListLogs | ReadLog
Ask = Command | View


def way_of(ask: Ask) -> Way:
    """On which way this may be asked; there is one for each."""
    match ask:
        case Stop() | Mission(request=Request.RETREAT | Request.KILL):
            return Way.SAFETY
        case ShowParams() | ShowPreflight() | ShowEvents() | ListLogs() | ReadLog():
            return Way.VIEW
    return Way.COMMAND


class Order(Struct, frozen=True):
    """A station asks something. Sent again with the same id it is answered again, and not carried out twice."""

    id: Name
    ask: Ask
    heard_ns: Stamp = 0
    """Newest stamp of the vehicle that the station had heard when it sent this; 0: none."""


class StationPulse(Struct, frozen=True):
    """A station is there."""

    sent_ns: Stamp
    """By the station's monotonic clock."""
    heard_ns: Stamp = 0
    """Newest stamp of the vehicle that the station has heard; 0: none."""


# --- what the vehicle tells -------------------------------------------------------------------------------------------


class Outcome(StrEnum):
    """What became of an order."""

    ACCEPTED = "accepted"
    """Taken on; ``DONE`` or ``REFUSED`` follows."""
    REFUSED = "refused"
    DONE = "done"


class Ack(Struct, frozen=True):
    """The answer to an order."""

    id: Name
    outcome: Outcome
    text: str = ""
    """Why it was refused, or what has come of it."""
    data: bytes = b""
    """What was asked to be shown."""


class Heard(Struct, frozen=True):
    """A session of a station, as the vehicle hears it."""

    name: Name
    session: Name
    heard_ns: Stamp
    """Newest stamp of the station that the vehicle has heard; 0: none."""
    held_ns: Stamp
    """Since it was heard."""
    present: bool
    """Its liveliness token is there."""


class VehiclePulse(Struct, frozen=True):
    """The link of the vehicle is there; whether its loop is, ``tick_ns`` tells."""

    sent_ns: Stamp
    """By the vehicle's monotonic clock, which is that of the ticks."""
    wall_ns: Stamp
    """Its UTC clock at the same moment."""
    tick_ns: Stamp
    """Time of the newest tick; 0: none was made yet."""
    commander: str
    """Name of the station that commands; empty: none."""
    stations: tuple[Heard, ...]
    told: Stamp
    """Number of the newest event."""
    dropped: Stamp
    """Events and answers that could not be sent."""


class Telemetry(Struct, frozen=True):
    """The newest tick."""

    sent_ns: Stamp
    tick: Tick


class Told(Struct, frozen=True):
    """An event; the numbers have no gap but what was lost."""

    number: Stamp
    event: Event


# --- what is shown, in the data of an answer --------------------------------------------------------------------------


class Check(Struct, frozen=True):
    """One line of the preflight checklist."""

    name: str
    ok: bool
    text: str
    """What was found."""
    remedy: str = ""
    """What to do about it; empty when all is well."""


class LogFile(Struct, frozen=True):
    """A log on the vehicle."""

    name: str
    """Relative to the folder of all runs."""
    size: int
    """Bytes."""
    sha256: str
    """Hexadecimal; empty while it is not known: it is made once the log has been finished and somebody reads it."""
    modified_ns: int
    """UTC."""
    writing: bool = False
    """It is being recorded."""


# --- bytes ------------------------------------------------------------------------------------------------------------

_pack = msgspec.msgpack.Encoder().encode


def encode(message: Struct) -> bytes:
    """A message as it travels."""
    return _MARK + bytes((VERSION,)) + _pack(message)


class Reader(Generic[T]):
    """Reads messages of one kind. Raises WireError for anything else."""

    def __init__(self, kind: type[T]) -> None:
        self._name = kind.__name__
        self._decode: Callable[[memoryview], T] = msgspec.msgpack.Decoder(kind).decode

    def __call__(self, payload: bytes) -> T:
        """The message that ``payload`` holds."""
        if len(payload) < len(_MARK) + 1 or not payload.startswith(_MARK):
            raise WireError(f"not a message of Pipewright ({len(payload)} bytes)")
        if (version := payload[len(_MARK)]) != VERSION:
            older = "this end" if version > VERSION else "the other end"
            raise WireError(f"message of version {version}, but here version {VERSION} is spoken: update {older}")
        try:
            return self._decode(memoryview(payload)[len(_MARK) + 1 :])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise WireError(f"not a valid {self._name}: {error}") from None


def refusal(why: str) -> bytes:
    """The answer to what cannot be understood: plain text, for it may be of another version."""
    return _REFUSAL + why.encode()


def read_refusal(payload: bytes) -> str:
    """Why the other end has refused; empty when the payload is something else."""
    return payload.removeprefix(_REFUSAL).decode(errors="replace") if payload.startswith(_REFUSAL) else ""


read_order = Reader(Order)
read_ack = Reader(Ack)
read_station_pulse = Reader(StationPulse)
read_vehicle_pulse = Reader(VehiclePulse)
read_telemetry = Reader(Telemetry)
read_told = Reader(Told)


# --- keys -------------------------------------------------------------------------------------------------------------


class Place(Struct, frozen=True):
    """Who writes at a station's key, and what."""

    station: str
    session: str
    what: str


class Keys:
    """The keys of one vehicle. Raises WireError for a name that cannot be one."""

    def __init__(self, vehicle: str) -> None:
        self._root = f"pipewright/{named('vehicle', vehicle)}"
        self.alive = f"{self._root}/alive"
        self.pulse = f"{self._root}/pulse"
        self.telemetry = f"{self._root}/telemetry"
        self.event = f"{self._root}/event"

    def ack(self, station: str) -> str:
        """Where a station is told what became of its orders."""
        return f"{self._root}/ack/{named('station', station)}"

    def station(self, station: str, session: str, what: str) -> str:
        """Where one session of a station writes: ``alive``, ``pulse`` or a way to ask."""
        return f"{self._root}/station/{named('station', station)}/{named('session', session)}/{what}"

    def stations(self, what: str) -> str:
        """The same of all stations, as a key expression."""
        return f"{self._root}/station/*/*/{what}"

    def place(self, key: str) -> Place:
        """Which station's key this is. Raises WireError for any other."""
        head, _, tail = key.partition("/station/")
        parts = tail.split("/")
        if head != self._root or len(parts) != 3:
            raise WireError(f"{key[:200]!r} is no key of a station of {self._root}")
        return Place(named("station", parts[0]), named("session", parts[1]), parts[2])


def is_name(text: str) -> bool:
    """Whether a text may name a person or a machine: it goes into certificates, keys of the link and file names."""
    return re.match(NAME, text) is not None


def named(kind: str, name: str) -> str:
    """The same name. Raises WireError for one that cannot be part of a key."""
    if not is_name(name):
        raise WireError(f"{name[:100]!r} is no name of a {kind}; {NAME_RULE}")
    return name
