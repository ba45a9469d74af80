"""Flies the repair at many places and draws docs/images/anywhere.svg, with the numbers in docs/anywhere.csv.

Heading, radius, force, height, distance and bearing of the pipe are a Latin hypercube over their whole ranges; the rest
is the scenario of the paper.

Run from the repository's root: python -m docs.figures.anywhere
"""

from __future__ import annotations

import csv
from math import cos, radians, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("svg")

import matplotlib.pyplot as plt
import numpy as np

from tests.acceptance.flights import FORCE_ROWS, Flown, Hangar

ROOT = Path(__file__).parents[2]
COUNT, SEED = 60, 1
#: What is varied, and its range.
RANGES = {
    "heading_deg": (-180.0, 180.0),
    "radius_m": (0.04, 0.12),
    "force_N": (1.0, 3.5),
    "height_m": (1.0, 3.0),
    "distance_m": (2.0, 5.0),
    "bearing_deg": (-180.0, 180.0),
}
SHOWN = ("heading_deg", "radius_m", "force_N", "height_m")
COLOURS = {"est_des": "#1f3b57", "meas_des": "#b03a2e", "est_meas": "#2e7d32"}
LABELS = {"est_des": "estimated, desired", "meas_des": "measured, desired", "est_meas": "estimated, measured"}


class Case(NamedTuple):
    """One place, and how the repair went there."""

    place: dict[str, float]
    figures: dict[str, Any]


def places() -> list[dict[str, float]]:
    """A Latin hypercube: each range in COUNT equal parts, one place in each part of each range."""
    random = np.random.default_rng(SEED)
    columns = []
    for low, high in RANGES.values():
        shares = (random.permutation(COUNT) + random.random(COUNT)) / COUNT
        columns.append((low + (high - low) * shares).round(4))
    return [dict(zip(RANGES, map(float, row), strict=True)) for row in zip(*columns, strict=True)]


def settings(place: dict[str, float]) -> list[str]:
    """The options that put the pipe there."""
    bearing = radians(place["bearing_deg"])
    x, y = place["distance_m"] * cos(bearing), place["distance_m"] * sin(bearing)
    return [
        f"pipe.position=[{x:.4f},{y:.4f},{place['height_m']}]",
        f"pipe.heading_deg={place['heading_deg']}",
        f"pipe.radius={place['radius_m']}",
        f"repair.force={place['force_N']}",
    ]


def figures(flown: Flown) -> dict[str, Any]:
    """What is told of one flight."""
    metrics = flown.metrics
    contact, limits = metrics["contact"], metrics["limits"]
    return {
        "outcome": metrics["outcome"],
        **metrics["force_rmse"],
        **{row: contact[row] for row in ("hold_mean", "touchdown_peak", "peak", "bounces", "tip_slip")},
        **{row: limits[row] for row in ("thrust_max", "torque_max")},
    }


def write(cases: list[Case], path: Path) -> None:
    """One row per case."""
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*RANGES, *cases[0].figures])
        for case in cases:
            told = [f"{value:.6g}" if isinstance(value, float) else value for value in case.figures.values()]
            writer.writerow([*case.place.values(), *told])


def draw(cases: list[Case], path: Path) -> None:
    """The three force rows over heading, radius, force and height, with twice what is asked at the paper's place."""
    plt.rcParams.update(
        {"font.size": 9, "svg.hashsalt": "anywhere", "axes.spines.top": False, "axes.spines.right": False}
    )
    figure, axes = plt.subplots(1, len(SHOWN), figsize=(10.0, 3.0), sharey=True, layout="constrained")
    for axis, name in zip(axes, SHOWN, strict=True):
        for row, colour in COLOURS.items():
            values = [case.figures[row] for case in cases]
            axis.plot([case.place[name] for case in cases], values, "o", ms=3, color=colour, label=LABELS[row])
            axis.axhline(2.0 * FORCE_ROWS[row], color=colour, lw=0.8, ls="--")
        quantity, unit = name.rsplit("_", 1)
        axis.set_xlabel(f"{quantity}, {unit}")
    axes[0].set_ylabel("force RMSE, N")
    axes[0].set_ylim(0.0, None)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Fly all cases, write and draw them, and tell the worst."""
    cases = []
    for place in places():
        with TemporaryDirectory() as folder:
            cases.append(Case(place, figures(Hangar(Path(folder))(*settings(place)))))
        print(len(cases), place, cases[-1].figures)  # noqa: T201
    write(cases, ROOT / "docs" / "anywhere.csv")
    draw(cases, ROOT / "docs" / "images" / "anywhere.svg")


if __name__ == "__main__":
    main()
