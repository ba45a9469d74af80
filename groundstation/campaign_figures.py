"""The pictures of a campaign as files: how its figures are distributed, and how every fault ends at every moment."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from groundstation.campaign_run import ENDS, FIGURES
from groundstation.campaign_summary import Summary, column

#: Of each end, from well to worse; told apart without colour by their letters.
COLOURS: Final = {
    "completed": "#2e8b57", "resumed": "#8fd0b8", "landed": "#9cc3e0", "autolanded": "#5b8fb9", "grounded": "#c3cad2",
    "holding": "#f0d58a", "unfinished": "#f0b070", "lost": "#b3261e", "error": "#5b1a6b",
}  # fmt: skip
LETTERS: Final = {
    "completed": "C", "resumed": "R", "landed": "L", "autolanded": "A", "grounded": "G", "holding": "H",
    "unfinished": "U", "lost": "X", "error": "E",
}  # fmt: skip
_SHOWN: Final = ("meas_des", "est_des", "est_meas", "touchdown_peak", "no_contact", "press_gap")
_DPI: Final = 110


def matrix(summary: Summary, path: Path) -> None:
    """Faults by moments: letter and colour of how the cell ended, a red frame where it may not end so."""
    faults = list(dict.fromkeys(cell.fault for cell in summary.cells))
    moments = list(dict.fromkeys(cell.moment for cell in summary.cells))
    order = list(ENDS)
    figure = Figure(figsize=(2.9 + 0.62 * len(moments), 1.7 + 0.27 * len(faults)), layout="constrained")
    axes = figure.subplots()
    for cell in summary.cells:
        x, y = moments.index(cell.moment), faults.index(cell.fault)
        worst = max(cell.ends, key=order.index)
        axes.add_patch(
            Rectangle(
                (x - 0.46, y - 0.44), 0.92, 0.88,
                facecolor=COLOURS[worst], edgecolor="none" if cell.ok else "red", linewidth=2.0,
            )
        )  # fmt: skip
        letters = "".join(LETTERS[end] for end in order if end in cell.ends)
        dark = worst in ("completed", "autolanded", "lost", "error")
        axes.text(x, y, letters + ("" if cell.ok else "!"), ha="center", va="center", fontsize=8,
                  color="white" if dark else "#16202a")  # fmt: skip
    axes.set_xlim(-0.5, len(moments) - 0.5)
    axes.set_ylim(len(faults) - 0.5, -0.5)
    axes.set_xticks(range(len(moments)), [moment.replace("_", "\n") for moment in moments], fontsize=8)
    axes.set_yticks(range(len(faults)), faults, fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    met = {end for cell in summary.cells for end in cell.ends}
    keys = [Patch(color=COLOURS[end], label=f"{LETTERS[end]}  {ENDS[end]}") for end in order if end in met]
    figure.legend(handles=keys, loc="outside lower left", ncols=2, fontsize=8, frameon=False)
    wrong = sum(not cell.ok for cell in summary.cells)
    words = "each ended as it may" if not wrong else f"{wrong} ended otherwise than they may (framed, !)"
    figure.suptitle(f"{summary.name}: {len(summary.cells)} cells, {words}", fontsize=10)
    figure.savefig(path, dpi=_DPI)


def distributions(summary: Summary, table: pa.Table, path: Path) -> None:
    """Histograms of the figures of force and contact, with median, 95th percentile and the limits asked for."""
    spreads = summary.figures
    known = [
        f for f in FIGURES if f.name in _SHOWN and f.name in spreads and spreads[f.name].low < spreads[f.name].high
    ]
    if not known:
        return
    rows = -(-len(known) // 3)
    figure = Figure(figsize=(10.5, 0.6 + 2.5 * rows), layout="constrained")
    places = np.atleast_1d(figure.subplots(rows, min(3, len(known)), squeeze=False)).ravel()
    for axes, told in zip(places, known, strict=False):
        _histogram(axes, summary, table, told.name, f"{told.words}{f', {told.unit}' if told.unit else ''}")
    for axes in places[len(known) :]:
        axes.set_visible(False)
    success = summary.success
    figure.suptitle(
        f"{summary.name}: {summary.runs} runs, {100 * success.share:.1f} % completed "
        f"({100 * success.low:.1f} to {100 * success.high:.1f} %), {summary.lost.count} lost",
        fontsize=10,
    )
    figure.savefig(path, dpi=_DPI)


def _histogram(axes: Axes, summary: Summary, table: pa.Table, name: str, label: str) -> None:
    values = column(table, name)
    values = values[np.isfinite(values)]
    spread = summary.figures[name]
    # What lies far out would flatten all the rest: it is counted in the last bar.
    top = max(spread.p95 + 2.0 * (spread.p95 - spread.p5), 1e-12)
    axes.hist(np.minimum(values, top), bins=min(40, max(8, len(values) // 4)), color="#0067a5", alpha=0.8)
    axes.axvline(spread.median, color="#1b1f24", linewidth=1.2, label=f"median {spread.median:.3g}")
    axes.axvline(spread.p95, color="#1b1f24", linewidth=1.2, linestyle="--", label=f"95 % {spread.p95:.3g}")
    for verdict in summary.verdicts:
        if verdict.limit.metric == name:
            kind = "median" if verdict.limit.quantile == 0.5 else f"{100 * verdict.limit.quantile:g} %"
            axes.axvline(
                verdict.limit.high, color="#b3261e", linestyle=":", label=f"limit of {kind}: {verdict.limit.high:g}"
            )
    axes.set_title(label, fontsize=8)
    axes.tick_params(labelsize=8)
    axes.set_ylabel("runs", fontsize=8)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(fontsize=7, framealpha=0.85, edgecolor="none")
