"""What systemd is told (sd_notify, systemd's service protocol): readiness, status, and the heartbeat of its watchdog.

The heartbeat leaves only from a tick, so that a loop that hangs is restarted by systemd, whatever else of the process
still lives. Without systemd nothing is sent. No call waits: systemd's queue may be full, and a tick cannot wait for it.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import MutableMapping
from types import TracebackType
from typing import Self

from onboard.layers import ConfigError


class Notifier:
    """Speaks to the service manager that started this process, if one did.

    Takes NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID out of ``environment``, so that no child speaks for us. Raises
    ConfigError when they cannot be understood.
    """

    def __init__(self, environment: MutableMapping[str, str] = os.environ) -> None:
        path = environment.pop("NOTIFY_SOCKET", "")
        interval = environment.pop("WATCHDOG_USEC", "")
        watched = environment.pop("WATCHDOG_PID", "")
        if path and path[0] not in "/@":
            raise ConfigError([f"NOTIFY_SOCKET={path}: must be an absolute path, or @ and a name"])
        for name, value in (("WATCHDOG_USEC", interval), ("WATCHDOG_PID", watched)):
            if value and not (value.isascii() and value.isdigit() and int(value) > 0):
                raise ConfigError([f"{name}={value}: must be a whole number above 0"])
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) if path else None
        if self._socket is not None:
            self._socket.setblocking(False)
        ours = bool(path and interval) and (not watched or int(watched) == os.getpid())
        self.period_ns = int(interval) * 1000 // 2 if ours else 0
        """Between two heartbeats: half of what systemd allows, ns; 0: no watchdog."""
        self._due_ns = 0
        self._status = ""
        self._trouble = ""
        self._told = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Say nothing any more; safe to call twice."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ready(self) -> None:
        """Everything is connected and the first ticks are made; also ends ``reloading``."""
        self._send("READY=1")

    def reloading(self) -> None:
        """The configuration is being read again; ``ready`` ends it, whatever came of it."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """The orderly end has begun."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """A line for ``systemctl status``; sent when it differs from the last."""
        if text != self._status and self._send(f"STATUS={' '.join(text.split())}"):
            self._status = text

    def tick(self, t_ns: int) -> None:
        """A tick was made at ``t_ns``: send the heartbeat if it is due. One that cannot leave is tried again."""
        if self.period_ns and t_ns >= self._due_ns and self._send("WATCHDOG=1"):
            self._due_ns = t_ns + self.period_ns

    def trouble(self) -> str:
        """Why nothing reaches systemd, once, and an empty text else."""
        if self._told or not self._trouble:
            return ""
        self._told = True
        return self._trouble

    def _send(self, message: str) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError as error:
            self._trouble = f"systemd does not take our messages ({error.strerror}): it may take us for hung"
            return False
        return True
