"""The life of the service as systemd hears it: a stand-in for its socket, the real flight process on the desk."""

from __future__ import annotations

import itertools
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, Queue
from threading import Thread

import pytest

from tests.process.flying import PATIENCE, Flying, flying
from tests.realtime import REALTIME

pytestmark = REALTIME

#: What systemd allows between two heartbeats, s.
WATCHDOG = 2.0


class Manager:
    """systemd's end of the notify socket: every message, and when it came (s, monotonic)."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._news: Queue[tuple[float, str]] = Queue()
        self.heard: list[tuple[float, str]] = []
        self._thread = Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while message := self._socket.recv(4096):
            self._news.put((time.monotonic(), message.decode()))

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b"", self._socket.getsockname())
        self._thread.join()
        self._socket.close()

    def hear(self, words: str, patience: float = PATIENCE) -> float:
        """Wait for the next message that begins with these words; gives when it came."""
        until = time.monotonic() + patience
        try:
            while True:
                news = self._news.get(timeout=max(0.0, until - time.monotonic()))
                self.heard.append(news)
                if news[1].startswith(words):
                    return news[0]
        except Empty:
            raise AssertionError(f"not within {patience:g} s: {words}; heard: {self.heard}") from None

    def last(self, words: str, silence: float) -> float:
        """When the last of these messages came, once none has come for ``silence`` s."""
        at = next(at for at, message in reversed(self.heard) if message.startswith(words))
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            try:
                at = self.hear(words, silence)
            except AssertionError:
                return at
        raise AssertionError(f"still coming: {words}")

    def order(self) -> list[str]:
        """The kinds of messages in the order in which they came, but for heartbeat and status."""
        kinds = (message.partition("=")[0] for _, message in self.heard)
        return [kind for kind in kinds if kind not in ("WATCHDOG", "STATUS")]


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    path = tmp_path / "notify"
    manager = Manager(path)
    monkeypatch.setenv("NOTIFY_SOCKET", str(path))
    monkeypatch.setenv("WATCHDOG_USEC", str(round(WATCHDOG * 1e6)))
    monkeypatch.setenv("PYTHONFAULTHANDLER", "1")  # as in the unit
    yield manager
    manager.close()


def beats(manager: Manager, count: int) -> list[float]:
    return [manager.hear("WATCHDOG=1") for _ in range(count)]


def test_it_is_ready_lives_reloads_and_stops(tmp_path: Path, manager: Manager) -> None:
    with flying(tmp_path / "run") as flight:
        manager.hear("STATUS=connecting")
        manager.hear("READY=1")
        manager.hear("STATUS=preflight")
        times = beats(manager, 4)
        gaps = [b - a for a, b in itertools.pairwise(times)]
        assert max(gaps) < WATCHDOG
        assert sum(gaps) / len(gaps) > 0.4 * WATCHDOG, "no more often than it must"
        flight.signal(signal.SIGHUP)
        manager.hear("RELOADING=1\nMONOTONIC_USEC=")
        manager.hear("READY=1")
        flight.wait_said("nothing differs")
        beats(manager, 2)
        flight.signal(signal.SIGTERM)
        manager.hear("STOPPING=1")
        assert flight.flight.wait(PATIENCE) == 0
    assert manager.order() == ["READY", "RELOADING", "READY", "STOPPING"]


@pytest.mark.parametrize("way", [signal.SIGUSR1, signal.SIGSTOP], ids=["stuck in a loop", "stopped"])
def test_a_loop_that_hangs_is_noticed_and_ended(tmp_path: Path, manager: Manager, way: int) -> None:
    with flying(tmp_path / "run") as flight:
        manager.hear("READY=1")
        beats(manager, 2)
        hung = time.monotonic()
        flight.signal(way)
        last = manager.last("WATCHDOG=1", WATCHDOG)
        assert last < hung + 0.5 * WATCHDOG, "a heartbeat from a process that does not tick"
        aborted_as_by_systemd(flight)
        if way == signal.SIGUSR1:
            assert flight.said("in spin"), "the journal must tell where it hung"
    assert manager.order() == ["READY"]


def aborted_as_by_systemd(flight: Flying) -> None:
    """SIGABRT, and SIGCONT so that a stopped process gets it."""
    flight.signal(signal.SIGABRT)
    flight.signal(signal.SIGCONT)
    assert flight.flight.wait(PATIENCE) == -signal.SIGABRT
