"""A process that hangs or dies: no goal leaves any more, and the servos' watchdog stops them."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event

import pytest

from drivers.dynamixel_settings import DynamixelSettings
from sim_backend.dynamixel_emulator import DynamixelEmulator, emulate

PROCESS = """
import asyncio, signal, sys
from drivers.dynamixel import Dynamixel
from drivers.dynamixel_settings import DynamixelSettings
from drivers.samples import JointMode, ServoCommand

stuck = False

def hang(*_):
    global stuck
    stuck = True

signal.signal(signal.SIGUSR1, hang)

async def main():
    driver = Dynamixel(DynamixelSettings(sys.argv[1], reply_margin=0.02, silent_after=0.3))
    await driver.start()
    k = 0
    while True:
        while stuck:
            pass
        k += 1
        driver.command(ServoCommand(JointMode.TORQUE, (0.02, 0.02, 0.02), (0.0, 0.0, 0.0, 0.1, 0.001 * (k % 100)), 1.0))
        await asyncio.sleep(0.004)

asyncio.run(main())
"""


@pytest.fixture
def emulator() -> Iterator[DynamixelEmulator]:
    made = emulate(DynamixelSettings("").servos)
    made.start()
    yield made
    made.stop()


def until(condition: Callable[[], bool], within: float = 60.0) -> None:
    pause = Event()
    for _ in range(round(within / 0.005)):
        if condition():
            return
        pause.wait(0.005)
    pytest.fail(f"not within {within} s")


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGUSR1, signal.SIGKILL], ids=["stopped", "stuck", "killed"])
def test_the_servos_stop_when_the_process_does(emulator: DynamixelEmulator, how: signal.Signals) -> None:
    servos = emulator.bus.servos
    here = Path(__file__).parents[2]
    with subprocess.Popen([sys.executable, "-c", PROCESS, emulator.path], cwd=here) as process:
        try:
            until(lambda: emulator.bus.goals > 100 and all(servo.torque_on for servo in servos))
            process.send_signal(how)
            until(lambda: all(servo.tripped or not servo.torque_on for servo in servos))
            goals = emulator.bus.goals
            # The joints had torque, which no goal takes back: the watchdog or the driver's own thread must have.
            until(lambda: all(servo.drive().goal == 0.0 or servo.drive().mode is None for servo in servos[:3]))
            until(lambda: all(abs(velocity) < 0.01 for velocity in emulator.bus._mechanics.velocity))  # type: ignore[attr-defined]
            assert emulator.bus.goals == goals
        finally:
            process.kill()
