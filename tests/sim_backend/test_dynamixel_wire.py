"""Packets of protocol 2.0, byte by byte as the manual's examples have them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend.dynamixel_wire import Instruction, Packet, Parser, crc, packet, status

#: Instruction packets of the e-manual (protocol 2.0): target, instruction, parameters, bytes on the wire.
EXAMPLES = [
    (0x01, Instruction.PING, "", "FF FF FD 00 01 03 00 01 19 4E"),
    (0xFE, Instruction.PING, "", "FF FF FD 00 FE 03 00 01 31 42"),
    (0x01, Instruction.READ, "84 00 04 00", "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    (0x01, Instruction.WRITE, "74 00 00 02 00 00", "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    (0x01, Instruction.REG_WRITE, "68 00 C8 00 00 00", "FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E"),
    (0x01, Instruction.ACTION, "", "FF FF FD 00 01 03 00 05 02 CE"),
    (0x01, Instruction.FACTORY_RESET, "01", "FF FF FD 00 01 04 00 06 01 A1 E6"),
    (0x01, Instruction.REBOOT, "", "FF FF FD 00 01 03 00 08 2F 4E"),
    (0x01, Instruction.CLEAR, "01 44 58 4C 22", "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC"),
    (0xFE, Instruction.SYNC_READ, "84 00 04 00 01 02", "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA"),
    (
        0xFE,
        Instruction.SYNC_WRITE,
        "74 00 04 00 01 96 00 00 00 02 AA 00 00 00",
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    (0xFE, Instruction.FAST_SYNC_READ, "84 00 04 00 03 07 04", "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2"),
    (
        0xFE,
        Instruction.BULK_READ,
        "01 90 00 02 00 02 92 00 01 00",
        "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    ),
    (
        0xFE,
        Instruction.BULK_WRITE,
        "01 20 00 02 00 A0 00 02 1F 00 01 00 50",
        "FF FF FD 00 FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68",
    ),
]


@pytest.mark.parametrize(("target", "instruction", "parameters", "wire"), EXAMPLES)
def test_instructions_of_the_manual(target: int, instruction: int, parameters: str, wire: str) -> None:
    content = bytes.fromhex(parameters)
    assert packet(target, instruction, content) == bytes.fromhex(wire)
    assert list(Parser().feed(bytes.fromhex(wire))) == [Packet(target, instruction, content, True)]


def test_status_packets_of_the_manual() -> None:
    assert status(1, 0, bytes.fromhex("06 04 26")) == bytes.fromhex("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D")
    assert status(1, 0) == bytes.fromhex("FF FF FD 00 01 04 00 55 00 A1 0C")
    assert status(2, 0, b"\x24") == bytes.fromhex("FF FF FD 00 02 05 00 55 00 24 8B A9")


def test_crc() -> None:
    """The first entries of the manual's table, and the check value of this CRC (CRC-16/UMTS)."""
    assert [crc(bytes((byte,))) for byte in range(8)] == [
        0x0000, 0x8005, 0x800F, 0x000A, 0x801B, 0x001E, 0x0014, 0x8011,
    ]  # fmt: skip
    assert crc(bytes((255,))) == 0x0202
    assert crc(b"123456789") == 0xFEE8


@given(st.binary(max_size=60), st.binary(max_size=60))
def test_crc_can_be_carried_on(head: bytes, tail: bytes) -> None:
    assert crc(tail, crc(head)) == crc(head + tail)


def test_the_header_s_pattern_is_stuffed() -> None:
    wire = packet(1, Instruction.WRITE, bytes.fromhex("74 00 FF FF FD 00"))
    assert wire[:-2] == bytes.fromhex("FF FF FD 00 01 0A 00 03 74 00 FF FF FD FD 00")


patterned = st.lists(st.sampled_from([b"\xff", b"\xff\xff", b"\xfd", b"\x00", b"\xff\xff\xfd", b"a"]), max_size=20)


@given(patterned.map(b"".join), st.binary(max_size=5), st.integers(1, 9))
def test_any_content_comes_through_in_any_pieces(content: bytes, noise: bytes, size: int) -> None:
    wire = noise.replace(b"\xff", b"") + packet(7, Instruction.WRITE, content)
    parser = Parser()
    found = [each for k in range(0, len(wire), size) for each in parser.feed(wire[k : k + size])]
    assert found == [Packet(7, Instruction.WRITE, content, True)]


@given(st.integers(0, 13), st.integers(1, 255))
def test_a_spoilt_packet_is_not_taken_and_does_not_swallow_what_follows(place: int, flip: int) -> None:
    wire = bytearray(packet(1, Instruction.READ, b"\x84\x00\x04\x00"))
    wire[place] ^= flip
    parser = Parser()
    # A spoilt length makes the parser wait for up to a kilobyte; the bus goes on meanwhile.
    found = list(parser.feed(bytes(wire) + 120 * packet(2, Instruction.PING)))
    assert [each for each in found if each.sound][-1] == Packet(2, Instruction.PING, b"", True)
    assert all(each.target == 2 for each in found if each.sound)
    assert sum(each.sound for each in found) >= 118
