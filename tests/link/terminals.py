"""People at terminals: the desk in one, the commands of stations in others, all as processes of their own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Condition, Thread
from types import TracebackType
from typing import Any, NamedTuple, Self

from tests.acceptance.flights import COMMAND
from tests.process.flying import PATIENCE, SETS
from tests.realtime import alone
from tests.zenoh_sessions import free_port

#: For a command to find the vehicle and be answered, on a busy machine, s.
TIMEOUT = 20.0
#: What is refused while the machine is busy is asked so often.
_TIMES = 10


class Said(NamedTuple):
    """What a command has said."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """What was for a program to read: all of it, or the last line."""
        try:
            return json.loads(self.out)
        except json.JSONDecodeError:
            return json.loads(self.out.splitlines()[-1])


class Running:
    """A command that is left running. Use as a context manager; leaving it kills what still runs."""

    def __init__(self, *arguments: str, cwd: Path) -> None:
        self.arguments = arguments
        self.out: list[str] = []
        self.err: list[str] = []
        self._news = Condition()
        self.process = subprocess.Popen(
            [str(COMMAND), *arguments], cwd=cwd, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0,
        )  # fmt: skip
        pipes = ((self.process.stdout, self.out), (self.process.stderr, self.err))
        self._listeners = [Thread(target=self._listen, args=pipe, daemon=True) for pipe in pipes]
        for listener in self._listeners:
            listener.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.end()
        if error is not None:
            words = "\n".join((*self.out[-10:], *self.err[-60:]))
            error.add_note(f"pipewright {' '.join(self.arguments)[:60]} said:\n{words}")

    def _listen(self, pipe: Any, lines: list[str]) -> None:
        for line in pipe:
            with self._news:
                lines.append(line.rstrip())
                self._news.notify_all()
        pipe.close()

    def wait(self, what: str, found: Callable[[], bool], patience: float = PATIENCE) -> None:
        """Until it has said something; fails when it has not in time, or has ended."""
        until = time.monotonic() + patience
        with self._news:
            while not found():
                left = until - time.monotonic()
                assert left > 0.0, f"not within {patience:g} s: {what}"
                listening = any(listener.is_alive() for listener in self._listeners)
                assert listening or self.process.poll() is None, f"ended before: {what}"
                self._news.wait(min(left, 0.2))

    def says(self, words: str, since: int = 0, patience: float = PATIENCE) -> None:
        """Until it says this, after so many lines, on standard error."""
        self.wait(words, lambda: any(words in line for line in self.err[since:]), patience)

    def end(self, number: int | None = None) -> Said:
        """Send it a signal, wait for its end, and give what it has said."""
        if number is not None:
            self.process.send_signal(number)
        code = self.process.wait(2 * PATIENCE)
        for listener in self._listeners:
            listener.join(PATIENCE)
        return Said(code, "\n".join(self.out), "\n".join(self.err))


class Terminal:
    """Commands of one station."""

    def __init__(self, folder: Path, *options: str, timeout: float = TIMEOUT) -> None:
        """``options`` go to every command: who asks, and where."""
        self._folder, self._options = folder, (*options, f"--timeout={timeout:g}", "--json")

    def __call__(self, *arguments: str, code: int = 0) -> Said:
        """Run a command to its end, which must be this."""
        said = self.run(*arguments)
        assert said.code == code, f"{arguments}: code {said.code}\n{said.out}\n{said.err}"
        return said

    def insist(self, *arguments: str) -> Said:
        """The same until it is done: preflight that has passed may not pass at that moment, on a busy machine."""
        for _ in range(_TIMES):
            said = self.run(*arguments)
            if said.code == 0:
                return said
        raise AssertionError(f"{arguments}: code {said.code}\n{said.out}\n{said.err}")

    def run(self, *arguments: str) -> Said:
        """Run a command to its end."""
        done = subprocess.run(
            [str(COMMAND), *arguments, *self._options], cwd=self._folder, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=3 * PATIENCE, check=False,
        )  # fmt: skip
        return Said(done.returncode, done.stdout, done.stderr)

    def begin(self, *arguments: str) -> Running:
        """Leave a command running."""
        return Running(*arguments, *self._options, cwd=self._folder)


class Keeper:
    """``lease take`` of a station, left running: it tells the phases as they come."""

    def __init__(self, terminal: Terminal, *options: str) -> None:
        self.running = terminal.begin("lease", "take", *options)

    def __enter__(self) -> Self:
        self.running.wait("the lease", lambda: bool(self.running.out))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.running.__exit__(kind, error, at)

    def _told(self) -> Iterator[dict[str, Any]]:
        for line in self.running.out.copy():
            yield json.loads(line)

    def phases(self) -> list[str]:
        """As they came."""
        return [told["phase"] for told in self._told() if told.get("phase")]

    def codes(self) -> list[str]:
        """Of the events, as they came."""
        return [told["code"] for told in self._told() if told.get("code")]

    def until(self, phase: str, since: int = 0, patience: float = 2 * PATIENCE) -> int:
        """Until a phase has come, after the first ``since`` ones; gives how many there were up to it."""
        self.running.wait(phase, lambda: phase in self.phases()[since:], patience)
        return since + self.phases()[since:].index(phase) + 1


class Desk:
    """``pipewright desk --no-autostart``, waiting for stations."""

    def __init__(self, folder: Path, sets: Sequence[str], running: Running, endpoint: str) -> None:
        self.folder, self.running, self.endpoint = folder, running, endpoint
        self.sets = sets
        self.log = folder / "runs" / "flight" / "log.mcap"

    def terminal(self, *options: str, timeout: float = TIMEOUT) -> Terminal:
        """Another person."""
        return Terminal(self.folder, f"--connect={self.endpoint}", *options, timeout=timeout)


@contextmanager
def desk(folder: Path, *sets: str, config: str = "desk", tls: bool = False) -> Iterator[Desk]:
    """A desk that waits on the ground, the only one of this machine; at the end it is interrupted."""
    endpoint = f"{'tls' if tls else 'tcp'}/127.0.0.1:{free_port()}"
    given = (*SETS, *sets, f"link.listen=[{endpoint}]", f"link.plain={str(not tls).lower()}")
    arguments = ["desk", "--no-autostart", f"--config={config}", "--out=runs/flight", "--no-progress"]
    with alone(), Running(*arguments, *(f"--set={item}" for item in given), cwd=folder) as running:
        found = Desk(folder, given, running, endpoint)
        running.says("ready to fly", patience=3 * PATIENCE)
        try:
            yield found
        finally:
            if running.process.poll() is None:
                _interrupt(running)


def _interrupt(running: Running) -> None:
    running.process.send_signal(signal.SIGINT)
    try:
        running.process.wait(2 * PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(running.process.pid, signal.SIGKILL)
        raise
