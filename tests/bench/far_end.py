"""The other side of the set-point bench, a process of its own: ``python -m tests.bench.far_end``.

A stand-in autopilot behind a socket that passes datagrams on both ways, and notes when the kernel had each set-point
and each bare datagram in that socket's queue. The first line on standard output is the port; the second, when standard
input closes, is ``Arrivals`` as JSON.
"""

from __future__ import annotations

import select
import socket
import struct
import sys
import time
from collections.abc import Callable

import msgspec
from msgspec import Struct

from onboard.config import load_config
from onboard.devices import world_of
from sim_backend.px4_emulator import Px4StandIn

#: First bytes of a datagram that is only timed.
BARE = b"bare"
_SET_ATTITUDE_TARGET = 82
_SO_TIMESTAMPNS = 35  # Linux; its answer is a struct timespec on the clock of time.time_ns()
_TIMESPEC = struct.Struct("@ll")


class Arrivals(Struct):
    """Times of arrival on the monotonic clock, ns, in order."""

    set_points: list[int]
    bare: list[int]


def message_of(datagram: bytes) -> int:
    """Number of the first MAVLink 2 message, or -1."""
    return int.from_bytes(datagram[7:10], "little") if len(datagram) >= 12 and datagram[0] == 0xFD else -1


def serve(arrived: Callable[[bytes, int], None]) -> None:
    """Tell the port, and serve until standard input closes; ``arrived`` hears each datagram and when it came, ns."""
    stand_in = Px4StandIn(world_of(load_config("desk")))
    stand_in.start()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there,
    ):
        here.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        here.bind(("127.0.0.1", 0))
        there.connect(("127.0.0.1", stand_in.port))
        print(here.getsockname()[1], flush=True)
        driver: tuple[str, int] | None = None
        while True:
            ready, _, _ = select.select((here, there, sys.stdin), (), ())
            if here in ready:
                datagram, extra, _, sender = here.recvmsg(2048, 64)
                offset = time.time_ns() - time.monotonic_ns()
                seconds, nanoseconds = _TIMESPEC.unpack_from(extra[0][2])
                arrived(datagram, seconds * 1_000_000_000 + nanoseconds - offset)
                if not datagram.startswith(BARE):
                    driver = sender
                    there.send(datagram)
            if there in ready:
                datagram = there.recv(2048)
                if driver is not None:
                    here.sendto(datagram, driver)
            if sys.stdin in ready and not sys.stdin.read():
                break
    stand_in.stop()


def main() -> None:
    """Note what comes until standard input closes."""
    arrivals = Arrivals([], [])

    def arrived(datagram: bytes, t_ns: int) -> None:
        if datagram.startswith(BARE):
            arrivals.bare.append(t_ns)
        elif message_of(datagram) == _SET_ATTITUDE_TARGET:
            arrivals.set_points.append(t_ns)

    serve(arrived)
    print(msgspec.json.encode(arrivals).decode(), flush=True)


if __name__ == "__main__":
    main()
