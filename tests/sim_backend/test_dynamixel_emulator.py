"""The emulated bus: what each instruction does, byte by byte, and how it behaves as a terminal and as a program."""

from __future__ import annotations

import os
import select
import struct
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import monotonic

import pytest

from drivers import xc330
from drivers.dynamixel_settings import ServoSettings
from drivers.vehicle import Vehicle
from drivers.xc330 import HardwareError, Item, Mode
from sim_backend import layout as at
from sim_backend.dynamixel_bus import DynamixelBus
from sim_backend.dynamixel_emulator import DynamixelEmulator, emulate, order
from sim_backend.dynamixel_mechanics import FreeServos, WorldServos
from sim_backend.dynamixel_servo import Servo
from sim_backend.dynamixel_wire import BROADCAST, Instruction, Packet, Parser, Trouble, crc_bytes, packet, status
from sim_backend.faults import Fault, Kind
from sim_backend.world import World

SETTLED = 10.0  # s: everything has come to rest


class Wire:
    """Servos with these ids at these encoder counts, asked without a terminal."""

    def __init__(self, counts: dict[int, int], firmware: int = 52) -> None:
        self.free = FreeServos(tuple(value * xc330.RAD_PER_COUNT for value in counts.values()))
        self.servos = {servo: Servo(servo, firmware) for servo in counts}
        self.bus = DynamixelBus(list(self.servos.values()), self.free)
        self.now = 0.0

    def ask(self, wire: bytes | str) -> bytes:
        (found,) = Parser().feed(bytes.fromhex(wire) if isinstance(wire, str) else wire)
        return self.bus.handle(found, self.now)[0]

    def inject(
        self,
        kind: Kind,
        duration: float | None = None,
        value: float = 0.0,
        part: str = "",
        count: int | None = None,
    ) -> None:
        self.bus.troubles.faults.inject(self.bus.time(self.now), kind, duration, value, part, count)

    def wait(self, seconds: float) -> None:
        """Let time pass without a word."""
        for _ in range(round(seconds / 0.005)):
            self.now += 0.005
            self.bus.update(self.now)

    def write(self, servo: int, item: Item, value: int) -> int:
        """The error number, alert bit included."""
        place = item.address.to_bytes(2, "little")
        (found,) = Parser().feed(self.ask(packet(servo, Instruction.WRITE, place + item.encode(value))))
        return found.parameters[0]

    def read(self, servo: int, item: Item) -> int:
        return item.decode(self.bytes(servo, item.address, item.size))

    def bytes(self, servo: int, address: int, length: int) -> bytes:
        (found,) = Parser().feed(self.ask(packet(servo, Instruction.READ, struct.pack("<HH", address, length))))
        assert found.parameters[0] & 0x7F == 0
        return found.parameters[1:]


def as_in_the_manual() -> Wire:
    """Two servos as in the manual's examples: model 1030, firmware 38, at 166 and 2079 counts."""
    wire = Wire({1: 166, 2: 2079})
    for servo in wire.servos.values():
        # The examples are of another model; its registers are the same.
        servo._put(xc330.MODEL_NUMBER, 1030)
        servo._put(xc330.FIRMWARE, 38)
    return wire


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("FF FF FD 00 01 03 00 01 19 4E", "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
        (
            "FF FF FD 00 FE 03 00 01 31 42",
            "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D",
        ),
        ("FF FF FD 00 01 07 00 02 84 00 04 00 1D 15", "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
        ("FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89", "FF FF FD 00 01 04 00 55 00 A1 0C"),
        ("FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E", "FF FF FD 00 01 04 00 55 00 A1 0C"),
        ("FF FF FD 00 01 04 00 06 01 A1 E6", "FF FF FD 00 01 04 00 55 00 A1 0C"),
        ("FF FF FD 00 01 03 00 08 2F 4E", "FF FF FD 00 01 04 00 55 00 A1 0C"),
        ("FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC", "FF FF FD 00 01 04 00 55 00 A1 0C"),
        (
            "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
            "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0 FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE",
        ),
        ("FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87", ""),
    ],
)
def test_answers_of_the_manual(question: str, answer: str) -> None:
    assert as_in_the_manual().ask(question) == bytes.fromhex(answer)


def test_bulk_read_of_the_manual() -> None:
    wire = as_in_the_manual()
    wire.free.voltage[0], wire.free.temperature[1] = 6.5, 36.0
    wire.servos[1].write(xc330.MAX_VOLTAGE.address, b"\x46\x00")
    answer = wire.ask("FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05")
    assert answer == status(1, 0, b"\x41\x00") + bytes.fromhex("FF FF FD 00 02 05 00 55 00 24 8B A9")


