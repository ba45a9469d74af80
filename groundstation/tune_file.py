"""What a tuning is: its file, what may be changed, and what is asked of the runs."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace

from groundstation.campaign_file import Job, Plan, read_campaign
from groundstation.campaign_run import ENDS, NAMES, SUCCESS
from groundstation.parsing import nearest
from groundstation.shipped import Shipped
from onboard.headless import ConfigError, Mission, Range, inline_text, range_of, read_struct

SHIPPED: Final = Shipped("tuning", "tunings")


def _note(meaning: str, unit: str = "") -> Meta:
    return Meta(description=meaning, extra={"unit": unit, "in_flight": False})


class Tuned(Struct, frozen=True, forbid_unknown_fields=True):
    """One parameter that is sought; its declaration bounds it, and these may bound it further."""

    name: Annotated[str, _note("as in --set")]
    low: Annotated[float, _note("least value; none: as declared")] | None = None
    high: Annotated[float, _note("largest value; none: as declared")] | None = None
    log: Annotated[bool, _note("the logarithm is sought evenly")] = False


class Objective(Struct, frozen=True, forbid_unknown_fields=True):
    """What is made small: a quantile of a figure over a trial's runs, and a penalty for those that do not complete."""

    metric: Annotated[str, _note("name of the figure")] = "meas_des"
    quantile: Annotated[float, Meta(ge=0.0, le=1.0), _note("1: the worst run")] = 1.0
    missing: Annotated[float, _note("stands for the figure of a run that has none")] = 3.0
    unfinished: Annotated[float, Meta(ge=0.0), _note("added, times the share of runs that are not completed")] = 2.0
    lost: Annotated[float, Meta(ge=0.0), _note("added, times the share of vehicles lost")] = 20.0

    def value(self, rows: Sequence[dict[str, Any]]) -> float:
        """Of the rows of a trial."""
        figures = [self.missing if row[self.metric] is None else row[self.metric] for row in rows]
        unfinished = sum(row["end"] not in SUCCESS for row in rows) / len(rows)
        lost = sum(row["end"] in ("lost", "error") for row in rows) / len(rows)
        return float(np.quantile(figures, self.quantile)) + self.unfinished * unfinished + self.lost * lost


class Tuning(Struct, frozen=True, forbid_unknown_fields=True):
    """All of a tuning's file."""

    campaign: Annotated[str, _note("name or file of the campaign that each trial flies")]
    parameters: Annotated[tuple[Tuned, ...], Meta(min_length=1)]
    trials: Annotated[int, Meta(ge=1, le=100_000), _note("how many are made in all")] = 50
    runs: Annotated[int, Meta(ge=1, le=100_000), _note("of the campaign's, that each flies; none: all")] | None = None
    objective: Objective = Objective()
    seed: Annotated[int, Meta(ge=0, le=2**31), _note("of the search")] = 0


class Study(Struct, frozen=True):
    """A checked tuning."""

    name: str
    tuning: Tuning
    plan: Plan
    ranges: dict[str, Range]

    def digest(self) -> str:
        """Equal for studies whose trials can stand beside each other."""
        same = replace(self.tuning, trials=1)
        return hashlib.sha256(msgspec.json.encode(same) + self.plan.digest().encode()).hexdigest()

    @property
    def length(self) -> int:
        """Runs of a trial."""
        return min(len(self.plan), self.tuning.runs or len(self.plan))

    def jobs(self, values: dict[str, Any]) -> list[Job]:
        """The runs of a trial with these values."""
        sets = tuple(f"{name}={inline_text(value)}" for name, value in values.items())
        jobs = (job for job, _ in zip(self.plan.jobs(), range(self.length), strict=False))
        return [replace(job, sets=(*job.sets, *sets)) for job in jobs]


def read_tuning(given: str) -> Study:
    """Read a tuning by the name of a shipped one, or from a file. Raises ConfigError with every error at once."""
    path = SHIPPED.path(given)
    tuning = read_struct(Tuning, path)
    plan = read_campaign(_beside(path, tuning.campaign), NAMES, tuple(ENDS))
    errors: list[str] = []
    if tuning.objective.metric not in NAMES:
        best = nearest(tuning.objective.metric, NAMES) or NAMES
        errors.append(
            f"{path}: objective.metric = {tuning.objective.metric!r}: no such figure; nearest: {', '.join(best)}"
        )
    ranges: dict[str, Range] = {}
    for wanted in tuning.parameters:
        try:
            ranges[wanted.name] = _range(wanted)
        except ConfigError as error:
            errors += [f"{path}: parameters: {text}" for text in error.errors]
    if len(ranges) < len(tuning.parameters) and not errors:
        errors.append(f"{path}: parameters: one is given twice")
    if errors:
        raise ConfigError(errors)
    return Study(path.stem, tuning, plan, ranges)


def present(study: Study) -> dict[str, Any]:
    """The values that are in force now, as far as they are within their bounds."""
    campaign = study.plan.campaign
    config = Mission(campaign.scenario, campaign.law, campaign.set, campaign.first_seed)
    return {
        name: value
        for name, bounds in study.ranges.items()
        if (value := config.value(name)) in bounds.choices
        or (not bounds.choices and bounds.low <= value <= bounds.high)
    }


def _beside(path: Path, campaign: str) -> str:
    """A campaign's file is named from where the tuning's file is."""
    file = path.parent / campaign
    return str(file) if campaign.endswith((".yaml", ".yml")) and file.is_file() else campaign


def _range(wanted: Tuned) -> Range:
    declared = range_of(wanted.name)
    if declared.choices:
        return declared
    low = declared.low if wanted.low is None else wanted.low
    high = declared.high if wanted.high is None else wanted.high
    if low < declared.low or high > declared.high or not low < high:
        allowed = f"{declared.low:g} to {declared.high:g}"
        raise ConfigError([f"{wanted.name}: from {low:g} to {high:g}: must be within {allowed}, low first"])
    if wanted.log and low <= 0.0:
        raise ConfigError([f"{wanted.name}: the logarithm wants low above 0"])
    return replace(declared, low=low, high=high)
