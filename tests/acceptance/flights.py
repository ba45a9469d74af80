"""Whole missions to measure, flown in process; and the installed command, as a person would call it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import termios
from pathlib import Path
from typing import Any, NamedTuple

from groundstation import metrics
from groundstation.run import Run, read_run
from onboard.config import load_config
from onboard.simulate import simulate

COMMAND = Path(sys.executable).with_name("pipewright")

#: What is asked of the tuned law in the scenario of the paper, N.
FORCE_ROWS = {"est_des": 0.05, "meas_des": 0.05, "est_meas": 0.025}
#: A shorter mission, for tests that look at the press: quick motion of arm and needle, a short arc, a short hold.
SHORT = (
    "plan.near_speed=0.3",
    "plan.yaw_rate=1",
    "plan.arm_speed=0.25",
    "plan.needle_speed=0.1",
    "plan.arc_max=0.6",
    "plan.descent_speed=0.3",
    "repair.hold=2",
)


class Flown(NamedTuple):
    """One mission: its log, and what was read from it."""

    log: Path
    run: Run
    metrics: dict[str, Any]

    @property
    def codes(self) -> list[str]:
        """Codes of all events, in order."""
        return [event.code for event in self.run.events]


class Hangar:
    """Flies missions into a folder, each one once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._flown: dict[tuple[object, ...], Flown] = {}

    def __call__(
        self, *sets: str, law: str | None = None, scenario: str = "paper", seed: int = 0, again: int = 0
    ) -> Flown:
        """The mission with these settings; another ``again`` flies the same once more."""
        key = (sets, law, scenario, seed, again)
        if key not in self._flown:
            log = self._folder / f"{len(self._flown)}.mcap"
            simulate(load_config(scenario, law, sets, seed), log)
            self._flown[key] = look(log)
        return self._flown[key]


def look(log: Path) -> Flown:
    """Read a finished run."""
    run = read_run(log)
    return Flown(log, run, metrics.compute(run))


def completed(flown: Flown) -> bool:
    """The mission was completed; says why, when it was not."""
    assert flown.metrics["outcome"] == "completed", [event.text for event in flown.run.events]
    return True


def within(rows: dict[str, float], bounds: dict[str, float], factor: float = 1.0) -> bool:
    """Every bounded row is at or below its bound; names those that are not."""
    above = {name: (rows[name], factor * bound) for name, bound in bounds.items() if not rows[name] <= factor * bound}
    assert not above, f"(figure, bound): {above}"
    return True


def contact_kept(flown: Flown) -> bool:
    """From the first touch to the release the sleeve never left the pipe."""
    contact = flown.metrics["contact"]
    assert (contact["bounces"], contact["time_without_contact"]) == (0, 0.0)
    assert "press_again" not in flown.codes
    return True


def in_limits(flown: Flown) -> bool:
    """No rotor and no joint gave more than it can, from start to end."""
    truth = flown.run.truth
    assert truth is not None
    assert truth.thrust.max() <= 13.0
    assert abs(truth.torque).max() <= 0.93
    return True


# --- the command --------------------------------------------------------------------------------------------------


def pipewright(*arguments: str | Path, cwd: Path, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Run the installed command to its end."""
    assert COMMAND.is_file(), f"{COMMAND} is missing: install the project first (make test does)"
    command = [str(COMMAND), *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False)


class Watched:
    """The command with a terminal of its own, so that its progress line tells where the mission is."""

    def __init__(self, *arguments: str | Path, cwd: Path) -> None:
        self._terminal, line = os.openpty()
        termios.tcsetwinsize(line, (24, 100))
        self.process = subprocess.Popen(
            [str(COMMAND), *map(str, arguments)], cwd=cwd, stdout=subprocess.PIPE, stderr=line, text=True
        )
        os.close(line)
        self.shown = ""

    def until(self, word: str) -> None:
        """Read the terminal until it shows the word."""
        while not re.search(rf"\b{word}\b", self.shown):
            assert self._read(), f"the run ended before it showed {word!r}: {self.shown[-500:]}"

    def end(self) -> tuple[int, str]:
        """Wait for the end; gives the exit code and what was printed."""
        while self._read():
            pass
        printed, _ = self.process.communicate(timeout=60.0)
        os.close(self._terminal)
        return self.process.returncode, printed

    @property
    def flight(self) -> int:
        """The id of the flight process that the command has started."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        assert len(children) == 1, children
        return int(children[0])

    def _read(self) -> bool:
        try:
            some = os.read(self._terminal, 65536)
        except OSError:  # the last writer has closed it
            return False
        self.shown += some.decode(errors="replace")
        return bool(some)
