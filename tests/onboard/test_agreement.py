"""PX4's position estimate against the tracker's."""

from __future__ import annotations

from drivers.mailbox import Level
from onboard.agreement import Agreement

MS = 1_000_000


def judged(agreement: Agreement, start_ms: int, end_ms: int, distance: float | None) -> list[tuple[int, Level]]:
    """When (ms) it told what, while the distance was this, looked at every 4 ms."""
    told = [(t, agreement.judge(t * MS, distance)) for t in range(start_ms, end_ms, 4)]
    return [(t, notice.level) for t, notice in told if notice is not None]


def test_it_tells_once_that_they_part_and_once_that_they_meet() -> None:
    agreement = Agreement(0.3)
    assert judged(agreement, 0, 5000, 0.29) == []
    assert agreement.obstacle == ""
    assert judged(agreement, 5000, 9000, 0.45) == [(6000, Level.WARNING)]
    assert "0.45 m" in agreement.obstacle
    assert judged(agreement, 9000, 12000, 0.1) == [(10000, Level.INFO)]
    assert agreement.obstacle == ""


def test_a_short_excursion_is_no_disagreement() -> None:
    agreement = Agreement(0.3)
    for second in range(5):
        assert judged(agreement, 2000 * second, 2000 * second + 900, 2.0) == []
        assert judged(agreement, 2000 * second + 900, 2000 * second + 2000, 0.0) == []


def test_where_px4_tells_no_position_nothing_is_judged() -> None:
    agreement = Agreement(0.3)
    assert judged(agreement, 0, 900, 2.0) == []
    assert judged(agreement, 900, 5000, None) == []
    assert judged(agreement, 5000, 5900, 2.0) == []
    assert agreement.obstacle == ""
