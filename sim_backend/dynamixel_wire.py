"""Packets of Dynamixel protocol 2.0 as a servo sees them (ROBOTIS e-manual, protocol 2.0 and CRC calculation)."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
STATUS = 0x55
ALERT = 0x80
_LONGEST = 1024
_PATTERN = b"\xff\xff\xfd"


class Instruction(IntEnum):
    """What a packet asks for."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Trouble(IntEnum):
    """Error numbers of a status packet."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class Packet(NamedTuple):
    """One packet that has come in; ``sound`` tells whether its CRC is right."""

    target: int
    instruction: int
    parameters: bytes
    sound: bool


def _remainder(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1) ^ 0x8005 if value & 0x8000 else value << 1
    return value & 0xFFFF


_TABLE = tuple(_remainder(byte) for byte in range(256))


def crc(data: bytes | bytearray, start: int = 0) -> int:
    """CRC-16 with polynomial 0x8005, not reflected, from ``start`` on."""
    value = start
    for byte in data:
        value = (value << 8 & 0xFF00) ^ _TABLE[value >> 8 ^ byte]
    return value


def crc_bytes(data: bytes | bytearray) -> bytes:
    """The CRC as it follows ``data`` on the wire."""
    return crc(data).to_bytes(2, "little")


def packet(target: int, instruction: int, parameters: bytes = b"") -> bytes:
    """A whole packet: stuffed, with length and CRC."""
    content = (bytes((instruction,)) + parameters).replace(_PATTERN, _PATTERN + b"\xfd")
    head = HEADER + bytes((target,)) + (len(content) + 2).to_bytes(2, "little") + content
    return head + crc_bytes(head)


def status(servo: int, error: int, data: bytes = b"") -> bytes:
    """A status packet."""
    return packet(servo, STATUS, bytes((error,)) + data)


class Parser:
    """Finds packets in a stream of bytes, whatever else is in it."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def clear(self) -> None:
        """Forget what has come so far."""
        self._buffer.clear()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes; yields every packet that is complete with them."""
        buffer = self._buffer
        buffer += data
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                del buffer[: max(0, len(buffer) - len(HEADER) + 1)]
                return
            del buffer[:start]
            if len(buffer) < 7:
                return
            length = buffer[5] | buffer[6] << 8
            if not 3 <= length <= _LONGEST:
                del buffer[: len(HEADER)]
                continue
            if len(buffer) < 7 + length:
                return
            whole = bytes(buffer[: 7 + length])
            sound = crc_bytes(whole[:-2]) == whole[-2:]
            # A wrong length must not swallow the packet behind.
            del buffer[: len(whole) if sound else len(HEADER)]
            content = whole[7:-2].replace(_PATTERN + b"\xfd", _PATTERN)
            yield Packet(whole[4], content[0], content[1:], sound)
