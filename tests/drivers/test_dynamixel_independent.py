"""Another Dynamixel library on the emulated bus: rustypot, which shares no code with dynamixel-sdk or with us."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from time import monotonic
from typing import Any

import pytest

from drivers import xc330
from drivers.xc330 import Mode

rustypot = pytest.importorskip("rustypot")

IDS = [1, 2, 3, 4, 5]


@pytest.fixture
def client() -> Iterator[Any]:
    # It keeps Python's lock while it waits, so the emulator is a process of its own.
    command = [sys.executable, "-m", "sim_backend.dynamixel_emulator"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        # The control table of the XL330 is that of the XC330.
        made = rustypot.Xl330PyController(process.stdout.readline().strip(), 1_000_000, 1.0)
        yield made
        made.close()
        process.communicate("quit\n", timeout=20)


def test_ping_and_model(client: Any) -> None:
    assert client.ping(1)
    assert not client.ping(77)
    assert client.read_model_number(3) == [xc330.MODEL]


def test_sync_reads_and_writes(client: Any) -> None:
    client.sync_write_operating_mode(IDS, [int(Mode.CURRENT_BASED_POSITION)] * 5)
    client.sync_write_goal_current(IDS, [900] * 5)
    client.sync_write_torque_enable(IDS, [True] * 5)
    goals = [0.3, -0.4, 0.5, -0.6, 0.7]
    client.sync_write_goal_position(IDS, goals)
    end = monotonic() + 20.0
    while client.sync_read_present_position(IDS) != pytest.approx(goals, abs=0.01):
        assert monotonic() < end
    assert client.sync_read_goal_current(IDS) == pytest.approx([900] * 5)


def test_the_eeprom_is_locked_under_torque(client: Any) -> None:
    client.write_torque_enable(2, True)
    assert client.read_return_delay_time(2) == [250]
    client.write_return_delay_time(2, 0)  # this library does not tell an access error
    assert client.read_return_delay_time(2) == [250]
    client.write_torque_enable(2, False)
    client.write_return_delay_time(2, 0)
    assert client.read_return_delay_time(2) == [0]