def test_fast_sync_read_of_the_manual() -> None:
    wire = Wire({3: 166, 7: 2079, 4: 1023})
    assert wire.ask("FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2") == bytes.fromhex(
        "FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA 00 04 FF 03 00 00 D1 9E"
    )


def test_fast_bulk_read() -> None:
    wire = Wire({3: 166, 7: 2079})
    asked = struct.pack("<BHHBHH", 3, 132, 4, 7, 146, 1)
    answer = wire.ask(packet(BROADCAST, Instruction.FAST_BULK_READ, asked))
    first = bytes.fromhex("FF FF FD 00 FE 0E 00 55 00 03 A6 00 00 00")
    first += crc_bytes(first)
    second = first + bytes.fromhex("00 07 1E")
    assert answer == second + crc_bytes(second)


def test_fast_reads_need_the_firmware() -> None:
    wire = Wire({1: 0, 2: 0}, firmware=45)
    assert wire.ask(packet(BROADCAST, Instruction.FAST_SYNC_READ, b"\x84\x00\x04\x00\x01\x02")) == b""
    assert wire.ask(packet(BROADCAST, Instruction.SYNC_READ, b"\x84\x00\x04\x00\x01\x02")) != b""


def test_reads_are_stuffed_but_fast_reads_are_not() -> None:
    wire = Wire({1: 0})
    wire.write(1, xc330.OPERATING_MODE, Mode.EXTENDED_POSITION)
    wire.write(1, xc330.GOAL_POSITION, int.from_bytes(b"\xff\xff\xfd\xff", "little", signed=True))
    read = packet(1, Instruction.READ, b"\x74\x00\x04\x00")
    assert b"\xff\xff\xfd\xfd\xff" in wire.ask(read)
    fast = wire.ask(packet(BROADCAST, Instruction.FAST_SYNC_READ, b"\x74\x00\x04\x00\x01"))
    assert fast[10:14] == b"\xff\xff\xfd\xff"


# -- groups ---------------------------------------------------------------------------------------------------------


def test_behind_a_silent_servo_there_is_silence() -> None:
    wire = Wire({1: 100, 2: 200, 3: 300})
    wire.inject(Kind.SILENT, part="theta_2")
    assert wire.ask(packet(BROADCAST, Instruction.SYNC_READ, b"\x84\x00\x04\x00\x01\x02\x03")) == status(
        1, 0, b"\x64\0\0\0"
    )
    fast = wire.ask(packet(BROADCAST, Instruction.FAST_SYNC_READ, b"\x84\x00\x04\x00\x01\x02\x03"))
    assert len(fast) == 8 + 8
    assert wire.ask(packet(BROADCAST, Instruction.SYNC_READ, b"\x84\x00\x04\x00\x02\x01")) == b""
    assert wire.ask(packet(2, Instruction.PING)) == b""


def test_sync_and_bulk_write_reach_their_servos_only() -> None:
    wire = Wire({1: 0, 2: 0, 3: 0})
    wire.ask(packet(BROADCAST, Instruction.SYNC_WRITE, b"\x41\x00\x01\x00\x01\x01\x03\x01"))
    assert [wire.read(servo, xc330.LED) for servo in (1, 2, 3)] == [1, 0, 1]
    wire.ask(packet(BROADCAST, Instruction.BULK_WRITE, b"\x01\x41\x00\x01\x00\x00\x02\x54\x00\x02\x00\x20\x03"))
    assert [wire.read(servo, xc330.LED) for servo in (1, 2, 3)] == [0, 0, 1]
    assert wire.read(2, xc330.POSITION_P) == 800


def test_a_write_to_all_is_done_and_not_answered() -> None:
    wire = Wire({1: 0, 2: 0})
    assert wire.ask(packet(BROADCAST, Instruction.WRITE, b"\x41\x00\x01")) == b""
    assert [wire.read(servo, xc330.LED) for servo in (1, 2)] == [1, 1]


# -- what is refused ------------------------------------------------------------------------------------------------


def test_error_numbers() -> None:
    wire = Wire({1: 100})
    assert wire.write(1, xc330.PRESENT_POSITION, 5) == Trouble.ACCESS
    assert wire.write(1, xc330.TORQUE_ENABLE, 2) == Trouble.DATA_RANGE
    assert wire.write(1, xc330.OPERATING_MODE, 2) == Trouble.DATA_RANGE
    assert wire.write(1, xc330.GOAL_POSITION, 4096) == Trouble.DATA_LIMIT
    wire.write(1, xc330.CURRENT_LIMIT, 500)
    assert wire.write(1, xc330.GOAL_CURRENT, -501) == Trouble.DATA_LIMIT
    half = wire.ask(packet(1, Instruction.WRITE, b"\x74\x00\x01\x00"))
    assert half == status(1, Trouble.DATA_LENGTH)
    assert wire.ask(packet(1, Instruction.WRITE, b"\x5c\x00\x01")) == status(1, Trouble.ACCESS)  # no item there
    assert wire.ask(packet(1, Instruction.READ, b"\xe0\x00\x08\x00")) == status(1, Trouble.ACCESS)  # beyond the end
    assert wire.ask(packet(1, 0x77)) == status(1, Trouble.INSTRUCTION)
    assert wire.ask(packet(1, Instruction.FACTORY_RESET, b"\x07")) == status(1, Trouble.DATA_RANGE)


