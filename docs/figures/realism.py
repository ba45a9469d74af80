"""Flies the scenario ``realistic`` over ten seeds with each interface and prints the tables of docs/realism.md.

Once as it is, and once with the pipe at the distance that the mission believes. A flight that was made is kept in
build/realism, so an interrupted run goes on where it was. The figures of force are those of ``metrics.json``; contact
is looked for in the ticks of the phase press alone, so that backing off to press again counts for nothing.

Run from the repository's root: python -m docs.figures.realism
"""

from __future__ import annotations

import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from tqdm import tqdm

from groundstation import metrics
from groundstation.run import read_run
from onboard.config import load_config
from onboard.core.types import Phase
from onboard.simulate import simulate

KEPT = Path(__file__).parents[2] / "build" / "realism"
SEEDS = range(10)
INTERFACES = ("attitude", "body_rate")
CASES = {"as it is": (), "pipe at its distance": ("world.deviations.pipe_ahead=0",)}
COLUMNS = ("interface", "seed", "meas_des", "est_meas", "touchdown", "largest", "lost_share", "presses", "outcome")


def figures(log: Path) -> dict[str, Any]:
    """What the table tells of one flight."""
    run = read_run(log)
    found = metrics.compute(run)
    assert run.truth is not None
    pressing = run.where(Phase.PRESS)
    named = [phase["name"] for phase in found["phases"]]
    crash = f": {run.truth.crashed}, in {named[-1]}" if run.truth.crashed else ""
    return {
        "meas_des": found["force_rmse"]["meas_des"],
        "est_meas": found["force_rmse"]["est_meas"],
        "touchdown": found["contact"]["touchdown_peak"],
        "largest": found["contact"]["peak"],
        "lost_share": 100.0 * float(np.mean(run.truth.force[pressing] <= 0.0)) if pressing.any() else None,
        "presses": named.count(Phase.PRESS.value),
        "outcome": f"{found['outcome']}{crash} ({run.t[-1]:.0f} s)",
    }


def flown(interface: str, seed: int, sets: tuple[str, ...], number: int) -> dict[str, Any]:
    """One flight, made or kept."""
    kept = KEPT / f"{number}-{interface}-{seed}.json"
    if not kept.exists():
        with TemporaryDirectory() as folder:
            log = Path(folder) / "log.mcap"
            simulate(load_config("realistic", sets=(f"interface={interface}", *sets), seed=seed), log)
            kept.write_bytes(msgspec.json.encode(figures(log)))
    told: dict[str, Any] = msgspec.json.decode(kept.read_bytes())
    return {"interface": interface, "seed": seed, **told}


def shown(value: Any) -> str:
    """A cell of the table."""
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)


def lines(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """The table of one case, and the medians under it."""
    out = ["", name, "", f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
    out += [f"| {' | '.join(shown(row[column]) for column in COLUMNS)} |" for row in rows]
    for interface in INTERFACES:
        for column in COLUMNS[2:7]:
            values = [row[column] for row in rows if row["interface"] == interface and row[column] is not None]
            if values:
                middle, worst = median(values), max(values)
                out.append(f"{interface}, {column}: median {middle:.2f}, worst {worst:.2f} of {len(values)}")
    return out


def main() -> None:
    """Fly what is not kept yet, and print."""
    KEPT.mkdir(parents=True, exist_ok=True)
    for number, (name, sets) in enumerate(CASES.items()):
        pairs = [(interface, seed) for interface in INTERFACES for seed in SEEDS]
        rows = [flown(interface, seed, sets, number) for interface, seed in tqdm(pairs, desc=name)]
        sys.stdout.write("\n".join(lines(name, rows)) + "\n")


if __name__ == "__main__":
    main()
