"""Inputs for property tests of the laws."""

from __future__ import annotations

from hypothesis import strategies as st

from drivers.samples import Vec3
from onboard.core.sliding_mode import Six


def number(limit: float) -> st.SearchStrategy[float]:
    """A finite float within +-limit."""
    return st.floats(-limit, limit, allow_nan=False, allow_infinity=False)


def vector(limit: float) -> st.SearchStrategy[Vec3]:
    """Three finite floats within +-limit."""
    x = number(limit)
    return st.tuples(x, x, x)


def six(limit: float) -> st.SearchStrategy[Six]:
    """Six finite floats within +-limit."""
    x = number(limit)
    return st.tuples(x, x, x, x, x, x)
