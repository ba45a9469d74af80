"""Compiled kernels of the world. Never fastmath: the same bits everywhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

from numba import njit

P = ParamSpec("P")
R = TypeVar("R")


def _drop_stale_cache() -> None:
    """Remove compiled kernels that are older than any source file here.

    Numba looks only at the file of the outermost function, so that after an edit of a callee in another file it
    would go on running the old one.
    """
    here = Path(__file__).parent
    newest = max(source.stat().st_mtime for source in here.glob("*.py"))
    for index in (here / "__pycache__").glob("*.nbi"):
        try:
            if index.stat().st_mtime < newest:
                index.unlink()
        except OSError:  # Another process was faster, or the folder is read-only and holds no cache that we wrote.
            continue


_drop_stale_cache()


def compiled(signature: str | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: compile for this numba signature, at import or from the cache; without one, where it is called."""
    decorate = njit(cache=True) if signature is None else njit(signature, cache=True)
    return cast(Callable[[Callable[P, R]], Callable[P, R]], decorate)
