"""What a campaign is: its file, and the runs that follow from it.

A campaign is one scenario flown many times: at points of the parameters that are varied, with the faults of a list in
the phases of a list, each with its seeds. The same file makes the same runs, in the same order, everywhere.
"""

from __future__ import annotations

import hashlib
import itertools
import shlex
from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from groundstation.parsing import nearest
from groundstation.shipped import Shipped
from onboard.headless import ConfigError, InfeasibleError, Mission, find, inline_text, read_struct
from onboard.messages import Phase

SHIPPED: Final = Shipped("campaign", "campaigns")


def _note(meaning: str, unit: str = "") -> Meta:
    return Meta(description=meaning, extra={"unit": unit, "in_flight": False})


class Design(StrEnum):
    """How the points are laid out."""

    LATIN = "latin"
    """A Latin hypercube of ``runs`` points; every point has seeds of its own."""
    GRID = "grid"
    """Every combination; the same seeds at each."""


class Spread(StrEnum):
    """How a parameter is distributed."""

    UNIFORM = "uniform"
    """Between ``low`` and ``high``."""
    LOG_UNIFORM = "log_uniform"
    """Between ``low`` and ``high``, its logarithm evenly."""
    NORMAL = "normal"
    """About ``mean`` with ``sigma``, cut off at ``low`` and ``high`` (at 3 sigma where those are not given)."""
    CHOICE = "choice"
    """One of ``values``, each as often."""


class Varied(Struct, frozen=True, forbid_unknown_fields=True):
    """One parameter that is varied."""

    name: Annotated[str, _note("as in --set")]
    spread: Annotated[Spread, _note("distribution; in a grid, steps are even in it")] = Spread.UNIFORM
    low: Annotated[float, _note("least value")] | None = None
    high: Annotated[float, _note("largest value")] | None = None
    mean: Annotated[float, _note("of a normal distribution")] | None = None
    sigma: Annotated[float, Meta(gt=0.0), _note("of a normal distribution")] | None = None
    values: Annotated[tuple[bool | int | float | str, ...], _note("what a choice is made of")] = ()
    steps: Annotated[int, Meta(ge=2, le=1000), _note("values of a grid between low and high, both included")] = 3

    def __post_init__(self) -> None:
        if self.spread is Spread.CHOICE or self.values:
            if not self.values or self.spread not in (Spread.CHOICE, Spread.UNIFORM):
                raise ValueError("a choice has values, and no other distribution has any")
            return
        if self.spread is Spread.NORMAL:
            if self.mean is None or self.sigma is None:
                raise ValueError("a normal distribution has mean and sigma")
        elif self.low is None or self.high is None:
            raise ValueError("missing low or high, or values to choose from")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        if self.spread is Spread.LOG_UNIFORM and not (self.low or 0.0) > 0.0:
            raise ValueError("the logarithm wants low above 0")

    def at(self, share: float) -> Any:
        """The value below which this share (0..1) of the distribution lies, to six digits."""
        if self.values:
            return self.values[min(int(share * len(self.values)), len(self.values) - 1)]
        return float(f"{self._quantile(share):.6g}")

    def _quantile(self, share: float) -> float:
        from scipy import stats

        if self.spread is Spread.NORMAL:
            mean, sigma = float(self.mean or 0.0), float(self.sigma or 1.0)
            low = -3.0 if self.low is None else (self.low - mean) / sigma
            high = 3.0 if self.high is None else (self.high - mean) / sigma
            return float(stats.truncnorm.ppf(share, low, high, mean, sigma))
        low, high = float(self.low or 0.0), float(self.high or 0.0)
        if self.spread is Spread.LOG_UNIFORM:
            return float(stats.loguniform.ppf(share, low, high))
        return low + share * (high - low)

    def levels(self) -> tuple[Any, ...]:
        """What it is in a grid."""
        if self.values:
            return self.values
        return tuple(self.at(k / (self.steps - 1)) for k in range(self.steps))


