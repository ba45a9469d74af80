"""``report.html`` of a campaign: one page, complete in itself, in the style of a run's report."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from groundstation.campaign_figures import COLOURS, LETTERS
from groundstation.campaign_run import ENDS, FIGURES
from groundstation.campaign_summary import Rate, Side, Summary, column
from groundstation.estimators import LABELS
from groundstation.svg import Chart

_HERE = Path(__file__).parent
_BINS: Final = 32
_STYLE = """
.matrix td { padding: 2px; border: none; } .matrix th { padding: 2px 6px; font-weight: 500; }
.cell { display: block; width: 44px; text-align: center; border-radius: 4px; color: #16202a; font-size: 12px; }
.cell.wrong { outline: 2px solid var(--limit); } .cell.dark { color: #fff; }
.key { display: inline-block; margin-right: 16px; font-size: 13px; }
.key i { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin-right: 5px; }
.share { display: inline-block; height: 9px; background: var(--c1); } code { font-size: 12px; user-select: all; }
"""


def write(summary: Summary, table: pa.Table, path: Path) -> None:
    """Write the report of a campaign."""
    path.write_text("".join(_page(summary, table)), encoding="utf-8")


def _page(summary: Summary, table: pa.Table) -> Iterator[str]:
    title = f"Campaign {summary.name}"
    kind, words = _badge(summary)
    style = (_HERE / "report.css").read_text(encoding="utf-8") + _STYLE
    yield '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<title>{escape(title)}</title><style>{style}</style></head>"
    yield f'<body><main><header><h1>{escape(title)}</h1><span class="badge {kind}">{words}</span></header>'
    yield f'<p class="soft">{escape(_about(summary))}</p>'
    yield from _cards(summary)
    yield from _ends(summary)
    yield from _matrix(summary)
    yield from _verdicts(summary)
    yield from _estimators(summary)
    yield from _distributions(summary, table)
    yield from _sensitivities(summary)
    yield from _worst(summary)
    yield f"<footer>Pipewright {escape(_version(table))}</footer></main>"
    yield f"<script>{(_HERE / 'report.js').read_text(encoding='utf-8')}</script></body></html>\n"


def _badge(summary: Summary) -> tuple[str, str]:
    if summary.lost.count or summary.ends.get("error"):
        lost, errors = summary.lost.count, summary.ends.get("error", 0)
        return "bad", f"✗ {lost} lost, {errors} failed"
    if summary.runs < summary.planned:
        return "warn", f"△ {summary.runs} of {summary.planned} runs"
    return ("good", "✓ as asked") if summary.good else ("warn", "△ not all as asked")


def _about(summary: Summary) -> str:
    campaign = summary.campaign
    law = f", law {campaign.law}" if campaign.law else ""
    sets = f", {', '.join(campaign.set)}" if campaign.set else ""
    hours = f"{summary.simulated_s / 3600:.1f} h simulated, {summary.wall_s / 3600:.2f} h of one core"
    return f"Scenario {campaign.scenario}{law}{sets}; {summary.runs} of {summary.planned} runs; {hours}."


def _cards(summary: Summary) -> Iterator[str]:
    yield '<div class="cards">'
    yield _share("completed", summary.success)
    yield _share("vehicle lost", summary.lost, "bad" if summary.lost.count else "good")
    for name in ("meas_des", "est_meas", "touchdown_peak"):
        if name in summary.figures:
            figure, spread = next(f for f in FIGURES if f.name == name), summary.figures[name]
            yield _card(f"{spread.median:.3f} / {spread.p95:.3f} {figure.unit}", f"{figure.words}: median / 95 %")
    yield _card(f"{summary.speed:.1f} x", "real time, per core")
    yield "</div>"


def _share(label: str, rate: Rate, kind: str = "") -> str:
    interval = f"{100 * rate.low:.1f} to {100 * rate.high:.1f} % with 95 % confidence"
    return _card(f"{100 * rate.share:.1f} %", f"{label}: {rate.count} of {rate.of}, {interval}", kind)


def _card(value: str, label: str, kind: str = "") -> str:
    attribute = f' class="{kind}"' if kind else ""
    return f'<div class="card"><b{attribute}>{escape(value)}</b><span>{escape(label)}</span></div>'


def _ends(summary: Summary) -> Iterator[str]:
    yield '<h2>How the runs ended</h2><table><tr><th>end</th><th class="n">runs</th><th>meaning</th></tr>'
    for end, count in summary.ends.items():
        yield f'<tr><td>{_swatch(end)}{end}</td><td class="n">{count}</td><td>{escape(ENDS[end])}</td></tr>'
    yield "</table>"


def _swatch(end: str) -> str:
    return f'<span class="key"><i style="background:{COLOURS[end]}"></i>{LETTERS[end]}</span>'


def _matrix(summary: Summary) -> Iterator[str]:
    if not summary.cells:
        return
    faults = list(dict.fromkeys(cell.fault for cell in summary.cells))
    moments = list(dict.fromkeys(cell.moment for cell in summary.cells))
    cells = {(cell.fault, cell.moment): cell for cell in summary.cells}
    yield "<h2>Faults, and when they begin</h2>"
    yield '<p class="note">A fault begins at the moment of its column. Framed: ended otherwise than it may. '
    yield "Point at a cell for its ends and the command that repeats it.</p>"
    yield '<div class="scroll"><table class="matrix"><tr><th></th>'
    yield "".join(f"<th>{escape(moment.replace('_', ' '))}</th>" for moment in moments) + "</tr>"
    for fault in faults:
        yield f"<tr><th>{escape(fault)}</th>"
        for moment in moments:
            cell = cells.get((fault, moment))
            if cell is None:
                yield "<td></td>"
                continue
            worst = max(cell.ends, key=list(ENDS).index)
            told = ", ".join(f"{count} {end}" for end, count in cell.ends.items())
            may = f"; may be {', '.join(cell.allowed)}" if cell.allowed else ""
            kind = ("" if cell.ok else " wrong") + (
                " dark" if worst in ("completed", "autolanded", "lost", "error") else ""
            )
            letters = "".join(LETTERS[end] for end in ENDS if end in cell.ends)
            yield f'<td><span class="cell{kind}" style="background:{COLOURS[worst]}" '
            yield f'title="{escape(f"{told}{may}: {cell.command}")}">{letters}{"" if cell.ok else "!"}</span></td>'
        yield "</tr>"
    yield "</table></div>"


def _verdicts(summary: Summary) -> Iterator[str]:
    if not summary.verdicts:
        return
    yield '<h2>What was asked</h2><table><tr><th>figure</th><th>of all runs</th><th class="n">limit</th>'
    yield '<th class="n">reached</th><th></th></tr>'
    for verdict in summary.verdicts:
        limit = verdict.limit
        figure = next(f for f in FIGURES if f.name == limit.metric)
        kind = (
            "median" if limit.quantile == 0.5 else "largest" if limit.quantile == 1.0 else f"{100 * limit.quantile:g} %"
        )
        value = "" if verdict.value is None else f"{verdict.value:.3f} {figure.unit}"
        mark = '<span class="good">✓ met</span>' if verdict.met else '<span class="bad">✗ missed</span>'
        yield f'<tr><td>{escape(figure.words)}</td><td>{kind}</td><td class="n">{limit.high:g} {figure.unit}</td>'
        yield f'<td class="n">{value}</td><td>{mark}</td></tr>'
    yield "</table>"


def _estimators(summary: Summary) -> Iterator[str]:
    if not summary.estimators:
        return
    yield '<h2>Force estimators, in the same runs</h2><p class="note">'
    if any(side.runs for side in summary.estimators):
        yield "Medians over the runs, from trigger to release against the true compression; the ratio is the paper's "
        yield "RMSE by its own in the same run, with the interval that holds its median with 95 % confidence. "
    if summary.watched_s:
        yield f"The trigger was watched for {summary.watched_s:.0f} s with nothing touching, false contacts: "
        yield f"{summary.false_contacts}; the last two columns say what each read meanwhile (RMS of all that time), "
        yield "and how often it alone would have pulled the trigger."
    headings, rows = side_by_side(summary)
    yield '</p><div class="scroll"><table><tr><th>estimator</th>'
    yield "".join(f'<th class="n">{heading}</th>' for heading in headings) + "</tr>"
    for label, cells in rows:
        yield f"<tr><td>{escape(label)}</td>" + "".join(f'<td class="n">{cell}</td>' for cell in cells) + "</tr>"
    yield "</table></div>"


def side_by_side(summary: Summary) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Headings, and label and cells of each estimator; without the columns that no run tells anything of."""
    columns: dict[str, list[str]] = {
        "runs": [str(side.runs or "") for side in summary.estimators],
        "RMSE, N": [_cell(side.rmse, ".3f") for side in summary.estimators],
        "bias, N": [_cell(side.bias, "+.3f") for side in summary.estimators],
        "delay, ms": [_cell(side.delay, ".0f", 1000.0) for side in summary.estimators],
        "paper by own": [_ratio(side) for side in summary.estimators],
        "watched, N": [_cell(side.watched_rms, ".3f") for side in summary.estimators],
        "pulls": [str(side.pulls) if side.watched_rms is not None else "" for side in summary.estimators],
    }
    told = {heading: cells for heading, cells in columns.items() if any(cells)}
    return list(told), [
        (LABELS[side.name], [cells[i] for cells in told.values()]) for i, side in enumerate(summary.estimators)
    ]


def _cell(value: float | None, form: str, factor: float = 1.0) -> str:
    return "" if value is None else f"{factor * value:{form}}"


def _ratio(side: Side) -> str:
    if side.ratio_low is None or side.name == "paper":
        return _cell(side.ratio, ".2f")
    return f"{side.ratio:.2f} ({side.ratio_low:.2f} to {side.ratio_high:.2f})"


def _distributions(summary: Summary, table: pa.Table) -> Iterator[str]:
    yield '<h2>Distributions</h2><div class="pair">'
    for figure in FIGURES:
        spread = summary.figures.get(figure.name)
        if not figure.charted or spread is None or spread.high - spread.low < 1e-9 * max(1.0, abs(spread.high)):
            continue
        values = column(table, figure.name)
        counts, edges = np.histogram(values[np.isfinite(values)], bins=min(_BINS, max(6, spread.count // 4)))
        title = f"{figure.words} (median {spread.median:.3g})"
        chart = Chart(title, "runs", (float(edges[0]), float(edges[-1])), y=(0.0, 1.1 * float(counts.max())),
                      x_label=f"{figure.name}{f', {figure.unit}' if figure.unit else ''}", height=200)  # fmt: skip
        for k, number in enumerate(counts.tolist()):
            low, high = float(edges[k]), float(edges[k + 1])
            chart.bar(low, high, float(number), f"{number} runs from {low:.4g} to {high:.4g}")
        chart.mark(spread.median, "")
        yield f"<div>{chart.svg()}</div>"
    yield '</div><details><summary>as numbers</summary><table><tr><th>figure</th><th>unit</th><th class="n">runs</th>'
    yield (
        "".join(f'<th class="n">{name}</th>' for name in ("mean", "least", "5 %", "median", "95 %", "largest"))
        + "</tr>"
    )
    for figure in FIGURES:
        if (spread := summary.figures.get(figure.name)) is not None:
            numbers = (spread.mean, spread.low, spread.p5, spread.median, spread.p95, spread.high)
            cells = "".join(f'<td class="n">{number:.4g}</td>' for number in numbers)
            yield f"<tr><td>{escape(figure.words)}</td><td>{figure.unit}</td>"
            yield f'<td class="n">{spread.count}</td>{cells}</tr>'
    yield "</table></details>"


def _sensitivities(summary: Summary) -> Iterator[str]:
    if not summary.sensitivities:
        return
    yield '<h2>Sensitivities</h2><p class="note">Spearman\'s rank correlation of parameter and figure; of a choice, '
    yield "the share of the ranks' variance between the choices. p: how likely chance alone gives as much.</p>"
    yield '<table><tr><th>figure</th><th>parameter</th><th class="n">strength</th><th></th><th class="n">p</th></tr>'
    for item in summary.sensitivities:
        bar = f'<span class="share" style="width:{120 * abs(item.strength):.0f}px"></span>'
        strength = f"{item.strength:+.2f}" if item.signed else f"{item.strength:.2f}"
        sure = ' class="n"' if item.p < 0.05 else ' class="n soft"'
        yield f"<tr><td>{item.figure}</td><td>{escape(item.parameter)}</td><td{sure}>{strength}</td><td>{bar}</td>"
        yield f"<td{sure}>{item.p:.2g}</td></tr>"
    yield "</table>"


def _worst(summary: Summary) -> Iterator[str]:
    metric = summary.campaign.metric
    yield f'<h2>The worst runs</h2><p class="note">Ends that may not be first, then by {metric}. Each command flies '
    yield "its run again, to the bit, and writes its log and report.</p>"
    yield f'<div class="scroll"><table><tr><th class="n">run</th><th>end</th><th>what</th><th class="n">{metric}</th>'
    yield "<th>command</th></tr>"
    for run in summary.worst:
        value = "" if run.value is None else f"{run.value:.3f}"
        yield f'<tr><td class="n">{run.run}</td><td>{run.end}</td><td>{escape(run.why)}</td><td class="n">{value}</td>'
        yield f"<td><code>{escape(run.command)}</code></td></tr>"
    yield "</table></div>"


def _version(table: pa.Table) -> str:
    return ", ".join(sorted({version for version in table["version"].to_pylist() if version}))
