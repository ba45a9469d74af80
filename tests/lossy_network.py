"""A wire that loses and delays packets, with the kernel's own TCP at both ends: two network namespaces of Linux.

Each end is a process that is alone in a namespace with an interface ``air`` whose packets come to us, where they are
carried to the other end, or not. No privileges are needed where users may have namespaces (``unshare -rn``).

``python -m tests.lossy_network ADDRESS FD LINEAR COMMAND...`` is what runs at an end; nobody else calls it.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import random
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Any, Self

#: Of the two ends.
ADDRESSES = ("10.77.0.1", "10.77.0.2")
_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_PATIENCE = 20.0


class UnavailableError(Exception):
    """There can be no such network here; the text says why."""


class LossyNetwork:
    """The wire between two ends. Use as a context manager.

    loss: share of the packets that are lost, of each direction; delay: of the others, s, one way. linear: as
    configs/sysctl sets it, TCP does not double its timeout with each loss.
    """

    def __init__(self, loss: float, delay: float, seed: int = 0, *, linear: bool = False) -> None:
        self._linear = linear
        self._loss, self._delay = loss, delay
        self._random = random.Random(seed)
        self._taps: list[int] = []
        self._closing_read, self._closing = os.pipe()
        self._thread = Thread(target=self._carry, name="lossy network", daemon=True)
        self.carried = self.lost = 0
        """Packets so far."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._closing)
        if self._thread.is_alive():
            self._thread.join()
        for fd in (*self._taps, self._closing_read):
            os.close(fd)

    def start(self, command: Sequence[str], **how: Any) -> subprocess.Popen[str]:
        """Run a command at the next end, the first at the first address; from the second one on packets are carried.

        how: for Popen. Raises UnavailableError.
        """
        ours, theirs = socket.socketpair()
        with ours, theirs:
            address = ADDRESSES[len(self._taps)]
            end = [
                sys.executable,
                "-m",
                "tests.lossy_network",
                address,
                str(theirs.fileno()),
                str(int(self._linear)),
                *command,
            ]
            try:
                process = subprocess.Popen(["unshare", "-rn", *end], pass_fds=[theirs.fileno()], text=True, **how)
            except OSError as error:
                raise UnavailableError(f"unshare cannot be run ({error.strerror})") from None
            theirs.close()
            ours.settimeout(_PATIENCE)
            word, fds, _, _ = socket.recv_fds(ours, 1000, 1)
        if not fds:
            process.kill()
            process.communicate()
            raise UnavailableError(word.decode() or "this user may have no network namespace (unshare -rn)")
        self._taps.append(fds[0])
        os.set_blocking(fds[0], False)
        if len(self._taps) == len(ADDRESSES):
            self._thread.start()
        return process

    def _carry(self) -> None:
        first, second = self._taps
        other = {first: second, second: first}
        waiting: list[tuple[float, int, int, bytes]] = []
        number = 0
        while True:
            rest = waiting[0][0] - time.monotonic() if waiting else None
            ready, _, _ = select.select([first, second, self._closing_read], [], [], rest and max(0.0, rest))
            if self._closing_read in ready:
                return
            now = time.monotonic()
            for tap in ready:
                packet = os.read(tap, 65536)
                if self._random.random() < self._loss:
                    self.lost += 1
                    continue
                number += 1
                heapq.heappush(waiting, (now + self._delay, number, other[tap], packet))
            while waiting and waiting[0][0] <= now:
                _, _, tap, packet = heapq.heappop(waiting)
                self.carried += 1
                try:
                    os.write(tap, packet)
                except OSError:  # an interface that is full, or down since its process has ended, loses it
                    self.lost += 1


def _end(address: str, fd: int, linear: str, command: Sequence[str]) -> None:
    """Make the interface of this namespace, hand it over, and become the command."""
    with socket.socket(fileno=fd) as peer:
        try:
            tap = os.open("/dev/net/tun", os.O_RDWR)
            fcntl.ioctl(tap, _TUNSETIFF, struct.pack("16sH22x", b"air", _IFF_TUN | _IFF_NO_PI))
            Path("/proc/sys/net/ipv4/tcp_thin_linear_timeouts").write_text(linear, encoding="ascii")
            for words in ("link set lo up", f"addr add {address}/24 dev air", "link set air up"):
                subprocess.run(["ip", *words.split()], check=True, capture_output=True, text=True)
        except OSError as error:
            peer.send(f"no interface of one's own: {error}".encode())
            raise SystemExit(1) from None
        except subprocess.CalledProcessError as error:
            peer.send(f"ip: {error.stderr}".encode())
            raise SystemExit(1) from None
        socket.send_fds(peer, [b"ready"], [tap])
    os.execvp(command[0], list(command))


if __name__ == "__main__":
    _end(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4:])
