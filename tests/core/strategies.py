"""Inputs for property tests of the laws."""

from __future__ import annotations

from hypothesis import strategies as st


def number(limit: float) -> st.SearchStrategy[float]:
    """A finite float within +-limit."""
    return st.floats(-limit, limit, allow_nan=False, allow_infinity=False)


def vector(limit: float, size: int = 3) -> st.SearchStrategy[tuple[float, ...]]:
    """A tuple of finite floats within +-limit."""
    return st.tuples(*([number(limit)] * size))
