"""``pipewright campaign``: one mission many times, over seeds, parameters and faults, on as many cores as there are."""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from argparse import RawDescriptionHelpFormatter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from groundstation.codes import BROKEN, DONE, INTERRUPTED, LOST, NOT_THERE, REFUSED, WRONG_INPUT

if TYPE_CHECKING:
    from groundstation.campaign_file import Plan
    from groundstation.campaign_store import Store
    from groundstation.campaign_summary import Summary

_EPILOG: Final = """\
examples:
  pipewright campaign realistic --workers 2                    a shipped campaign (configs/campaigns)
  pipewright campaign my.yaml --out runs/mine
  pipewright campaign my.yaml --out runs/mine --resume         go on after whatever ended it
  pipewright campaign robustness --scheduler tcp://10.0.0.7:8786
"""


def add_parser(commands: argparse._SubParsersAction[Any]) -> None:
    """The command on the command line."""
    words = "fly one mission many times: seeds, parameters, faults; a report of all"
    command = commands.add_parser(
        "campaign",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=RawDescriptionHelpFormatter,
    )
    command.add_argument("file", metavar="NAME|FILE", help="a shipped campaign, or a file (docs/campaigns.md)")
    add_pool_options(command)
    command.add_argument("--resume", action="store_true", help="go on with what is in the folder")
    command.add_argument("--out", type=Path, metavar="DIR", help="folder (default: a new one in runs/)")
    command.add_argument("--no-progress", action="store_true", help="no progress bar")
    command.set_defaults(run=run)


def add_pool_options(command: argparse.ArgumentParser) -> None:
    """Where the runs are flown."""
    where = command.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="processes of this machine (default: one per core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="a Dask cluster elsewhere: tcp://HOST:PORT")


def run(options: argparse.Namespace) -> int:
    """Fly what is missing, then report all of it; gives the exit code."""
    from groundstation.campaign_file import read_campaign
    from groundstation.campaign_pool import PoolError
    from groundstation.campaign_run import ENDS, NAMES
    from groundstation.campaign_store import Store, StoreError
    from onboard.headless import ConfigError

    try:
        workers = pool_size(options)
        plan = read_campaign(options.file, NAMES, tuple(ENDS))
        store = Store(_folder(options, plan.name), plan)
        with store.opened(resume=options.resume):
            interrupted = _fly(plan, store, workers, options)
            summary = _report(plan, store)
    except (ConfigError, StoreError) as error:
        print(error, file=sys.stderr)
        return WRONG_INPUT
    except PoolError as error:
        print(error, file=sys.stderr)
        return NOT_THERE
    if interrupted:
        words = f"{summary.runs} of {summary.planned} runs are in {store.folder}; the same command with --resume"
        print(f"pipewright: interrupted: {words} goes on (with --out {store.folder})", file=sys.stderr)
        return INTERRUPTED
    return _code(summary)


def pool_size(options: argparse.Namespace) -> int:
    """How many processes are asked for. Raises ConfigError."""
    from onboard.headless import ConfigError

    workers = options.workers if options.workers is not None else len(os.sched_getaffinity(0))
    if not 1 <= workers <= 1024:
        raise ConfigError([f"--workers {workers}: must be from 1 to 1024"])
    return int(workers)


def _folder(options: argparse.Namespace, name: str) -> Path:
    if options.out is not None:
        return Path(options.out)
    names = (re.fullmatch(rf"campaign-{re.escape(name)}-(\d+)", path.name) for path in Path("runs").glob("*"))
    last = max((int(match[1]) for match in names if match), default=0)
    return Path("runs") / f"campaign-{name}-{max(1, last + (not options.resume)):03d}"


def _fly(plan: Plan, store: Store, workers: int, options: argparse.Namespace) -> bool:
    """Fly the runs that are not there yet; gives whether it was interrupted."""
    from groundstation.campaign_pool import pool
    from groundstation.campaign_run import failed, flown

    done = store.done()
    missing = (job for job in plan.jobs() if job.run not in done)
    if len(done) >= len(plan):
        return False
    try:
        with _progress(plan, len(done), options) as tell, pool(workers, options.scheduler) as flying:
            for row in flying.each(flown, missing, failed):
                store.put(row)
                tell(row)
    except KeyboardInterrupt:
        return True
    return False


