"""How a real PX4 reaches its simulator: as a TCP client of ours, or over a serial port."""

from __future__ import annotations

import os
import re
import select
import time
from socket import AF_INET, IPPROTO_TCP, SO_REUSEADDR, SOCK_STREAM, SOL_SOCKET, TCP_NODELAY, socket
from typing import Any, Protocol

import serial

from drivers.protocols import DeviceError

_CHUNK = 65536
_REOPEN = 1.0  # s between two attempts to open a port that has gone


class LostError(Exception):
    """The other end has gone; the text says how it was noticed."""


class Wire(Protocol):
    """Bytes to and from one PX4. Nothing waits but ``wait``."""

    where: str
    """For people: where PX4 is looked for."""
    lockstep: bool
    """PX4's time is the simulator's, so that each waits for the other."""

    @property
    def connected(self) -> bool:
        """Somebody is at the other end."""

    def open(self) -> bool:
        """Take PX4 if it is there; whether it is."""

    def read(self) -> bytes:
        """What has come. Raises LostError; the wire then looks for the next PX4."""

    def write(self, data: bytes) -> None:
        """Send. Raises LostError likewise."""

    def wait(self, seconds: float) -> None:
        """Until something can be read, or time is up."""

    def close(self) -> None:
        """Give port and connection back. Safe to call twice."""


def wire_of(url: str) -> Wire:
    """Open ``tcp://HOST:PORT`` (we listen; port 0: any) or ``serial://DEVICE:BAUD``. Raises DeviceError."""
    if match := re.fullmatch(r"tcp://([^:/]+):(\d{1,5})", url):
        return TcpWire(match[1], int(match[2]))
    if match := re.fullmatch(r"serial://(/.+):(\d+)", url):
        return SerialWire(match[1], int(match[2]))
    raise DeviceError(
        f"PX4's simulator: no way to PX4 is called {url!r}; want for example tcp://127.0.0.1:4560 "
        "(PX4 in software comes there) or serial:///dev/ttyACM0:921600 (PX4 on its board)"
    )


class TcpWire:
    """We are the server and PX4 is the client, one at a time."""

    lockstep = True

    def __init__(self, host: str, port: int) -> None:
        self._client: socket | None = None
        self._server = socket(AF_INET, SOCK_STREAM)
        try:
            self._server.setsockopt(SOL_SOCKET, SO_REUSEADDR, 1)
            self._server.bind((host, port))
            self._server.listen(1)
        except (OSError, OverflowError) as error:
            self._server.close()
            raise DeviceError(
                f"PX4's simulator: cannot listen on TCP {host}:{port} ({error}); is another simulator running? "
                "PX4 in software comes to port 4560, and to one more for each further instance"
            ) from error
        self._server.setblocking(False)
        self.port = int(self._server.getsockname()[1])
        self.where = f"TCP {host}:{self.port}"

    @property
    def connected(self) -> bool:
        """PX4 is there."""
        return self._client is not None

    def open(self) -> bool:
        """Accept PX4 if it is waiting."""
        try:
            client, _ = self._server.accept()
        except BlockingIOError:
            return False
        client.setsockopt(IPPROTO_TCP, TCP_NODELAY, 1)
        client.setblocking(False)
        self._client = client
        return True

    def read(self) -> bytes:
        """What has come."""
        assert self._client is not None
        data = b""
        while True:
            try:
                part = self._client.recv(_CHUNK)
            except BlockingIOError:
                return data
            except OSError as error:
                raise self._lost(str(error)) from error
            if not part:
                if data:
                    return data
                raise self._lost("it has closed the connection")
            data += part

    def write(self, data: bytes) -> None:
        """Send whole messages only: half of one would spoil the next."""
        assert self._client is not None
        try:
            sent = self._client.send(data)
        except BlockingIOError as error:
            raise self._lost("it does not read any more") from error
        except OSError as error:
            raise self._lost(str(error)) from error
        if sent < len(data):
            raise self._lost("it does not read any more")

    def wait(self, seconds: float) -> None:
        """Until something can be read, or time is up."""
        assert self._client is not None
        poll = select.poll()
        poll.register(self._client, select.POLLIN)
        poll.poll(1e3 * seconds)

    def close(self) -> None:
        """Stop listening."""
        self._drop()
        self._server.close()

    def _lost(self, reason: str) -> LostError:
        self._drop()
        return LostError(reason)

    def _drop(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()


class SerialWire:
    """A board on a serial port. It must be there at first; when it goes, it is looked for once a second."""

    lockstep = False

    def __init__(self, path: str, baud: int) -> None:
        self._path, self._baud = path, baud
        self._port: Any = None
        self._due = 0.0
        self.where = f"{path} at {baud} baud"
        try:
            self._port = serial.Serial(path, baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            raise DeviceError(
                f"PX4's simulator: cannot open {self.where} ({error}); is the board plugged in, is the user in the "
                "group dialout, and does no other process use the port?"
            ) from error

    @property
    def connected(self) -> bool:
        """The port is open."""
        return self._port is not None

    def open(self) -> bool:
        """Look for the port again."""
        if self._port is not None:
            return True
        if time.monotonic() < self._due:
            return False
        self._due = time.monotonic() + _REOPEN
        try:
            self._port = serial.Serial(self._path, self._baud, timeout=0, exclusive=True)
        except (OSError, ValueError):
            return False
        return True

    def read(self) -> bytes:
        """What has come."""
        try:
            return bytes(self._port.read(_CHUNK))
        except OSError as error:  # SerialException is one
            raise self._lost(error) from error

    def write(self, data: bytes) -> None:
        """Send what the line takes; the rest is lost, as on a line that is too slow."""
        try:
            os.write(self._port.fileno(), data)  # pyserial's own write would wait
        except BlockingIOError:
            return
        except OSError as error:
            raise self._lost(error) from error

    def wait(self, seconds: float) -> None:
        """Until something can be read, or time is up."""
        select.select([self._port.fileno()], [], [], seconds)

    def close(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _lost(self, error: Exception) -> LostError:
        self.close()
        return LostError(str(error))
