"""``python -m tests.bench``: fly a mission, measure, print one table, write the same as JSON."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from onboard.config import load_config
from onboard.layers import ConfigError
from tests.bench import compare, core, desk, flight, lateness, servos, setpoints, throughput, worlds
from tests.bench.emergency import measure
from tests.bench.report import Report, conditions
from tests.bench.table import table


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0, 1 when the flight in real time failed, or 2 for a wrong input."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    parser.add_argument("--json", type=Path, default=Path("build/bench.json"), help="where to write the figures")
    parser.add_argument("--scenario", default="paper", metavar="NAME|FILE", help="what is flown")
    parser.add_argument("--law", help="parameter set of the controllers")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="set a parameter")
    parser.add_argument("--longest", type=float, metavar="S", help="break the mission off after S simulated seconds")
    parser.add_argument("--cycles", type=int, default=1000, metavar="N", help="of each of the rows in real time")
    parser.add_argument("--trials", type=int, default=1000, metavar="N", help="of the emergency stop; 0 leaves it out")
    parser.add_argument("--runs", type=int, default=12, metavar="N", help="of the campaign; 0 leaves it out")
    parser.add_argument("--no-desk", action="store_true", help="leave out the flight in real time")
    given = parser.parse_args(arguments)
    if not 40 <= given.cycles <= 100_000:
        parser.error(f"--cycles {given.cycles}: from 40 to 100000")
    if given.trials and not 10 <= given.trials <= 100_000:
        parser.error(f"--trials {given.trials}: 0, or from 10 to 100000")
    if not 0 <= given.runs <= 1000:
        parser.error(f"--runs {given.runs}: from 0 to 1000")
    if given.longest is not None and not 1.0 <= given.longest <= 900.0:
        parser.error(f"--longest {given.longest:g}: from 1 to 900 s")
    try:
        config = load_config(given.scenario, given.law, given.set)
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.open("ab").close()
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    except OSError as error:
        print(f"--json {given.json}: cannot be written ({error.strerror})", file=sys.stderr)
        return 2
    before = conditions(f"scenario {config.scenario}, law {config.law}, interface {config.interface.value}")
    flown, ticks = flight.fly(config, given.longest)
    stepped = core.measure(ticks, config)
    before["interrupted"] = f"{stepped.interruptions} times while the core was measured"
    try:
        flown_in_real_time = None if given.no_desk else desk.measure()
    except desk.FlightError as error:
        print(error, file=sys.stderr)
        return 1
    report = Report(
        before,
        stepped,
        flown,
        flight.fly_in_pybullet(config, given.longest),
        compare.compare(config.fuzzy, config.vehicle),
        servos.rows(given.cycles // 2),
        setpoints.measure(given.cycles),
        lateness.measure(ticks[: given.cycles], config),
        measure.measure(given.trials) if given.trials else None,
        worlds.measure(config),
        throughput.measure(given.runs) if given.runs else None,
        flown_in_real_time,
    )
    given.json.write_bytes(msgspec.json.format(msgspec.json.encode(report)) + b"\n")
    print(table(report))
    print(f"\nThe same as JSON: {given.json}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
