"""Is the physics step small enough? Figures of one mission flown with two steps, side by side."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

#: Largest change of a figure that converged physics may show.
RELATIVE = 0.02
#: What lies below counts as nothing: far finer than any figure that is asked for.
FLOORS = {"N": 1e-4, "m": 1e-6, "deg": 1e-5, "s": 0.004, "N m": 1e-4, "": 0.0}
_UNITS = {
    "touchdown_peak": "N",
    "peak": "N",
    "hold_mean": "N",
    "hold_std": "N",
    "overshoot": "N",
    "time_to_95": "s",
    "tip_slip": "m",
    "bounces": "",
    "time_without_contact": "s",
    "thrust_max": "N",
    "torque_max": "N m",
    "arc_deg": "deg",
    "path_error_rms": "m",
}


class Figure(NamedTuple):
    """One number of ``metrics.json``."""

    name: str
    unit: str
    value: float


class Change(NamedTuple):
    """What another step does to it."""

    figure: Figure
    other: float

    @property
    def relative(self) -> float:
        """Change over value; 0 where the change is below the floor of its unit."""
        change = abs(self.other - self.figure.value)
        return 0.0 if change <= FLOORS[self.figure.unit] else change / max(abs(self.figure.value), 1e-300)


def figures(metrics: dict[str, Any]) -> Iterator[Figure]:
    """Every number that the table shows: the rows of Table II, contact, limits and adhesive."""
    for row, value in metrics["force_rmse"].items():
        yield Figure(f"F {row}", "N", value)
    for window in ("flight", "contact"):
        for row, value in metrics["state_rmse"][window].items():
            yield Figure(f"{row} ({window})", "m" if row in "xyz" else "deg", value)
    for group in ("contact", "limits", "adhesive"):
        for row, value in metrics[group].items():
            if row in _UNITS:
                yield Figure(row, _UNITS[row], float(value))


def changes(metrics: dict[str, Any], other: dict[str, Any]) -> list[Change]:
    """Every figure of one run beside that of the other."""
    pairs = zip(figures(metrics), figures(other), strict=True)
    return [Change(figure, twin.value) for figure, twin in pairs]
