"""Draws docs/images/px4-forces.png from the run folder of a mission on a real PX4.

Run from the repository's root: python -m docs.figures.px4 RUN_FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np

from groundstation.figures import around_contact
from groundstation.run import read_run

IMAGE = Path(__file__).parents[1] / "images" / "px4-forces.png"


def main() -> None:
    """Draw force and pitch about the contact."""
    run = read_run(Path(sys.argv[1]) / "log.mcap")
    assert run.truth is not None, "want a run in a simulated world"
    low, high = around_contact(run)
    shown = (run.t >= low) & (run.t <= high)
    t = run.t[shown] - low
    figure, (force, pitch) = plt.subplots(2, 1, sharex=True, figsize=(9.0, 5.0), layout="constrained")
    force.plot(t, run.truth.force[shown], color="#b03a2e", lw=0.8, label="true")
    force.plot(t, run.force_est[shown], color="#1f3b57", lw=0.8, label="estimated")
    force.plot(t, run.force_des[shown], color="#2e7d32", lw=1.2, ls="--", label="desired")
    force.set_ylabel("contact force, N")
    pitch.plot(t, np.degrees(run.truth.rpy[shown, 1]), color="#b03a2e", lw=0.8, label="true")
    pitch.plot(t, np.degrees(run.attitude_ref[shown, 1]), color="#2e7d32", lw=1.0, ls="--", label="followed")
    pitch.set_ylabel("pitch, deg")
    pitch.set_xlabel("time, s")
    for axes in (force, pitch):
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left", frameon=False)
    figure.savefig(IMAGE, dpi=100)


if __name__ == "__main__":
    main()