@contextmanager
def _progress(plan: Plan, done: int, options: argparse.Namespace) -> Iterator[Any]:
    """A bar over the runs, with what has become of them, how fast it goes and when it will be done."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    shown = not options.no_progress and sys.stderr.isatty()
    columns = [
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[words]}"),
    ]  # fmt: skip
    begun, simulated, wrong = time.monotonic(), 0.0, 0
    with Progress(*columns, console=Console(stderr=True), disable=not shown, transient=True) as bar:
        task = bar.add_task(plan.name, total=len(plan), completed=done, words="")

        def tell(row: dict[str, Any]) -> None:
            nonlocal simulated, wrong
            simulated += row["sim_s"] or 0.0
            wrong += not row["ok"]
            speed = simulated / max(1e-9, time.monotonic() - begun)
            bar.update(task, advance=1, words=f"{wrong} not as they may; {speed:.0f} x real time")

        yield tell


def _report(plan: Plan, store: Store) -> Summary:
    from rich.console import Console

    from groundstation import campaign_figures, campaign_report, campaign_summary

    if len(store.done()) >= len(plan):
        store.compact()
    table = store.table()
    summary = campaign_summary.summarize(plan, table)
    campaign_summary.write(summary, store.folder / "summary.json")
    campaign_report.write(summary, table, store.folder / "report.html")
    campaign_figures.distributions(summary, table, store.folder / "distributions.png")
    if summary.cells:
        campaign_figures.matrix(summary, store.folder / "matrix.png")
    _say(summary, store.folder, Console(highlight=False))
    return summary


def _say(summary: Summary, folder: Path, console: Any) -> None:
    success, lost = summary.success, summary.lost
    ends = ", ".join(f"{count} {end}" for end, count in summary.ends.items())
    console.print(f"{summary.name}: {summary.runs} of {summary.planned} runs: {ends}")
    console.print(
        f"completed {100 * success.share:.1f} % ({100 * success.low:.1f} to {100 * success.high:.1f} %), "
        f"lost {100 * lost.share:.1f} % (up to {100 * lost.high:.1f} %); {summary.speed:.1f} x real time per core",
        soft_wrap=True,
    )
    if summary.estimators:
        console.print(side_by_side(summary))
    if summary.watched_s:
        console.print(
            f"False contacts: {summary.false_contacts}, in {summary.watched_s:.0f} s with the trigger watched "
            "and nothing touching",
            soft_wrap=True,
        )
    for verdict in summary.verdicts:
        mark = "[green]✓[/]" if verdict.met else "[red]✗[/]"
        value = "not known" if verdict.value is None else f"{verdict.value:.3f}"
        limit = verdict.limit
        console.print(f"{mark} {limit.metric}, quantile {limit.quantile:g}: {value}, asked {limit.high:g}")
    for cell in summary.cells:
        if not cell.ok:
            console.print(f"[red]✗[/] {cell.fault} at {cell.moment}: {', '.join(cell.ends)}", soft_wrap=True)
            console.print(f"    {cell.command}", soft_wrap=True, markup=False)
    console.print(f"\nreport: {folder / 'report.html'}", soft_wrap=True)


def side_by_side(summary: Summary) -> Any:
    """The table of the force estimators; it fits a terminal of 80 columns."""
    from groundstation import campaign_report
    from groundstation.terminal import labelled

    return labelled("Force estimators, medians", *campaign_report.side_by_side(summary), gap=0)


def _code(summary: Summary) -> int:
    if summary.ends.get("error"):
        return BROKEN
    if summary.lost.count and not summary.cells:
        return LOST
    return DONE if summary.good or (summary.cells and all(cell.ok for cell in summary.cells)) else REFUSED
