"""``pipewright log list|fetch``: the logs on the vehicle, fetched piece by piece, and never taken for whole when not.

A copy grows as ``log.mcap.part``; a fetch that was cut goes on at its end. It gets its name once all of it is there
and its sum is that of the vehicle.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from groundstation import codes, station
from onboard.wire import ListLogs, LogFile, ReadLog

if TYPE_CHECKING:
    from groundstation.client import Client

#: Most, first and fewest bytes asked for at once. Pieces are such that each takes no longer than this, s: it holds up
#: other answers of the vehicle, and what takes longer than 0.25 s would be asked for again.
PIECE, _FIRST, _LEAST, _SLOW = 256 * 1024, 16 * 1024, 2 * 1024, 0.15
#: The vehicle takes a view order 20 times a second, and drops what comes faster, s.
_PACE: Final = 1.0 / 16.0
#: For the vehicle to make the sum of a log: so long, and so fast, s and bytes/s.
_PATIENCE, _SUMMED = 30.0, 5e6
_LOOK: Final = 0.25
PART: Final = ".part"
_EPILOG = """\
examples:
  pipewright log list                               the newest first
  pipewright log fetch desk-007                     into fetched/desk-007/log.mcap
  pipewright log fetch desk-007/log.mcap --out /media/stick
  pipewright report fetched/desk-007

What was cut off goes on where it ended: give the same command again. Of a log that is still being recorded, what there
is so far is fetched into log.mcap.part, which `pipewright report --partial` reads; a later fetch goes on with it.
"""

Told = Callable[[int, int], None]


def add_parser(commands: Any) -> None:
    """Add ``log`` to the commands of an argparse parser."""
    raw = argparse.RawDescriptionHelpFormatter
    words = "list the logs on the vehicle, or fetch one"
    log = commands.add_parser(
        "log", help=words, description=words.capitalize() + ".", epilog=_EPILOG, formatter_class=raw
    )
    actions = log.add_subparsers(required=True, dest="action", metavar="ACTION")
    words = "what the vehicle has recorded, the newest first"
    listing = actions.add_parser("list", help=words, description=words.capitalize() + ".")
    words = "copy a log, whole and unharmed, or say what lacks"
    fetching = actions.add_parser(
        "fetch", help=words, description=words.capitalize() + ".", epilog=_EPILOG, formatter_class=raw
    )
    fetching.add_argument("name", metavar="NAME", help="as `pipewright log list` shows it, or its folder alone")
    fetching.add_argument(
        "--out",
        type=Path,
        default=Path("fetched"),
        metavar="DIR",
        help="where the run folder is made (default: fetched)",
    )
    for parser in (listing, fetching):
        station.add_options(parser)
        parser.set_defaults(run=run)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Run ``log``; gives the exit code."""
    with station.open_client(options) as client:
        if options.action == "list":
            files = listing(client, options)
            station.tell_data(options, {"logs": files}, [_line(file) for file in files] or ["the vehicle has no logs"])
        else:
            _fetch(client, options)
    return codes.DONE


def listing(client: Client, options: argparse.Namespace) -> tuple[LogFile, ...]:
    """The logs of the vehicle, the newest first. Raises RefusedError, NoVehicleError, NoAnswerError."""
    return station.shown(client, ListLogs(), tuple[LogFile, ...], options)


def _line(file: LogFile) -> str:
    when = datetime.fromtimestamp(file.modified_ns * 1e-9).astimezone()
    state = "  still being recorded" if file.writing else ""
    return f"{file.name:40}  {file.size / 1e6:10.1f} MB  {when:%Y-%m-%d %H:%M:%S}{state}"


# --- fetching ---------------------------------------------------------------------------------------------------------


class Fetched(NamedTuple):
    """What became of a fetch."""

    path: Path
    file: LogFile
    already: bool = False
    """It was here before."""


