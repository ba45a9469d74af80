"""``pipewright watch`` as a process in a terminal of its own, and where there is none."""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from threading import Event, Thread

import pytest
from msgspec.structs import replace

from groundstation import codes, watch
from onboard.core.types import Phase
from onboard.link import Link
from onboard.link_settings import LinkSettings
from tests.groundstation.watching import first
from tests.waiting import LONG, seconds_until
from tests.zenoh_sessions import free_port

_PROGRAM = """
import argparse, sys
from groundstation import watch
parser = argparse.ArgumentParser()
watch.add_parser(parser.add_subparsers())
options = parser.parse_args(sys.argv[1:])
sys.exit(options.run(options))
"""


def parsed(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    watch.add_parser(parser.add_subparsers())
    return parser.parse_args(["watch", *arguments])


@pytest.mark.parametrize("arguments", [[], ["--json"]])
def test_it_wants_a_terminal(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    options = parsed(*arguments)
    assert options.run(options) == codes.WRONG_INPUT
    assert "watch wants a terminal; for a program: pipewright status --json" in capsys.readouterr().err


class Terminal:
    """A terminal with a program in it."""

    def __init__(self, command: list[str], columns: int, rows: int, **environment: str) -> None:
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.before = termios.tcgetattr(theirs)
        self._theirs = theirs
        self.process = subprocess.Popen(
            command,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**os.environ, **environment},
            start_new_session=True,
        )
        self.seen = ""

    def sees(self, pattern: str) -> None:
        """Read until it is there, in what came since the last that was waited for."""
        end = time.monotonic() + LONG
        while not (match := re.search(pattern, self.seen, re.DOTALL)):
            assert time.monotonic() < end, f"not seen: {pattern}; seen: {self.seen[-2000:]!r}"
            if select.select([self._ours], [], [], 0.1)[0]:
                self.seen += os.read(self._ours, 65536).decode(errors="replace")
        self.seen = self.seen[match.end() :]

    def types(self, keys: str) -> None:
        os.write(self._ours, keys.encode())

    def restored(self) -> bool:
        """The modes of the terminal are as before."""
        return termios.tcgetattr(self._theirs)[:4] == self.before[:4]

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._ours)
        os.close(self._theirs)


@pytest.fixture
def link() -> Iterator[Link]:
    """A vehicle on the ground, whose loop ticks."""
    link = Link(
        LinkSettings(vehicle="falcon", listen=(f"tcp/127.0.0.1:{free_port()}",), plain=True),
        lambda asked: asked.done("Holding."),
    )
    link.start()
    tick, ended = first(Phase.PREFLIGHT), Event()

    def run() -> None:
        index = 0
        while not ended.wait(0.02):
            index += 5
            link.tick(replace(tick, index=index, inputs=replace(tick.inputs, t_ns=time.monotonic_ns())))

    loop = Thread(target=run, daemon=True)
    loop.start()
    yield link
    ended.set()
    loop.join()
    link.stop()


@pytest.mark.parametrize(
    "environment",
    [{"TERM": "xterm-256color", "COLORTERM": "truecolor"}, {"TERM": "xterm", "COLORTERM": "", "NO_COLOR": "1"}],
    ids=["many colours", "none"],
)
def test_a_person_at_a_terminal(link: Link, environment: dict[str, str]) -> None:
    command = [sys.executable, "-c", _PROGRAM, "watch", "--plain", "--vehicle", "falcon", "--station", "alice"]
    terminal = Terminal([*command, "--connect", link._settings.listen[0], "--lease"], 80, 24, **environment)
    try:
        terminal.sees("PREFLIGHT")
        terminal.sees("live")
        seconds_until(lambda: link.state().commander == "alice")
        terminal.sees("you ")
        terminal.types("s")
        terminal.sees("stop done")
        terminal.types("q")
        terminal.sees(r"\x1b\[\?1049l.*alice commands no more\.")
        assert terminal.process.wait(LONG) == codes.DONE
        assert terminal.restored()
        assert link.state().commander == ""
    finally:
        terminal.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=["SIGTERM", "SIGHUP"])
def test_ended_from_outside_it_leaves_in_order(link: Link, number: signal.Signals) -> None:
    command = [sys.executable, "-c", _PROGRAM, "watch", "--plain", "--vehicle", "falcon", "--station", "alice"]
    terminal = Terminal([*command, "--connect", link._settings.listen[0], "--lease"], 80, 24, TERM="xterm-256color")
    try:
        terminal.sees("live")
        seconds_until(lambda: link.state().commander == "alice")
        terminal.sees("you ")
        terminal.process.send_signal(number)
        terminal.sees(r"\x1b\[\?1049l.*alice commands no more\.")
        assert terminal.process.wait(LONG) == codes.DONE
        assert terminal.restored()
    finally:
        terminal.close()
