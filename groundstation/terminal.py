"""What a person reads in the terminal after a run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from groundstation import estimators, table
from groundstation.run import Run
from onboard.messages import Severity

_WORDS = {
    "completed": "[bold green]✓ mission completed[/]",
    "safe": "[bold yellow]△ ended safely, mission not completed[/]",
    "unfinished": "[bold yellow]△ the run was broken off[/]",
    "lost": "[bold red]✗ vehicle lost[/]",
}
_MARKS = {True: "[green]✓[/]", False: "[red]✗[/]", None: " "}
_REASONS = 6


def summarize(
    run: Run, metrics: dict[str, Any], report: Path, console: Console, beside: Sequence[dict[str, Any]] = ()
) -> None:
    """Print outcome, Table II beside the run (and others), the figures of the contact, and where the report is."""
    wall = metrics["wall_s"]
    speed = f" in {wall:.1f} s, {metrics['sim_s'] / wall:.0f} times real time" if wall and not run.info.realtime else ""
    console.print(f"{_WORDS[metrics['outcome']]}, {metrics['sim_s']:.1f} s{speed}")
    if metrics["outcome"] != "completed":
        _reasons(run, console)
    side = ruled("RMSE, beside Table II of the paper")
    for heading in ("", "paper", "this run", "in contact", "unit", "verdict"):
        side.add_column(heading, justify="right" if heading in ("paper", "this run", "in contact") else "left")
    for other in beside:
        plant = f"\n{other['plant']}" if other["plant"] not in (None, "rigid") else ""
        side.add_column(f"{other['law']}\nseed {other['seed']}{plant}", justify="right", no_wrap=True)
    columns = [table.rows(other) for other in beside]
    for i, row in enumerate(table.rows(metrics)):
        value, contact, *rest = (
            f"{v:.5f}" if v is not None else ""
            for v in (row.value, row.in_contact, *(rows[i].value for rows in columns))
        )
        verdict = f"{_MARKS[row.better]} {row.verdict}"
        side.add_row(row.label, f"{row.paper:.4f}", value, contact, row.unit, verdict, *rest, end_section=i == 2)
    console.print(side)
    if metrics["estimators"] is not None:
        console.print(side_by_side(metrics["estimators"]))
        console.print(estimators.words(metrics["estimators"]) + "\n", markup=False)
    others = Table(box=None, show_header=False, pad_edge=False)
    for figure in table.figures(metrics, run.config.repair.force):
        others.add_row(figure.label, figure.value, _MARKS[figure.good], figure.detail)
    console.print(others)
    console.print(f"\nreport: {report}", soft_wrap=True, highlight=False)


def ruled(title: str, gap: int = 1) -> Table:
    """An empty table with a rule under its headings; between its columns are a space and ``gap`` more."""
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, gap, 0, 0), title=title, title_justify="left")


def side_by_side(told: dict[str, Any]) -> Table:
    """The table of the force estimators."""
    return labelled("Force estimators, from trigger to release", estimators.HEADINGS, estimators.rows(told))


def labelled(title: str, headings: Iterable[str], rows: Iterable[tuple[str, Sequence[str]]], gap: int = 1) -> Table:
    """A ruled table of a label and figures to a row; the unit in a heading stands under it."""
    side = ruled(title, gap)
    side.add_column("", no_wrap=True)
    for heading in headings:
        side.add_column(heading.replace(", ", ",\n"), justify="right")
    for label, cells in rows:
        side.add_row(label, *cells)
    return side


def _reasons(run: Run, console: Console) -> None:
    """The last warnings and errors, and what the world saw of a crash."""
    loud = [event for event in run.events if event.severity is not Severity.INFO][-_REASONS:]
    for event in loud:
        colour = "red" if event.severity is Severity.ERROR else "yellow"
        time = (event.t_ns - run.start_ns) * 1e-9
        console.print(f"  [{colour}]{time:8.2f} s  {event.code}[/]: {event.text}", soft_wrap=True, highlight=False)
    if run.truth is not None and run.truth.crashed:
        console.print(f"  [red]{run.truth.crashed}[/]", highlight=False)