def test_a_wrong_crc_is_told_by_the_servo_it_was_for() -> None:
    wire = Wire({1: 100, 2: 100})
    spoilt = packet(2, Instruction.PING)[:-1] + b"\x00"
    assert wire.ask(spoilt) == status(2, Trouble.CRC)


def test_a_write_is_done_whole_or_not_at_all() -> None:
    wire = Wire({1: 0})
    answer = wire.ask(packet(1, Instruction.WRITE, b"\x40\x00\x01\x02"))  # torque 1, LED 2
    assert answer == status(1, Trouble.DATA_RANGE)
    assert wire.read(1, xc330.TORQUE_ENABLE) == 0


def test_the_eeprom_is_locked_under_torque() -> None:
    wire = Wire({1: 0})
    wire.write(1, xc330.TORQUE_ENABLE, 1)
    assert wire.write(1, xc330.RETURN_DELAY, 0) == Trouble.ACCESS
    assert wire.read(1, xc330.RETURN_DELAY) == 250
    wire.write(1, xc330.TORQUE_ENABLE, 0)
    assert wire.write(1, xc330.RETURN_DELAY, 0) == Trouble.NONE


def test_status_return_level() -> None:
    wire = Wire({1: 0})
    assert wire.ask(packet(1, Instruction.WRITE, b"\x44\x00\x01")) != b""  # it counts from the next on
    assert wire.ask(packet(1, Instruction.WRITE, b"\x41\x00\x01")) == b""
    assert wire.read(1, xc330.LED) == 1
    wire.ask(packet(1, Instruction.WRITE, b"\x44\x00\x00"))
    assert wire.ask(packet(1, Instruction.READ, b"\x41\x00\x01\x00")) == b""
    assert wire.ask(packet(BROADCAST, Instruction.SYNC_READ, b"\x41\x00\x01\x00\x01")) == b""
    assert wire.ask(packet(1, Instruction.PING)) != b""


# -- registers that do something ------------------------------------------------------------------------------------


def test_registered_writes_wait_for_the_action() -> None:
    wire = Wire({1: 0, 2: 0})
    assert wire.ask(packet(1, Instruction.ACTION)) == status(1, Trouble.INSTRUCTION)
    for servo in (1, 2):
        assert wire.ask(packet(servo, Instruction.REG_WRITE, b"\x41\x00\x01")) == status(servo, 0)
    assert [wire.read(1, xc330.REGISTERED), wire.read(1, xc330.LED)] == [1, 0]
    assert wire.ask(packet(BROADCAST, Instruction.ACTION)) == b""
    assert [wire.read(servo, item) for servo in (1, 2) for item in (xc330.REGISTERED, xc330.LED)] == [0, 1, 0, 1]


def test_indirect_addresses_inherit_everything() -> None:
    wire = Wire({1: 1000})
    places = [64, *range(116, 120), *range(132, 136), 0x46]
    data = b"".join(place.to_bytes(2, "little") for place in places)
    assert wire.servos[1].write(xc330.INDIRECT_ADDRESS, data) == Trouble.NONE
    assert wire.servos[1].write(208, b"\x01\x00\x02\x00\x00") == Trouble.NONE
    assert [wire.read(1, xc330.TORQUE_ENABLE), wire.read(1, xc330.GOAL_POSITION)] == [1, 512]
    wire.wait(SETTLED)
    assert wire.bytes(1, 208, 10) == b"\x01" + (512).to_bytes(4, "little") * 2 + b"\x00"
    assert wire.servos[1].write(209, b"\x01\x00\x02") == Trouble.DATA_LENGTH
    assert wire.servos[1].write(213, b"\x01\x00\x02\x00") == Trouble.ACCESS
    # An indirect address that was not set stands for itself: plain memory.
    assert wire.servos[1].write(220, b"\x2a") == Trouble.NONE
    assert wire.bytes(1, 220, 1) == b"\x2a"


