"""A cycle of the servo bus beside what the wire alone takes, and beside dynamixel-sdk's own port.

The emulated bus is a process of its own and answers when the last bit of an answer would have come.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from time import perf_counter_ns, sleep, thread_time_ns
from typing import Any

from dynamixel_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler
from msgspec import Struct

from drivers.dynamixel_bus import Bus, BusError, Port, wire_time
from drivers.dynamixel_setup import READ_BYTES, WRITTEN_BYTES
from tests.bench.measure import Stat, stat

IDS = (1, 2, 3, 4, 5)
_READ_AT, _WRITE_AT = 208, 222
_PERIOD = 0.004
_MARGIN = 0.02


class ServoCycle(Struct, frozen=True):
    """Sync write and fast sync read of five servos, 250 times a second. Times in us."""

    baud: int
    wire: float
    """What the bytes of a cycle take on the wire."""
    ours: Stat
    ours_cpu: float
    """Processor time of a cycle."""
    sdk: Stat
    """The same packets over dynamixel-sdk's own port."""
    sdk_cpu: float
    failed: int
    """Cycles without an answer, of both; they are not in the figures."""


def measure(baud: int = 1_000_000, cycles: int = 500) -> ServoCycle:
    """Measure both in turns, so that what else the machine does falls on both."""
    command = [sys.executable, "-m", "sim_backend.dynamixel_emulator", "--baud", str(baud)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        path = process.stdout.readline().strip()
        times: tuple[list[int], list[int]] = ([], [])
        costs: tuple[list[int], list[int]] = ([], [])
        failed = 0
        for _ in range(4):
            for side, open_ in enumerate((_ours, _theirs)):
                cycle, close = open_(path, baud)
                for _ in range(cycles // 4):
                    began, busy = perf_counter_ns(), thread_time_ns()
                    if cycle():
                        times[side].append(perf_counter_ns() - began)
                        costs[side].append(thread_time_ns() - busy)
                    else:
                        failed += 1
                    sleep(max(0.0, _PERIOD - (perf_counter_ns() - began) * 1e-9))
                close()
        process.communicate("quit\n")
    wire = wire_time(baud, len(IDS), READ_BYTES, WRITTEN_BYTES) * 1e6
    means = [sum(cost) / len(cost) * 1e-3 for cost in costs]
    return ServoCycle(baud, wire, stat(times[0]), means[0], stat(times[1]), means[1], failed)


def _ours(path: str, baud: int) -> tuple[Callable[[], bool], Callable[[], None]]:
    bus = Bus(Port(path, baud, _MARGIN))
    for servo in IDS:
        bus.write_bytes(servo, 9, b"\0")  # no return delay
    goals = dict.fromkeys(IDS, bytes(WRITTEN_BYTES))

    def cycle() -> bool:
        try:
            bus.sync_write(_WRITE_AT, WRITTEN_BYTES, goals)
            bus.sync_read(_READ_AT, READ_BYTES, IDS, fast=True)
        except BusError:
            return False
        return True

    return cycle, bus.close


def _theirs(path: str, baud: int) -> tuple[Callable[[], bool], Callable[[], None]]:
    port: Any = PortHandler(path)
    port.openPort()
    port.setBaudRate(baud)
    packets = PacketHandler(2.0)
    write = GroupSyncWrite(port, packets, _WRITE_AT, WRITTEN_BYTES)
    read = GroupSyncRead(port, packets, _READ_AT, READ_BYTES)
    for servo in IDS:
        write.addParam(servo, list(bytes(WRITTEN_BYTES)))
        read.addParam(servo)

    def cycle() -> bool:
        return bool(write.txPacket() == COMM_SUCCESS and read.fastSyncRead() == COMM_SUCCESS)

    return cycle, port.closePort


def rows(cycles: int = 500) -> tuple[ServoCycle, ...]:
    """At the usual and at the highest baud rate."""
    return tuple(measure(baud, cycles) for baud in (1_000_000, 4_000_000))
