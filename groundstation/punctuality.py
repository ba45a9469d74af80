"""How punctual a run was: the part ``timing`` of ``metrics.json``. Times in s, rates in Hz, shares from 0 to 1.

The loop owes one tick a period. A tick is *missed* when its own period passes without it: it begins more than one
period after it was due, or it never begins, because the loop has given up catching up after a stall. A tick that the
log lacks although the loop ran it is not missed; it is one of ``missing_ticks``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from groundstation.run import SOURCES, Array, Run

#: Lower edges of the bins of the lateness histogram, s; the last bin has no upper edge.
LATENESS_EDGES = (0.0, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 4e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5, 1.0)
#: What is asked of a flight: the share of its ticks that may be missed.
MISSED_ALLOWED = 0.001
CPU = "cpu."


def timing(run: Run) -> dict[str, Any]:
    """Punctuality of the loop, ages of what it had and of what it sent, and how the devices and the processor did.

    ``None`` stands for what the run does not tell; a simulated one is never late.
    """
    duration = float(run.t[-1]) or float("nan")
    rates = {"tick": (len(run.t) - 1) / duration}
    for name in SOURCES:
        stamps = run.stamps[name][np.isfinite(run.stamps[name])]
        rates[name] = float(np.count_nonzero(np.diff(stamps))) / duration
    values = device_values(run)
    return {
        "rates": rates,
        "ages": {name: spread(run.ages[name]) for name in SOURCES},
        "setpoint_age": spread(setpoint_ages(run)),
        "period": spread(periods(run)),
        "late": spread(run.late),
        "lateness": _histogram(run.late),
        "busy": spread(run.busy),
        "sent": spread(run.sent),
        "missed": _missed(run),
        "missing_ticks": int(run.index[-1] - run.index[0] + 1 - len(run.index)),
        "without_truth": None if run.truth is None else int(np.count_nonzero(~run.truth.known)),
        "devices": {name: _over_time(told) for name, (_, told) in values.items() if not name.startswith(CPU)},
        "cpu": {name[len(CPU) :]: _over_time(told) for name, (_, told) in values.items() if name.startswith(CPU)},
    }


def periods(run: Run) -> Array:
    """Time (s) from each tick to the next, (n - 1,); NaN across ticks that the log lacks."""
    return np.where(np.diff(run.index) == 1, np.diff(run.t), np.nan)


def setpoint_ages(run: Run) -> Array:
    """Age (s) of the attitude that each set-point answers, when the set-point left, (n,); NaN where none left."""
    ages: Array = np.where(run.offboard, run.ages["autopilot"] + run.sent, np.nan)
    return ages


def device_values(run: Run) -> dict[str, tuple[Array, Array]]:
    """Times (s on the clock of ``run.t``) and values of everything that the devices reported, by name, sorted."""
    names = sorted({name for report in run.devices for name in report.values})
    told = {
        name: [((r.t_ns - run.start_ns) * 1e-9, r.values[name]) for r in run.devices if name in r.values]
        for name in names
    }
    return {name: (np.array([t for t, _ in pairs]), np.array([v for _, v in pairs])) for name, pairs in told.items()}


def spread(values: Array) -> dict[str, float] | None:
    """Median, 99th percentile and largest of the finite values; None when there are none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    median, p99 = np.percentile(finite, (50, 99))
    return {"median": float(median), "p99": float(p99), "max": float(finite.max())}


def counts(values: Array, edges: Iterable[float]) -> list[int]:
    """How many of the finite values lie from each edge up to the next, or above the last."""
    found, _ = np.histogram(values[np.isfinite(values)], bins=[*edges, np.inf])
    return [int(count) for count in found]


def _histogram(late: Array) -> dict[str, list[float] | list[int]] | None:
    """Early ticks count as punctual."""
    if not np.isfinite(late).any():
        return None
    return {"edges": list(LATENESS_EDGES), "counts": counts(np.maximum(late, 0.0), LATENESS_EDGES)}


def _missed(run: Run) -> dict[str, float] | None:
    """Count and share of the ticks owed whose period passed without them."""
    told = np.isfinite(run.late)
    late, index = run.late[told], run.index[told]
    if len(late) < 2:
        return None
    due = run.t[told] - late
    steps, ticks = np.diff(due), np.diff(index)
    period = float(np.median(steps / ticks))
    begun_late = int(np.count_nonzero(late > period))
    skipped = int(np.sum(np.maximum(0, np.rint(steps / period).astype(np.int64) - ticks)))
    owed = int(index[-1] - index[0] + 1) + skipped
    return {
        "count": begun_late + skipped,
        "share": (begun_late + skipped) / owed,
        "late": begun_late,
        "skipped": skipped,
        "period": period,
    }


def _over_time(values: Array) -> dict[str, float] | None:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    return {
        "min": float(finite.min()),
        "median": float(np.median(finite)),
        "max": float(finite.max()),
        "last": float(finite[-1]),
    }