def _fetch(client: Client, options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    file = chosen(options.name, listing(client, options))
    shown = [TextColumn(file.name), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()]
    with Progress(*shown, console=Console(stderr=True), transient=True, disable=options.json) as progress:
        task = progress.add_task("", total=file.size)
        fetched = fetch(client, options, file, lambda done, total: progress.update(task, completed=done, total=total))
    size = f"{fetched.path.stat().st_size / 1e6:.1f} MB"
    more = {"path": str(fetched.path), "sha256": fetched.file.sha256, "whole": not fetched.file.writing}
    if fetched.file.writing:
        text = f"{fetched.path}: {size} so far; {fetched.file.name} is still being recorded, fetch again for the rest"
    elif fetched.already:
        text = f"{fetched.path}: is here already, and unharmed"
    else:
        text = f"{fetched.path}: {size}, unharmed (sha256 {fetched.file.sha256[:16]}...)"
    station.tell(options, text, **more)


def chosen(name: str, files: Sequence[LogFile]) -> LogFile:
    """The log of this name, or of this run folder. Raises WrongInputError."""
    wanted = name.rstrip("/")
    for file in files:
        if wanted in (file.name, file.name.partition("/")[0]):
            path = PurePosixPath(file.name)
            if path.is_absolute() or ".." in path.parts:
                raise station.WrongInputError(f"{file.name!r}: the vehicle gives a name that leads out of --out")
            return file
    names = [file.name for file in files]
    near = get_close_matches(name, names, cutoff=0.4) or names[:3]
    raise station.WrongInputError(
        f"no log {name!r} on the vehicle; "
        + (f"there are, for example: {', '.join(near)}" if near else "there are none")
    )


def fetch(client: Client, options: argparse.Namespace, file: LogFile, told: Told) -> Fetched:
    """Fetch a log into ``options.out``; ``told`` hears how many bytes are here, and of how many.

    Raises WrongInputError for a place that cannot take it, UnfinishedError for a copy that is not what the vehicle has,
    RefusedError, NoVehicleError, NoAnswerError. What has come stays, for the next time.
    """
    from groundstation.client import NoAnswerError
    from onboard.endpoints import NoVehicleError

    path = options.out / file.name
    part = path.with_name(path.name + PART)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            return _compared(client, options, file, path)
        with part.open("a+b") as copy:
            return _fill(client, options, file, _Copy(copy, part), told, path)
    except (NoAnswerError, NoVehicleError) as error:
        raise type(error)(f"{error}; what has come is in {part}: the same command goes on there") from error
    except OSError as error:
        raise station.UnfinishedError(f"{part}: cannot be written: {error.strerror}; what has come stays") from error


class _Copy:
    """The part of a log that is here. Opened for reading and appending."""

    def __init__(self, file: Any, path: Path) -> None:
        self._file, self.path = file, path
        self.size = 0
        self._sum = hashlib.sha256()
        file.seek(0)
        while piece := file.read(1 << 20):
            self._took(piece)

    def add(self, piece: bytes) -> None:
        self._file.write(piece)
        self._file.flush()
        self._took(piece)

    def finish(self) -> None:
        os.fsync(self._file.fileno())

    @property
    def sum(self) -> str:
        return self._sum.hexdigest()

    def _took(self, piece: bytes) -> None:
        self._sum.update(piece)
        self.size += len(piece)


def _fill(client: Client, options: argparse.Namespace, file: LogFile, copy: _Copy, told: Told, path: Path) -> Fetched:
    """Until all is here that the vehicle has; a log may be finished while it is fetched."""
    patience = math.inf
    while True:
        if copy.size > file.size:
            raise station.WrongInputError(
                f"{copy.path}: holds {copy.size} bytes, {file.name} only {file.size}: it is of another log; remove it"
            )
        _take(client, options, file, copy, told)
        if file.writing:
            return Fetched(copy.path, file)
        if file.sha256:
            break
        patience = min(patience, time.monotonic() + _PATIENCE + file.size / _SUMMED)
        file = _again(client, options, file, patience)
    if copy.sum != file.sha256:
        copy.path.unlink()
        raise station.UnfinishedError(
            f"{file.name}: the copy is not what the vehicle has: a piece was damaged, on the way or on a disk. It was "
            "removed; fetch it again"
        )
    copy.finish()
    copy.path.replace(path)
    return Fetched(path, file)


def _take(client: Client, options: argparse.Namespace, file: LogFile, copy: _Copy, told: Told) -> None:
    """Read on to the end of the log, and at least once: the vehicle makes the sum of what is read."""
    told(copy.size, file.size)
    first, most = True, _FIRST
    while first or copy.size < file.size:
        begun = time.monotonic()
        size = max(1, min(most, file.size - copy.size))
        piece = station.ask(client, ReadLog(file.name, copy.size, size), options).data
        took = time.monotonic() - begun
        most = max(_LEAST, most // 2) if took > _SLOW else min(PIECE, 2 * most) if took < 0.7 * _SLOW else most
        if copy.size < file.size:
            if not 0 < len(piece) <= size:
                raise station.UnfinishedError(
                    f"{file.name}: the vehicle gave {len(piece)} bytes where {size} were asked for; list the logs again"
                )
            copy.add(piece)
            told(copy.size, file.size)
        first = False
        if copy.size < file.size:
            time.sleep(max(0.0, _PACE - took))


def _again(client: Client, options: argparse.Namespace, file: LogFile, until: float) -> LogFile:
    """The same log a moment later. Raises UnfinishedError when it is gone, or its sum does not come."""
    if time.monotonic() > until:
        raise station.UnfinishedError(f"{file.name}: the vehicle does not tell its sum; fetch it again")
    time.sleep(_LOOK)
    for now in listing(client, options):
        if now.name == file.name:
            return now
    raise station.UnfinishedError(f"{file.name}: is on the vehicle no more")


def _compared(client: Client, options: argparse.Namespace, file: LogFile, path: Path) -> Fetched:
    """What is here under its name must be the same."""
    other = f"{path}: is here already, and is another log; move it away, or give another --out"
    if file.writing or path.stat().st_size != file.size:
        raise station.WrongInputError(other)
    with path.open("rb") as here:
        copy = _Copy(here, path)
    station.ask(client, ReadLog(file.name, 0, 1), options)
    until = time.monotonic() + _PATIENCE + file.size / _SUMMED
    while not file.sha256:
        file = _again(client, options, file, until)
    if copy.sum != file.sha256:
        raise station.WrongInputError(other)
    return Fetched(path, file, already=True)
