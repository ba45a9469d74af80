"""The fuzzy law and the dynamics beside other packages that compute the same, on the same inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from math import degrees, radians
from typing import Any

import numpy as np
from msgspec import Struct

from drivers.vehicle import Vehicle
from onboard.core import fuzzy
from onboard.core.dynamics import Model
from onboard.core.fuzzy import LEVELS, PITCH_TERMS
from tests.bench.measure import Stat, calls, stat

#: Points on each range for the packages that sample their sets.
POINTS = 101
ROUNDS = 3

Side = tuple[Callable[..., Any], Sequence[tuple[Any, ...]]]
"""A function, and the inputs to call it with."""


class Comparison(Struct, frozen=True):
    """One computation, here and in another package."""

    name: str
    package: str
    """Name and version, or why there is no comparison."""
    note: str
    ours: Stat | None = None
    theirs: Stat | None = None
    ratio: float | None = None
    """Their median by ours."""
    difference: float | None = None
    """Largest difference of the results, as a share of their range."""


def compare(params: fuzzy.Params, vehicle: Vehicle) -> tuple[Comparison, ...]:
    """All comparisons; a package that is not installed leaves its row with the reason."""
    return (*_fuzzy(params), *_dynamics(vehicle))


def _row(name: str, distribution: str, note: str, ours: Side, theirs: Side, results: tuple[Any, Any]) -> Comparison:
    """Time both, in turns. results: of both, for all inputs."""
    here: list[int] = []
    there: list[int] = []
    for _ in range(ROUNDS):
        here += calls(*ours, repeats=3)
        there += calls(*theirs, repeats=1)
    a, b = (np.asarray(result) for result in results)
    apart = float(np.max(np.abs(a - b)) / (np.max(b) - np.min(b)))
    mine, other = stat(here), stat(there)
    package = f"{distribution} {version(distribution)}"
    return Comparison(name, package, note, mine, other, other.median / mine.median, apart)


def _missing(distribution: str) -> bool:
    try:
        version(distribution)
    except PackageNotFoundError:
        return True
    return False


# --- fuzzy law --------------------------------------------------------------------------------------------------------


def _fuzzy(params: fuzzy.Params) -> list[Comparison]:
    errors = np.linspace(params.force_error_low, params.force_error_high, 7).tolist()
    pitches = np.linspace(radians(params.pitch_low_deg), radians(params.pitch_high_deg), 5).tolist()
    inputs = list(product(errors, pitches))
    spread = params.output_scale * (params.output_high - params.output_low)
    low = params.output_scale * params.output_low

    def ours(error: float, pitch: float) -> float:
        return fuzzy.evaluate(error, pitch, params)

    here = [(ours(*pair) - low) / spread for pair in inputs]
    rows = []
    for distribution, note, build in (
        ("scikit-fuzzy", "its control system", _scikit_system),
        ("scikit-fuzzy", "its functions, in loops written out", _scikit_functions),
        ("simpful", "its Mamdani inference", _simpful),
    ):
        if _missing(distribution):
            rows.append(Comparison("fuzzy law", f"skipped: {distribution} is not installed", note))
            continue
        theirs = build(params)
        there = [theirs(*pair) for pair in inputs]
        note = f"{note}; {POINTS} points a range"
        rows.append(_row("fuzzy law", distribution, note, (ours, inputs), (theirs, inputs), (here, there)))
    return rows


def _triangles(low: float, high: float, count: int) -> list[list[float]]:
    """Corners of evenly spread triangles; the outermost are cut at the ends of the range."""
    peaks = np.linspace(low, high, count).tolist()
    return [[peaks[max(0, k - 1)], peaks[k], peaks[min(count - 1, k + 1)]] for k in range(count)]


def _scikit_system(params: fuzzy.Params) -> Callable[[float, float], float]:
    """Its control system of the same rules; the output from 0 to 1."""
    import skfuzzy
    from skfuzzy import control as fuzzy_control

    def variable(kind: Any, name: str, low: float, high: float, terms: Sequence[str]) -> Any:
        made = kind(np.linspace(low, high, POINTS), name)
        for term, corners in zip(terms, _triangles(low, high, len(terms)), strict=True):
            made[term] = skfuzzy.trimf(made.universe, corners)
        return made

    error = variable(fuzzy_control.Antecedent, "F", params.force_error_low, params.force_error_high, LEVELS)
    pitch = variable(fuzzy_control.Antecedent, "T", params.pitch_low_deg, params.pitch_high_deg, PITCH_TERMS)
    output = variable(fuzzy_control.Consequent, "A", 0.0, 1.0, LEVELS)
    rules = [
        fuzzy_control.Rule(error[of_error] & pitch[of_pitch], output[level])
        for of_error, row in zip(LEVELS, params.rules, strict=True)
        for of_pitch, level in zip(PITCH_TERMS, row, strict=True)
    ]
    system = fuzzy_control.ControlSystemSimulation(fuzzy_control.ControlSystem(rules), cache=False)

    def evaluate(force_error: float, pitch: float) -> float:
        system.input["F"], system.input["T"] = force_error, degrees(pitch)
        system.compute()
        return float(system.output["A"])

    return evaluate


def _scikit_functions(params: fuzzy.Params) -> Callable[[float, float], float]:
    """Its memberships and its centroid, and NumPy between them; the output from 0 to 1."""
    import skfuzzy

    def terms(low: float, high: float, count: int) -> tuple[Any, list[Any]]:
        universe = np.linspace(low, high, POINTS)
        return universe, [skfuzzy.trimf(universe, corners) for corners in _triangles(low, high, count)]

    of_error, errors = terms(params.force_error_low, params.force_error_high, len(LEVELS))
    of_pitch, pitches = terms(params.pitch_low_deg, params.pitch_high_deg, len(PITCH_TERMS))
    of_output, outputs = terms(0.0, 1.0, len(LEVELS))
    rules = [[outputs[LEVELS.index(level)] for level in row] for row in params.rules]

    def evaluate(force_error: float, pitch: float) -> float:
        rows = [skfuzzy.interp_membership(of_error, term, force_error) for term in errors]
        columns = [skfuzzy.interp_membership(of_pitch, term, degrees(pitch)) for term in pitches]
        union = np.zeros(POINTS)
        for row, line in zip(rows, rules, strict=True):
            for column, output in zip(columns, line, strict=True):
                union = np.fmax(union, np.fmin(min(row, column), output))
        return float(skfuzzy.defuzz(of_output, union, "centroid"))

    return evaluate


def _simpful(params: fuzzy.Params) -> Callable[[float, float], float]:
    """Its fuzzy system of the same rules; the output from 0 to 1."""
    import simpful

    system = simpful.FuzzySystem(show_banner=False, verbose=False)
    for name, low, high, terms in (
        ("F", params.force_error_low, params.force_error_high, LEVELS),
        ("T", params.pitch_low_deg, params.pitch_high_deg, PITCH_TERMS),
        ("A", 0.0, 1.0, LEVELS),
    ):
        sets = [
            simpful.TriangleFuzzySet(*corners, term=term)
            for corners, term in zip(_triangles(low, high, len(terms)), terms, strict=True)
        ]
        system.add_linguistic_variable(name, simpful.LinguisticVariable(sets, universe_of_discourse=[low, high]))
    system.add_rules(
        [
            f"IF (F IS {of_error}) AND (T IS {of_pitch}) THEN (A IS {level})"
            for of_error, row in zip(LEVELS, params.rules, strict=True)
            for of_pitch, level in zip(PITCH_TERMS, row, strict=True)
        ]
    )

    def evaluate(force_error: float, pitch: float) -> float:
        system.set_variable("F", force_error)
        system.set_variable("T", degrees(pitch))
        found = system.Mamdani_inference(["A"], subdivisions=POINTS - 1, aggregation_function=max)
        return float(found["A"])

    return evaluate


# --- dynamics ---------------------------------------------------------------------------------------------------------


def _dynamics(vehicle: Vehicle) -> list[Comparison]:
    names = ("inverse dynamics", "mass matrix")
    if _missing("pin"):
        return [Comparison(name, "skipped: pin (Pinocchio) is not installed", "") for name in names]
    from tests.core.test_dynamics import Tree, nine, states

    model, tree = Model.from_vehicle(vehicle), Tree(vehicle, True)
    arrays = [state for seed in range(5) for state in states(seed)]
    tuples = [(nine(q), nine(qd), nine(qdd)) for q, qd, qdd in arrays]
    joints = [tuple(tree.reduce @ values for values in state) for state in arrays]
    pin, its, data = tree.pin, tree.model, tree.data
    note = f"rnea; its tree of every bar has {its.nv} joints; their map to our 9 is not counted"
    return [
        _row(
            names[0],
            "pin",
            note,
            (lambda q, qd, qdd: model.inverse_dynamics(q, qd, qdd, True), tuples),
            (lambda q, qd, qdd: pin.rnea(its, data, q, qd, qdd), joints),
            (
                [model.inverse_dynamics(*state, True) for state in tuples],
                [tree.inverse_dynamics(*state) for state in arrays],
            ),
        ),
        _row(
            names[1],
            "pin",
            "crba; ours computes C(q, qd) with it",
            (lambda q: model.mass_matrix(q, True), [state[:1] for state in tuples]),
            (lambda q: pin.crba(its, data, q), [state[:1] for state in joints]),
            (
                [model.mass_matrix(state[0], True) for state in tuples],
                [tree.mass_matrix(state[0]) for state in arrays],
            ),
        ),
    ]