def test_position_mode_follows_its_goal_and_profile() -> None:
    wire = Wire({1: 1000})
    wire.write(1, xc330.TORQUE_ENABLE, 1)
    assert wire.read(1, xc330.GOAL_POSITION) == 1000  # torque comes without a jump
    wire.write(1, xc330.PROFILE_VELOCITY, 44)  # 1.055 rad/s, 688 counts/s
    wire.write(1, xc330.GOAL_POSITION, 3000)
    wire.wait(1.0)
    assert wire.read(1, xc330.POSITION_TRAJECTORY) == pytest.approx(1688, abs=8)
    assert wire.read(1, xc330.PRESENT_POSITION) == pytest.approx(1660, abs=20)
    assert wire.read(1, xc330.PRESENT_VELOCITY) == pytest.approx(44, abs=2)
    assert wire.read(1, xc330.MOVING) == 1
    wire.wait(SETTLED)
    assert wire.read(1, xc330.PRESENT_POSITION) == 3000
    assert wire.read(1, xc330.MOVING) == 0


def test_current_velocity_and_pwm_modes_turn_the_right_way() -> None:
    for mode, item, goal in (
        (Mode.CURRENT, xc330.GOAL_CURRENT, -300),
        (Mode.VELOCITY, xc330.GOAL_VELOCITY, -50),
        (Mode.PWM, xc330.GOAL_PWM, -100),
    ):
        wire = Wire({1: 2000})
        wire.write(1, xc330.OPERATING_MODE, mode)
        wire.write(1, item, goal)
        wire.write(1, xc330.TORQUE_ENABLE, 1)
        wire.wait(0.2)
        assert wire.read(1, xc330.PRESENT_VELOCITY) < -20
        assert wire.read(1, xc330.PRESENT_POSITION) < 2000


def test_a_new_operating_mode_resets_goals_gains_and_profile() -> None:
    wire = Wire({1: 2000})
    wire.write(1, xc330.CURRENT_LIMIT, 700)
    wire.write(1, xc330.POSITION_P, 5)
    wire.write(1, xc330.PROFILE_VELOCITY, 9)
    wire.write(1, xc330.OPERATING_MODE, Mode.CURRENT)
    assert wire.read(1, xc330.GOAL_CURRENT) == 700  # so a client must set it before it gives torque
    assert wire.read(1, xc330.POSITION_P) == 1100
    assert wire.read(1, xc330.PROFILE_VELOCITY) == 0


def test_homing_offset_shifts_the_position() -> None:
    wire = Wire({1: 2000})
    wire.write(1, xc330.HOMING_OFFSET, -500)
    assert wire.read(1, xc330.PRESENT_POSITION) == 1500
    wire.write(1, xc330.TORQUE_ENABLE, 1)
    wire.write(1, xc330.GOAL_POSITION, 1600)
    wire.wait(SETTLED)
    assert wire.free.position[0] / xc330.RAD_PER_COUNT == pytest.approx(2100, abs=1)


