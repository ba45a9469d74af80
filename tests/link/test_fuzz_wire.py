"""Messages that are nearly right, whoever reads them: understood or refused in words; nothing else is ever raised."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from onboard.core.types import Event, Phase, Request, Severity
from onboard.wire import (
    Ack,
    Ask,
    Go,
    Heard,
    Mission,
    Order,
    Outcome,
    Reader,
    SetParams,
    StationPulse,
    TakeLease,
    Telemetry,
    Told,
    VehiclePulse,
    WireError,
    encode,
    read_ack,
    read_order,
    read_refusal,
    read_station_pulse,
    read_telemetry,
    read_told,
    read_vehicle_pulse,
    way_of,
)
from tests.link.wrong_input import anything, damaged, examples, nested, places, put, spoilt, taken
from tests.synthetic import mission

TICK = next(tick for tick, _ in mission() if tick.outputs.phase is Phase.PRESS)
MESSAGES: tuple[tuple[Reader[Any], msgspec.Struct], ...] = (
    (read_order, Order("1f", SetParams(("safety.tilt=0.4", "plan.speed=0.3")), 17)),
    (read_order, Order("1e", Go(Phase.PRESS), 17)),
    (read_order, Order("1d", Mission(Request.LAND), 17)),
    (read_order, Order("1c", TakeLease(seize=True), 17)),
    (read_ack, Ack("1f", Outcome.REFUSED, "no", b"\x00" * 20)),
    (read_station_pulse, StationPulse(5, 3)),
    (read_vehicle_pulse, VehiclePulse(5, 6, 4, "alice", (Heard("alice", "s1", 3, 1, True),), 2, 0)),
    (read_telemetry, Telemetry(5, TICK)),
    (read_told, Told(2, Event(1, "hold", Severity.WARNING, "Holding."))),
)
WRONG: tuple[Any, ...] = (float("nan"), float("inf"), 2**64 - 1, -(2**63), "\x00", b"\xff", None, [], {})
HEADER = encode(StationPulse(1))[:3]
KINDS = pytest.mark.parametrize(("read", "message"), MESSAGES, ids=lambda part: type(part).__name__)


def travels(read: Reader[Any], payload: bytes) -> Any:
    """What was understood can be sent on and is understood the same, and every question about it has an answer."""
    message = taken(lambda: read(payload), WireError)
    if message is not None:
        assert encode(read(encode(message))) == encode(message)
        if isinstance(message, Order):
            asked: Ask = message.ask
            assert way_of(asked)
    return message


def packed(tree: Any) -> bytes:
    return HEADER + msgspec.msgpack.encode(tree)


@KINDS
def test_damaged_bytes(read: Reader[Any], message: msgspec.Struct) -> None:
    @examples(60)
    @given(damaged([encode(message)]))
    def feed(payload: bytes) -> None:
        travels(read, payload)
        read_refusal(payload)

    feed()


@KINDS
def test_wrong_values(read: Reader[Any], message: msgspec.Struct) -> None:
    tree = msgspec.to_builtins(message, builtin_types=(bytes,))

    @examples(100)
    @given(spoilt(tree))
    def feed(wrong: Any) -> None:
        travels(read, packed(wrong))

    feed()


@KINDS
def test_anything_in_every_place(read: Reader[Any], message: msgspec.Struct) -> None:
    """Each field once in the place of a pit, of a number that is none, and of one that no clock tells."""
    tree = msgspec.to_builtins(message, builtin_types=(bytes,))
    assert travels(read, packed(tree)) == message
    for path in places(tree):
        for value in WRONG:
            travels(read, packed(put(tree, path, value)))


@KINDS
@pytest.mark.parametrize("kind", [list, dict])
def test_pits(read: Reader[Any], message: msgspec.Struct, kind: type) -> None:
    """As deep as this interpreter can pack them, and deeper than it can."""
    tree = msgspec.to_builtins(message, builtin_types=(bytes,))
    key = next(iter(tree))
    for depth in (10, 100, 400):
        travels(read, packed({**tree, "more": nested(depth, kind)}))
        travels(read, packed({**tree, key: nested(depth, kind)}))
    opening = b"\x91" if kind is list else b"\x81\xa1x"
    body = msgspec.msgpack.encode(tree)
    assert body[0] & 0xF0 == 0x80, "a small mapping"
    deep = HEADER + bytes((body[0] + 1,)) + b"\xa4more" + opening * 5000 + b"\xc0" + body[1:]
    assert travels(read, deep) is None


@examples(150)
@given(anything, st.sampled_from([read for read, _ in MESSAGES]))
def test_anything(value: Any, read: Reader[Any]) -> None:
    travels(read, packed(value))


@examples(60)
@given(st.binary(max_size=300), st.sampled_from([read for read, _ in MESSAGES]))
def test_noise(payload: bytes, read: Reader[Any]) -> None:
    travels(read, payload)
    travels(read, HEADER + payload)
    read_refusal(payload)
