"""``pipewright events``: what the vehicle tells, as sentences a person acts on."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Collection
from datetime import datetime
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

from groundstation import codes, station
from onboard.wire import ShowEvents, Told

if TYPE_CHECKING:
    from groundstation.client import Client, Contact

_WAIT: Final = 0.1
_EPILOG = """\
examples:
  pipewright events                    the last ones
  pipewright events --follow           and those that come, until Ctrl-C
  pipewright events --follow --json    an object on each line: time, t_ns, number, severity, code, text
"""


def add_parser(commands: Any) -> None:
    """Add ``events`` to the commands of an argparse parser."""
    words = "show what the vehicle has told: time, severity, code, sentence"
    events = commands.add_parser(
        "events",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    events.add_argument("--follow", action="store_true", help="go on until Ctrl-C")
    station.add_options(events)
    events.set_defaults(run=run)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Run ``events``; gives the exit code."""
    printer = Printer(options)
    with station.open_client(options, on_told=printer.hear) as client:
        printer.history(client)
        while options.follow:
            printer.print_new(client.contact(), _WAIT)
    return codes.DONE


class Printer:
    """Prints events as they come, in the thread that asks for it, each once."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._heard: SimpleQueue[Told] = SimpleQueue()
        self._newest = 0
        self._codes: set[str] = set()

    def hear(self, told: Told) -> None:
        """Take an event, on any thread."""
        self._heard.put(told)

    def history(self, client: Client) -> None:
        """Print what the vehicle remembers."""
        for told in station.shown(client, ShowEvents(), tuple[Told, ...], self._options):
            self._print(told, client.contact())

    def print_new(self, contact: Contact, timeout: float = 0.0) -> bool:
        """Print what has come; without anything, wait for it. Whether anything was printed."""
        printed = False
        try:
            while True:
                self._print(self._heard.get(timeout=0.0 if printed else timeout), contact)
                printed = True
        except Empty:
            return printed

    def await_one(self, client: Client, codes_wanted: Collection[str], timeout: float) -> bool:
        """Print what comes until one of these codes was among all that was printed; whether it was."""
        end = time.monotonic() + timeout
        while not self._codes.intersection(codes_wanted) and time.monotonic() < end:
            self.print_new(client.contact(), _WAIT)
        return bool(self._codes.intersection(codes_wanted))

    def _print(self, told: Told, contact: Contact) -> None:
        if told.number <= self._newest:
            return
        self._newest = told.number
        self._codes.add(told.event.code)
        station.tell_data(self._options, as_data(told, contact), [as_line(told, contact)])


def as_line(told: Told, contact: Contact) -> str:
    """One event for a person, at the local time of this machine."""
    event, when = told.event, _time(told, contact)
    clock = f"{when.astimezone():%H:%M:%S.%f}"[:-3] if when is not None else "--:--:--.---"
    # a device begins its sentences with its name, for those who see no code
    return f"{clock}  {event.severity.upper():7}  {event.code}: {event.text.removeprefix(f'{event.code}: ')}"


def as_data(told: Told, contact: Contact) -> dict[str, Any]:
    """One event for a program; ``time`` is UTC, by the clock of this machine."""
    event, when = told.event, _time(told, contact)
    return {
        "time": when.isoformat(timespec="milliseconds") if when is not None else None,
        "t_ns": event.t_ns,
        "number": told.number,
        "severity": event.severity.value,
        "code": event.code,
        "text": event.text,
    }


def _time(told: Told, contact: Contact) -> datetime | None:
    """When it was told; None while that is known by the vehicle's clock alone."""
    return None if math.isnan(contact.clock_offset) else contact.when(told.event.t_ns)
