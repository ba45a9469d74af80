"""The figures of merit of one run, from its log alone.

Windows: ``flight`` runs from the end of takeoff to the start of landing; ``contact`` from the trigger (first tick of
the press) to the release. Errors are taken against the reference the loop follows, from the truth of the world where
there is one, else from the estimate. Ticks without a fresh truth are left out of what is taken from the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from groundstation import estimators, health
from groundstation.punctuality import timing
from groundstation.run import Array, Mask, Run, stretches
from onboard.messages import Phase

#: Table II of the paper, as printed: N, m, deg.
PAPER: dict[str, dict[str, float]] = {
    "force_rmse": {"est_des": 0.2093, "meas_des": 0.2038, "est_meas": 0.0397},
    "state_rmse": {
        "x": 0.0312,
        "y": 0.0001,
        "z": 0.0015,
        "phi": 0.0038,
        "theta": 0.0272,
        "psi": 0.0071,
        "theta_1": 0.0247,
        "theta_2": 0.1632,
        "theta_3": 0.3286,
    },
}
STATES = tuple(PAPER["state_rmse"])

#: A gap in the contact longer than this is a loss of contact, s.
BOUNCE_GAP = 0.010
_LANDING = (Phase.LAND, Phase.RETREAT_LAND)
_GROUNDED = (Phase.PREFLIGHT, Phase.ARMED, Phase.STOPPED)
_HOLDING = (Phase.HOLD, Phase.RETREAT_HOLD)
_IN_CONTACT = (Phase.ADVANCE, Phase.PRESS, Phase.RELEASE)


@dataclass(frozen=True)
class Windows:
    """Ranges of ticks; empty ones where the run did not come so far."""

    flight: slice
    contact: slice
    """Trigger to release."""
    touch: slice
    """First touch (truth) to release."""


def compute(run: Run, wall_s: float | None = None) -> dict[str, Any]:
    """Content of ``metrics.json``: N, m, s, deg, N m. ``None`` stands for what the run did not come to or cannot tell.

    wall_s: how long the run took on the wall clock, where that is known. What a tick of the estimators costs is read
    from beside the log.
    """
    window = windows(run)
    return {
        "outcome": outcome(run),
        "scenario": run.info.scenario,
        "law": run.info.law,
        "seed": run.info.seed,
        "plant": None if run.truth is None else run.config.world.plant.kind,
        "version": run.info.version,
        "sim_s": float(run.t[-1]),
        "wall_s": wall_s,
        "phases": phases(run),
        "force_rmse": _force_rmse(run, window.contact),
        "state_rmse": {"flight": _state_rmse(run, window.flight), "contact": _state_rmse(run, window.contact)},
        "estimators": estimators.compute(run, window.contact, estimators.read_costs(run.path)),
        "contact": _contact(run, window),
        "limits": _limits(run),
        "adhesive": _adhesive(run),
        "timing": timing(run),
        "health": health.compute(run),
        "paper": PAPER,
    }


def write(metrics: dict[str, Any], path: Path) -> None:
    """Write ``metrics.json``."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(metrics), indent=2) + b"\n")


def former_wall_s(path: Path) -> float | None:
    """Duration of the run on the wall clock as a ``metrics.json`` tells it, where there is one."""

    class Former(msgspec.Struct):
        wall_s: float | None = None

    try:
        return msgspec.json.decode(path.read_bytes(), type=Former).wall_s
    except (OSError, ValueError, RecursionError):
        return None


def windows(run: Run) -> Windows:
    """Find flight and contact in a run."""
    n = len(run.t)
    taking_off = np.flatnonzero(run.where(Phase.TAKEOFF))
    start = int(taking_off[-1]) + 1 if len(taking_off) else n
    landing = np.flatnonzero(run.where(*_LANDING, *_GROUNDED)[start:])
    end = start + int(landing[0]) if len(landing) else n
    pressing = np.flatnonzero(run.where(Phase.PRESS))
    contact = slice(int(pressing[0]), int(pressing[-1]) + 1) if len(pressing) else slice(n, n)
    touch = contact
    if run.truth is not None and len(pressing):
        near = np.flatnonzero(run.where(*_IN_CONTACT) & (run.truth.force > 0.0))
        if len(near):
            touch = slice(min(int(near[0]), contact.stop), contact.stop)
    return Windows(slice(start, end), contact, touch)


