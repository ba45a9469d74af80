"""The force estimators side by side: how far from the truth, how late, and what a tick of each costs.

Over the contact window, against the compression that is true in the simulated world. The delay is where the
cross-correlation of both is largest, taken of their changes: the levels of a slow profile correlate at any delay. In
free flight, where no contact is, whatever an estimator reads is wind, noise and model error. That matters where the
gate at the tip is open and the trigger is looked at: there nothing but the estimate and its witnesses holds it back.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from groundstation.run import ESTIMATORS, FELT, Array, Mask, Run, stretches
from onboard.messages import Phase

#: Costs beside a log, as the flight process measured them after the flight on the machine that flew: us, by name.
COSTS = "costs.json"
LABELS = {
    "paper": "paper, eq. 11-17",
    "body": "body acceleration",
    "momentum": "momentum, with arm",
    "kalman": "Kalman, wind apart",
    "ukf": "UKF (filterpy)",
    FELT: "joints alone",
}
#: Of each estimator: RMSE, bias and spread in contact (N), delay (s), RMS of what it reads in free flight and, of that,
#: while the trigger is watched (N), how often it would then have pulled the trigger alone, and the cost of a tick (us).
KEYS = ("rmse", "bias", "spread", "delay", "free_rms", "watched_rms", "pulls", "cost")
#: Delays that are looked at, and the time over which a change is taken, s.
_LONGEST, _CHANGE = 0.6, 0.1
#: Changes smaller than this (N, RMS) tell no delay.
_STILL = 0.01
#: A trigger is false when there has been no contact for so long before, nor is within so long after, s.
_BEFORE, _AFTER = 0.3, 0.1
#: Nor is anything counted that is left of a contact, for so long, s.
_FADED = 1.0
_FREE = (Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE, Phase.RETURN, Phase.HOLD)


def read_costs(log: Path) -> dict[str, float]:
    """Median costs of a tick, us; empty when none were measured."""
    try:
        return msgspec.json.decode(log.with_name(COSTS).read_bytes(), type=dict[str, float])
    except (OSError, ValueError):
        return {}


def compute(run: Run, contact: slice, costs: Mapping[str, float]) -> dict[str, Any] | None:
    """The part ``estimators`` of ``metrics.json``; None when the log holds no estimates side by side.

    contact: ticks from trigger to release. N, s, us.
    """
    if not run.forces:
        return None
    names = [*(name for name in run.forces if name != FELT), FELT]
    free = run.where(*_FREE)
    truth = run.truth
    known = np.zeros(len(run.t), dtype=np.bool_)
    if truth is not None:
        known[contact] = truth.known[contact]
        free &= truth.known & (truth.force <= 0.0)
    period = float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0
    watched = _watched(run)
    table: dict[str, dict[str, float | None]] = {}
    for name in names:
        estimate = run.forces[name]
        row: dict[str, float | None] = dict.fromkeys(KEYS)
        if truth is not None and known.any() and np.isfinite(estimate[known]).all():
            error = estimate[known] - truth.force[known]
            row["rmse"], row["bias"] = float(np.sqrt(np.mean(error * error))), float(np.mean(error))
            row["spread"] = float(np.std(error))
            row["delay"] = delay(estimate[known], truth.force[known], period)
        if free.any() and np.isfinite(estimate[free]).all():
            row["free_rms"] = float(np.sqrt(np.mean(estimate[free] ** 2)))
        if watched.any() and np.isfinite(estimate[watched]).all():
            row["watched_rms"] = float(np.sqrt(np.mean(estimate[watched] ** 2)))
            row["pulls"] = float(_pulls(watched & (estimate > run.config.contact.threshold), run, period))
        row["cost"] = costs.get(name)
        table[name] = row
    selected = run.config.estimators.selected
    rmse, paper = table[selected]["rmse"], table["paper"]["rmse"]
    return {
        "selected": selected,
        "ratio": paper / rmse if paper is not None and rmse else None,
        "table": table,
        "cost_all": sum(costs[name] for name in ESTIMATORS) if all(name in costs for name in ESTIMATORS) else None,
        "false_contacts": _false(run.triggered, run) if truth is not None else None,
        "alarms": len(_rises(run.alarm)),
        "free_s": float(np.count_nonzero(free) * period),
        "watched_s": float(np.count_nonzero(watched) * period),
    }


def _watched(run: Run) -> Mask:
    """Ticks in which the gate is open and nothing touches, nor has just now; none where the truth is not known."""
    if run.truth is None:
        return np.zeros(len(run.t), dtype=np.bool_)
    touching = run.truth.force > 0.0
    last = np.maximum.accumulate(np.where(touching, run.t, -np.inf))
    gate = np.nan_to_num(run.forces["kalman"]) != 0.0  # the filter's contact is nothing at all while it is closed
    mask: Mask = gate & run.truth.known & (run.t - last > _FADED) & run.where(*_FREE, Phase.ADVANCE)
    return mask


def _pulls(high: Mask, run: Run, period: float) -> int:
    """How often it lasts for as long as the trigger asks."""
    return int(np.count_nonzero(stretches(high) * period >= run.config.contact.debounce))


def delay(estimate: Array, truth: Array, period: float) -> float | None:
    """How far ``estimate`` lags ``truth``, s, sampled every ``period`` s; None when nothing changes."""
    width = max(1, round(_CHANGE / period)) if period > 0.0 else 0
    if not width or len(truth) < 4 * width:
        return None
    a, b = estimate[width:] - estimate[:-width], truth[width:] - truth[:-width]
    if np.sqrt(np.mean(b * b)) < _STILL:
        return None
    most = min(round(_LONGEST / period), len(b) // 2)
    n = len(b) - most
    # each window of the estimate by its own size: else the lag that reaches its largest change would win
    size = np.sqrt(np.convolve(a * a, np.ones(n), "valid"))
    found = np.array([np.dot(a[lag : lag + n], b[:n]) for lag in range(most + 1)]) / np.maximum(size, 1e-12)
    at = int(np.argmax(found))
    if 0 < at < most:  # between the samples, by the parabola through the three highest
        left, top, right = found[at - 1 : at + 2]
        bend = left - 2.0 * top + right
        return float((at + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)) * period)
    return at * period


def _rises(mask: Mask) -> list[int]:
    return (np.flatnonzero(mask[1:] & ~mask[:-1]) + 1).tolist()


def _false(triggered: Mask, run: Run) -> int:
    """Times the trigger was pulled with no contact about."""
    assert run.truth is not None
    touching, t = run.truth.force > 0.0, run.t
    count = 0
    for at in _rises(triggered):
        about = slice(*np.searchsorted(t, (t[at] - _BEFORE, t[at] + _AFTER)))
        count += bool(run.truth.known[about].all() and not touching[about].any())
    return count


def rows(told: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Label and cells (RMSE, bias, spread, delay, free flight, cost) of each estimator, as they are shown."""
    shown = []
    for name, row in told["table"].items():
        mark = " *" if name == told["selected"] else ""
        cells = [f"{row[key]:{form}}" if row[key] is not None else "" for key, form in (
            ("rmse", ".4f"), ("bias", "+.4f"), ("spread", ".4f")
        )]  # fmt: skip
        cells.append(f"{1000 * row['delay']:.0f}" if row["delay"] is not None else "")
        cells.append(f"{row['free_rms']:.4f}" if row["free_rms"] is not None else "")
        cells.append(f"{row['cost']:.1f}" if row["cost"] is not None else "")
        shown.append((LABELS.get(name, name) + mark, cells))
    return shown


HEADINGS = ("RMSE, N", "bias, N", "spread, N", "delay, ms", "free, N", "a tick, us")


def words(told: dict[str, Any]) -> str:
    """What the table leaves to be said."""
    parts = ["* is the one selected for control."]
    if told["ratio"] is not None and told["selected"] != "paper":
        parts.append(f"The paper's RMSE is {told['ratio']:.2f} times its own.")
    if told["cost_all"] is not None:
        parts.append(f"All together {told['cost_all']:.1f} us a tick, measured after the flight.")
    if told["false_contacts"] is not None:
        parts.append(
            f"False contacts: {told['false_contacts']}; without the gate at the tip there would have been "
            f"{told['alarms']} in {told['free_s']:.0f} s of free flight. "
            f"With the gate open and nothing touching: {told['watched_s']:.0f} s."
        )
    return " ".join(parts)
