"""Messages there and back, and everything else that may arrive in their place: refused in words, never a crash."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from onboard.core.types import Event, Phase, Request, Severity
from onboard.wire import (
    VERSION,
    Ack,
    Arm,
    Ask,
    Go,
    Heard,
    Keys,
    Mission,
    Order,
    Outcome,
    Place,
    Reader,
    ReleaseLease,
    ReloadParams,
    SaveParams,
    SetParams,
    ShowParams,
    ShowPreflight,
    StationPulse,
    Stop,
    TakeLease,
    Tare,
    Telemetry,
    Told,
    VehiclePulse,
    Way,
    WireError,
    encode,
    read_ack,
    read_order,
    read_refusal,
    read_station_pulse,
    read_telemetry,
    read_told,
    read_vehicle_pulse,
    refusal,
    way_of,
)
from tests.synthetic import mission

READERS: tuple[Reader[Any], ...] = (
    read_order,
    read_ack,
    read_station_pulse,
    read_vehicle_pulse,
    read_telemetry,
    read_told,
)
TICK, _ = next(mission())
MESSAGES: tuple[tuple[Reader[Any], msgspec.Struct], ...] = (
    (read_order, Order("1f", Go(Phase.PRESS), 17)),
    (read_ack, Ack("1f", Outcome.REFUSED, "no", b"\x00")),
    (read_station_pulse, StationPulse(5, 3)),
    (read_vehicle_pulse, VehiclePulse(5, 6, 4, "alice", (Heard("alice", "s1", 3, 1, True),), 2, 0)),
    (read_telemetry, Telemetry(5, TICK)),
    (read_told, Told(2, Event(1, "hold", Severity.WARNING, "Holding."))),
)
ASKS: tuple[Ask, ...] = (
    *(Mission(request) for request in Request),
    Stop(),
    Go(Phase.TARE),
    Arm(),
    Tare(),
    SetParams(("safety.tilt=0.4",)),
    ReloadParams(),
    SaveParams(),
    TakeLease(),
    ReleaseLease(),
    ShowParams(),
    ShowPreflight(),
)
HEADER = encode(StationPulse(1))[:3]

plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
#: Mappings with the right names, and anything as their values.
shaped = st.dictionaries(
    st.sampled_from(
        sorted({name for _, message in MESSAGES for name in message.__struct_fields__} | {"type", "request", "phase"})
    ),
    plain | st.sampled_from([cls.__name__ for cls in {type(ask) for ask in ASKS}]),
    max_size=8,
)


def feed(payload: bytes) -> None:
    """Every reader either gives a message that can travel on, or refuses."""
    for read in READERS:
        with suppress(WireError):
            encode(read(payload))


@pytest.mark.parametrize(("read", "message"), MESSAGES, ids=lambda part: type(part).__name__)
def test_there_and_back(read: Reader[Any], message: msgspec.Struct) -> None:
    assert read(encode(message)) == message


@pytest.mark.parametrize("ask", ASKS, ids=repr)
def test_asks_there_and_back(ask: Ask) -> None:
    assert read_order(encode(Order("1", ask))).ask == ask


def test_what_is_not_finite_travels() -> None:
    estimate = msgspec.structs.replace(TICK.outputs.estimate, contact_force=math.nan, age_odometry=math.inf)
    tick = msgspec.structs.replace(TICK, outputs=msgspec.structs.replace(TICK.outputs, estimate=estimate))
    read = read_telemetry(encode(Telemetry(1, tick))).tick.outputs.estimate
    assert math.isnan(read.contact_force)
    assert read.age_odometry == math.inf


def test_stop_retreat_and_kill_go_their_own_way_and_nothing_else() -> None:
    safety = {ask for ask in ASKS if way_of(ask) is Way.SAFETY}
    assert safety == {Stop(), Mission(Request.RETREAT), Mission(Request.KILL)}
    assert {ask for ask in ASKS if way_of(ask) is Way.VIEW} == {ShowParams(), ShowPreflight()}


@pytest.mark.parametrize(("version", "who"), [(VERSION + 1, "this end"), (0, "the other end")])
def test_another_version_is_refused_in_a_word(version: int, who: str) -> None:
    payload = bytearray(encode(StationPulse(1)))
    payload[2] = version
    with pytest.raises(WireError, match=f"message of version {version}, but here version 1 is spoken: update {who}"):
        read_station_pulse(bytes(payload))


def test_fields_that_are_added_later_do_no_harm() -> None:
    payload = HEADER + msgspec.msgpack.encode({"sent_ns": 7, "heard_ns": 0, "mood": "fine"})
    assert read_station_pulse(payload) == StationPulse(7)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"id": "1", "ask": {"type": "Dance"}}, "Invalid value 'Dance' - at `\\$.ask.type`"),
        ({"id": "1", "ask": {"type": "Go", "phase": "moon"}}, "Invalid enum value 'moon' - at `\\$.ask.phase`"),
        ({"id": "../..", "ask": {"type": "Stop"}}, "matching regex .* at `\\$.id`"),
        ({"id": "1", "ask": {"type": "Stop"}, "heard_ns": -1}, ">= 0 - at `\\$.heard_ns`"),
        ({"id": "1\n", "ask": {"type": "Stop"}}, "matching regex .* at `\\$.id`"),
        ({"id": "1"}, "missing required field `ask`"),
        ({"id": "1", "ask": {"type": "SetParams", "values": []}}, "length >= 1"),
    ],
)
def test_what_is_wrong_with_an_order_is_told(values: dict[str, Any], said: str) -> None:
    with pytest.raises(WireError, match=f"not a valid Order: .*{said}"):
        read_order(HEADER + msgspec.msgpack.encode(values))


@pytest.mark.parametrize("payload", [b"", b"P", b"PW", b"hello", b"\x00" * 100])
def test_other_bytes_are_refused(payload: bytes) -> None:
    with pytest.raises(WireError, match=f"not a message of Pipewright \\({len(payload)} bytes\\)"):
        read_order(payload)


@given(st.binary(max_size=200))
def test_any_bytes(payload: bytes) -> None:
    feed(payload)
    feed(HEADER + payload)


@given(plain | shaped)
def test_any_values(value: Any) -> None:
    feed(HEADER + msgspec.msgpack.encode(value))


@given(st.sampled_from([encode(message) for _, message in MESSAGES]), st.data())
def test_damaged_messages(payload: bytes, data: st.DataObject) -> None:
    at = data.draw(st.integers(0, len(payload) - 1))
    damaged = bytearray(payload)
    damaged[at] ^= data.draw(st.integers(1, 255))
    feed(bytes(damaged))
    feed(payload[:at])


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a"], ids=["lists", "mappings"])
def test_a_pit_of_nested_values(opening: bytes) -> None:
    feed(HEADER + opening * 10_000 + b"\xc0")
    feed(HEADER + b"\x81\xa1x" + opening * 10_000 + b"\xc0")


@pytest.mark.parametrize("length", [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"])
def test_lengths_that_are_not_there_take_no_memory(length: bytes) -> None:
    feed(HEADER + length)
    feed(HEADER + b"\x82\xa2id\xa11\xa3ask\x82\xa4type\xa9SetParams\xa6values" + length)


def test_refusals_are_plain_text() -> None:
    assert read_refusal(refusal("too old")) == "too old"
    assert read_refusal(b"Timeout") == ""
    assert read_refusal(b"pipewright: \xff") == "\N{REPLACEMENT CHARACTER}"


def test_keys() -> None:
    keys = Keys("x500")
    assert keys.telemetry == "pipewright/x500/telemetry"
    assert keys.place(keys.station("alice", "s1", Way.COMMAND)) == Place("alice", "s1", "command")


@pytest.mark.parametrize("name", ["", "Alice", "a/b", "*", "a b", "-a", "a" * 33, "ä", "a\n"])
def test_names_that_cannot_be_part_of_a_key(name: str) -> None:
    for make in (Keys, Keys("x").ack, lambda name: Keys("x").station("a", name, "pulse")):
        with pytest.raises(WireError, match="it takes small letters, digits, - and _, 32 at most"):
            make(name)


@pytest.mark.parametrize(
    "key",
    ["", "pipewright/y/station/a/s/pulse", "pipewright/x/telemetry", "pipewright/x/station/a/pulse",
     "pipewright/x/station/a/s/t/pulse", "pipewright/x/station/*/s/pulse", "pipewright/x/station/**"],
)  # fmt: skip
def test_keys_that_are_no_stations(key: str) -> None:
    with pytest.raises(WireError):
        Keys("x").place(key)


@given(st.text(max_size=80))
def test_any_key(key: str) -> None:
    with pytest.raises(WireError):
        Keys("x").place(key)
