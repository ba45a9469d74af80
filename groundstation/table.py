"""Table II of the paper beside a run: the rows, for the terminal and for the report."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from groundstation.metrics import PAPER
from groundstation.punctuality import MISSED_ALLOWED

#: What is asked of a good contact: hold within (N), touchdown peak (N), tip slip (m).
HOLD, TOUCHDOWN, SLIP = 0.03, 3.0, 0.005
#: Symbols of the nine states.
SYMBOLS = {
    "x": "x",
    "y": "y",
    "z": "z",
    "phi": "φ",
    "theta": "θ",
    "psi": "ψ",
    "theta_1": "θ₁",
    "theta_2": "θ₂",
    "theta_3": "θ₃",
}
FORCES = {
    "est_des": "F est vs des",
    "meas_des": "F meas vs des",
    "est_meas": "F est vs meas",
}


class Row(NamedTuple):
    """One line: RMSE of a force or a state."""

    label: str
    unit: str
    paper: float
    value: float | None
    """The run's figure: contact window for forces, flight window for states."""
    in_contact: float | None
    """The same over the contact window (states only)."""

    @property
    def better(self) -> bool | None:
        """At or below the paper's figure, as printed; None when there is nothing to compare."""
        return None if self.value is None else self.value <= self.paper

    @property
    def verdict(self) -> str:
        """In words, with the ratio."""
        if self.value is None:
            return "no value"
        if self.better:
            ratio = self.paper / self.value if self.value > 0.0 else float("inf")
            return f"better, {ratio:.3g}x" if ratio < 1000.0 else "better, >1000x"
        return f"worse, {self.value / self.paper:.3g}x"


class Figure(NamedTuple):
    """One more figure of a run."""

    label: str
    value: str
    detail: str = ""
    good: bool | None = None
    """Meets what is asked of the tuned law; None where nothing is asked."""


def name(metrics: dict[str, Any]) -> str:
    """What tells a run from others."""
    plant = f", {metrics['plant']}" if metrics["plant"] not in (None, "rigid") else ""
    return f"scenario {metrics['scenario']}, law {metrics['law']}, seed {metrics['seed']}{plant}"


def rows(metrics: dict[str, Any]) -> list[Row]:
    """The twelve rows of Table II."""
    force, state = metrics["force_rmse"], metrics["state_rmse"]
    forces = [Row(label, "N", PAPER["force_rmse"][key], force[key], None) for key, label in FORCES.items()]
    states = [
        Row(SYMBOLS[key], "m" if key in "xyz" else "deg", paper, state["flight"][key], state["contact"][key])
        for key, paper in PAPER["state_rmse"].items()
    ]
    return forces + states


def figures(metrics: dict[str, Any], force: float) -> list[Figure]:
    """Contact, limits and adhesive of a run that pressed with ``force`` N."""
    return list(_figures(metrics, force))


def _figures(metrics: dict[str, Any], force: float) -> Iterator[Figure]:
    contact, limits, adhesive = metrics["contact"], metrics["limits"], metrics["adhesive"]
    mean, spread = contact["hold_mean"], contact["hold_std"]
    if mean is not None:
        yield Figure("hold", f"{mean:.3f} N", f"set {force:g} N, deviation {spread:.4f} N", abs(mean - force) <= HOLD)
    if (peak := contact["touchdown_peak"]) is not None:
        yield Figure("touchdown peak", f"{peak:.2f} N", "", peak <= TOUCHDOWN)
    if (over := contact["overshoot"]) is not None:
        yield Figure("overshoot", f"{over:.3f} N", f"{100 * over / force:.1f} % of the set force")
    if (rise := contact["time_to_95"]) is not None:
        yield Figure("time to 95 %", f"{rise:.2f} s", "from the trigger")
    if (bounces := contact["bounces"]) is not None:
        lost = f"{1000 * contact['time_without_contact']:.0f} ms without contact" if bounces else ""
        yield Figure("bounces", f"{bounces}", lost, bounces == 0)
    if (slip := contact["tip_slip"]) is not None:
        yield Figure("tip slip", f"{1000 * slip:.2f} mm", "", slip <= SLIP)
    if (thrust := limits["thrust_max"]) is not None:
        bound = limits["thrust_limit"]
        yield Figure("largest rotor thrust", f"{thrust:.2f} N", f"limit {bound:g} N", thrust <= bound)
    if (torque := limits["torque_max"]) is not None:
        bound = limits["torque_limit"]
        yield Figure("largest joint torque", f"{torque:.3f} N m", f"limit {bound:g} N m", torque <= bound)
    if (arc := adhesive["arc_deg"]) is not None:
        yield Figure("adhesive", f"{arc:.0f}°", f"path error {1000 * adhesive['path_error_rms']:.2f} mm RMS")
    if (late := metrics["timing"]["late"]) is not None:
        detail = f"p99 {1000 * late['p99']:.2f} ms, max {1000 * late['max']:.1f} ms"
        yield Figure("median lateness of the loop", f"{1000 * late['median']:.2f} ms", detail)
    if (missed := metrics["timing"]["missed"]) is not None:
        share = f"{100 * missed['share']:.3f} % of the ticks owed"
        yield Figure("missed ticks", f"{missed['count']}", share, missed["share"] < MISSED_ALLOWED)
