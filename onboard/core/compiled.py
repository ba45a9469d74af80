"""Compiled kernels.

Every kernel names its signature, so it is compiled (or loaded from the cache) when its module is imported, and an
argument of another type is an error: compilation never happens in flight. Never fastmath: same bits everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

P = ParamSpec("P")
R = TypeVar("R")


def compiled(signature: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: compile for this numba signature."""
    return cast(Callable[[Callable[P, R]], Callable[P, R]], njit(signature, cache=True))