def phases(run: Run) -> list[dict[str, Any]]:
    """Name, start and end (s) of each phase in order."""
    starts = [0, *(np.flatnonzero(run.phase[1:] != run.phase[:-1]) + 1).tolist()]
    ends = [*starts[1:], len(run.t) - 1]
    return [
        {"name": str(run.phase[a]), "start": float(run.t[a]), "end": float(run.t[b])}
        for a, b in zip(starts, ends, strict=True)
    ]


def outcome(run: Run) -> str:
    """How the run ended.

    "completed": sleeve installed and landed as planned; "safe": not that, but on the ground or holding unharmed;
    "lost": the vehicle crashed or its motors were cut in the air; "unfinished": broken off in the middle.
    """
    truth = run.truth
    grounded = truth.on_ground if truth is not None else run.landed == "on_ground"
    if truth is not None and truth.crashed:
        return "lost"
    if run.phase[-1] == Phase.STOPPED and not grounded:
        return "lost"
    if not run.complete or not (grounded or run.phase[-1] in _HOLDING):
        return "unfinished"
    installed = truth.sleeve_on_pipe if truth is not None else bool(run.payload[0]) and not bool(run.payload[-1])
    order = [phase["name"] for phase in phases(run)]
    planned = Phase.RETREAT_LAND not in order and Phase.RETREAT_HOLD not in order
    return "completed" if installed and planned and Phase.RETURN in order and grounded else "safe"


def _known(run: Run, span: slice) -> Mask:
    """The ticks of a window that can be judged."""
    known = np.zeros(len(run.t), dtype=np.bool_)
    known[span] = True if run.truth is None else run.truth.known[span]
    return known


def _rmse(error: Array) -> float | None:
    return float(np.sqrt(np.mean(error * error))) if error.size and np.isfinite(error).all() else None


def _wrap(angle: Array) -> Array:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _force_rmse(run: Run, span: slice) -> dict[str, float | None]:
    own = {"est_des": _rmse(run.force_est[span] - run.force_des[span])}
    if run.truth is None:
        return {**own, "meas_des": None, "est_meas": None}
    known = _known(run, span)
    desired, estimated, measured = run.force_des[known], run.force_est[known], run.truth.force[known]
    return {**own, "meas_des": _rmse(measured - desired), "est_meas": _rmse(estimated - measured)}


def _state_rmse(run: Run, span: slice) -> dict[str, float | None]:
    error, known = state_errors(run), _known(run, span)
    return {name: _rmse(error[name][known]) for name in STATES}


def state_errors(run: Run) -> dict[str, Array]:
    """Followed reference less the state, for each of the nine states: m and deg, (n,) each."""
    actual = run.truth if run.truth is not None else run
    errors = np.concatenate(
        (
            run.p_ref - actual.p,
            np.degrees(_wrap(run.attitude_ref - actual.rpy)),
            np.degrees(_wrap(run.joints_ref - actual.joints)),
        ),
        axis=1,
    )
    return dict(zip(STATES, errors.T, strict=True))


