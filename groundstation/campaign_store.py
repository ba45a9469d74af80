"""Where the results of a campaign lie: each run's row is on the disk before the next is thought of.

A row is a Parquet file of its own under the number of its run, put there by one rename; at the end they become one
file. Whatever is killed at whatever moment, a run is there once or not at all.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct

from groundstation.campaign_file import Plan
from groundstation.campaign_run import NAMES

_ABOUT, _PARTS, _WHOLE, _LOCK = "campaign.json", "parts", "results.parquet", ".lock"
_TEXTS: Final = ("fault", "moment", "end", "outcome", "ended_in", "crash", "error", "command", "host", "version")
#: Rows that are read at once while they are put together.
_BATCH: Final = 256


class StoreError(Exception):
    """The folder does not fit what is asked for."""


class About(Struct, frozen=True):
    """What a folder holds the runs of."""

    name: str
    digest: str
    columns: list[str]
    runs: int
    campaign: Any = None


class Store:
    """The folder of one campaign."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self._plan = folder, plan
        self._parts = folder / _PARTS
        varied = [(item.name, _kind(item.values)) for item in plan.campaign.parameters]
        self.values = tuple(name for name, _ in varied)
        self.schema = pa.schema(
            [("run", pa.int64()), ("seed", pa.int64()), ("ok", pa.bool_())]
            + [(name, pa.string()) for name in _TEXTS]
            + [(name, pa.float64()) for name in NAMES]
            + varied
        )

    @contextmanager
    def opened(self, *, resume: bool) -> Iterator[None]:
        """Make the folder, or go on in it; nobody else adds runs meanwhile.

        Raises StoreError when it is another campaign's, has runs already, or somebody else is at work on it.
        """
        self._check(resume)
        self._parts.mkdir(parents=True, exist_ok=True)
        with (self.folder / _LOCK).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreError(f"{self.folder}: another process is at work on it; wait for it or end it") from None
            for left in self._parts.glob("*.tmp"):
                left.unlink()
            _write(self.folder / _ABOUT, msgspec.json.format(msgspec.json.encode(self._about)))
            yield

    def _check(self, resume: bool) -> None:
        there, about = self.folder / _ABOUT, self._about
        if not there.is_file():
            if self.folder.is_dir() and any(path.name not in (_LOCK, _PARTS) for path in self.folder.iterdir()):
                raise StoreError(f"{self.folder}: holds other files; give a new or empty folder")
            return
        former = msgspec.json.decode(there.read_bytes(), type=About)
        if not resume:
            words = "--resume goes on with it, or give another --out"
            raise StoreError(f"{self.folder}: holds {former.name} already; {words}")
        if former.digest != about.digest:
            raise StoreError(
                f"{self.folder}: holds {former.name} as its file and its scenario were then; something has been "
                "changed since, so its runs are others: give another --out"
            )
        if former.columns != about.columns:
            raise StoreError(f"{self.folder}: was begun by a version that told other figures: give another --out")

    @property
    def _about(self) -> About:
        plan = self._plan
        return About(plan.name, plan.digest(), self.schema.names, len(plan), msgspec.to_builtins(plan.campaign))

    def done(self) -> set[int]:
        """Numbers of the runs that are there."""
        whole = self.folder / _WHOLE
        known = set(pq.read_table(whole, columns=["run"])["run"].to_pylist()) if whole.is_file() else set()
        return known | {int(path.stem) for path in self._parts.glob("*.parquet")}

    def put(self, row: dict[str, Any]) -> None:
        """Keep the row of a run, for good."""
        row = {**row, **{name: _as(row["values"].get(name), self.schema.field(name).type) for name in self.values}}
        table = pa.Table.from_pylist([{name: row.get(name) for name in self.schema.names}], self.schema)
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        _write(self._parts / f"{row['run']:07d}.parquet", sink.getvalue().to_pybytes())

    def compact(self) -> None:
        """Put all rows into one file, in the order of the runs."""
        parts = self._part_files()
        if parts:
            whole = self.folder / _WHOLE
            temporary = whole.with_suffix(".tmp")
            pq.write_table(self.table(), temporary)
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
            temporary.replace(whole)
            _sync(self.folder)
            for part in parts:
                part.unlink()
        with suppress(OSError):
            self._parts.rmdir()

    def table(self) -> pa.Table:
        """All rows that are there, in the order of the runs, each once."""
        whole, parts = self.folder / _WHOLE, self._part_files()
        tables = [self._read(parts[k : k + _BATCH]) for k in range(0, len(parts), _BATCH)]
        if whole.is_file():
            here = {int(path.stem) for path in parts}
            former = pq.read_table(whole, schema=self.schema)
            tables.append(former.filter(pa.array([run not in here for run in former["run"].to_pylist()], pa.bool_())))
        return pa.concat_tables(tables).sort_by("run") if tables else self.schema.empty_table()

    def _part_files(self) -> list[Path]:
        return sorted(self._parts.glob("*.parquet"))

    def _read(self, parts: Sequence[Path]) -> pa.Table:
        return pa.concat_tables([pq.read_table(part, schema=self.schema) for part in parts])


def _kind(values: Iterable[Any]) -> pa.DataType:
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return pa.float64() if numbers else pa.string()


def _as(value: Any, kind: pa.DataType) -> Any:
    return None if value is None else float(value) if kind == pa.float64() else str(value)


def _write(path: Path, data: bytes) -> None:
    """There whole or not at all, also when the power fails."""
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    _sync(path.parent)


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
