"""How servos, tracker and link did in a run: the part ``health`` of ``metrics.json``.

``None`` stands for what the run does not tell: servos or tracker that never spoke, a link on which nobody commanded.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.samples import SERVO_NAMES
from drivers.xc330 import error_words
from groundstation.punctuality import spread
from groundstation.run import Run

#: A commander that was not heard for longer was missed, s.
SILENT = 1.0


def compute(run: Run) -> dict[str, Any]:
    """A, V, degC, deg, s; shares from 0 to 1."""
    return {"servos": _servos(run), "vision": _vision(run), "link": _link(run)}


def _servos(run: Run) -> dict[str, Any] | None:
    health = run.health
    told = np.isfinite(health.temperature).all(axis=1) & np.isfinite(health.current).all(axis=1)
    if not told.any():
        return None
    current, voltage, temperature = (values[told] for values in (health.current, health.voltage, health.temperature))
    bits = np.bitwise_or.reduce(health.error[told].astype(np.int64), axis=0).tolist()
    return {
        name: {
            "current_rms": float(np.sqrt(np.mean(current[:, i] ** 2))),
            "current_max": float(np.max(np.abs(current[:, i]))),
            "voltage_min": float(voltage[:, i].min()),
            "voltage_max": float(voltage[:, i].max()),
            "temperature_max": float(temperature[:, i].max()),
            "errors": error_words(bits[i]),
        }
        for i, name in enumerate(SERVO_NAMES)
    }


def _vision(run: Run) -> dict[str, Any] | None:
    health = run.health
    confidence = health.confidence[np.isfinite(health.confidence)]
    if not confidence.size:
        return None
    resets = health.resets[np.isfinite(health.resets)]
    return {
        "confidence": {str(level): float(np.mean(confidence == level)) for level in (3, 2, 1, 0)},
        "jumps": int(resets[-1] - resets[0]),
        "lean_deg": spread(np.degrees(health.lean)),
    }


def _link(run: Run) -> dict[str, Any] | None:
    health = run.health
    age = spread(health.link_age)
    if age is None:
        return None
    commanded = np.isfinite(health.link_age)
    ticks = np.diff(run.t, prepend=run.t[0])
    return {
        "commanders": list(health.commanders),
        "age": age,
        "silent_s": float(np.sum(ticks[commanded & (health.link_age > SILENT)])),
        "absent_s": float(np.sum(ticks[commanded & ~health.link_present])),
    }