def _contact(run: Run, window: Windows) -> dict[str, Any]:
    truth, span = run.truth, window.contact
    force = truth.force if truth is not None else run.force_est
    peak = truth.peak if truth is not None else run.force_est
    wanted = run.config.repair.force
    pressed, t = force[span], run.t[span]
    hold = pressed[(run.force_des[span] >= 0.999 * wanted) & np.isfinite(pressed)]
    reached = np.flatnonzero(pressed >= 0.95 * wanted)
    touched = window.touch.stop > window.touch.start
    gaps, press_gaps = (_gaps(run, of) for of in (window.touch, span))
    return {
        "source": "truth" if truth is not None else "estimate",
        "peak": _largest(peak[: span.stop]) if touched else None,
        "touchdown_peak": _largest(peak[window.touch.start : _settled(run, window)]) if touched else None,
        "hold_mean": float(np.mean(hold)) if hold.size else None,
        "hold_std": float(np.std(hold)) if hold.size else None,
        "overshoot": max(0.0, _largest(peak[span]) - wanted) if pressed.size else None,
        "time_to_95": float(t[reached[0]] - t[0]) if reached.size else None,
        "tip_slip": _largest(truth.slip[: span.stop]) - _largest(truth.slip[: max(1, window.touch.start)])
        if truth is not None and touched
        else None,
        "bounces": len(gaps) if truth is not None and touched else None,
        "longest_gap": max(gaps, default=0.0) if truth is not None and touched else None,
        "press_gap": max(press_gaps, default=0.0) if truth is not None and pressed.size else None,
        "time_without_contact": float(sum(gaps)) if truth is not None and touched else None,
    }


def _largest(values: Array) -> float:
    """The largest known value; 0 when none is known."""
    return float(np.max(values[np.isfinite(values)], initial=0.0))


def _settled(run: Run, window: Windows) -> int:
    """First tick at which the desired force rises above its value at the trigger: the end of the touchdown."""
    desired = run.force_des[window.contact]
    rising = np.flatnonzero(desired > desired[0] + 0.01 * run.config.repair.force)
    start: int = window.contact.start
    return start + int(rising[0]) if rising.size else int(window.contact.stop)


def _gaps(run: Run, span: slice) -> list[float]:
    """Durations (s) of the losses of contact longer than ``BOUNCE_GAP``; none where the truth is not known."""
    if run.truth is None:
        return []
    t = run.t[span]
    period = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    lengths = stretches(run.truth.force[span] <= 0.0) * period
    return [float(length) for length in lengths if length > BOUNCE_GAP]


def _limits(run: Run) -> dict[str, Any]:
    vehicle = run.config.vehicle
    bounds = {"thrust_limit": vehicle.rotors.max_thrust, "torque_limit": vehicle.servo.stall_torque}
    if run.truth is None:
        return {"thrust_max": None, "torque_max": None, "thrust_by_rotor": None, "torque_by_joint": None, **bounds}
    thrust = np.max(run.truth.thrust[run.truth.known], axis=0, initial=0.0)
    torque = np.max(np.abs(run.truth.torque[run.truth.known]), axis=0, initial=0.0)
    return {
        "thrust_max": float(thrust.max()),
        "torque_max": float(torque.max()),
        "thrust_by_rotor": thrust.tolist(),
        "torque_by_joint": torque.tolist(),
        **bounds,
    }


def plane(run: Run, points: Array) -> tuple[Array, Array, Array]:
    """Points (n, 3) in W as seen from the pipe: ahead of its axis along the heading, up, and off the plane, m."""
    pipe = run.config.pipe
    heading = np.radians(pipe.heading_deg)
    offset = points - np.array(pipe.position)
    ahead = offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading)
    aside = offset[:, 1] * np.cos(heading) - offset[:, 0] * np.sin(heading)
    return ahead, offset[:, 2], aside


def _adhesive(run: Run) -> dict[str, float | None]:
    if run.truth is None or not (chosen := run.dispensing & run.truth.known).any():
        return {"arc_deg": None, "path_error_rms": None}
    ahead, up, aside = plane(run, run.truth.needle[chosen])
    angle = np.unwrap(np.arctan2(up, -ahead))
    radial = np.hypot(ahead, up) - (run.config.pipe.radius + run.config.plan.needle_gap)
    return {"arc_deg": float(np.degrees(np.ptp(angle))), "path_error_rms": _rmse(np.hypot(radial, aside))}
