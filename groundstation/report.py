"""``report.html``: one page, complete in itself, that shows what happened in a run."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

from groundstation import estimators, figures, film, health, punctuality, table
from groundstation.run import Run
from groundstation.svg import Chart
from onboard.messages import Severity

_HERE = Path(__file__).parent
_BADGES = {
    "completed": ("good", "✓ completed"),
    "safe": ("warn", "△ ended safely, not completed"),
    "unfinished": ("warn", "△ broken off"),
    "lost": ("bad", "✗ vehicle lost"),
}


def write(run: Run, metrics: dict[str, Any], path: Path, beside: Sequence[dict[str, Any]] = ()) -> None:
    """Write the report of a run.

    ``metrics`` is what ``metrics.compute`` gave for it, ``beside`` the same of other runs to show in the table.
    """
    path.write_text("".join(_page(run, metrics, beside)), encoding="utf-8")


def _page(run: Run, metrics: dict[str, Any], beside: Sequence[dict[str, Any]]) -> Iterator[str]:
    info = run.info
    title = f"Pipe repair: {info.scenario}, {info.law}, seed {info.seed}"
    kind, words = _BADGES[metrics["outcome"]]
    yield '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<title>{escape(title)}</title><style>{(_HERE / 'report.css').read_text(encoding='utf-8')}</style></head>"
    yield f'<body><main><header><h1>Pipe repair</h1><span class="badge {kind}">{words}</span></header>'
    yield f'<p class="soft">{_summary(run, metrics)}</p>'
    yield from _cards(run, metrics)
    yield "<h2>Phases</h2>"
    yield figures.timeline(run)
    yield from _table(metrics, beside)
    note = "The shaded stretch is the contact, from trigger to release. Point at a chart to read values."
    yield from _figure("Tracking in contact (figure 5)", note, figures.tracking(run), pair=True)
    yield from _figure(
        "Force estimate (figure 6)", "Compression of the pipe is positive.", figures.estimation(run), pair=False
    )
    yield from _estimators(run, metrics)
    note = "What the rotors and the servos really gave, over the whole run."
    yield from _figure("Actuation (figure 7)", note, figures.actuation(run), pair=False)
    note = "The drawing is to scale, with the vehicle to the left; the broken circle is the needle's path."
    yield from _figure("At the pipe", note, figures.at_the_pipe(run), pair=True)
    yield from _film(run.path.parent / film.FOLDER)
    yield from _health(run, metrics)
    yield from _timing(run, metrics)
    yield from _events(run)
    yield "<h2>Configuration</h2><details><summary>all that was in force at the start</summary>"
    yield f"<pre>{escape(run.config_yaml)}</pre></details>"
    yield f"<footer>Pipewright {escape(info.version)}</footer></main>"
    yield f"<script>{(_HERE / 'report.js').read_text(encoding='utf-8')}</script></body></html>\n"


def _summary(run: Run, metrics: dict[str, Any]) -> str:
    info, pipe = run.info, run.config.pipe
    world = "real time" if info.realtime else "simulated"
    took = f" in {metrics['wall_s']:.1f} s of wall clock" if metrics["wall_s"] is not None and not info.realtime else ""
    begun = f", begun {info.started}" if info.started else ""
    text = (
        f"Scenario {info.scenario}, law {info.law}, seed {info.seed}; {metrics['sim_s']:.1f} s {world}{took}{begun}. "
        f"Pipe of radius {1000 * pipe.radius:g} mm at ({', '.join(f'{v:g}' for v in pipe.position)}) m, "
        f"heading {pipe.heading_deg:g}°; set force {run.config.repair.force:g} N."
    )
    return escape(text)


def _cards(run: Run, metrics: dict[str, Any]) -> Iterator[str]:
    yield '<div class="cards">'
    for row in table.rows(metrics)[:3]:
        if row.value is not None:
            yield _card(f"{row.value:.4f} N", f"{row.label}, RMSE (paper {row.paper:g} N)", row.better)
    for figure in table.figures(metrics, run.config.repair.force):
        label = f"{figure.label} ({figure.detail})" if figure.detail else figure.label
        yield _card(figure.value, label, figure.good)
    yield "</div>"


def _card(value: str, label: str, good: bool | None) -> str:
    kind = {True: ' class="good"', False: ' class="bad"', None: ""}[good]
    mark = {True: " ✓", False: " ✗", None: ""}[good]
    return f'<div class="card"><b{kind}>{escape(value)}{mark}</b><span>{escape(label)}</span></div>'


def _table(metrics: dict[str, Any], beside: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield "<h2>Table II, side by side</h2>"
    yield (
        '<p class="note">Root mean square errors: forces from trigger to release; states against the reference '
        "that the loop follows, from the end of takeoff to the start of landing, and in contact alone.</p>"
    )
    yield '<div class="scroll"><table><tr><th></th><th class="n">paper</th><th class="n">this run</th>'
    yield '<th class="n">in contact</th><th>unit</th><th>verdict</th>'
    yield "".join(f'<th class="n">{escape(table.name(other))}</th>' for other in beside) + "</tr>"
    others = [table.rows(other) for other in beside]
    for i, row in enumerate(table.rows(metrics)):
        if i in (0, 3):
            yield f'<tr class="group"><th colspan="{6 + len(beside)}">{"states" if i else "forces"}</th></tr>'
        value, contact = (f"{v:.5f}" if v is not None else "" for v in (row.value, row.in_contact))
        mark = {True: '<span class="good">▲ ', False: '<span class="bad">▼ ', None: '<span class="soft">'}[row.better]
        yield (
            f'<tr><td>{escape(row.label)}</td><td class="n">{row.paper:.4f}</td><td class="n">{value}</td>'
            f'<td class="n">{contact}</td><td>{row.unit}</td><td>{mark}{escape(row.verdict)}</span></td>'
        )
        values = (rows[i].value for rows in others)
        yield "".join(f'<td class="n">{v:.5f}</td>' if v is not None else "<td></td>" for v in values) + "</tr>"
    yield "</table></div>"


def _estimators(run: Run, metrics: dict[str, Any]) -> Iterator[str]:
    told = metrics["estimators"]
    if told is None:
        return
    yield from _figure("Force estimators, side by side", estimators.words(told), figures.estimators(run), pair=False)
    yield '<div class="scroll"><table><tr><th></th>'
    yield "".join(f'<th class="n">{heading}</th>' for heading in estimators.HEADINGS) + "</tr>"
    for label, cells in estimators.rows(told):
        yield f"<tr><td>{escape(label)}</td>" + "".join(f'<td class="n">{cell}</td>' for cell in cells) + "</tr>"
    yield "</table></div>"


def _figure(heading: str, note: str, charts: list[Chart], *, pair: bool) -> Iterator[str]:
    if charts:
        yield f"<h2>{escape(heading)}</h2>" + (f'<p class="note">{escape(note)}</p>' if note else "")
        yield '<div class="pair">' if pair else "<div>"
        for chart in charts:
            yield f"<div{' class=drawing' if chart.equal else ''}>{chart.svg()}</div>"
        yield "</div>"


def _film(folder: Path) -> Iterator[str]:
    """What ``pipewright film`` has made of the run, if it has."""
    pictures = [(folder / name, words) for name, words in ((film.FILM, "the mission"), (film.SHEET, "its phases"))]
    found = [(path, words) for path, words in pictures if path.is_file()]
    if found:
        yield "<h2>Film</h2>"
    for path, words in found:
        data = b64encode(path.read_bytes()).decode()
        yield f'<p><img alt="{words}" style="max-width:100%" src="data:image/{path.suffix[1:]};base64,{data}"></p>'


def _health(run: Run, metrics: dict[str, Any]) -> Iterator[str]:
    servos, vision, link = (metrics["health"][part] for part in ("servos", "vision", "link"))
    if servos is not None:
        yield from _figure("Servos", "", figures.servos(run), pair=True)
        yield from _servo_table(servos)
    if vision is not None:
        shares = ", ".join(f"{level} for {100 * share:.1f} %" for level, share in vision["confidence"].items() if share)
        jumps = f"its frame jumped {vision['jumps']} times" if vision["jumps"] else "its frame never jumped"
        note = f"The tracker's confidence (of 3) was {shares} of the ticks; {jumps}."
        yield from _figure("Vision", note, figures.vision(run), pair=True)
    if link is not None:
        age = link["age"]
        note = (
            f"Commanded by {', then '.join(link['commanders'])}. The newest word was at most {age['max']:.2f} s old "
            f"(median {age['median']:.2f} s); older than {health.SILENT:g} s for {link['silent_s']:.1f} s in all, and "
            f"nobody was connected for {link['absent_s']:.1f} s of it."
        )
        yield from _figure("Link", note, figures.link(run), pair=False)


def _servo_table(servos: dict[str, dict[str, Any]]) -> Iterator[str]:
    headings = ("largest current, A", "its RMS, A", "supply, V", "warmest, degC")
    yield "<table><tr><th></th>" + "".join(f'<th class="n">{words}</th>' for words in headings) + "<th>errors</th></tr>"
    for name, told in servos.items():
        supply = f"{told['voltage_min']:.1f} to {told['voltage_max']:.1f}"
        cells = (f"{told['current_max']:.2f}", f"{told['current_rms']:.2f}", supply, f"{told['temperature_max']:.0f}")
        errors = f'<td class="bad">✗ {escape(told["errors"])}</td>' if told["errors"] else "<td>none</td>"
        yield (
            f"<tr><td>{escape(name)}</td>" + "".join(f'<td class="n">{cell}</td>' for cell in cells) + errors + "</tr>"
        )
    yield "</table>"


def _timing(run: Run, metrics: dict[str, Any]) -> Iterator[str]:
    timing = metrics["timing"]
    if timing["late"] is None:
        return
    yield "<h2>Punctuality</h2>"
    if (missed := timing["missed"]) is not None:
        words = (
            f"{missed['count']} of the ticks owed were missed ({100 * missed['share']:.3f} %): {missed['late']} began "
            f"more than one period ({1000 * missed['period']:g} ms) late, {missed['skipped']} never began. "
            "Ages are those of the newest sample at each tick; that of a set-point counts from the attitude it answers "
            "until it had left."
        )
        yield f'<p class="note">{escape(words)}</p>'
    if timing["missing_ticks"]:
        yield f'<p class="note">{timing["missing_ticks"]} ticks are missing in the log.</p>'
    if timing["without_truth"]:
        yield f'<p class="note">{timing["without_truth"]} ticks have no truth of the world beside them.</p>'
    headings = "".join(f'<th class="n">{words}</th>' for words in ("rate, Hz", "median, ms", "p99, ms", "max, ms"))
    yield f"<table><tr><th></th>{headings}</tr>"
    rows: list[tuple[str, str, dict[str, float] | None]] = [
        ("lateness of the tick", "tick", timing["late"]),
        ("from tick to tick", "", timing["period"]),
        ("tick begun to set-point sent", "", timing["sent"]),
        ("duration of the tick", "", timing["busy"]),
        *((f"age of {name}", name, spread) for name, spread in timing["ages"].items()),
        ("age of a set-point as it left", "", timing["setpoint_age"]),
    ]
    for label, rate, spread in rows:
        hertz = f"{timing['rates'][rate]:.1f}" if rate else ""
        cells = "".join(
            f'<td class="n">{1000 * spread[key]:.2f}</td>' if spread else '<td class="n"></td>'
            for key in ("median", "p99", "max")
        )
        yield f'<tr><td>{escape(label)}</td><td class="n">{hertz}</td>{cells}</tr>'
    yield "</table>"
    yield '<div class="pair">' + "".join(f"<div>{chart.svg()}</div>" for chart in figures.punctual(run)) + "</div>"
    yield from (chart.svg() for chart in figures.processor(run))
    shares = {f"{punctuality.CPU}{part}": told for part, told in timing["cpu"].items()}
    yield from _devices("Processor", "share of one core", shares, 100.0, " %")
    yield from _devices("Devices", "as reported once a second; times in s, rates in Hz", timing["devices"])


def _devices(
    heading: str, note: str, values: dict[str, dict[str, float] | None], scale: float = 1.0, unit: str = ""
) -> Iterator[str]:
    """What a run reported about itself once a second."""
    if not values:
        return
    keys = ("min", "median", "max", "last")
    yield f"<details><summary>{heading}: {note}</summary><table><tr><th></th>"
    yield "".join(f'<th class="n">{key}</th>' for key in keys) + "</tr>"
    for name, told in values.items():
        cells = (f"{scale * told[key]:.4g}{unit}" if told else "" for key in keys)
        yield f"<tr><td>{escape(name)}</td>" + "".join(f'<td class="n">{cell}</td>' for cell in cells) + "</tr>"
    yield "</table></details>"


def _events(run: Run) -> Iterator[str]:
    if not run.events:
        return
    marks = {Severity.INFO: "", Severity.WARNING: "△ ", Severity.ERROR: "✗ "}
    kinds = {Severity.INFO: "", Severity.WARNING: "", Severity.ERROR: ' class="bad"'}
    yield '<h2>Events</h2><div class="scroll"><table><tr><th class="n">time, s</th><th>code</th><th>what</th></tr>'
    for event in run.events:
        time = (event.t_ns - run.start_ns) * 1e-9
        yield (
            f'<tr{kinds[event.severity]}><td class="n">{time:.3f}</td><td>{escape(event.code)}</td>'
            f"<td>{marks[event.severity]}{escape(event.text)}</td></tr>"
        )
    yield "</table></div>"
