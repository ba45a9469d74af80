"""``pipewright lease``: who commands. ``take`` stays, as the one the vehicle hears while a person commands it."""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from groundstation import codes, station, status
from groundstation.events import Printer
from groundstation.follow import GROUND, since_now
from onboard.wire import ReleaseLease, TakeLease

if TYPE_CHECKING:
    from groundstation.client import Client

_EPILOG = """\
examples:
  pipewright lease take             leave it running; give orders from other terminals
  pipewright lease take --seize     from whoever commands now
  pipewright lease release

A vehicle wants its commander to be there all the time. `lease take` is: it keeps the link, and shows how the vehicle
is. `pipewright watch --lease` does so on a whole screen. All commands of the same station name then act under it.
"""
_LOOK: Final = 0.1
#: A second Ctrl-C within this time leaves a flying vehicle, s.
_SURE: Final = 5.0
_ALONE: Final = (
    "Without its commander {0} holds after a short time, and later retreats and lands; nothing resumes by itself. "
    "`pipewright lease take` by the same station keeps it again."
)
#: A vehicle that is not heard for so long is told as that, s.
_GONE: Final = 1.0


def add_parser(commands: Any) -> None:
    """Add ``lease`` to the commands of an argparse parser."""
    raw = argparse.RawDescriptionHelpFormatter
    words = "take the command of the vehicle and keep it, or give it back"
    lease = commands.add_parser(
        "lease", help=words, description=words.capitalize() + ".", epilog=_EPILOG, formatter_class=raw
    )
    actions = lease.add_subparsers(required=True, dest="action", metavar="ACTION")
    words = "take command, and stay there as long as you command"
    take = actions.add_parser("take", help=words, description=words.capitalize() + ".")
    take.add_argument("--seize", action="store_true", help="even from a station that commands now")
    words = "command no more; a flying vehicle is not left: land it, or let another station seize it"
    release = actions.add_parser("release", help=words, description=words.capitalize() + ".")
    for parser in (take, release):
        parser.formatter_class, parser.epilog = raw, station.examples_of(parser.prog, _EPILOG)
        station.add_options(parser)
        parser.set_defaults(run=run)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Run ``lease``; gives the exit code."""
    if options.action == "release":
        with station.open_client(options) as client:
            station.tell(options, station.ask(client, ReleaseLease(), options).text)
        return codes.DONE
    printer = Printer(options)
    with station.open_client(options, on_told=printer.hear) as client, _interrupts() as interrupts:
        station.tell(options, _take(client, options), vehicle=client.vehicle, station=client.station)
        since_now(client, options.timeout)  # from here on, what is heard is of after the lease
        if not options.json:
            print(
                f"Leave this running, and give orders from other terminals. Ctrl-C releases {client.vehicle} on the "
                "ground.",
                flush=True,
            )
        return _Keeper(client, options, printer, interrupts).keep()


def _take(client: Client, options: argparse.Namespace) -> str:
    try:
        return station.ask(client, TakeLease(options.seize), options).text
    except station.RefusedError as error:
        hint = "" if options.seize else " `pipewright lease take --seize` takes it all the same."
        raise station.RefusedError(f"{error}{hint}") from None


class _Keeper:
    """Stays on the link, and shows how the vehicle is, until it is interrupted or commands no more."""

    def __init__(self, client: Client, options: argparse.Namespace, printer: Printer, interrupts: list[int]) -> None:
        self._client, self._options, self._printer, self._interrupts = client, options, printer, interrupts
        self._live = sys.stdout.isatty() and not options.json
        self._shown: tuple[object, ...] = ()
        self._warned = 0.0

    def keep(self) -> int:
        """Gives the exit code."""
        try:
            while True:
                self._clear()
                self._printer.print_new(self._client.contact())
                now = status.status_of(self._client)
                if not now.commanding:
                    return self._lost(now)
                if self._interrupts and (code := self._interrupted(self._interrupts.pop(0))) is not None:
                    return code
                self._show(now)
                self._client.wait(lambda _: bool(self._interrupts), _LOOK)
        finally:
            self._clear()

    def _lost(self, now: status.Status) -> int:
        """Commanding no more: by release it is as wanted, else it is not."""
        if not now.commander and now.phase in (None, *GROUND):
            station.tell(self._options, f"{now.station} commands {now.vehicle} no more; this ends here.")
            return codes.DONE
        who = f"{now.commander} has taken command" if now.commander else "nobody commands: it may have begun anew"
        raise station.RefusedError(f"{now.vehicle}: {who}. {now.station} commands no more.")

    def _interrupted(self, number: int) -> int | None:
        """Give the vehicle back, if it can be; None: stay, a person has to decide."""
        if number != signal.SIGINT:
            self._say(self._left())
            return codes.INTERRUPTED
        if time.monotonic() < self._warned:
            self._say(f"Leaving {self._client.vehicle} without a commander.")
            return codes.INTERRUPTED
        try:
            text = station.ask(self._client, ReleaseLease(), self._options).text
        except station.RefusedError as error:
            self._warned = time.monotonic() + _SURE
            alone = _ALONE.format(self._client.vehicle)
            self._say(f"{error}\nCtrl-C again within {_SURE:g} s leaves it all the same. {alone}")
            return None
        station.tell(self._options, text)
        return codes.DONE

    def _left(self) -> str:
        """Ended from outside: there is nobody to ask. What became of it."""
        try:
            return station.ask(self._client, ReleaseLease(), self._options).text
        except station.RefusedError:
            return _ALONE.format(self._client.vehicle)

    def _say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def _show(self, now: status.Status) -> None:
        """One line that lives; where lines stay, one for each change."""
        if self._live:
            print(f"{status.brief(now)}"[: shutil.get_terminal_size().columns - 1], end="", flush=True)
            return
        heard = now.contact_age < _GONE
        if (changed := (now.phase, now.action, now.reasons, heard)) != self._shown:
            self._shown = changed
            station.tell_data(self._options, now, [status.brief(now)])

    def _clear(self) -> None:
        if self._live:
            print("\r\x1b[K", end="", flush=True)


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Signals that would end this process, as they come, instead of ending it."""
    heard: list[int] = []

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append(number)

    former = {number: signal.signal(number, hear) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield heard
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
