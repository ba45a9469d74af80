"""``pipewright estimators RUN``: the force estimators over a recorded log again, and their table."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

from groundstation.codes import BROKEN, DONE, WRONG_INPUT

_EPILOG = """\
The table is that of the report, made anew from the log: every estimator sees the inputs of the flight, whichever of
them was in its loop. Costs are those of this machine. All but costs wants the truth of a simulated world.

examples:
  pipewright estimators runs/desk-007
  pipewright estimators runs/desk-007 --ukf                             the literature's baseline as well (slow)
  pipewright estimators runs/desk-007 --set estimators.kalman.joint_noise=1 --set estimators.thrust.lag=0.04
"""


def add_parser(commands: Any) -> None:
    """Add ``estimators`` to the commands of an argparse parser."""
    words = "run the force estimators over a log again, with other parameters, and print their table"
    parser = commands.add_parser(
        "estimators",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", type=Path, metavar="RUN", help="log.mcap of a run, or its run folder")
    parser.add_argument("--ukf", action="store_true", help="also an unscented Kalman filter, in the contact only")
    parser.add_argument(
        "--set", action="append", default=[], dest="sets", metavar="KEY=VALUE", help="a parameter of the estimators"
    )
    parser.add_argument("--partial", action="store_true", help="accept a log that was cut off")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Recompute and print; gives the exit code."""
    # Imported here so that --help and wrong input answer at once.
    import msgspec
    import numpy as np
    from rich.console import Console

    from groundstation import estimators, metrics, terminal
    from groundstation.run import FELT, read_run
    from onboard.messages import LogError

    class Told(msgspec.Struct):
        forces: dict[str, list[float | None]]
        triggered: list[bool]
        alarm: list[bool]
        selected: str
        costs: dict[str, float]

    log = options.log / "log.mcap" if options.log.is_dir() else options.log
    command = [
        sys.executable,
        "-P",
        "-m",
        "onboard",
        "estimators",
        str(log),
        *(f"--set={item}" for item in options.sets),
    ]
    command += ["--ukf"] if options.ukf else []
    command += ["--partial"] if options.partial else []
    child = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    if child.returncode != DONE:
        return WRONG_INPUT if child.returncode == WRONG_INPUT else BROKEN
    told = msgspec.json.decode(child.stdout, type=Told)
    try:
        flight = read_run(log, partial=options.partial)
    except LogError as error:
        print(f"pipewright: {error}", file=sys.stderr)
        return WRONG_INPUT
    forces = {name: np.array(values, dtype=np.float64) for name, values in told.forces.items()}
    forces[FELT] = forces.pop(FELT)  # the witness is shown last
    again = flight.with_estimates(
        forces, np.array(told.triggered, dtype=np.bool_), np.array(told.alarm, dtype=np.bool_), told.selected
    )
    table = estimators.compute(again, metrics.windows(again).contact, told.costs)
    assert table is not None
    console = Console(highlight=False)
    console.print(terminal.side_by_side(table))
    console.print(estimators.words(table), markup=False)
    return DONE