class Moment(Struct, frozen=True, forbid_unknown_fields=True):
    """When a fault begins: a column of the matrix."""

    name: Annotated[str, _note("name of the column")]
    phase: Annotated[str, _note("phase of the mission")]
    at: Annotated[float, Meta(ge=0.0, le=1e5), _note("after the phase was entered", "s")] = 0.5


class FaultCase(Struct, frozen=True, forbid_unknown_fields=True):
    """A fault that is flown at each of some moments, and how that may end."""

    label: Annotated[str, _note("name of the row in the matrix")]
    device: Annotated[str, _note("autopilot, odometry or servos")]
    kind: Annotated[str, _note("kind of the fault")]
    moments: Annotated[tuple[str, ...], _note("names of those in which it is flown; empty: all")] = ()
    duration: Annotated[float, _note("how long; none: for good", "s")] | None = None
    value: Annotated[float, _note("how much")] = 0.0
    part: Annotated[str, _note("servo or message that it strikes")] = ""
    count: Annotated[int, _note("samples or packets that it strikes")] | None = None
    ends: Annotated[tuple[str, ...], _note("how it may end; empty: in any way that harms nothing")] = ()

    def fault(self, moment: Moment) -> dict[str, Any]:
        """The fault at this moment, as the configuration has it."""
        told: dict[str, Any] = {"device": self.device, "kind": self.kind, "phase": moment.phase, "start": moment.at}
        told |= {"value": self.value} if self.value else {}
        told |= {name: value for name in ("duration", "count") if (value := getattr(self, name)) is not None}
        return told | ({"part": self.part} if self.part else {})


class Campaign(Struct, frozen=True, forbid_unknown_fields=True):
    """All of a campaign's file."""

    scenario: Annotated[str, _note("name or file of the scenario")] = "paper"
    law: Annotated[str, _note("controller parameters; none: those of the scenario")] | None = None
    set: Annotated[tuple[str, ...], _note("KEY=VALUE as in --set, for every run")] = ()
    design: Annotated[Design, _note("latin or grid")] = Design.LATIN
    runs: Annotated[int, Meta(ge=1, le=1_000_000), _note("points of a Latin hypercube")] = 1
    seeds: Annotated[int, Meta(ge=1, le=1_000_000), _note("runs at each point, with seeds of their own")] = 1
    first_seed: Annotated[int, Meta(ge=0, le=2**31), _note("seed of the first run")] = 0
    design_seed: Annotated[int, Meta(ge=0, le=2**31), _note("seed of the design itself")] = 0
    parameters: tuple[Varied, ...] = ()
    faults: tuple[FaultCase, ...] = ()
    moments: tuple[Moment, ...] = ()
    """When faults begin."""
    longest: Annotated[float, Meta(gt=0.0, le=1e5), _note("simulated time, then a run is broken off", "s")] = 900.0
    wall_s: Annotated[float, Meta(gt=0.0), _note("wall clock, then a run is given up", "s")] | None = None
    metric: Annotated[str, _note("figure by which the worst runs are chosen")] = "meas_des"
    limits: tuple[Limit, ...] = ()
    """What is asked of the figures."""


class Limit(Struct, frozen=True, forbid_unknown_fields=True):
    """A bound on a quantile of a figure over all runs."""

    metric: Annotated[str, _note("name of the figure")]
    high: Annotated[float, _note("largest allowed value")]
    quantile: Annotated[float, Meta(ge=0.0, le=1.0), _note("0.5 is the median, 1 the largest")] = 0.5


