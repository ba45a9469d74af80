"""The watch over a machine's punctuality: quiet where bytes come through, and telling where they are held back."""

from __future__ import annotations

import time

import pytest

from tests import realtime
from tests.realtime import Machine


def test_a_machine_that_held_nothing_back_may_judge() -> None:
    machine = Machine()
    machine.stop()
    assert machine.unfit(time.monotonic()) == ""


@pytest.mark.parametrize("held_back", [[0.05], [0.011] * 10])
def test_a_machine_that_held_bytes_back_may_not(held_back: list[float]) -> None:
    machine = Machine()
    machine.stop()
    machine._held_back = [(100.0 + i, took) for i, took in enumerate(held_back)]
    assert f"held {len(held_back)} bytes" in machine.unfit(100.0)
    assert machine.unfit(100.5 + len(held_back)) == ""


def test_it_notices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime, "_HELD_BACK", 0.0)
    machine = Machine()
    end = time.monotonic() + 20.0
    while len(machine._held_back) < 10 and time.monotonic() < end:
        machine._over.wait(0.01)
    machine.stop()
    assert machine.unfit(0.0)
