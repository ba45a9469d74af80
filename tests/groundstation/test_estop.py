"""The panel in a terminal of its own, on a real link; the button's events come through a pipe."""

from __future__ import annotations

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from threading import Thread
from typing import Any

import pytest

from groundstation import codes
from groundstation.big_text import big
from onboard.core.types import Request
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.wire import Ack, Ask, Mission, Stop
from tests.groundstation import vehicle as commands
from tests.synthetic import mission
from tests.waiting import LONG, pause, seconds_until
from tests.zenoh_sessions import free_port

KILL = Mission(Request.KILL)
_PANEL = """
import argparse, os, sys
from types import SimpleNamespace
from groundstation import button, estop

class Pad:
    name, path = "pad", "/dev/input/event7"
    def fileno(self):
        return 3
    def read(self):
        data = os.read(3, 100)
        if not data:
            raise OSError(19, "No such device")
        return [SimpleNamespace(type=1, code=0x130, value=int(value)) for value in data.decode()]
    def close(self):
        pass

button.open_button = lambda path: button.Button(Pad())
parser = argparse.ArgumentParser()
estop.add_parser(parser.add_subparsers())
options = parser.parse_args(sys.argv[1:])
sys.exit(options.run(options))
"""


class Vehicle:
    """A link that notes what is asked of it, and tells a flying vehicle's ticks."""

    def __init__(self) -> None:
        self.port = free_port()
        self.asked: list[Ask] = []
        self.answer: Callable[[Asked], Ack] = lambda asked: asked.done("Holding.")
        self.link = Link(LinkSettings(listen=(f"tcp/127.0.0.1:{self.port}",), plain=True), self._hear)
        self._over = False
        self._thread = Thread(target=self._fly)

    def __enter__(self) -> Vehicle:
        self.link.start()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over = True
        self._thread.join()
        self.link.stop()

    def _hear(self, asked: Asked) -> Ack:
        self.asked.append(asked.ask)
        return self.answer(asked)

    def _fly(self) -> None:
        ticks = [tick for tick, _ in mission()]
        flying = [tick for tick in ticks if tick.outputs.phase == "approach"][:2]
        while not self._over:
            for tick in flying:
                self.link.tick(tick)
                pause(0.05)


class Panel:
    """The command in a pseudo-terminal of 80x24."""

    def __init__(self, port: int, *arguments: str) -> None:
        self.near, far = pty.openpty()
        termios.tcsetwinsize(far, (24, 80))
        self.before = termios.tcgetattr(far)
        events, self._button = os.pipe()
        given = ["estop", "--connect", f"tcp/127.0.0.1:{port}", "--plain", "--station", "tester", *arguments]

        def own_terminal() -> None:
            os.setsid()
            os.dup2(events, 3)

        self.process: subprocess.Popen[bytes] = subprocess.Popen(
            [sys.executable, "-c", _PANEL, *given],
            stdin=far,
            stdout=far,
            stderr=far,
            preexec_fn=own_terminal,
            close_fds=False,
            env={**os.environ, "TERM": "xterm-256color"},
        )
        os.close(events)
        self.far = far
        self.shown = ""

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for fd in (self.near, self.far, self._button):
            if fd >= 0:
                os.close(fd)

    def reads(self, words: str) -> bool:
        while self.near in select.select([self.near], [], [], 0.0)[0]:
            self.shown += os.read(self.near, 65536).decode(errors="replace")
        return words in self.shown

    def await_words(self, *words: str) -> None:
        for each in words:
            seconds_until(lambda each=each: self.reads(each))  # type: ignore[misc]
        self.shown = ""

    def type(self, keys: str) -> None:
        os.write(self.near, keys.encode())

    def button(self, values: str) -> None:
        os.write(self._button, values.encode())

    def unplug(self) -> None:
        os.close(self._button)
        self._button = -1

    def ended(self) -> int:
        end = time.monotonic() + LONG
        while self.process.poll() is None and time.monotonic() < end:
            self.reads("")
            pause(0.01)
        self.reads("")
        assert self.process.returncode is not None
        return self.process.returncode

    def restored(self) -> bool:
        return termios.tcgetattr(self.far) == self.before


@pytest.fixture
def vehicle() -> Iterator[Vehicle]:
    with Vehicle() as vehicle:
        yield vehicle


