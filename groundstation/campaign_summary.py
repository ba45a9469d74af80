"""What the rows of a campaign say together: success with its interval, distributions, sensitivities, the worst runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct
from numpy.typing import NDArray

from groundstation.campaign_file import Campaign, Limit, Plan
from groundstation.campaign_run import ENDS, NAMES, OF_ESTIMATORS, SUCCESS
from groundstation.run import ESTIMATORS, FELT

Array = NDArray[np.float64]

_QUANTILES: Final = (0.0, 0.05, 0.5, 0.95, 1.0)
_CONFIDENCE: Final = 0.95
_WORST: Final = 10
#: Fewer runs tell nothing of a sensitivity.
_LEAST: Final = 8
#: Figures whose sensitivity is looked at, beside the campaign's own.
_FELT: Final = ("meas_des", "est_meas", "touchdown_peak", "no_contact")


class Rate(Struct, frozen=True):
    """A share of the runs, and where the true one lies with 95 % confidence (Wilson's score interval)."""

    count: int
    of: int
    share: float
    low: float
    high: float


class Distribution(Struct, frozen=True):
    """A figure over all runs that have it."""

    count: int
    mean: float
    low: float
    p5: float
    median: float
    p95: float
    high: float


class Side(Struct, frozen=True):
    """One force estimator over the runs: medians of its figures, and of the paper's RMSE by its own in the same run.

    The ratio's interval holds the true median with 95 % confidence, whatever the distribution (by order statistics);
    it takes six runs. N, s.
    """

    name: str
    runs: int
    """With a contact."""
    rmse: float | None
    bias: float | None
    delay: float | None
    ratio: float | None
    ratio_low: float | None
    ratio_high: float | None
    watched_rms: float | None
    """While the trigger was watched with nothing touching; root of the mean square over all of that time."""
    pulls: int
    """How often, in all runs, it alone would then have pulled the trigger."""


class Verdict(Struct, frozen=True):
    """A limit of the campaign's file, and what was reached."""

    limit: Limit
    value: float | None
    met: bool


class Sensitivity(Struct, frozen=True):
    """How a figure goes with a parameter: Spearman's rank correlation, and how likely chance alone gives as much.

    Of a choice: Kruskal and Wallis's test, and the share of the ranks' variance between the choices, without a sign.
    """

    parameter: str
    figure: str
    strength: float
    p: float
    signed: bool = True


class Worst(Struct, frozen=True):
    """One of the worst runs."""

    run: int
    seed: int
    end: str
    why: str
    value: float | None
    command: str


class Cell(Struct, frozen=True):
    """All runs with one fault at one moment."""

    fault: str
    moment: str
    ends: dict[str, int]
    ok: bool
    allowed: tuple[str, ...]
    command: str
    """Of the first run that ended otherwise than it may, else of the first."""


class Summary(Struct, frozen=True):
    """The content of ``summary.json``."""

    name: str
    campaign: Campaign
    planned: int
    runs: int
    ends: dict[str, int]
    success: Rate
    lost: Rate
    figures: dict[str, Distribution]
    verdicts: tuple[Verdict, ...]
    sensitivities: tuple[Sensitivity, ...]
    worst: tuple[Worst, ...]
    cells: tuple[Cell, ...]
    estimators: tuple[Side, ...]
    watched_s: float
    """With the gate of the trigger open and nothing touching, of all runs."""
    false_contacts: int
    """In all runs."""
    simulated_s: float
    wall_s: float
    speed: float
    """Times real time, of one core: simulated over wall time of the runs."""

    @property
    def good(self) -> bool:
        """All runs were flown, none was lost, every limit is met and every cell ended as it may."""
        whole = self.runs == self.planned and not self.ends.get("error", 0) and not self.lost.count
        return whole and all(v.met for v in self.verdicts) and all(cell.ok for cell in self.cells)


def summarize(plan: Plan, table: pa.Table) -> Summary:
    """Count and measure all rows."""
    count = Counter(table["end"].to_pylist())
    runs = table.num_rows
    simulated, wall = (float(np.nansum(column(table, name))) for name in ("sim_s", "wall_s"))
    return Summary(
        name=plan.name,
        campaign=plan.campaign,
        planned=len(plan),
        runs=runs,
        ends={end: count[end] for end in ENDS if count[end]},
        success=rate(sum(count[end] for end in SUCCESS), runs),
        lost=rate(count["lost"], runs),
        figures={name: found for name in NAMES if (found := distribution(column(table, name))) is not None},
        verdicts=tuple(_verdict(limit, column(table, limit.metric)) for limit in plan.campaign.limits),
        sensitivities=tuple(_sensitivities(plan, table)),
        worst=tuple(_worst(plan, table)),
        cells=tuple(_cells(plan, table)),
        estimators=tuple(_sides(table)),
        watched_s=float(np.nansum(column(table, "watched_s"))),
        false_contacts=int(np.nansum(column(table, "false_contacts"))),
        simulated_s=simulated,
        wall_s=wall,
        speed=simulated / wall if wall else 0.0,
    )


def write(summary: Summary, path: Path) -> None:
    """Write ``summary.json``."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")


def column(table: pa.Table, name: str) -> Array:
    """A column of numbers, NaN where there is none."""
    values: Array = table[name].to_numpy(zero_copy_only=False).astype(float)
    return values


def rate(count: int, of: int) -> Rate:
    """A share with its interval; anything is possible where nothing was flown."""
    from scipy.stats import binomtest

    if not of:
        return Rate(0, 0, 0.0, 0.0, 1.0)
    interval = binomtest(count, of).proportion_ci(_CONFIDENCE, "wilson")
    return Rate(count, of, count / of, float(interval.low), float(interval.high))


def distribution(values: Array) -> Distribution | None:
    """The distribution of what is known."""
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, p5, median, p95, high = (float(value) for value in np.quantile(known, _QUANTILES))
    return Distribution(int(known.size), float(known.mean()), low, p5, median, p95, high)


def median_interval(values: Array) -> tuple[float, float] | None:
    """Where the median of what they are drawn from lies with 95 % confidence; None when they are too few to tell."""
    from scipy.stats import binom

    k = int(binom.ppf(0.5 * (1.0 - _CONFIDENCE), len(values), 0.5)) if len(values) else 0
    ordered = np.sort(values)
    return (float(ordered[k - 1]), float(ordered[-k])) if k else None


def _sides(table: pa.Table) -> Iterator[Side]:
    paper, watched = column(table, "paper_rmse"), column(table, "watched_s")
    for name in (*ESTIMATORS, FELT):
        of = {key: column(table, f"{name}_{key}") for key, _, _ in OF_ESTIMATORS}
        read = np.isfinite(of["watched_rms"])
        if not (read | np.isfinite(of["rmse"])).any():
            continue
        ratios = paper / np.where(of["rmse"] > 0.0, of["rmse"], np.nan)
        ratios = ratios[np.isfinite(ratios)]
        low, high = median_interval(ratios) or (None, None)
        time = float(watched[read].sum())
        yield Side(
            name=name,
            runs=int(np.isfinite(of["rmse"]).sum()),
            rmse=_median(of["rmse"]),
            bias=_median(of["bias"]),
            delay=_median(of["delay"]),
            ratio=_median(ratios),
            ratio_low=low,
            ratio_high=high,
            watched_rms=float(np.sqrt(np.sum(of["watched_rms"][read] ** 2 * watched[read]) / time)) if time else None,
            pulls=int(np.nansum(of["pulls"])),
        )


def _median(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _verdict(limit: Limit, values: Array) -> Verdict:
    known = values[np.isfinite(values)]
    value = float(np.quantile(known, limit.quantile)) if known.size else None
    return Verdict(limit, value, value is not None and value <= limit.high)


def _sensitivities(plan: Plan, table: pa.Table) -> list[Sensitivity]:
    figures = list(dict.fromkeys((plan.campaign.metric, *_FELT)))
    success = np.array([float(end in SUCCESS) for end in table["end"].to_pylist()])
    columns = {name: column(table, name) for name in figures} | {"success": success}
    found = []
    for varied in plan.campaign.parameters:
        for name, values in columns.items():
            told = _sensitivity(varied.name, name, table[varied.name].to_pylist(), values)
            found += [told] if told is not None else []
    return sorted(found, key=lambda item: [*figures, "success"].index(item.figure) * 10 - abs(item.strength))


def _sensitivity(parameter: str, figure: str, given: list[Any], values: Array) -> Sensitivity | None:
    from scipy.stats import kruskal, spearmanr

    known = np.isfinite(values)
    given = [value for value, use in zip(given, known, strict=True) if use]
    values = values[known]
    if len(values) < _LEAST or np.ptp(values) == 0.0 or len(set(given)) < 2:
        return None
    if all(isinstance(value, float) for value in given):
        told = spearmanr(given, values)
        return Sensitivity(parameter, figure, float(told.statistic), float(told.pvalue))
    groups = [[v for g, v in zip(given, values, strict=True) if g == choice] for choice in sorted(set(given))]
    told = kruskal(*groups)
    return Sensitivity(parameter, figure, float(told.statistic) / (len(values) - 1), float(told.pvalue), signed=False)


def _worst(plan: Plan, table: pa.Table) -> list[Worst]:
    """Not as they may end first, the worse the end the earlier; then by the figure."""
    ranks = {end: rank for rank, end in enumerate(ENDS)}
    ends, ok = table["end"].to_pylist(), table["ok"].to_pylist()
    values = column(table, plan.campaign.metric)
    unlike = np.array([0 if fine else 1 for fine in ok])
    badness = np.array([ranks[end] for end in ends])
    order = np.lexsort((-np.nan_to_num(values, nan=-np.inf), -badness, -unlike))[:_WORST]
    found = []
    for k in order.tolist():
        row = table.slice(k, 1).to_pylist()[0]
        lines = row["error"].strip().splitlines()
        why = row["crash"] or (lines[-1] if lines else "") or f"in {row['ended_in']}"
        if row["fault"]:
            why = f"{row['fault']}, {row['moment']}: {why}"
        value = None if np.isnan(values[k]) else float(values[k])
        found.append(Worst(row["run"], row["seed"], row["end"], why, value, row["command"]))
    return found


def _cells(plan: Plan, table: pa.Table) -> list[Cell]:
    cells = []
    for cell in plan.cells:
        if cell is None:
            continue
        case, moment = cell
        here = table.filter(pc.and_(pc.equal(table["fault"], case.label), pc.equal(table["moment"], moment.name)))
        if here.num_rows:
            ok = here["ok"].to_pylist()
            command = here["command"][ok.index(False) if False in ok else 0].as_py()
            ends = dict(Counter(here["end"].to_pylist()))
            cells.append(Cell(case.label, moment.name, ends, all(ok), case.ends, command))
    return cells
