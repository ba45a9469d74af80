"""The folder of runs on the vehicle: what stations see and fetch of it, and how much of the disk it may take.

A run is a folder that holds a ``log.mcap``. Names come from outside, so nothing is ever followed out of the folder: a
name is a run and its log, folders and logs that are links are none, and each step is opened from the one before.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock, Thread, get_native_id
from typing import Final

from msgspec import Struct

from onboard.orders import NotShownError
from onboard.wire import LogFile

LOG: Final = "log.mcap"
#: A piece that is read at once is no larger, bytes.
PIECE: Final = 256 * 1024
#: Newest runs that are never removed.
KEPT: Final = 3
#: What a run folder holds. One that holds anything else is a person's, and is left alone.
_OURS: Final = frozenset({LOG, "config.yaml", "metrics.json", "report.html"})
_MOST: Final = 1000
_READ: Final = 1 << 20
_NICE: Final = 10
_GB: Final = 1e9
_FOLDER: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
#: Without O_NONBLOCK a pipe of this name would wait for a writer.
_FILE: Final = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class _Run(Struct, frozen=True):
    """One run folder."""

    name: str
    log: os.stat_result

    @property
    def file(self) -> str:
        return f"{self.name}/{LOG}"


class Logs:
    """The runs in one folder.

    writing: name of the run that is being recorded. Any thread may call; only ``prune`` takes long.
    """

    def __init__(self, folder: Path, writing: str = "") -> None:
        self._folder, self._writing = folder, writing
        self._sums: dict[str, tuple[tuple[int, int], str]] = {}
        """By name: size and time of change of the log that was summed, and its sum."""
        self._summing: set[str] = set()
        self._one_sum = Lock()

    def files(self) -> tuple[LogFile, ...]:
        """All logs, the newest first. Of one that was never read, or is being written, no sum is known."""
        return tuple(
            LogFile(
                run.file,
                run.log.st_size,
                self._known_sum(run.file, _version(run.log)),
                run.log.st_mtime_ns,
                run.name == self._writing,
            )
            for run in self._runs()[:_MOST]
        )

    def read(self, name: str, offset: int, size: int) -> bytes:
        """A piece of a log, ``PIECE`` bytes at most; empty behind its end. Then its sum is made, in a thread.

        Raises NotShownError for a name that ``files`` does not give, and for a log that cannot be read.
        """
        run, _, file = name.partition("/")
        if file != LOG or not _plain(run):
            raise NotShownError(f"{name[:100]!r} is no log of this vehicle; ask which there are.")
        try:
            with self._opened(run) as log:
                if run != self._writing:
                    self._sum_later(name, run, _version(os.fstat(log)))
                return os.pread(log, min(size, PIECE), offset)
        except FileNotFoundError:
            raise NotShownError(f"{name!r} is not there, or not any more; ask which logs there are.") from None
        except OSError as error:
            raise NotShownError(f"{name!r} cannot be read: {error.strerror}.") from None

    def prune(self, budget: float) -> tuple[str, ...]:
        """Remove the oldest runs until all take ``budget`` bytes at most, with the one being written; 0: none.

        That one, the newest ``KEPT`` of the others, and what holds files that are not Pipewright's stay. Gives a
        sentence for each run that was removed, or should have been.
        """
        if not budget:
            return ()
        runs = [(run, self._size(run)) for run in self._runs()]
        total, told = sum(size for _, size in runs), []
        finished = [(run, size) for run, size in runs if run.name != self._writing]
        for run, size in reversed(finished[KEPT:]):
            if total <= budget:
                break
            try:
                self._remove(run.name)
            except OSError as error:
                told.append(f"Run {run.name} should make way for new logs, but cannot be removed: {error.strerror}.")
            except _ForeignError as error:
                told.append(f"Run {run.name} should make way for new logs, but holds {error}: move it, or remove it.")
            else:
                total -= size
                told.append(f"Run {run.name} ({size / _GB:.2f} GB) was removed to make way for new logs.")
        if total > budget:
            told.append(f"The runs take {total / _GB:.2f} GB, and logs.budget is {budget / _GB:g} GB.")
        return tuple(told)

    def free(self) -> int:
        """Bytes that may still be written. Raises OSError."""
        room = os.statvfs(self._folder)
        return room.f_bavail * room.f_frsize

    # -- sums -----------------------------------------------------------------------------------------------------

    def _known_sum(self, name: str, version: tuple[int, int]) -> str:
        of, known = self._sums.get(name, (version, ""))
        return known if of == version else ""

    def _sum_later(self, name: str, run: str, version: tuple[int, int]) -> None:
        """Make the sum of a log in a thread of its own, unless it is known or under way."""
        if name not in self._summing and not self._known_sum(name, version):
            self._summing.add(name)
            Thread(target=self._sum, args=(name, run), name="logs.sum", daemon=True).start()

    def _sum(self, name: str, run: str) -> None:
        os.setpriority(os.PRIO_PROCESS, get_native_id(), _NICE)
        found = hashlib.sha256()
        try:
            with self._one_sum, self._opened(run) as log:
                version = _version(os.fstat(log))
                while piece := os.read(log, _READ):
                    found.update(piece)
                if _version(os.fstat(log)) == version:
                    self._sums[name] = (version, found.hexdigest())
        except OSError:
            pass  # whoever reads it is told why
        finally:
            self._summing.discard(name)

    # -- the disk -------------------------------------------------------------------------------------------------

    def _runs(self) -> list[_Run]:
        """The newest first."""
        found = []
        try:
            with os.scandir(self._folder) as entries:
                for entry in entries:
                    if _plain(entry.name) and entry.is_dir(follow_symlinks=False):
                        try:
                            log = os.stat(Path(entry.path) / LOG, follow_symlinks=False)
                        except OSError:
                            continue
                        if stat.S_ISREG(log.st_mode):
                            found.append(_Run(entry.name, log))
        except OSError:
            return []  # there is no run yet; a disk that fails is told of by the recorder
        return sorted(found, key=lambda run: run.log.st_mtime_ns, reverse=True)

    @contextmanager
    def _opened(self, run: str) -> Iterator[int]:
        """The log of a run. Raises OSError, also for what is no plain file."""
        folder = os.open(self._folder / run, _FOLDER)
        try:
            log = os.open(LOG, _FILE, dir_fd=folder)
        finally:
            os.close(folder)
        try:
            if not stat.S_ISREG(os.fstat(log).st_mode):
                raise FileNotFoundError
            yield log
        finally:
            os.close(log)

    def _size(self, run: _Run) -> int:
        """Bytes of all files of a run; of one that cannot be looked into, those of its log."""
        try:
            with os.scandir(self._folder / run.name) as entries:
                return sum(entry.stat(follow_symlinks=False).st_size for entry in entries)
        except OSError:
            return run.log.st_size

    def _remove(self, run: str) -> None:
        """Raises _ForeignError and OSError; the log goes last, so that what is left is still a run."""
        folder = os.open(self._folder / run, _FOLDER)
        try:
            names = sorted(os.listdir(folder), key=lambda name: name == LOG)
            if foreign := [name for name in names if name not in _OURS]:
                raise _ForeignError(foreign[0])
            for name in names:
                os.unlink(name, dir_fd=folder)
        finally:
            os.close(folder)
        os.rmdir(self._folder / run)


class _ForeignError(Exception):
    """The name of a file that is not Pipewright's."""


def _plain(name: str) -> bool:
    """Whether this may be the name of a run: one part of a path that can be shown."""
    return name not in ("", ".", "..") and "/" not in name and name.isprintable()


def _version(log: os.stat_result) -> tuple[int, int]:
    return log.st_size, log.st_mtime_ns
