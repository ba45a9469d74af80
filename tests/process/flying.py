"""A flight of two processes, as on the desk, watched and disturbed from outside."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Condition
from types import TracebackType
from typing import NamedTuple

from groundstation.desk import Desk, end, start
from onboard.core.types import Phase
from sim_backend.world_client import WorldClient
from sim_backend.world_messages import Look
from tests.brisk import BRISK
from tests.realtime import alone

#: Whatever is waited for comes well before this, s: the machine may be busy.
PATIENCE = 60.0
#: Of which one gets into the air.
TAKEOFFS = 3
#: A takeoff that was refused is asked for again after this time, s.
_AGAIN = 3.0
#: Settings of the flight; it presses for long.
SETS = (*BRISK, "repair.hold=20")

#: The flight process, but for one thing: on SIGUSR1 the thread of the loop spins for ever.
_STICKY = """
import signal, sys
def spin(number, frame):
    while True:
        pass
signal.signal(signal.SIGUSR1, spin)
from onboard.main import main
sys.exit(main(sys.argv[1:]))
"""


class Line(NamedTuple):
    """What the flight process has said on standard error, and when it was heard, ns on the monotonic clock."""

    t_ns: int
    text: str


class Flying:
    """World and flight process of one configuration. Use as a context manager."""

    def __init__(self, folder: Path, *sets: str, config: str = "desk", arguments: Sequence[str] = ()) -> None:
        """``arguments`` are for the flight process alone."""
        self.folder = folder
        self._arguments = arguments
        self._common = [f"--config={config}", *(f"--set={item}" for item in (*SETS, *sets))]
        self.looks: list[Look] = []
        self.lines: list[Line] = []
        self._ended = False
        #: Notified by every look and every line.
        self._news = Condition()

    def __enter__(self) -> Flying:
        self._desk = Desk(self._common)
        self.endpoints = self._desk.start_world()
        self.client = WorldClient(self.endpoints["devices.world"], on_look=self._see)
        self.client.start(PATIENCE)
        sets = [f"--set={path}={value}" for path, value in self.endpoints.items()]
        out = ["--out", str(self.folder), "--no-progress"]
        arguments = ["fly", *self._common, *sets, "--attended", *self._arguments, *out]
        self.flight = start(arguments, stderr=subprocess.PIPE, program=("-c", _STICKY))
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self.flight.poll() is None:
            os.kill(self.flight.pid, signal.SIGCONT)
        end(self.flight)
        self._listener.join(PATIENCE)
        if self.flight.stderr is not None:
            self.flight.stderr.close()
        self.client.stop()
        self._desk.__exit__(None, None, None)
        if error is not None:
            error.add_note("the flight process said:\n" + "\n".join(line.text for line in self.lines))

    def _listen(self) -> None:
        assert self.flight.stderr is not None
        for text in self.flight.stderr:
            with self._news:
                self.lines.append(Line(time.monotonic_ns(), text.rstrip()))
                self._news.notify_all()
        with self._news:
            self._ended = True
            self._news.notify_all()

    def _see(self, look: Look) -> None:
        with self._news:
            self.looks.append(look)
            self._news.notify_all()

    # -- what may be done -----------------------------------------------------------------------------------------

    def ask(self, request: str) -> None:
        """A request for the mission."""
        assert self.flight.stdin is not None
        self.flight.stdin.write(f"{request}\n")
        self.flight.stdin.flush()

    def inject(self, **fault: object) -> None:
        """A fault of an emulated device, that begins now."""
        self._desk.order(json.dumps(fault))

    def signal(self, number: int) -> None:
        """A signal for the flight process."""
        self.flight.send_signal(number)

    # -- what may be seen -----------------------------------------------------------------------------------------

    def look(self) -> Look:
        """How the world looks now."""
        return self.looks[-1]

    def silent_since(self, message: str, silence: float = 0.3) -> Look:
        """The look at which the last message of this name had come, once none has come for ``silence`` s."""
        last = self.look()

        def is_silent(look: Look) -> bool:
            nonlocal last
            if look.received.get(message, 0) != last.received.get(message, 0):
                last = look
            return look.t_ns - last.t_ns >= silence * 1e9

        self.wait(f"no more {message}", is_silent)
        return last

    def said(self, words: str, since: int = 0) -> list[str]:
        """What the flight process has said with these words in it, since that time (ns, monotonic)."""
        return [line.text for line in self.lines if line.t_ns >= since and words in line.text]

    def wait(
        self, what: str, happens: Callable[[Look], bool], patience: float = PATIENCE, since: Look | None = None
    ) -> Look:
        """The first look at which something is so, from now or ``since`` on; fails with ``what`` when none comes."""
        seen = len(self.looks) - 1
        while since is not None and self.looks[seen].t_ns > since.t_ns:
            seen -= 1

        def found() -> Look | None:
            nonlocal seen
            while seen < len(self.looks):
                if happens(self.looks[seen]):
                    return self.looks[seen]
                seen += 1
            return None

        with self._news:
            look = self._news.wait_for(found, patience)
        if look is None:
            last = self.look()
            raise AssertionError(
                f"not within {patience:g} s: {what}; the vehicle is at {last.truth.p_WB}, phase {last.phase}, "
                f"mode {last.mode}, {'armed' if last.armed else 'disarmed'}"
            )
        return look

    def wait_said(self, words: str, patience: float = PATIENCE, since: int = 0) -> str:
        """The first sentence of the flight process with these words in it, since that time (ns, monotonic)."""
        with self._news:
            self._news.wait_for(lambda: self._ended or self.said(words, since), patience)
            said = self.said(words, since)
        if not said:
            raise AssertionError(f"not said {f'within {patience:g} s' if not self._ended else 'to its end'}: {words}")
        return said[0]

    def rest(self, seconds: float) -> Look:
        """Let the world go on for so long."""
        until = self.look().t_ns + round(seconds * 1e9)
        return self.wait(f"the next {seconds:g} s", lambda look: look.t_ns >= until)

    def take_off(self) -> Look:
        """Up to the hover."""
        self.wait_said("ready")
        self.ask("takeoff")
        return self.wait("hover", lambda look: look.truth.p_WB[2] > 0.75)

    def hover(self) -> Look:
        """Up to the hover, whatever its height, from the first preflight or after a ``reset``; the takeoff is over.

        One that a busy machine has broken off on the ground is tried again.
        """
        self.wait_said("ready")
        for _ in range(TAKEOFFS):
            taking_off = self._taking_off()
            ended = self.wait("hover", lambda look: look.phase in (Phase.HOLD, Phase.STOPPED), since=taking_off)
            if ended.phase == Phase.HOLD:
                return ended
            self.reset()
        raise AssertionError(f"{TAKEOFFS} takeoffs were broken off")

    def _taking_off(self) -> Look:
        """Ask until it does: preflight that has passed may not pass at that moment, on a machine that is busy."""
        until = time.monotonic() + PATIENCE
        while True:
            self.ask("takeoff")
            try:
                return self.wait("takeoff", lambda look: look.phase == Phase.TAKEOFF, _AGAIN)
            except AssertionError:
                if time.monotonic() > until:
                    raise

    def land(self) -> Look:
        """Down by request."""
        self.ask("land")
        return self.stopped()

    def stopped(self, patience: float = PATIENCE) -> Look:
        """On the ground, motors off, nothing broken, and the mission knows it."""
        self.ended_safely(patience)
        return self.wait("stopped", lambda look: look.phase == Phase.STOPPED, patience)

    def reset(self) -> None:
        """Back to preflight, and ready for the next flight."""
        now = time.monotonic_ns()
        self.ask("reset")
        self.wait_said("ready", since=now)

    def press(self) -> Look:
        """The whole way to a steady press."""
        self.wait_said("ready")
        self.ask("start")
        return self.wait("press", lambda look: look.truth.contact_force > 1.2, 3 * PATIENCE)

    def ended_safely(self, patience: float = PATIENCE) -> Look:
        """On the ground, motors off, nothing broken."""
        look = self.wait("on the ground, disarmed", lambda look: look.truth.on_ground and not look.armed, patience)
        assert look.truth.crashed == ""
        return look


@contextmanager
def flying(folder: Path, *sets: str, config: str = "desk", arguments: Sequence[str] = ()) -> Iterator[Flying]:
    """A flight with a folder for its log, the only one of this machine."""
    with alone(), Flying(folder, *sets, config=config, arguments=arguments) as flight:
        yield flight
