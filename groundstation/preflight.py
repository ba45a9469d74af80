"""``pipewright preflight``: the checklist of the vehicle, and what only the station can judge: clocks and contact."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Final

from groundstation import codes, station
from onboard.wire import Check, ShowPreflight

if TYPE_CHECKING:
    from rich.table import Table

    from groundstation.client import Client, Contact

#: Between two looks at the vehicle while it is waited for, s.
_AGAIN: Final = 0.5
#: By how much clocks may differ before what logs and certificates say of time is wrong, s.
CLOCKS: Final = 1.0
#: How old the newest word may be, and how long the way there and back, s.
AGE, ROUND_TRIP = 1.0, 0.5
_EPILOG = """\
A cross says what is wrong and what to do. Exit code 0: all is well; 3: it is not.

examples:
  pipewright preflight                   the list as it is now
  pipewright preflight --wait 60         until all is well, a minute at most
  pipewright preflight --json            {"ok": ..., "checks": [{"name": ..., "ok": ..., "text": ..., "remedy": ...}]}
"""


def add_parser(commands: Any) -> None:
    """Add ``preflight`` to the commands of an argparse parser."""
    words = "show what is well before a flight and what is not, with the remedy"
    preflight = commands.add_parser(
        "preflight",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    preflight.add_argument(
        "--wait", type=_seconds, default=0.0, metavar="SECONDS", help="look again until all is well, at most so long"
    )
    station.add_options(preflight)
    preflight.set_defaults(run=run)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Run ``preflight``; gives the exit code."""
    from rich.console import Console
    from rich.live import Live

    console = Console(highlight=False)
    watched = options.wait > 0.0 and console.is_terminal and not options.json
    end = time.monotonic() + options.wait
    with (
        station.open_client(options) as client,
        Live(console=console, transient=True, auto_refresh=False) if watched else nullcontext() as live,
    ):
        rows = checklist(client, options)
        while not _well(rows) and (left := end - time.monotonic()) > 0.0:
            if live is not None:
                live.update(_table(rows), refresh=True)
            time.sleep(min(_AGAIN, left))
            rows = checklist(client, options)
    if options.json:
        station.tell_data(options, {"ok": _well(rows), "checks": rows}, [])
    else:
        console.print(_table(rows))
        wrong = sum(not row.ok for row in rows)
        console.print(f"{wrong} of {len(rows)} are not well: do not fly" if wrong else "all is well")
    return codes.DONE if _well(rows) else codes.REFUSED


def checklist(client: Client, options: argparse.Namespace) -> tuple[Check, ...]:
    """What the vehicle says of itself, and what this station sees of it.

    Raises RefusedError, NoVehicleError, NoAnswerError.
    """
    told = station.shown(client, ShowPreflight(), tuple[Check, ...], options)
    return (*told, *seen(client.contact()))


def seen(contact: Contact) -> tuple[Check, ...]:
    """What only the station can judge: how the vehicle is heard, and whether its clock tells our time."""
    heard = contact.present and contact.age <= AGE and contact.round_trip <= ROUND_TRIP
    text = f"heard {_seconds_of(contact.age)} ago, {_seconds_of(contact.round_trip)} there and back"
    remedy = "The radio is bad: come nearer, or change the channel." if contact.present else "The vehicle has gone."
    offset = contact.clock_offset
    if math.isfinite(offset):
        told = f"{_seconds_of(abs(offset))} {'ahead of' if offset >= 0.0 else 'behind'} this station's"
    else:
        told = "not compared yet"
    clock = "Set the clocks of both (chrony or timedatectl): logs and certificates go by them."
    in_time = abs(offset) <= CLOCKS
    return (
        Check("contact", heard, text, "" if heard else remedy),
        Check("clock", in_time, told, "" if in_time else clock),
    )


def _well(rows: Sequence[Check]) -> bool:
    return all(row.ok for row in rows)


def _table(rows: Sequence[Check]) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        mark = Text("✓", "green") if row.ok else Text("✗", "bold red")
        table.add_row(mark, Text(row.name, "" if row.ok else "bold red"), Text(row.text))
        if row.remedy:
            table.add_row("", "", Text(f"→ {row.remedy}", "yellow"))
    return table


def _seconds_of(value: float) -> str:
    """A time in words."""
    if not math.isfinite(value):
        return "never" if value > 0.0 else "?"
    return f"{1e3 * value:.1f} ms" if value < 1.0 else f"{value:.1f} s"


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 <= seconds <= 86400.0:
        raise argparse.ArgumentTypeError(f"{text}: must be a time in seconds, up to a day")
    return seconds
