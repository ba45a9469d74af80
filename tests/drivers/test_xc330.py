"""The control table, the units and the words of the XC330."""

from __future__ import annotations

from itertools import pairwise
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import xc330
from drivers.xc330 import HardwareError, Mode, error_words


def test_no_two_items_overlap() -> None:
    items = [xc330.TABLE[address] for address in sorted(xc330.TABLE)]
    assert all(a.address + a.size <= b.address for a, b in pairwise(items))
    assert items[-1].address + items[-1].size == xc330.SIZE


@pytest.mark.parametrize(
    ("item", "address", "size", "initial"),
    [
        (xc330.MODEL_NUMBER, 0, 2, 1240),
        (xc330.BAUD_RATE, 8, 1, 1),
        (xc330.RETURN_DELAY, 9, 1, 250),
        (xc330.OPERATING_MODE, 11, 1, 3),
        (xc330.HOMING_OFFSET, 20, 4, 0),
        (xc330.CURRENT_LIMIT, 38, 2, 2352),
        (xc330.SHUTDOWN, 63, 1, 52),
        (xc330.TORQUE_ENABLE, 64, 1, 0),
        (xc330.HARDWARE_ERROR, 70, 1, 0),
        (xc330.POSITION_P, 84, 2, 1100),
        (xc330.BUS_WATCHDOG, 98, 1, 0),
        (xc330.GOAL_POSITION, 116, 4, 0),
        (xc330.PRESENT_CURRENT, 126, 2, 0),
        (xc330.PRESENT_POSITION, 132, 4, 0),
        (xc330.PRESENT_TEMPERATURE, 146, 1, 25),
    ],
)
def test_items_are_where_the_manual_has_them(item: xc330.Item, address: int, size: int, initial: int) -> None:
    assert (item.address, item.size, item.initial) == (address, size, initial)
    assert xc330.TABLE[address] is item


def test_units() -> None:
    units = {
        "turn": 4096 * xc330.RAD_PER_COUNT,
        "no-load speed, 81 rev/min at 5 V": 354 * xc330.RAD_S_PER_UNIT,
        "acceleration": 60 * xc330.RAD_S2_PER_UNIT,
        "stall current": 1800 * xc330.AMPERE_PER_UNIT,
        "supply": 50 * xc330.VOLT_PER_UNIT,
        "watchdog": 5 * xc330.S_PER_WATCHDOG_UNIT,
        "return delay of the factory": 250 * xc330.S_PER_DELAY_UNIT,
    }
    assert units == {
        "turn": pytest.approx(2.0 * pi),
        "no-load speed, 81 rev/min at 5 V": pytest.approx(81.0 * 2.0 * pi / 60.0, rel=2e-3),
        "acceleration": pytest.approx(214.577 * 2.0 * pi / 60.0),
        "stall current": pytest.approx(1.8),
        "supply": pytest.approx(5.0),
        "watchdog": pytest.approx(0.1),
        "return delay of the factory": pytest.approx(500e-6),
    }


@given(st.sampled_from(sorted(xc330.TABLE)), st.data())
def test_numbers_survive_the_wire(address: int, data: st.DataObject) -> None:
    item = xc330.TABLE[address]
    value = data.draw(st.integers(item.low, item.high))
    assert item.decode(item.encode(value)) == value
    assert len(item.encode(value)) == item.size


def test_negative_numbers_are_two_s_complement() -> None:
    assert xc330.GOAL_CURRENT.encode(-2) == b"\xfe\xff"
    assert xc330.BUS_WATCHDOG.decode(b"\xff") == xc330.TRIPPED
    with pytest.raises(OverflowError):
        xc330.GOAL_CURRENT.encode(40_000)


def test_read_only_items() -> None:
    assert not xc330.PRESENT_POSITION.writable
    assert not xc330.HARDWARE_ERROR.writable
    assert xc330.GOAL_POSITION.writable


def test_errors_in_words() -> None:
    assert error_words(0) == ""
    assert error_words(HardwareError.OVERLOAD | HardwareError.VOLTAGE) == "supply voltage out of its limits, overload"
    assert error_words(HardwareError.SILENT) == "no answer"
    assert error_words(0x42) == "unknown bits 0x42"


def test_modes() -> None:
    assert [int(mode) for mode in Mode] == [0, 1, 3, 4, 5, 16]
