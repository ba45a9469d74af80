"""Whether PX4's own position estimate is where the tracker is: PX4 lands by it when this process is gone."""

from __future__ import annotations

from drivers.mailbox import Level, Notice

#: Apart, or together again, for so long before it is believed, ns.
_PATIENCE_NS = 1_000_000_000


class Agreement:
    """Judges the distance between the two, with patience. ``limit``: m."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._apart = False
        self._since_ns: int | None = None
        self._distance = 0.0

    def judge(self, t_ns: int, distance: float | None) -> Notice | None:
        """Take the distance (m; None: PX4 tells no position) at ``t_ns``; a notice when the judgement has changed."""
        if distance is None:
            self._since_ns = None
            return None
        self._distance = distance
        if (distance > self._limit) is self._apart:
            self._since_ns = None
            return None
        if self._since_ns is None:
            self._since_ns = t_ns
        if t_ns - self._since_ns < _PATIENCE_NS:
            return None
        self._apart, self._since_ns = not self._apart, None
        if self._apart:
            return Notice(t_ns, Level.WARNING, self.obstacle)
        return Notice(t_ns, Level.INFO, "PX4's position estimate is where the tracker is again.")

    @property
    def obstacle(self) -> str:
        """Why the vehicle must not arm; empty: the two agree."""
        if not self._apart:
            return ""
        return (
            f"PX4 believes to be {self._distance:.2f} m from where the tracker is: does it take the poses "
            "(EKF2_EV_CTRL), and has it been moved since its start?"
        )