def test_turns_are_lost_by_a_reboot_and_by_clear() -> None:
    for code, parameters in ((Instruction.REBOOT, b""), (Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")):
        wire = Wire({1: 1000})
        wire.write(1, xc330.OPERATING_MODE, Mode.EXTENDED_POSITION)
        wire.write(1, xc330.TORQUE_ENABLE, 1)
        wire.write(1, xc330.GOAL_POSITION, -9000)
        assert wire.ask(packet(1, Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")) == status(1, 0)  # it stands yet
        wire.write(1, xc330.GOAL_POSITION, -9000)
        wire.wait(0.1)
        assert wire.ask(packet(1, Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")) == status(1, Trouble.RESULT_FAIL)
        wire.wait(SETTLED)
        wire.ask(packet(1, code, parameters))
        wire.wait(0.2)
        assert wire.read(1, xc330.PRESENT_POSITION) == -9000 % 4096


# -- watchdog, errors, reboot ---------------------------------------------------------------------------------------


def under_watchdog(mode: Mode) -> Wire:
    wire = Wire({1: 2000, 2: 0})
    wire.write(1, xc330.OPERATING_MODE, mode)
    wire.write(1, xc330.GOAL_CURRENT, 300)
    wire.write(1, xc330.TORQUE_ENABLE, 1)
    wire.write(1, xc330.BUS_WATCHDOG, 5)
    return wire


def test_the_watchdog_stops_a_servo_and_locks_its_goals() -> None:
    wire = under_watchdog(Mode.CURRENT_BASED_POSITION)
    wire.write(1, xc330.GOAL_POSITION, 4000)
    wire.wait(0.09)
    assert not wire.servos[1].tripped
    wire.wait(0.02)
    assert wire.read(1, xc330.BUS_WATCHDOG) == xc330.TRIPPED
    there = wire.read(1, xc330.PRESENT_POSITION)
    wire.wait(SETTLED)
    assert 2000 < there < 4000
    assert wire.read(1, xc330.PRESENT_POSITION) == pytest.approx(there, abs=1)
    assert wire.write(1, xc330.GOAL_POSITION, 3000) == Trouble.DATA_RANGE
    assert wire.write(1, xc330.BUS_WATCHDOG, 0) == Trouble.NONE
    assert wire.write(1, xc330.GOAL_POSITION, 3000) == Trouble.NONE


def test_in_current_mode_the_watchdog_takes_the_current() -> None:
    wire = under_watchdog(Mode.CURRENT)
    wire.wait(0.2)
    assert wire.servos[1].tripped
    assert wire.read(1, xc330.GOAL_CURRENT) == 0
    wire.wait(SETTLED)
    assert wire.read(1, xc330.PRESENT_VELOCITY) == 0


def test_a_servo_that_runs_on_keeps_its_goal() -> None:
    wire = under_watchdog(Mode.CURRENT)
    wire.servos[1].runs_on = True
    wire.wait(0.3)
    assert wire.servos[1].tripped
    assert wire.read(1, xc330.PRESENT_VELOCITY) > 0


def test_every_packet_feeds_the_watchdog_whomever_it_is_for() -> None:
    wire = under_watchdog(Mode.CURRENT_BASED_POSITION)
    for _ in range(10):
        wire.wait(0.08)
        wire.ask(packet(2, Instruction.PING))
    assert not wire.servos[1].tripped


def test_the_watchdog_sleeps_while_torque_is_off() -> None:
    wire = Wire({1: 0})
    wire.write(1, xc330.BUS_WATCHDOG, 5)
    wire.wait(1.0)
    assert wire.read(1, xc330.BUS_WATCHDOG) == 5


def test_overload_takes_the_torque_until_the_reboot() -> None:
    wire = Wire({1: 2000})
    wire.write(1, xc330.TORQUE_ENABLE, 1)
    wire.servos[1].fail(HardwareError.OVERLOAD)
    assert wire.read(1, xc330.TORQUE_ENABLE) == 0
    assert wire.read(1, xc330.HARDWARE_ERROR) == HardwareError.OVERLOAD
    assert wire.ask(packet(1, Instruction.WRITE, b"\x41\x00\x01")) == status(1, 0x80)
    assert wire.write(1, xc330.TORQUE_ENABLE, 1) == 0x80 | Trouble.RESULT_FAIL
    assert wire.ask(packet(1, Instruction.REBOOT)) == status(1, 0x80)
    assert wire.ask(packet(1, Instruction.PING)) == b""  # not awake yet
    wire.wait(0.2)
    assert wire.read(1, xc330.HARDWARE_ERROR) == 0
    assert wire.write(1, xc330.TORQUE_ENABLE, 1) == 0


def test_voltage_warns_and_heat_shuts_down() -> None:
    wire = Wire({1: 0})
    wire.write(1, xc330.TORQUE_ENABLE, 1)
    wire.free.voltage[0] = 3.2
    assert wire.read(1, xc330.HARDWARE_ERROR) == HardwareError.VOLTAGE
    assert wire.read(1, xc330.TORQUE_ENABLE) == 1  # not among the shutdown bits of the factory
    wire.free.temperature[0] = 71.0
    assert wire.read(1, xc330.HARDWARE_ERROR) == HardwareError.VOLTAGE | HardwareError.OVERHEATING
    assert wire.read(1, xc330.TORQUE_ENABLE) == 0


def test_a_reboot_forgets_the_ram_and_keeps_the_eeprom() -> None:
    wire = Wire({1: 100})
    wire.write(1, xc330.RETURN_DELAY, 0)
    wire.write(1, xc330.PROFILE_VELOCITY, 50)
    wire.servos[1].write(xc330.INDIRECT_ADDRESS, b"\x84\x00")
    wire.ask(packet(1, Instruction.REBOOT))
    wire.wait(0.2)
    assert wire.read(1, xc330.RETURN_DELAY) == 0
    assert wire.read(1, xc330.PROFILE_VELOCITY) == 0
    assert wire.bytes(1, xc330.INDIRECT_ADDRESS, 2) == b"\xd0\x00"


@pytest.mark.parametrize(("option", "servo", "baud"), [(0xFF, 1, 1), (0x01, 9, 1), (0x02, 9, 3)])
def test_factory_reset(option: int, servo: int, baud: int) -> None:
    wire = Wire({9: 100})
    wire.write(9, xc330.BAUD_RATE, 3)
    wire.write(9, xc330.CURRENT_LIMIT, 77)
    wire.ask(packet(9, Instruction.FACTORY_RESET, bytes((option,))))
    wire.wait(0.2)
    assert [wire.read(servo, item) for item in (xc330.ID, xc330.BAUD_RATE, xc330.CURRENT_LIMIT)] == [servo, baud, 2352]
    assert wire.read(servo, xc330.FIRMWARE) == 52


def test_all_servos_at_once_are_not_reset_to_the_same_id() -> None:
    wire = Wire({8: 0, 9: 0})
    wire.ask(packet(BROADCAST, Instruction.FACTORY_RESET, b"\xff"))
    assert [servo.servo_id for servo in wire.servos.values()] == [8, 9]


# -- faults on command ----------------------------------------------------------------------------------------------


def test_faults_spoil_so_many_answers_and_no_more() -> None:
    wire = Wire({1: 100, 2: 100})
    ping = packet(1, Instruction.PING)
    sound = wire.ask(ping)
    wire.inject(Kind.DROP, value=1.0, count=2)
    assert [wire.ask(ping), wire.ask(ping), wire.ask(ping)] == [b"", b"", sound]
    wire.inject(Kind.CORRUPT, value=1.0, count=1)
    spoilt = wire.ask(ping)
    assert [each.sound for each in Parser().feed(spoilt)] == [False]
    wire.inject(Kind.TRUNCATE, value=1.0, count=1)
    assert wire.ask(ping) == sound[: len(sound) // 2]
    wire.inject(Kind.WRONG_ID, value=1.0, count=2)
    assert next(Parser().feed(wire.ask(ping))) == Packet(0x41, 0x55, sound[8:-2], True)
    fast = wire.ask(packet(BROADCAST, Instruction.FAST_SYNC_READ, b"\x84\x00\x04\x00\x01\x02"))
    assert fast[9] == 0x41
    assert crc_bytes(fast[:-2]) == fast[-2:]
    assert wire.ask(ping) == sound


def test_an_error_stays_as_long_as_its_fault_and_is_gone_after_the_next_reboot() -> None:
    wire = Wire({1: 100, 2: 100})
    wire.inject(Kind.ERROR_BIT, 1.0, HardwareError.OVERLOAD, "theta_2")
    wire.wait(0.1)
    assert [servo.alert for servo in wire.servos.values()] == [0, 0x80]
    for expected in (0x80, 0):
        wire.ask(packet(2, Instruction.REBOOT))
        wire.wait(0.5)
        assert wire.servos[2].alert == expected
        wire.wait(0.6)


def test_what_lasts_for_no_time_happens_once() -> None:
    wire = Wire({1: 100, 2: 100})
    wire.inject(Kind.ERROR_BIT, 0.0, HardwareError.OVERHEATING)
    wire.inject(Kind.REBOOT, 0.0, part="theta_2")
    wire.servos[2].write(xc330.LED.address, b"\x01")
    wire.now += 0.5
    wire.bus.update(wire.now)
    assert [servo.get(xc330.HARDWARE_ERROR) for servo in wire.servos.values()] == [4, 0]
    assert wire.servos[2].get(xc330.LED) == 0
    assert [servo.hears(wire.now) for servo in wire.servos.values()] == [True, False]
    wire.wait(0.2)
    assert wire.servos[2].hears(wire.now)


def test_a_reboot_lasts_as_long_as_declared() -> None:
    wire = Wire({1: 100, 2: 100})
    wire.inject(Kind.REBOOT, 1.0, part="theta_1")
    wire.wait(0.9)
    assert wire.ask(packet(1, Instruction.PING)) == b""
    wire.wait(0.2)
    assert wire.ask(packet(1, Instruction.PING)) != b""


def test_a_share_of_the_answers() -> None:
    wire = Wire({1: 100})
    wire.inject(Kind.DROP, value=0.3)
    answered = sum(wire.ask(packet(1, Instruction.PING)) != b"" for _ in range(1000))
    assert 640 < answered < 760


# -- a simulated world ----------------------------------------------------------------------------------------------

MOUNTING = (
    ServoSettings(id=10, zero=1000),
    ServoSettings(id=11, zero=3000, sign=-1),
    ServoSettings(id=12, zero=2048, sign=-1),
    ServoSettings(id=13, zero=500),
    ServoSettings(id=14, zero=2048, sign=-1),
)


class InWorld(Wire):
    def __init__(self, vehicle: Vehicle, faults: Sequence[Fault] = ()) -> None:
        self.world = World(vehicle)
        self.servos = {mount.id: Servo(mount.id) for mount in MOUNTING}
        self.bus = DynamixelBus(list(self.servos.values()), WorldServos(self.world, MOUNTING), faults)
        self.now = 0.0

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.004)):
            self.now += 0.004
            self.world.advance(0.004)
            self.bus.update(self.now)

    def angles(self) -> list[float]:
        """As a client reckons them."""
        return [
            mount.sign * (self.read(mount.id, xc330.PRESENT_POSITION) - mount.zero) * xc330.RAD_PER_COUNT
            for mount in MOUNTING
        ]

    def true(self) -> list[float]:
        truth = self.world.truth()
        return [*truth.joints, truth.pump, truth.gripper]


def test_the_world_s_angles_are_seen_through_the_mounting(vehicle: Vehicle) -> None:
    wire = InWorld(vehicle)
    assert wire.angles() == pytest.approx(wire.true(), abs=xc330.RAD_PER_COUNT)


def test_the_arm_rests_until_a_servo_is_switched_on(vehicle: Vehicle) -> None:
    wire = InWorld(vehicle)
    before = wire.true()
    wire.wait(0.5)
    assert wire.true() == pytest.approx(before, abs=0.02)
    wire.write(12, xc330.TORQUE_ENABLE, 1)
    wire.wait(0.5)
    # Now the servos are what they are: the two without torque let the links fall.
    assert wire.true()[:2] != pytest.approx(before[:2], abs=0.02)
    assert wire.world.snapshot.torque_on


def test_all_five_follow_goals_in_the_world(vehicle: Vehicle) -> None:
    wire = InWorld(vehicle)
    goals = [angle + move for angle, move in zip(wire.true(), (0.1, 0.1, -0.2, 0.5, 0.7), strict=True)]
    for mount, goal in zip(MOUNTING, goals, strict=True):
        wire.write(mount.id, xc330.OPERATING_MODE, Mode.CURRENT_BASED_POSITION)
        wire.write(mount.id, xc330.TORQUE_ENABLE, 1)
        counts = mount.zero + round(mount.sign * goal / xc330.RAD_PER_COUNT)
        assert wire.write(mount.id, xc330.GOAL_POSITION, counts) == 0
    wire.wait(2.0)
    assert wire.angles() == pytest.approx(goals, abs=0.03)


def test_current_is_torque_in_the_world(vehicle: Vehicle) -> None:
    wire = InWorld(vehicle)
    for mount in MOUNTING[:3]:
        wire.write(mount.id, xc330.OPERATING_MODE, Mode.CURRENT)
        wire.write(mount.id, xc330.GOAL_CURRENT, 100)
        wire.write(mount.id, xc330.TORQUE_ENABLE, 1)
    wire.wait(0.02)
    u = wire.world.plant.u
    expected = [mount.sign * 0.1 * mount.torque_constant for mount in MOUNTING[:3]]
    assert list(u[at.U_TORQUE : at.U_TORQUE + 3]) == pytest.approx(expected)
    assert wire.world.truth().joint_torque == pytest.approx(expected)
    assert [wire.read(mount.id, xc330.PRESENT_CURRENT) for mount in MOUNTING[:3]] == pytest.approx([100] * 3, abs=1)
    assert list(u[at.U_LIMP : at.U_LIMP + 5]) == [0, 0, 0, 1, 1]
    assert u[at.U_POSITION_MODE] == 0


def test_one_servo_goes_limp_alone(vehicle: Vehicle) -> None:
    wire = InWorld(vehicle)
    for mount in MOUNTING:
        wire.write(mount.id, xc330.OPERATING_MODE, Mode.CURRENT_BASED_POSITION)
        wire.write(mount.id, xc330.TORQUE_ENABLE, 1)
    wire.wait(0.2)
    wire.servos[12].fail(HardwareError.OVERLOAD)
    before = wire.true()
    wire.wait(0.5)
    assert abs(wire.true()[2] - before[2]) > 0.05
    assert wire.world.truth().joint_torque[2] == 0.0
    assert wire.true()[:2] == pytest.approx(before[:2], abs=0.05)


def test_declared_for_a_phase_in_the_world_s_time(vehicle: Vehicle) -> None:
    wire = InWorld(vehicle, [Fault("servos", Kind.SILENT, 0.1, 0.2, phase="press", part="pump")])
    wire.wait(0.5)
    wire.bus.troubles.faults.enter("press", wire.world.time)
    seen = []
    for _ in range(4):
        seen.append(wire.servos[13].silent)
        wire.wait(0.1)
    assert seen == [False, True, True, False]


# -- the terminal ---------------------------------------------------------------------------------------------------


class Client:
    """A client that knows nothing but bytes."""

    def __init__(self, path: str, speed: int = termios.B1000000) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)
        settings = termios.tcgetattr(self.fd)
        settings[4] = settings[5] = speed
        termios.tcsetattr(self.fd, termios.TCSANOW, settings)

    def ask(self, question: bytes, length: int, within: float = 5.0) -> bytes:
        """The answer of so many bytes, or what came until it was too late."""
        os.write(self.fd, question)
        answer, end = b"", monotonic() + within
        while len(answer) < length and select.select([self.fd], [], [], max(0.0, end - monotonic()))[0]:
            answer += os.read(self.fd, length)
        return answer

    def close(self) -> None:
        os.close(self.fd)


FIVE = tuple(ServoSettings(id=servo) for servo in (1, 2, 3, 4, 5))
PING = packet(1, Instruction.PING)
PONG = status(1, 0, b"\xd8\x04\x34")


@pytest.fixture
def emulator(tmp_path: Path) -> Iterator[DynamixelEmulator]:
    made = emulate(FIVE, link=tmp_path / "servos")
    made.start()
    yield made
    made.stop()
    made.stop()


def test_a_client_of_plain_bytes(emulator: DynamixelEmulator) -> None:
    client = Client(emulator.path)
    assert client.ask(PING, 14) == PONG
    assert client.ask(packet(BROADCAST, Instruction.PING), 70) == b"".join(
        status(servo, 0, b"\xd8\x04\x34") for servo in (1, 2, 3, 4, 5)
    )
    client.close()


def test_an_answer_takes_its_time_on_the_wire(emulator: DynamixelEmulator) -> None:
    """28 bytes of instruction, 500 us of return delay and 239 bytes of answer at 57600 baud."""
    for servo in emulator.bus.servos:
        servo.write(xc330.BAUD_RATE.address, b"\x01")
    client = Client(emulator.path, termios.B57600)
    question = packet(1, Instruction.READ, b"\x00\x00\xe4\x00")
    began = monotonic()
    answer = client.ask(question, 239)
    assert len(answer) == 239
    assert monotonic() - began >= (14 + 239) * 10 / 57_600 + 500e-6
    client.close()


def test_at_another_baud_rate_nobody_hears(emulator: DynamixelEmulator) -> None:
    client = Client(emulator.path, termios.B57600)
    assert client.ask(PING, 14, within=0.05) == b""
    client.close()
    client = Client(emulator.path)
    assert client.ask(PING, 14) == PONG
    client.close()


def test_unplugging_hangs_up_and_plugging_brings_the_link_back(emulator: DynamixelEmulator) -> None:
    client = Client(emulator.path)
    emulator.unplug()
    assert not Path(emulator.path).exists()
    with pytest.raises(OSError, match=r"Input/output error|Bad file"):
        client.ask(PING, 14)
    client.close()
    emulator.plug()
    client = Client(emulator.path)
    assert client.ask(PING, 14) == PONG
    client.close()


def test_an_answer_can_be_held_back(emulator: DynamixelEmulator) -> None:
    client = Client(emulator.path)
    emulator.inject(Kind.DELAY, value=0.05, count=1)
    began = monotonic()
    assert client.ask(PING, 14) == PONG
    assert monotonic() - began >= 0.05
    client.close()


def test_orders(emulator: DynamixelEmulator) -> None:
    client = Client(emulator.path)
    assert order(emulator, "{device: servos, kind: drop, value: 1, count: 1}") == ""
    assert client.ask(PING, 14, within=0.05) == b""
    assert order(emulator, "{device: servos, kind: silent, part: theta_1}") == ""
    assert client.ask(PING, 14, within=0.05) == b""
    assert order(emulator, "clear") == order(emulator, "") == ""
    assert client.ask(PING, 14) == PONG
    assert "no part 'elbow'; want one of gripper, pump, theta_1" in order(
        emulator, "{device: servos, kind: silent, part: elbow}"
    )
    assert "standard input: fault 1: " in order(emulator, "drop many")
    client.close()


def test_late_answers_come_one_behind_the_other(emulator: DynamixelEmulator) -> None:
    """A delay is on the way, not in the servos: ten questions in a row take it once."""
    emulator.inject(Kind.DELAY, value=0.2)
    client = Client(emulator.path)
    began = monotonic()
    assert client.ask(PING * 10, 140) == PONG * 10
    assert 0.2 <= monotonic() - began < 1.5
    client.close()


def test_a_baud_rate_that_no_servo_has() -> None:
    with pytest.raises(ValueError, match="baud 250000: want one of"):
        emulate(FIVE, baud=250_000)


def test_alone_from_the_command_line(tmp_path: Path) -> None:
    link = tmp_path / "bus"
    command = [sys.executable, "-m", "sim_backend.dynamixel_emulator", "--link", str(link), "--baud", "2000000"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == f"{link}\n"
        client = Client(str(link), termios.B2000000)
        assert client.ask(PING, 14) == PONG
        _, complaints = process.communicate("{device: odometry, kind: nan}\nquit\n", timeout=10)
        client.close()
    assert process.returncode == 0
    assert "fault nan of odometry: servos can show corrupt, delay" in complaints
    assert not link.exists()


def test_the_command_line_refuses_ids_that_clash() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sim_backend.dynamixel_emulator", "--ids", "1", "1", "2", "3", "4"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "want five different numbers" in done.stderr