class Job(Struct, frozen=True):
    """One run: all that it is flown by, and how it came about."""

    run: int
    scenario: str
    law: str | None
    sets: tuple[str, ...]
    seed: int
    longest: float
    wall_s: float | None
    values: dict[str, bool | int | float | str] = {}
    """Of the varied parameters."""
    fault: str = ""
    moment: str = ""
    ends: tuple[str, ...] = ()

    def command(self) -> str:
        """The shell command that repeats it exactly."""
        words = ["pipewright", "sim", "--scenario", self.scenario]
        words += [] if self.law is None else ["--law", self.law]
        words += ["--seed", str(self.seed)]
        words += [word for text in self.sets for word in ("--set", text)]
        words += [] if self.longest == 900.0 else ["--longest", f"{self.longest:g}"]
        return shlex.join(words)


class Plan:
    """A checked campaign, and its runs."""

    def __init__(self, name: str, campaign: Campaign, base: str = "") -> None:
        """base: all parameters that are in force before any is varied, as text."""
        self.name, self.campaign, self._base = name, campaign, base

    @property
    def cells(self) -> list[tuple[FaultCase, Moment] | None]:
        """Each fault at each of its moments; a single None where there are no faults."""
        campaign = self.campaign
        return [
            (case, moment)
            for case in campaign.faults
            for moment in campaign.moments
            if moment.name in case.moments or not case.moments
        ] or [None]

    @property
    def points(self) -> int:
        """Different values of the parameters."""
        campaign = self.campaign
        if campaign.design is Design.LATIN:
            return campaign.runs
        count = 1
        for varied in campaign.parameters:
            count *= len(varied.levels())
        return count

    def __len__(self) -> int:
        return self.points * len(self.cells) * self.campaign.seeds

    def digest(self) -> str:
        """Equal for equal runs."""
        return hashlib.sha256(msgspec.json.encode(self.campaign) + self._base.encode()).hexdigest()

    def jobs(self) -> Iterator[Job]:
        """All runs, in order."""
        campaign, run = self.campaign, 0
        cells = self.cells
        for point, values in enumerate(self._values()):
            for cell in cells:
                for k in range(campaign.seeds):
                    paired = campaign.design is Design.GRID
                    seed = campaign.first_seed + (k if paired else point * campaign.seeds + k)
                    yield self._job(run, values, cell, seed)
                    run += 1

    def _values(self) -> Iterator[dict[str, Any]]:
        parameters = self.campaign.parameters
        names = [varied.name for varied in parameters]
        if self.campaign.design is Design.GRID:
            for levels in itertools.product(*(varied.levels() for varied in parameters)):
                yield dict(zip(names, levels, strict=True))
        elif not parameters:
            yield from ({} for _ in range(self.campaign.runs))
        else:
            from scipy.stats import qmc

            cube = qmc.LatinHypercube(d=len(parameters), rng=self.campaign.design_seed)
            for shares in cube.random(self.campaign.runs):
                yield {varied.name: varied.at(float(share)) for varied, share in zip(parameters, shares, strict=True)}

    def _job(self, run: int, values: dict[str, Any], cell: tuple[FaultCase, Moment] | None, seed: int) -> Job:
        campaign = self.campaign
        sets = [*campaign.set, *(f"{name}={inline_text(value)}" for name, value in values.items())]
        case, moment = cell if cell is not None else (None, None)
        if case is not None and moment is not None:
            sets.append(f"faults={inline_text([case.fault(moment)])}")
        return Job(
            run,
            campaign.scenario,
            campaign.law,
            tuple(sets),
            seed,
            campaign.longest,
            campaign.wall_s,
            values,
            case.label if case else "",
            moment.name if moment else "",
            case.ends if case else (),
        )


def read_campaign(given: str, figures: Sequence[str], ends: Sequence[str]) -> Plan:
    """Read a campaign by the name of a shipped one, or from a file, and check all that can be checked before flying.

    figures, ends: the names that metrics and ends may have. Raises ConfigError with every error at once.
    """
    path = SHIPPED.path(given)
    campaign = read_struct(Campaign, path)
    plan = Plan(path.stem, campaign)
    errors = _wrong_names(campaign, figures, ends, path) or _wrong_points(plan, path)
    if errors:
        raise ConfigError(errors)
    base = Mission(campaign.scenario, campaign.law, campaign.set, campaign.first_seed).yaml
    return Plan(path.stem, campaign, base)


