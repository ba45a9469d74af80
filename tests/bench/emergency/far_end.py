"""Autopilot and servos: ``python -m tests.bench.emergency.far_end autopilot|servos``, a process for each.

The first line on standard output is the UDP port, or the path of the terminal; the second, when standard input closes,
is ``Frames`` as JSON.
"""

from __future__ import annotations

import struct
import sys
import time
from enum import IntEnum

import msgspec

from drivers import xc330
from drivers.dynamixel_settings import DynamixelSettings
from sim_backend.dynamixel_emulator import emulate
from sim_backend.dynamixel_wire import Instruction, Packet
from tests.bench.emergency.messages import Frames
from tests.bench.far_end import message_of, serve

#: A stop is marked in the set-points by so much roll rate each, rad/s.
MARK = 1e-3
_PAYLOAD = 10
_ARM_DISARM, _SET_MODE = 400, 176
_FORCE, _AUTO = 21196.0, 4.0
_LONGEST_PAYLOAD = 64


class _Message(IntEnum):
    COMMAND_LONG = 76
    SET_ATTITUDE_TARGET = 82


def autopilot() -> Frames:
    """A stand-in behind a socket that stamps."""
    frames = Frames()

    def arrived(datagram: bytes, t_ns: int) -> None:
        # MAVLink 2 leaves out the zeros at the end of a payload.
        payload = datagram[_PAYLOAD : _PAYLOAD + datagram[1]].ljust(_LONGEST_PAYLOAD, b"\0")
        match message_of(datagram):
            case _Message.COMMAND_LONG:
                (second,) = struct.unpack_from("<f", payload, 4)
                (command,) = struct.unpack_from("<H", payload, 28)
                if (command, second) == (_ARM_DISARM, _FORCE):
                    frames.kills.append(t_ns)
                elif (command, second) == (_SET_MODE, _AUTO):
                    frames.lands.append(t_ns)
            case _Message.SET_ATTITUDE_TARGET:
                (roll_rate,) = struct.unpack_from("<f", payload, 20)
                frames.marks.setdefault(round(roll_rate / MARK), t_ns)

    serve(arrived)
    return frames


def servos() -> Frames:
    """An emulated bus, at the pace of the wire."""
    frames = Frames()
    mounting = DynamixelSettings("").servos
    limp = xc330.TORQUE_ENABLE.address.to_bytes(2, "little") + b"\1\0" + b"".join(bytes((m.id, 0)) for m in mounting)
    emulator = emulate(mounting)
    handle = emulator.bus.handle

    def noted(packet: Packet, now: float, speed: int | None = None) -> tuple[bytes, float]:
        if packet.instruction == Instruction.SYNC_WRITE and packet.parameters == limp:
            frames.limp.append(time.monotonic_ns())
        return handle(packet, now, speed)

    emulator.bus.handle = noted  # type: ignore[method-assign]
    emulator.start()
    print(emulator.path, flush=True)
    sys.stdin.read()
    emulator.stop()
    return frames


def main() -> None:
    """Serve until standard input closes."""
    frames = {"autopilot": autopilot, "servos": servos}[sys.argv[1]]()
    print(msgspec.json.encode(frames).decode(), flush=True)


if __name__ == "__main__":
    main()
