"""A short flight of ``pipewright desk``: what each part of the flight process takes of a core, and how late it is."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from msgspec import Struct

from groundstation import metrics
from groundstation.run import read_run

_COMMAND = "import sys; from groundstation.cli import main; sys.exit(main())"
_LONGEST = 180.0


class Desk(Struct, frozen=True):
    """Figures of the flight process, with all devices emulated in another process."""

    flown_s: float
    cpu: dict[str, float]
    """Share of one core by part, median of the whole seconds; empty where the flight process does not report it."""
    late_median: float
    late_p99: float
    """Lateness of the ticks, us."""
    setpoint_age: float | None
    """Age of the attitude that a set-point answers when it leaves, median, us."""
    missed: float
    """Share of the ticks owed."""


class FlightError(Exception):
    """The flight could not be had; the text says why."""


def measure(duration: float = 5.0) -> Desk:
    """Take off, land after ``duration`` s. Raises FlightError."""
    with TemporaryDirectory() as folder:
        arguments = ["desk", "--duration", f"{duration:g}", "--out", folder, "--no-progress"]
        command = [sys.executable, "-c", _COMMAND, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST, check=False)
        log = Path(folder) / "log.mcap"
        if not log.exists():
            raise FlightError(f"pipewright desk flew nothing (code {done.returncode}): {done.stderr.strip()[-400:]}")
        timing = metrics.compute(read_run(log, partial=True))["timing"]
    if timing["late"] is None or timing["missed"] is None:
        raise FlightError(f"pipewright desk flew too short (code {done.returncode}): {done.stderr.strip()[-400:]}")
    return Desk(
        flown_s=sum(timing["lateness"]["counts"]) * timing["missed"]["period"],
        cpu={part: told["median"] for part, told in timing["cpu"].items() if told is not None},
        late_median=1e6 * timing["late"]["median"],
        late_p99=1e6 * timing["late"]["p99"],
        setpoint_age=1e6 * timing["setpoint_age"]["median"] if timing["setpoint_age"] is not None else None,
        missed=timing["missed"]["share"],
    )
