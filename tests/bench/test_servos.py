"""The servo bench, on a few cycles: no figure is judged, only that they belong together."""

from __future__ import annotations

import pytest

from tests.bench.servos import measure


def test_a_few_cycles() -> None:
    row = measure(2_000_000, 40)
    assert row.wire == pytest.approx(830.0)
    assert row.ours.count + row.sdk.count + row.failed == 80
    assert row.wire < row.ours.median
    assert row.wire < row.sdk.median
    assert 0.0 < row.ours_cpu < row.ours.mean * 1.1
