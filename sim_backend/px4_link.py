"""The stand-in's UDP socket, and what a bad line makes of it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from contextlib import suppress
from random import Random
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from drivers.protocols import DeviceError
from sim_backend.faults import Faults, Kind

Address = tuple[str, int]

_MAX_DATAGRAM = 1400


class Link:
    """MAVLink 2 on one UDP socket, to everybody who has written and from the start to ``peer``.

    Faults: DROP and CORRUPT strike a share of the packets sent, DELAY holds them back, SILENT loses everything both
    ways, UNPLUGGED and REBOOT besides close the socket for their duration.
    """

    def __init__(self, bind: Address, peer: Address | None, system: int, component: int, faults: Faults, seed: int):
        self._bind = bind
        self._faults = faults
        self._random = Random(seed)
        self._peers: dict[Address, None] = {} if peer is None else {peer: None}
        self._first = tuple(self._peers)
        self._parsers: dict[Address, Any] = {}
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._out: list[bytes] = []
        self._late: deque[tuple[float, bytes]] = deque()
        self._socket: socket | None = self._open()
        self._bind = self._address()
        #: Messages sent so far, by name; those that a fault has lost are counted.
        self.sent: Counter[str] = Counter()

    @property
    def port(self) -> int:
        """UDP port it listens on."""
        return self._bind[1]

    def _open(self) -> socket:
        opened = socket(AF_INET, SOCK_DGRAM)
        try:
            opened.bind(self._bind)
        except OSError as error:
            opened.close()
            host, port = self._bind
            raise DeviceError(f"PX4 stand-in: cannot listen on UDP {host}:{port} ({error.strerror})") from error
        opened.setblocking(False)
        return opened

    def _address(self) -> Address:
        assert self._socket is not None
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def close(self) -> None:
        """Close the socket. Safe to call twice."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def forget(self) -> None:
        """As after a reboot: nobody has written yet."""
        self._peers = dict.fromkeys(self._first)
        self._parsers.clear()

    def listen(self, t: float) -> None:
        """At world time t: close and open the socket as the faults will."""
        gone = any(self._faults.find(kind, t) for kind in (Kind.UNPLUGGED, Kind.REBOOT))
        if gone and self._socket is not None:
            self.close()
            self._out.clear()
            self._late.clear()
        elif not gone and self._socket is None:
            self._socket = self._open()

    def receive(self, t: float) -> Iterator[Any]:
        """Messages that have arrived by world time t."""
        self.listen(t)
        deaf = self._faults.find(Kind.SILENT, t) is not None
        while self._socket is not None:
            try:
                data, address = self._socket.recvfrom(2048)
            except (BlockingIOError, ConnectionRefusedError):
                return
            if deaf:
                continue
            if address not in self._parsers:
                parser = mavlink.MAVLink(None)
                parser.robust_parsing = True
                self._parsers[address] = parser
                self._peers.setdefault(address)
            yield from self._parsers[address].parse_buffer(data) or ()

    def send(self, message: Any) -> None:
        """Put a message into the next datagram."""
        self.sent[message.get_type()] += 1
        self._out.append(message.pack(self._mav))

    def flush(self, t: float) -> None:
        """Send what is due at world time t."""
        self.listen(t)
        packets, self._out = self._out, []
        if self._faults.find(Kind.SILENT, t) is not None:
            packets = []
        packets = [self._damaged(packet, t) for packet in packets if not self._struck(Kind.DROP, t)]
        for packet in packets:
            delay = self._faults.strike(Kind.DELAY, t)
            self._late.append((t + (0.0 if delay is None else delay.value), packet))
        packets = []
        while self._late and self._late[0][0] <= t:
            packets.append(self._late.popleft()[1])
        batch = b""
        for packet in (*packets, b""):
            if batch and (not packet or len(batch) + len(packet) > _MAX_DATAGRAM):
                self._put(batch)
                batch = b""
            batch += packet

    def _struck(self, kind: Kind, t: float) -> bool:
        return self._faults.strike(kind, t, chance=self._random.random()) is not None

    def _damaged(self, packet: bytes, t: float) -> bytes:
        if not self._struck(Kind.CORRUPT, t):
            return packet
        spoilt = bytearray(packet)
        spoilt[self._random.randrange(len(spoilt))] ^= self._random.randrange(1, 256)
        return bytes(spoilt)

    def _put(self, batch: bytes) -> None:
        if self._socket is None:
            return
        for peer in self._peers:
            # A peer that is gone answers with an ICMP error, and a full buffer drops: PX4 cares for neither.
            with suppress(OSError):
                self._socket.sendto(batch, peer)
