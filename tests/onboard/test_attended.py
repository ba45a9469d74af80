"""Orders through a pipe, and the end of the process at its other end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from threading import Event

import pytest

from onboard import attended

#: A child that would run for an hour, but ends when its standard input closes; prints its orders.
CHILD = """
import sys, time
from threading import Event
from onboard import attended
over = Event()
attended.watch(lambda line: print("order", line, flush=True), over.set)
print("running", flush=True)
over.wait(3600.0)
print("ended in order", flush=True)
"""
#: Starts such a child, tells its number, and waits to be killed.
PARENT = f"""
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", {CHILD!r}], stdin=subprocess.PIPE, stdout=sys.stdout)
print(child.pid, flush=True)
time.sleep(3600.0)
"""


def orders(*pieces: bytes) -> list[str]:
    """What is heard when these bytes come, and then the end."""
    reading, writing = os.pipe()
    heard: list[str] = []
    over = Event()
    thread = attended.watch(heard.append, over.set, reading)
    for piece in pieces:
        os.write(writing, piece)
    os.close(writing)
    assert over.wait(30.0)
    thread.join(30.0)
    os.close(reading)
    return heard


def test_lines_however_they_are_cut() -> None:
    assert orders(b"start\nho", b"ld\n\n  \nland\r\n") == ["start", "hold", "land"]
    assert orders(b"the last line need not end") == ["the last line need not end"]
    assert orders() == []
    assert orders(b"\xff\xfe\n") == ["\ufffd\ufffd"]


def test_an_order_that_fails_is_told_and_the_next_one_heard(capsys: pytest.CaptureFixture[str]) -> None:
    reading, writing = os.pipe()
    heard: list[str] = []
    over = Event()

    def order(text: str) -> None:
        if text == "bad":
            raise ValueError("no such request")
        heard.append(text)

    thread = attended.watch(order, over.set, reading)
    os.write(writing, b"bad\ngood\n")
    os.close(writing)
    assert over.wait(30.0)
    thread.join(30.0)
    os.close(reading)
    assert heard == ["good"]
    assert "bad: ValueError: no such request" in capsys.readouterr().err


def test_the_process_ends_while_the_thread_still_waits() -> None:
    """Within sys.stdin, the interpreter would abort here."""
    code = "import time; from onboard import attended; attended.watch(print, print); time.sleep(0.2)"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.wait(60.0) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""


def test_a_child_never_outlives_a_parent_that_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        told = [parent.stdout.readline().strip() for _ in range(2)]
        child = int(next(line for line in told if line.isdigit()))
        assert "running" in told
        parent.send_signal(signal.SIGKILL)
        # the child holds the other end of this pipe: reading to its end waits for the child's own end
        assert parent.stdout.read() == "ended in order\n"
    assert child != parent.pid
