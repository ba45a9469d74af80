"""Compiled kernels of the world. Never fastmath: the same bits everywhere."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

from numba import config, njit

P = ParamSpec("P")
R = TypeVar("R")

_HERE = Path(__file__).parent
_TEXTS = [source.read_bytes() for source in sorted(_HERE.glob("*.py"))]
_SOURCES = sha256(b"".join(text for text in _TEXTS if b"@compiled" in text or b"compile-time" in text)).hexdigest()
_CACHE = str(_HERE / "__pycache__" / f"kernels-{_SOURCES[:16]}")


def compiled(signature: str | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: compile for this numba signature, at import or from the cache; without one, where it is called.

    Numba takes a cached kernel for fresh while the file of its outermost function is unchanged, and would go on
    running the old callees after an edit in another file. So each state of the kernels' sources has a cache of its own.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        elsewhere = config.CACHE_DIR  # type: ignore[attr-defined]
        config.CACHE_DIR = _CACHE  # type: ignore[attr-defined]
        try:
            wrap = njit(cache=True) if signature is None else njit(signature, cache=True)
            return cast(Callable[P, R], wrap(function))
        finally:
            config.CACHE_DIR = elsewhere  # type: ignore[attr-defined]

    return decorate
