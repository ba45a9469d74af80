"""Gain and delay margin of the contact loop, found in simulation: docs/images/margin.svg and the numbers of control.md.

The loop is broken where all of its feedback passes: at the set-point that leaves for the autopilot. While 2.5 N are
held in the scenario ``realistic`` (the wind apart, which would only blur it), the set-point's departure from what it
was at the beginning is multiplied by a gain, or the whole of it comes later. Each trial goes on from a copy of the same
moment for eight seconds; what the force swings in the last four tells whether the loop holds.

Run from the repository's root: python -m docs.figures.margin
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from msgspec.structs import replace

mpl.use("Agg")
from matplotlib import pyplot as plt

from drivers.samples import AutopilotCommand, Interface
from onboard.config import load_config
from onboard.core.math3 import euler_from_quat, quat_from_euler
from onboard.core.types import Phase, Request
from tests.stories.flight import PERIOD, Flight

SETS = ("world.wind.mean=0", "world.wind.gusts=0", "plan.arc_max=0.2", "repair.hold=30")
INTERFACES = ("attitude", "body_rate")
GAINS = (0.25, 0.5, 0.7, 1.0, 1.4, 2.0, 2.3, 2.6, 3.0, 4.0)
DELAYS = (0, 3, 6, 9, 12, 15, 18, 21)
#: Ticks.
TRIAL, JUDGED = 2000, 1000
#: A force that swings more (standard deviation, N), or a contact that breaks, is no hold.
HELD = 0.3
SEED = 0
Change = Callable[[AutopilotCommand], AutopilotCommand]


def holding(interface: str) -> Flight:
    """Three seconds into the hold."""
    flight = Flight(load_config("realistic", sets=(*SETS, f"interface={interface}"), seed=SEED)).run(2.0)
    flight.tick(Request.START)
    return flight.until(lambda o: o.phase is Phase.PRESS and o.reference.force > 2.49, 150.0).run(3.0)


def amplified(gain: float) -> Change:
    """The lean of the set-point departs ``gain`` times as far from that of the first."""
    first: list[tuple[float, float, float]] = []

    def change(command: AutopilotCommand) -> AutopilotCommand:
        if command.interface is Interface.BODY_RATE:
            x, y, z = command.w_WB_B
            return replace(command, w_WB_B=(gain * x, gain * y, z))
        angles = euler_from_quat(command.q_WB)
        if not first:
            first.append(angles)
        roll, pitch = (was + gain * (now - was) for was, now in zip(first[0][:2], angles[:2], strict=True))
        return replace(command, q_WB=quat_from_euler((roll, pitch, angles[2])))

    return change


def late(ticks: int) -> Change:
    """The set-point comes so many ticks later."""
    under_way: deque[AutopilotCommand] = deque()

    def change(command: AutopilotCommand) -> AutopilotCommand:
        under_way.append(command)
        return under_way.popleft() if len(under_way) > ticks else under_way[0]

    return change


def swing(flight: Flight, change: Change) -> float:
    """Standard deviation of the contact force at the end of a trial, N; infinite when the contact does not hold."""
    trial, force = flight.copy(), []
    trial.autopilot.twist = change
    for _ in range(TRIAL):
        outputs = trial.tick()
        force.append(trial.truth.contact_force)
        if trial.truth.crashed or outputs.phase is not Phase.PRESS:
            return np.inf
    judged = np.array(force[-JUDGED:])
    return float(np.inf if (judged <= 0.0).any() else judged.std())


def main() -> None:
    """Fly the trials, print the table, draw the picture."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.2), sharey=True, layout="constrained")
    for interface in INTERFACES:
        flight = holding(interface)
        gains = [swing(flight, amplified(gain)) for gain in GAINS]
        delays = [swing(flight, late(ticks)) for ticks in DELAYS]
        held = [gain for gain, force in zip(GAINS, gains, strict=True) if force < HELD]
        latest = [1e3 * PERIOD * ticks for ticks, force in zip(DELAYS, delays, strict=True) if force < HELD]
        sys.stdout.write(f"{interface}: gains {dict(zip(GAINS, np.round(gains, 3), strict=True))}\n")
        sys.stdout.write(f"{interface}: delays {dict(zip(DELAYS, np.round(delays, 3), strict=True))} ticks\n")
        sys.stdout.write(f"{interface}: holds with gains {min(held)} to {max(held)}, {max(latest):.0f} ms later\n")
        left.semilogx(GAINS, np.clip(gains, 0.0, 1.0), "o-", label=interface)
        right.plot([1e3 * PERIOD * ticks for ticks in DELAYS], np.clip(delays, 0.0, 1.0), "o-", label=interface)
    for axes, label in ((left, "gain on the set-point"), (right, "further delay of the set-point, ms")):
        axes.axhline(HELD, color="0.6", linewidth=0.8)
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
    left.set_ylabel("swing of the force, N\n(1: contact lost)")
    left.set_xticks([0.25, 0.5, 1, 2, 4], labels=["0.25", "0.5", "1", "2", "4"])
    left.minorticks_off()
    left.legend(frameon=False)
    figure.savefig(Path(__file__).parents[1] / "images" / "margin.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
