"""What a real PX4 in software says: to a ground station, to the driver through a wire tap, and from a file.

Files are .tlog, as ground stations write them: for each packet eight bytes of microseconds (big-endian), the packet.
"""

from __future__ import annotations

import select
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket
from types import TracebackType
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

# Ports of PX4's first instance: it sends to the first of each pair, and listens on the second.
_ONBOARD = ("127.0.0.1", 14540), ("127.0.0.1", 14580)
_GROUND = ("127.0.0.1", 14550), ("127.0.0.1", 18570)
_ASK_PERIOD = 0.03
_GLANCE = 0.02
_STAMP = struct.Struct(">Q")
_MODES = {(6, 0): "offboard", (4, 3): "hold", (4, 5): "return", (4, 6): "land", (4, 10): "descend"}


class Packet(NamedTuple):
    """One MAVLink message of PX4 and when it came, ns on the monotonic clock or since the start of a file."""

    t_ns: int
    message: Any

    @property
    def name(self) -> str:
        """Of the message."""
        return str(self.message.get_type())

    @property
    def mode(self) -> str:
        """PX4's mode, of a heartbeat; empty for any other message."""
        if self.name != "HEARTBEAT":
            return ""
        custom = self.message.custom_mode
        return _MODES.get((custom >> 16 & 0xFF, custom >> 24 & 0xFF), f"{custom:#x}")

    @property
    def armed(self) -> bool:
        """Of a heartbeat."""
        return bool(self.message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)


class _Ear:
    """Keeps what PX4 says. Use as a context manager."""

    def __init__(self) -> None:
        self.packets: list[Packet] = []
        self._parser = parser()
        self._stopping = threading.Event()
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="ear", daemon=True)

    def _run(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Any:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stopping.set()
        self._thread.join()

    def wait(self, what: str, happens: Callable[[Packet], bool], patience: float, since: int = 0) -> Packet:
        """The first packet of which something is true, from a time (ns) on; fails with ``what`` when none comes."""
        seen = 0

        def found() -> Packet | None:
            nonlocal seen
            while seen < len(self.packets):
                packet = self.packets[seen]
                seen += 1
                if packet.t_ns >= since and happens(packet):
                    return packet
            return None

        with self._news:
            packet = self._news.wait_for(found, patience)
        assert packet is not None, f"not within {patience:g} s: {what}"
        return packet

    def _hear(self, data: bytes) -> None:
        now = time.monotonic_ns()
        with self._news:
            self.packets += (Packet(now, message) for message in self._parser.parse_buffer(data) or ())
            self._news.notify_all()


class GroundStation(_Ear):
    """Asks PX4 for its mode 30 times a second, on the link of ground stations."""

    def _run(self) -> None:
        mine, theirs = _GROUND
        mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        request = mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_HEARTBEAT, 0, 0, 0, 0, 0, 0
        )
        with socket(AF_INET, SOCK_DGRAM) as link:
            link.bind(mine)
            due = 0.0
            while not self._stopping.is_set():
                with suppress(ConnectionRefusedError):  # PX4 has not come yet, or has gone
                    if time.monotonic() >= due:
                        due = time.monotonic() + _ASK_PERIOD
                        link.sendto(request.pack(mav), theirs)
                    if select.select((link,), (), (), _GLANCE)[0]:
                        self._hear(link.recv(65535))


class Tap(_Ear):
    """Stands between PX4 and the driver, which connects to ``url``, and hands every packet on."""

    def __init__(self) -> None:
        super().__init__()
        self._driver = socket(AF_INET, SOCK_DGRAM)
        self._driver.bind(("127.0.0.1", 0))

    @property
    def url(self) -> str:
        """For the driver."""
        return f"udpout://127.0.0.1:{self._driver.getsockname()[1]}"

    def _run(self) -> None:
        mine, theirs = _ONBOARD
        driver: Any = None
        with self._driver, socket(AF_INET, SOCK_DGRAM) as px4:
            px4.bind(mine)
            while not self._stopping.is_set():
                for ready in select.select((px4, self._driver), (), (), _GLANCE)[0]:
                    with suppress(ConnectionRefusedError):  # the other end has gone, or has not come yet
                        data, sender = ready.recvfrom(65535)
                        if ready is self._driver:
                            driver = sender
                            px4.sendto(data, theirs)
                        else:
                            self._hear(data)
                            if driver is not None:
                                self._driver.sendto(data, driver)


def parser() -> Any:
    """A MAVLink parser that survives what it does not know."""
    found = mavlink.MAVLink(None)
    found.robust_parsing = True
    return found


def write_tlog(path: Path, packets: Iterable[Packet]) -> None:
    """Packets as they came, times counted from the first."""
    with path.open("wb") as file:
        start: int | None = None
        for packet in packets:
            start = packet.t_ns if start is None else start
            file.write(_STAMP.pack((packet.t_ns - start) // 1000) + bytes(packet.message.get_msgbuf()))


def read_tlog(path: Path) -> Iterator[Packet]:
    """The packets of a file."""
    data, at, reader = path.read_bytes(), 0, parser()
    while at < len(data):
        (stamp,) = _STAMP.unpack_from(data, at)
        at += _STAMP.size
        # MAVLink 2, not signed: 10 bytes before the payload, 2 behind it.
        size = 12 + data[at + 1]
        (message,) = reader.parse_buffer(data[at : at + size])
        yield Packet(stamp * 1000, message)
        at += size
