"""The figures of the report: those of the paper for this run, and what else a person wants to see of it."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

import numpy as np

from groundstation import punctuality
from groundstation.metrics import phases, plane, windows
from groundstation.run import ESTIMATORS, Array, Mask, Run
from groundstation.svg import Chart, Range, ticks
from onboard.messages import Phase

#: Seconds shown before and after the contact.
_MARGIN = 4.0
#: Pictures of single late ticks show the largest value of each stretch of so many seconds.
_STRETCH = 0.5
_SERVOS = ("θ₁", "θ₂", "θ₃", "pump", "gripper")
#: Kind of a phase, which chooses its colour.
_KINDS = {
    Phase.PREFLIGHT: "ground",
    Phase.ARMED: "ground",
    Phase.STOPPED: "ground",
    Phase.ADHESIVE: "adhesive",
    Phase.ADVANCE: "contact",
    Phase.PRESS: "contact",
    Phase.RELEASE: "contact",
    Phase.HOLD: "safe",
    Phase.RETREAT_HOLD: "safe",
    Phase.RETREAT_LAND: "safe",
}


def whole(run: Run) -> Range:
    """The whole run, s."""
    return (0.0, max(float(run.t[-1]), 1e-3))


def around_contact(run: Run) -> Range:
    """The contact with a few seconds about it, s; the whole run when there was none."""
    span = windows(run).contact
    if span.start == span.stop:
        return whole(run)
    low, high = whole(run)
    return (max(low, float(run.t[span.start]) - _MARGIN), min(high, float(run.t[span.stop - 1]) + _MARGIN))


def tracking(run: Run) -> list[Chart]:
    """Figure 5: force, pitch, x and theta_3 about the contact."""
    x, t = around_contact(run), run.t
    state = run.truth if run.truth is not None else run
    force = _contact(run, Chart("(a) contact force", "N", x))
    if run.truth is not None:
        force.line(t, run.truth.force, "measured", "c2 broad")
    force.line(t, run.force_est, "estimated", "c1").line(t, run.force_des, "desired", "ref")
    pitch = _contact(run, Chart("(b) pitch θ", "deg", x))
    pitch.line(t, np.degrees(state.rpy[:, 1]), "θ", "c1").line(t, np.degrees(run.attitude_ref[:, 1]), "followed", "ref")
    place = _contact(run, Chart("(c) position x", "m", x))
    place.line(t, state.p[:, 0], "x", "c1").line(t, run.p_ref[:, 0], "followed", "ref")
    joint = _contact(run, Chart("(d) joint θ₃", "deg", x))
    joint.line(t, np.degrees(state.joints[:, 2]), "θ₃", "c1")
    joint.line(t, np.degrees(run.joints_ref[:, 2]), "followed", "ref")
    return [force, pitch, place, joint]


def estimation(run: Run) -> list[Chart]:
    """Figure 6: estimated against measured force, and their difference in contact."""
    if run.truth is None:
        return []
    x, t = around_contact(run), run.t
    both = _contact(run, Chart("estimated and measured contact force", "N", x, width=950))
    both.line(t, run.truth.force, "measured", "c2 broad").line(t, run.force_est, "estimated", "c1")
    error = Chart("estimated less measured, in contact", "N", x, width=950, height=150)
    span = windows(run).contact
    error.line(t[span], (run.force_est - run.truth.force)[span], "", "c1")
    return [both, _contact(run, error)]


def estimators(run: Run) -> list[Chart]:
    """What each force estimator reads, about the contact."""
    if not run.forces:
        return []
    chart = _contact(run, Chart("compression by each estimator", "N", around_contact(run), width=950))
    if run.truth is not None:
        chart.line(run.t, run.truth.force, "measured", "c2 broad")
    for name, style in zip(ESTIMATORS, ("c1", "c3", "c4", "ref"), strict=True):
        chart.line(run.t, run.forces[name], name, style)
    return [chart]


def actuation(run: Run) -> list[Chart]:
    """Figure 7: rotor thrusts and joint torques with their limits."""
    if run.truth is None:
        return []
    x, vehicle = whole(run), run.config.vehicle
    thrust = _contact(run, Chart("(a) rotor thrusts", "N", x, width=950))
    for i, name in enumerate(("front right", "rear left", "front left", "rear right")):
        thrust.line(run.t, run.truth.thrust[:, i], name, f"c{i + 1}")
    limit = vehicle.rotors.max_thrust
    thrust.limit(limit, f"limit {limit:g} N")
    torque = _contact(run, Chart("(b) joint torques", "N m", x, width=950))
    for i, name in enumerate(("θ₁", "θ₂", "θ₃")):
        torque.line(run.t, run.truth.torque[:, i], name, f"c{i + 1}")
    limit = vehicle.servo.stall_torque
    torque.limit(limit, f"limit {limit:g} N m").limit(-limit, "")
    return [thrust, torque]


def at_the_pipe(run: Run) -> list[Chart]:
    """The tools in the plane of the arm, to scale; how far the needle and the pressed sleeve leave their paths."""
    if run.truth is None:
        return []
    radius = 1000.0 * run.config.pipe.radius
    gap = 1000.0 * run.config.plan.needle_gap
    reach = radius + 60.0
    drawing = Chart(
        "tools and pipe in the plane of the arm",
        "mm",
        (-reach - 40.0, radius + 20.0),
        y=(-reach, reach),
        x_label="ahead of the pipe's axis, mm",
        equal=True,
        thinned=False,
    )
    drawing.circle(0.0, 0.0, radius, "pipe").circle(0.0, 0.0, radius + gap, "path")
    _trace(run, drawing, run.truth.needle, run.where(Phase.ADHESIVE) & ~run.dispensing, "needle", "c3 faint")
    _trace(run, drawing, run.truth.needle, run.dispensing, "dispensing", "c3 thick")
    near = run.where(Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT)
    _trace(run, drawing, run.truth.tip, near, "sleeve tip", "c2")
    charts = [drawing]
    dispensing = run.dispensing & run.truth.known
    if dispensing.any():
        ahead, up, aside = (1000.0 * values[dispensing] for values in plane(run, run.truth.needle))
        t = run.t[dispensing]
        errors = Chart("needle off its path while dispensing", "mm", (float(t[0]), float(t[-1])))
        errors.line(t, np.hypot(ahead, up) - radius - gap, "outwards", "c1").line(t, aside, "along the axis", "c3")
        charts.append(errors)
    touching = np.zeros(len(run.t), dtype=np.bool_)
    touching[windows(run).touch] = True
    span = np.flatnonzero(touching & run.truth.known)
    if len(span) > 1:
        ahead, up, aside = (1000.0 * values[span] for values in plane(run, run.truth.tip))
        t = run.t[span]
        drift = Chart("sleeve on the pipe, against touchdown", "mm", (float(t[0]), float(t[-1])))
        drift.line(t, up - up[0], "up the surface", "c1")
        drift.line(t, aside - aside[0], "along the axis", "c3")
        drift.line(t, ahead - ahead[0], "into the pipe", "c2")
        charts.append(drift)
    return charts


def punctual(run: Run) -> list[Chart]:
    """How punctual a wall-clock run was: the ticks, what they had, and what they sent."""
    if not np.isfinite(run.late).any():
        return []
    x, t = whole(run), run.t
    kinds = {**run.ages, "set-point": punctuality.setpoint_ages(run)}
    periods = Chart("from tick to tick", "ms", x)
    periods.line(t[1:], 1000.0 * punctuality.periods(run), "", "c1")
    worst = Chart(f"largest in each {_STRETCH:g} s", "ms", x)
    worst.line(*_largest(t, 1000.0 * run.late), "lateness of a tick", "c2")
    worst.line(*_largest(t, 1000.0 * run.busy), "its duration", "c1")
    oldest = Chart(f"oldest in each {_STRETCH:g} s: samples at a tick, set-points as they left", "ms", x)
    for i, (name, values) in enumerate(kinds.items()):
        oldest.line(*_largest(t, 1000.0 * values), name, f"c{i + 1}")
    return [_lateness(run), _older(kinds), periods, worst, oldest]


def _lateness(run: Run) -> Chart:
    """A histogram; a tick that is less late than its left edge is counted in the first bar."""
    late = 1000.0 * run.late[np.isfinite(run.late)]
    low, high = 0.01, _decade_above(float(late.max()))
    edges = np.geomspace(low, high, 10 * round(np.log10(high / low)) + 1)
    counts, _ = np.histogram(np.clip(late, low, high), bins=edges)
    chart = Chart("lateness of the ticks", "ticks", (low, high), log="xy", x_label="late by, ms")
    for start, end, count in zip(edges[:-1].tolist(), edges[1:].tolist(), counts.tolist(), strict=True):
        chart.bar(start, end, float(count), f"late by {start:.3g} to {end:.3g} ms: {count} ticks")
    period = 1000.0 * float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0
    return chart.mark(period, "one period") if low < period < high else chart


def _older(kinds: dict[str, Array]) -> Chart:
    """Share of the ticks at which each age was exceeded."""
    finite = {name: np.sort(1000.0 * values[np.isfinite(values)]) for name, values in kinds.items()}
    top = _decade_above(max((float(values[-1]) for values in finite.values() if values.size), default=1.0))
    chart = Chart("how many of them are older, of samples and set-points", "%", (0.1, top), log="xy", x_label="age, ms")
    for i, (name, values) in enumerate(finite.items()):
        chart.line(values, 100.0 * (1.0 - np.arange(len(values)) / max(1, len(values))), name, f"c{i + 1}")
    return chart


def processor(run: Run) -> list[Chart]:
    """Share of a core that each part of the flight process took."""
    values = {name: told for name, told in punctuality.device_values(run).items() if name.startswith(punctuality.CPU)}
    top = max((100.0 * float(np.nanmax(share)) for _, share in values.values()), default=1.0)
    words = "processor time of the flight process by part, of one core"
    chart = Chart(words, "%", whole(run), y=(0.0, 1.1 * top), width=950, height=200)
    for i, (name, (t, share)) in enumerate(values.items()):
        chart.line(t, 100.0 * share, name[len(punctuality.CPU) :], f"c{i % 6 + 1}")
    return [chart] if values else []


def servos(run: Run) -> list[Chart]:
    """Current and temperature of each servo."""
    if not np.isfinite(run.health.temperature).any():
        return []
    current = Chart(f"largest current in each {_STRETCH:g} s", "A", whole(run))
    temperature = Chart("temperature", "degC", whole(run))
    for i, name in enumerate(_SERVOS):
        current.line(*_largest(run.t, np.abs(run.health.current[:, i])), name, f"c{i + 1}")
        temperature.line(*_largest(run.t, run.health.temperature[:, i]), name, f"c{i + 1}")
    return [current, temperature]


def vision(run: Run) -> list[Chart]:
    """The tracker's own confidence, and how far its vertical is from the autopilot's."""
    if not np.isfinite(run.health.confidence).any():
        return []
    confidence = Chart(f"least confidence in each {_STRETCH:g} s", "of 3", whole(run), y=(-0.1, 3.1))
    t, lost = _largest(run.t, 3.0 - run.health.confidence)
    lean = Chart("largest angle between the verticals of tracker and autopilot", "deg", whole(run))
    lean.line(*_largest(run.t, np.degrees(run.health.lean)), "", "c1")
    return [confidence.line(t, 3.0 - lost, "", "c2"), lean]


def link(run: Run) -> list[Chart]:
    """How long ago the commanding station was certainly there."""
    if not np.isfinite(run.health.link_age).any():
        return []
    words = f"age of the newest word of the commanding station, largest in each {_STRETCH:g} s"
    return [Chart(words, "s", whole(run), width=950, height=180).line(*_largest(run.t, run.health.link_age), "", "c1")]


def _decade_above(value: float) -> float:
    """The power of ten at or above a value, and at least 10."""
    return float(10.0 ** np.ceil(np.log10(max(value, 10.0))))


def _largest(t: Array, values: Array) -> tuple[Array, Array]:
    """The middle and the largest value of each stretch of ``_STRETCH`` s; stretches without a value are left out."""
    finite = np.isfinite(values)
    if not finite.any():
        return t[:0], values[:0]
    stretch = np.floor(t[finite] / _STRETCH)
    first = np.flatnonzero(np.diff(stretch, prepend=-1.0))
    return (stretch[first] + 0.5) * _STRETCH, np.maximum.reduceat(values[finite], first)


def timeline(run: Run) -> str:
    """The phases of the run as one band, an ``<svg>`` element."""
    return "".join(_timeline(run))


def _timeline(run: Run) -> Iterator[str]:
    width, left = 950.0, 8.0
    low, high = whole(run)
    scale = (width - 2 * left) / (high - low)
    yield f'<svg class="chart" viewBox="0 0 {width:.0f} 78" role="img" aria-label="phases">'
    for i, phase in enumerate(phases(run)):
        x, w = left + phase["start"] * scale, (phase["end"] - phase["start"]) * scale
        name = phase["name"].replace("_", " ")
        words = f"{name}: {phase['start']:.1f} to {phase['end']:.1f} s"
        yield f'<g class="phase {_KINDS.get(phase["name"], "flight")}"><title>{escape(words)}</title>'
        yield f'<rect x="{x:.1f}" y="6" width="{w:.1f}" height="30"/>'
        if w > 6.5 * len(name):
            yield f'<text class="name" x="{x + w / 2:.1f}" y="25">{escape(name)}</text>'
        else:
            # Names of short phases stand below, on two levels so that neighbours keep apart.
            y = 47 if i % 2 else 57
            yield f'<path class="grid" d="M{x + w / 2:.1f} 36V{y - 7}"/>'
            half = 2.7 * len(name)
            middle = min(max(x + w / 2, half), width - half)
            yield f'<text class="small" x="{middle:.1f}" y="{y}">{escape(name)}</text>'
        yield "</g>"
    for value in ticks(low, high, 12)[0]:
        yield f'<text class="tick mid" x="{left + value * scale:.1f}" y="74">{value:g} s</text>'
    yield "</svg>"


def _contact(run: Run, chart: Chart) -> Chart:
    span = windows(run).contact
    if span.stop > span.start:
        chart.band(float(run.t[span.start]), float(run.t[span.stop - 1]), "trigger to release")
    return chart


def _trace(run: Run, chart: Chart, points: Array, chosen: Mask, label: str, style: str) -> None:
    """Draw the path of a point in the plane of the arm where it is chosen, one line for each stretch."""
    rows = np.flatnonzero(chosen)
    for stretch in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        if len(stretch):
            ahead, up, _ = plane(run, points[stretch[:: max(1, len(rows) // 600)]])
            chart.line(1000.0 * ahead, 1000.0 * up, label, style)
            label = ""
