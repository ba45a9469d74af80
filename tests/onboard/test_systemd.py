"""What systemd would receive, on a socket that stands in for it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from onboard.layers import ConfigError
from onboard.systemd import Notifier


class Systemd:
    """The manager's end of the protocol."""

    def __init__(self, name: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + name[1:] if name.startswith("@") else name)
        self._socket.setblocking(False)
        self.environment = {"NOTIFY_SOCKET": name}

    def received(self) -> list[str]:
        messages = []
        while True:
            try:
                messages.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return messages

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Systemd]:
    name = str(tmp_path / "notify") if request.param == "path" else f"@pipewright-test-{os.getpid()}"
    manager = Systemd(name)
    yield manager
    manager.close()


def test_the_life_of_a_service(systemd: Systemd) -> None:
    with Notifier(systemd.environment) as notifier:
        notifier.ready()
        notifier.status("waiting for PX4's\nheartbeat")
        notifier.status("waiting for PX4's\nheartbeat")
        notifier.status("hold")
        before = time.monotonic_ns() // 1000
        notifier.reloading()
        after = time.monotonic_ns() // 1000
        notifier.ready()
        notifier.stopping()
    ready, *status, reloading, again, stopping = systemd.received()
    assert (ready, again, stopping) == ("READY=1", "READY=1", "STOPPING=1")
    assert status == ["STATUS=waiting for PX4's heartbeat", "STATUS=hold"]
    first, _, stamp = reloading.partition("\n")
    assert first == "RELOADING=1"
    assert before <= int(stamp.removeprefix("MONOTONIC_USEC=")) <= after
    assert notifier.trouble() == ""


def test_heartbeats_leave_at_half_the_interval_and_only_with_ticks(systemd: Systemd) -> None:
    systemd.environment |= {"WATCHDOG_USEC": "200000", "WATCHDOG_PID": str(os.getpid())}
    notifier = Notifier(systemd.environment)
    assert notifier.period_ns == 100_000_000
    beats = []
    for t in range(10_000_000_000, 11_000_000_000, 4_000_000):
        notifier.tick(t)
        beats += [t for _ in systemd.received()]
    assert beats == list(range(10_000_000_000, 11_000_000_000, 100_000_000))
    notifier.tick(15_000_000_000)  # after a hang, one at once and no burst
    notifier.tick(15_004_000_000)
    assert systemd.received() == ["WATCHDOG=1"]
    notifier.close()


@pytest.mark.parametrize("extra", [{}, {"WATCHDOG_USEC": "200000", "WATCHDOG_PID": "1"}])
def test_no_heartbeat_where_none_is_asked_of_this_process(systemd: Systemd, extra: dict[str, str]) -> None:
    with Notifier(systemd.environment | extra) as notifier:
        notifier.tick(time.monotonic_ns())
    assert systemd.received() == []


def test_without_systemd_nothing_happens() -> None:
    environment = {"WATCHDOG_USEC": "200000", "HOME": "/"}
    with Notifier(environment) as notifier:
        notifier.ready()
        notifier.status("hold")
        notifier.tick(1)
        assert notifier.trouble() == ""
    assert environment == {"HOME": "/"}


def test_a_child_does_not_speak_for_us(systemd: Systemd, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in systemd.environment.items():
        monkeypatch.setenv(name, value)
    with Notifier():
        look = "import os; print(os.environ.get('NOTIFY_SOCKET'))"
        child = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert child.stdout == "None\n"


def test_a_full_queue_delays_nothing_and_the_heartbeat_is_tried_again(systemd: Systemd) -> None:
    notifier = Notifier(systemd.environment | {"WATCHDOG_USEC": "2000"})
    for t in range(1, 2_000_000_000, 1_000_000):  # far beyond what a socket holds
        notifier.tick(t)
    assert "systemd does not take our messages" in notifier.trouble()
    assert notifier.trouble() == "", "told once"
    assert len(systemd.received()) > 0
    notifier.tick(2_000_000_001)
    assert systemd.received() == ["WATCHDOG=1"]
    notifier.close()


def test_a_manager_that_comes_back_is_heard_again(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    first = Systemd(str(path))
    with Notifier(first.environment | {"WATCHDOG_USEC": "2000"}) as notifier:
        first.close()
        notifier.tick(1)
        assert "Connection refused" in notifier.trouble()
        path.unlink()
        second = Systemd(str(path))
        notifier.tick(2)
        assert second.received() == ["WATCHDOG=1"]
        second.close()


@pytest.mark.parametrize(
    "bad",
    [{"NOTIFY_SOCKET": "vsock:2:1"}, {"WATCHDOG_USEC": "soon"}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_PID": "-3"}],
)
def test_what_cannot_be_understood_is_told(bad: dict[str, str]) -> None:
    ((name, value),) = bad.items()
    with pytest.raises(ConfigError, match=f"{name}={value}: must be"):
        Notifier(dict(bad))
