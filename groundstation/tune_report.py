"""What a study has found: the best set as YAML, and a page with its history and what mattered."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from groundstation.tune_file import Study
from onboard.headless import Mission, overlay_text

_DPI: Final = 110
#: Fewer trials tell nothing of what mattered.
_LEAST: Final = 8


def write_best(study: Study, search: Any, folder: Path) -> dict[str, Any]:
    """Write ``best.yaml``, a scenario with the best values in it, and ``gains.yaml``, those alone; gives the values."""
    campaign = study.plan.campaign
    best = _values(search.best_trial, study)
    head = (
        f"# Found by the study {study.name}, trial {search.best_trial.number} of {len(search.trials)}:\n"
        f"# {_asked(study)} is {search.best_value:.4f}.\n"
    )
    (folder / "gains.yaml").write_text(head + overlay_text(None, (), best), encoding="utf-8")
    path = folder / "best.yaml"
    path.write_text(head + overlay_text(campaign.scenario, campaign.set, best, campaign.law), encoding="utf-8")
    Mission(str(path), None, (), campaign.first_seed)
    return best


def write(study: Study, search: Any, page: Path) -> None:
    """Write the page, and its pictures into ``images`` beside it."""
    images = page.parent / "images"
    images.mkdir(parents=True, exist_ok=True)
    stem = f"tune-{study.name}"
    _history(study, search, images / f"{stem}-history.png")
    importance = _importance(search)
    if importance:
        _bars(importance, images / f"{stem}-importance.png")
        _slices(study, search, list(importance)[:6], images / f"{stem}-parameters.png")
    page.write_text("\n".join(_page(study, search, importance, stem)) + "\n", encoding="utf-8")


def _asked(study: Study) -> str:
    objective = study.tuning.objective
    kind = "largest" if objective.quantile == 1.0 else f"{100 * objective.quantile:g} % quantile of"
    return f"{kind} {objective.metric} over {study.length} runs of {study.plan.name}, with penalties"


def _values(trial: Any, study: Study) -> dict[str, Any]:
    return {
        name: float(f"{value:.6g}") if isinstance(value, float) else value
        for name in study.ranges
        if (value := trial.params.get(name)) is not None
    }


def _complete(search: Any) -> list[Any]:
    return [trial for trial in search.trials if trial.state.name == "COMPLETE"]


def _page(study: Study, search: Any, importance: dict[str, float], stem: str) -> list[str]:
    complete, best = _complete(search), search.best_trial
    first = complete[0]
    pruned = sum(trial.state.name == "PRUNED" for trial in search.trials)
    objective = study.tuning.objective
    lines = [
        f"# Study {study.name}",
        "",
        f"Written by `pipewright tune {study.name}`. Sought: the least {_asked(study)}: {objective.unfinished:g} times "
        f"the share of runs not completed and {objective.lost:g} times the share of vehicles lost are added, and a run "
        f"without the figure counts as {objective.missing:g}. {len(complete)} trials were flown whole, {pruned} broken "
        "off when they were behind. The first is what was in force before.",
        "",
        f"| | first ({first.number}) | best ({best.number}) |",
        "|---|---:|---:|",
        f"| objective | {first.value:.4f} | {best.value:.4f} |",
        f"| {objective.metric}, median of runs | {_median(first)} | {_median(best)} |",
        f"| runs completed | {_done(first)} | {_done(best)} |",
        "",
        "| parameter | from | to | first | best | importance |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, bounds in study.ranges.items():
        low, high = ("", "") if bounds.choices else (f"{bounds.low:g}", f"{bounds.high:g}")
        before, after = (_shown(trial.params.get(name)) for trial in (first, best))
        weight = f"{importance[name]:.2f}" if name in importance else ""
        lines.append(f"| `{name}` | {low} | {high} | {before} | {after} | {weight} |")
    lines += ["", f"![value of each trial](images/{stem}-history.png)"]
    if importance:
        lines += [
            "",
            "Importance: how far the best tenth of the trials lies apart from all, by parameter (PED-ANOVA).",
            "",
            f"![importance](images/{stem}-importance.png)",
            "",
            f"![trials by parameter](images/{stem}-parameters.png)",
        ]
    return lines


def _shown(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _median(trial: Any) -> str:
    known = [value for value in trial.user_attrs.get("figures", []) if value is not None]
    return f"{float(np.median(known)):.4f}" if known else ""


def _done(trial: Any) -> str:
    ends = trial.user_attrs.get("ends", [])
    return f"{sum(end in ('completed', 'resumed') for end in ends)} of {len(ends)}"


def _importance(search: Any) -> dict[str, float]:
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    values = [trial.value for trial in _complete(search)]
    if len(values) < _LEAST or len(set(values)) < 2:
        return {}
    return dict(get_param_importances(search, evaluator=PedAnovaImportanceEvaluator()))


def _history(study: Study, search: Any, path: Path) -> None:
    complete = _complete(search)
    numbers, values = [trial.number for trial in complete], [trial.value for trial in complete]
    figure = Figure(figsize=(7.5, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(numbers, values, "o", markersize=4, color="#0067a5", label="trial")
    axes.step(numbers, np.minimum.accumulate(values), where="post", color="#c8500a", label="best so far")
    _scale(axes, values)
    axes.set_xlabel("trial")
    axes.set_ylabel("objective")
    axes.set_title(f"{study.name}: objective of each trial", fontsize=10)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=_DPI)


def _scale(axes: Axes, values: list[float]) -> None:
    """Trials with penalties must not press all others together."""
    if min(values) > 0.0 and max(values) > 20.0 * min(values):
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())


def _bars(importance: dict[str, float], path: Path) -> None:
    names = list(importance)[::-1]
    figure = Figure(figsize=(7.5, 0.8 + 0.32 * len(names)), layout="constrained")
    axes = figure.subplots()
    axes.barh(names, [importance[name] for name in names], color="#0067a5")
    axes.set_xlabel("importance")
    figure.savefig(path, dpi=_DPI)


def _slices(study: Study, search: Any, names: list[str], path: Path) -> None:
    complete = _complete(search)
    rows = -(-len(names) // 3)
    figure = Figure(figsize=(9.5, 0.3 + 2.4 * rows), layout="constrained")
    places = figure.subplots(rows, min(3, len(names)), squeeze=False).ravel()
    values = [trial.value for trial in complete]
    for axes, name in zip(places, names, strict=False):
        known = [trial for trial in complete if name in trial.params]
        given = [trial.params[name] for trial in known]
        axes.scatter(given, [trial.value for trial in known], s=14, color="#0067a5")
        axes.axvline(search.best_trial.params[name], color="#c8500a", linewidth=1.0)
        if next(item.log for item in study.tuning.parameters if item.name == name):
            axes.set_xscale("log")
        _scale(axes, values)
        axes.set_title(name, fontsize=8)
        axes.tick_params(labelsize=7)
    for axes in places[len(names) :]:
        axes.set_visible(False)
    figure.savefig(path, dpi=_DPI)