@pytest.fixture
def panel(vehicle: Vehicle, request: Any) -> Iterator[Panel]:
    panel = Panel(vehicle.port, *getattr(request, "param", ()))
    yield panel
    panel.close()


def last_row(word: str) -> str:
    return big(word).splitlines()[4].strip()


def test_keys(vehicle: Vehicle, panel: Panel) -> None:
    panel.await_words(last_row("READY"), "APPROACH", "space stops")
    panel.type(" ")
    seconds_until(lambda: vehicle.asked == [Stop()])
    panel.await_words(last_row("STOP"), "Holding.", "press again: land")
    panel.type(" ")
    seconds_until(lambda: vehicle.asked == [Stop(), Stop()])
    panel.type("k")
    panel.await_words("k again cuts the motors")
    panel.type("k")
    seconds_until(lambda: vehicle.asked == [Stop(), Stop(), KILL])
    panel.await_words(last_row("KILL"))
    panel.type("q")
    assert panel.ended() == codes.DONE
    assert panel.reads("kill: Holding.")
    assert panel.reads("The vehicle flies on, and this panel stops it no more.")
    assert vehicle.asked == [Stop(), Stop(), KILL]
    assert panel.restored()


@pytest.mark.parametrize("panel", [("--listen",)], indirect=True)
def test_a_dead_man(vehicle: Vehicle, panel: Panel) -> None:
    panel.await_words(last_row("PRESS"), "hold the button of pad")
    panel.button("0")
    panel.button("1")
    panel.await_words(last_row("HELD"), "letting go is a stop")
    assert vehicle.asked == []
    panel.button("0")
    seconds_until(lambda: vehicle.asked == [Stop()])
    panel.await_words(last_row("STOP"))
    panel.button("1")
    panel.await_words(last_row("HELD"))
    panel.unplug()
    seconds_until(lambda: vehicle.asked == [Stop(), Stop()])
    panel.await_words("pad: unplugged")
    panel.type("q")
    assert panel.ended() == codes.DONE
    assert vehicle.asked == [Stop(), Stop()]


@pytest.mark.parametrize("panel", [("--dead-man", "--device", "/dev/input/event7")], indirect=True)
@pytest.mark.parametrize("way", ["q", signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_closing_it_lets_go(vehicle: Vehicle, panel: Panel, way: str | signal.Signals) -> None:
    panel.await_words(last_row("PRESS"))
    panel.button("1")
    panel.await_words(last_row("HELD"))
    if isinstance(way, str):
        panel.type(way)
    else:
        panel.process.send_signal(way)
    assert panel.ended() == codes.DONE
    assert vehicle.asked == [Stop()]
    assert panel.restored()


@pytest.mark.parametrize("panel", [("--listen", "--push")], indirect=True)
def test_a_button_to_push(vehicle: Vehicle, panel: Panel) -> None:
    panel.await_words(last_row("READY"))
    panel.button("1")
    seconds_until(lambda: vehicle.asked == [Stop()])
    panel.button("0")
    panel.process.send_signal(signal.SIGTERM)
    assert panel.ended() == codes.DONE
    assert vehicle.asked == [Stop()]


def test_a_panel_alone_is_closed_and_asks_nothing(vehicle: Vehicle, panel: Panel) -> None:
    panel.await_words(last_row("READY"))
    panel.process.send_signal(signal.SIGINT)
    assert panel.ended() == codes.DONE
    assert vehicle.asked == []
    assert panel.restored()


def test_no_answer_is_seen(vehicle: Vehicle, panel: Panel) -> None:
    vehicle.answer = lambda asked: asked.accepted()
    panel.await_words(last_row("READY"))
    panel.type(" ")
    panel.await_words(last_row("STOP"), "asked, no answer yet")


def test_a_link_that_is_lost() -> None:
    with Vehicle() as vehicle:
        panel = Panel(vehicle.port)
        panel.await_words(last_row("READY"))
    try:
        panel.await_words(last_row("LOST"), "no link; what is asked")
    finally:
        panel.close()


def test_it_wants_a_terminal(vehicle: Vehicle, capsys: pytest.CaptureFixture[str]) -> None:
    from groundstation import estop

    assert commands.run(estop.add_parser, vehicle.port, "estop") == codes.WRONG_INPUT
    assert "estop wants a terminal; for a program: pipewright stop --json" in capsys.readouterr().err
