"""All figures of one run, and the conditions they were taken in."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

from msgspec import Struct

from tests.bench.compare import Comparison
from tests.bench.core import Core
from tests.bench.desk import Desk
from tests.bench.emergency.measure import Emergency
from tests.bench.flight import Flight
from tests.bench.lateness import Lateness
from tests.bench.servos import ServoCycle
from tests.bench.setpoints import SetPoints
from tests.bench.throughput import Throughput
from tests.bench.worlds import Worlds

#: What a desk core must reach in the median, so that a Jetson Nano holds 250 Hz, us.
TARGET_US = 150


class Report(Struct, frozen=True):
    """One run of the bench. Times in us where not said otherwise."""

    conditions: dict[str, str]
    core: Core
    flight: Flight
    bullet: Flight | None
    """The same mission in PyBullet; None where that is not installed."""
    comparisons: tuple[Comparison, ...]
    servos: tuple[ServoCycle, ...]
    setpoints: SetPoints
    lateness: Lateness
    emergency: Emergency | None
    worlds: Worlds
    throughput: Throughput | None
    desk: Desk | None
    """None when they were left out."""


def conditions(config: str) -> dict[str, str]:
    """Of the machine, before anything is measured."""
    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    return {
        "processor": f"{_processor()}, {os.cpu_count()} cores, {platform.machine()}",
        "load before": f"{load} (1, 5, 15 min)",
        "python": f"{platform.python_version()} on {sys.platform}",
        "flown": config,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return names[0] if names else platform.processor() or "unknown"