def _wrong_names(campaign: Campaign, figures: Sequence[str], ends: Sequence[str], path: Path) -> list[str]:
    def unknown(where: str, name: str, known: Sequence[str]) -> list[str]:
        if name in known:
            return []
        best = nearest(name, known)
        hint = f"nearest: {', '.join(best)}" if best else f"there are: {', '.join(known)}"
        return [f"{path}: {where} = {name!r}: no such name; {hint}"]

    columns = [moment.name for moment in campaign.moments]
    errors = unknown("metric", campaign.metric, figures)
    for k, limit in enumerate(campaign.limits):
        errors += unknown(f"limits.{k}.metric", limit.metric, figures)
    for k, case in enumerate(campaign.faults):
        for end in case.ends:
            errors += unknown(f"faults.{k}.ends", end, ends)
        for name in case.moments:
            errors += unknown(f"faults.{k}.moments", name, columns)
    for k, moment in enumerate(campaign.moments):
        errors += unknown(f"moments.{k}.phase", moment.phase, [phase.value for phase in Phase])
    if campaign.faults and not columns:
        errors.append(f"{path}: moments: missing; say when the faults begin: moments: [{{name: press, phase: press}}]")
    if campaign.design is Design.GRID and campaign.runs != 1:
        errors.append(f"{path}: runs = {campaign.runs}: a grid has as many as it has points; leave it out")
    names = [varied.name for varied in campaign.parameters]
    errors += [
        f"{path}: parameters: {name} is given twice" for name in sorted({n for n in names if names.count(n) > 1})
    ]
    return errors


def _wrong_points(plan: Plan, path: Path) -> list[str]:
    """Errors of the scenario, of the names, and of the outermost values: what all runs are made of is made once."""
    campaign = plan.campaign
    try:
        config = Mission(campaign.scenario, campaign.law, campaign.set, campaign.first_seed).config
    except ConfigError as error:
        return [f"{path}: {text}" for text in error.errors]
    except InfeasibleError as error:
        return [f"{path}: this mission cannot be flown: {error}"]
    errors: list[str] = []
    if campaign.parameters:
        try:
            find(config, [varied.name for varied in campaign.parameters])
        except ConfigError as error:
            return [f"{path}: parameters: {text}" for text in error.errors]
    edges = [
        varied.values[:1] + varied.values[-1:] or (varied.at(0.0), varied.at(1.0)) for varied in campaign.parameters
    ]
    texts = [
        [f"{v.name}={inline_text(ends[k])}" for v, ends in zip(campaign.parameters, edges, strict=True)]
        for k in (0, -1)
    ]
    faults = [case.fault(campaign.moments[0]) for case in campaign.faults]
    # Most campaigns are right: all is tried at once, and one by one only where that is refused.
    for together in texts:
        if _refusals(campaign, together, ""):
            for varied, text in zip(campaign.parameters, together, strict=True):
                errors += _refusals(campaign, [text], f"{path}: parameters: {varied.name}")
    if faults and _refusals(campaign, [f"faults={inline_text(faults)}"], ""):
        for case, fault in zip(campaign.faults, faults, strict=True):
            errors += _refusals(campaign, [f"faults={inline_text([fault])}"], f"{path}: faults: {case.label}")
    return errors


def _refusals(campaign: Campaign, texts: Sequence[str], where: str) -> list[str]:
    try:
        Mission(campaign.scenario, campaign.law, (*campaign.set, *texts), campaign.first_seed)
    except ConfigError as error:
        return [f"{where}: {words}" for words in error.errors]
    except InfeasibleError as error:
        return [f"{where}: {', '.join(texts)}: cannot be flown: {error}"]
    return []
