"""The fuzzy law: its range, its symmetry, how far it is monotone, and two libraries that must agree with it."""

from __future__ import annotations

from math import inf, radians
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from onboard.core import fuzzy
from onboard.core.fuzzy import LEVELS, PITCH_TERMS, Params, evaluate

PRINTED = Params()
SYMMETRIC = Params(output_low=-0.004, output_high=0.004)

steady = settings(max_examples=500)
errors = st.floats(-3.0, 3.0)
pitches = st.floats(radians(-5.0), radians(15.0))
heights = st.lists(st.floats(0.0, 1.0), min_size=5, max_size=5)


def spread(params: Params) -> float:
    return params.output_scale * (params.output_high - params.output_low)


def brute_centroid(clips: list[float], points: int = 200_001) -> float:
    x = np.linspace(0.0, 4.0, points)
    union = np.max([np.minimum(h, np.maximum(0.0, 1.0 - np.abs(x - k))) for k, h in enumerate(clips)], axis=0)
    return float(np.trapezoid(x * union, x) / np.trapezoid(union, x))


@settings(max_examples=60)
@given(heights.filter(lambda clips: max(clips) > 0.05))
def test_centroid_in_closed_form_is_the_integral(clips: list[float]) -> None:
    assert fuzzy.centroid(clips) == pytest.approx(brute_centroid(clips), abs=1e-6)


@steady
@given(
    st.floats(allow_nan=False, allow_infinity=False),
    st.floats(allow_nan=False, allow_infinity=False),
    st.floats(0.0, 1000.0),
)
def test_finite_in_gives_bounded_out(force_error: float, pitch: float, scale: float) -> None:
    params = replace(PRINTED, output_scale=scale)
    value = evaluate(force_error, pitch, params)
    assert scale * params.output_low <= value <= scale * params.output_high


def test_table_1_pushes_at_no_error_and_a_symmetric_range_does_not() -> None:
    assert evaluate(0.0, 0.0, PRINTED) == pytest.approx(0.00075)
    assert evaluate(0.0, 0.0, SYMMETRIC) == pytest.approx(0.0, abs=1e-18)


def test_values_by_hand() -> None:
    # Halfway between Z and PS, both clipped at 1/2: by symmetry the centroid is midway between their peaks.
    assert evaluate(0.5, 0.0, SYMMETRIC) == pytest.approx(0.001)
    # Only PL holds, fully: the centroid of the half triangle lies a third of its base inside the range.
    assert evaluate(2.0, 0.0, SYMMETRIC) == pytest.approx(0.004 - 0.002 / 3.0)
    # Only Z of row PS, theta = PL.
    assert evaluate(1.0, radians(9.0), SYMMETRIC) == pytest.approx(0.0, abs=1e-18)
    # At no error the columns up to PM all say Z.
    assert evaluate(0.0, radians(4.5), SYMMETRIC) == pytest.approx(0.0, abs=1e-18)


@steady
@given(errors, pitches)
def test_scale_and_saturation(force_error: float, pitch: float) -> None:
    value = evaluate(force_error, pitch, PRINTED)
    assert evaluate(force_error, pitch, replace(PRINTED, output_scale=20.0)) == pytest.approx(20.0 * value)
    held = evaluate(max(-2.0, min(2.0, force_error)), max(0.0, min(radians(9.0), pitch)), PRINTED)
    assert value == pytest.approx(held, abs=1e-15)


@steady
@given(errors, st.floats(radians(-5.0), radians(3.0)))
def test_odd_in_the_force_error_where_the_rules_are(force_error: float, pitch: float) -> None:
    """Columns Z and PS of the rules are odd, so up to the peak of PS (3 deg) a symmetric range gives an odd law."""
    mirrored = evaluate(-force_error, pitch, SYMMETRIC)
    assert evaluate(force_error, pitch, SYMMETRIC) == pytest.approx(-mirrored, abs=1e-15)


@steady
@given(errors, st.floats(0.0, 4.0), st.floats(radians(-5.0), radians(4.5)))
def test_monotone_in_the_force_error_up_to_4_5_deg(force_error: float, more: float, pitch: float) -> None:
    lower, upper = (evaluate(error, pitch, PRINTED) for error in (force_error, force_error + more))
    assert upper >= lower - 1e-12 * spread(PRINTED)


@steady
@given(errors, st.floats(0.0, 4.0), pitches)
def test_never_falls_by_more_than_2_3_per_cent_of_the_range(force_error: float, more: float, pitch: float) -> None:
    lower, upper = (evaluate(error, pitch, PRINTED) for error in (force_error, force_error + more))
    assert upper >= lower - 0.023 * spread(PRINTED)


def test_the_fall_is_inherent_to_min_max() -> None:
    """At 9 deg, NL alone holds for F_e from -2 to -1 N, weakest at -1.5; a lower clip has a centroid further inside."""
    pitch = radians(9.0)
    full, weak, again = (evaluate(error, pitch, SYMMETRIC) for error in (-2.0, -1.5, -1.0))
    assert full == pytest.approx(again)
    assert weak - again == pytest.approx((brute_centroid([0.5, 0, 0, 0, 0]) - 1.0 / 3.0) / 4.0 * 0.008, abs=1e-8)
    worst = max(
        max(np.maximum.accumulate(row) - row)
        for row in (
            np.array([evaluate(error, radians(pitch), SYMMETRIC) for error in np.linspace(-2.0, 2.0, 161).tolist()])
            for pitch in np.linspace(0.0, 9.0, 73).tolist()
        )
    )
    assert 0.02 < worst / spread(SYMMETRIC) < 0.023


@steady
@given(errors, pitches, st.floats(-1e-6, 1e-6), st.floats(-1e-6, 1e-6))
def test_no_jump(force_error: float, pitch: float, d_error: float, d_pitch: float) -> None:
    step = evaluate(force_error + d_error, pitch + d_pitch, SYMMETRIC) - evaluate(force_error, pitch, SYMMETRIC)
    # Steepest slopes found: 1.03 ranges per newton, 20 ranges per radian.
    assert abs(step) <= spread(SYMMETRIC) * (1.2 * abs(d_error) + 25.0 * abs(d_pitch)) + 1e-15


GRID = [(e, p) for e in np.linspace(-2.3, 2.3, 24).tolist() for p in np.linspace(-1.0, 10.0, 23).tolist()]


@pytest.mark.parametrize("params", [PRINTED, SYMMETRIC], ids=["printed", "symmetric"])
def test_agrees_with_scikit_fuzzy(params: Params) -> None:
    """Its membership functions and centroid, sampled finely, under min-max inference written out."""
    skfuzzy = pytest.importorskip("skfuzzy")
    out = np.linspace(params.output_low, params.output_high, 2001)
    terms = triangles(params.output_low, params.output_high, 5)
    shapes = [skfuzzy.trimf(out, list(term)) for term in terms]
    of_error = triangles(params.force_error_low, params.force_error_high, 5)
    of_pitch = triangles(params.pitch_low_deg, params.pitch_high_deg, 4)
    for error, pitch in GRID:
        inside = (np.array([np.clip(error, -2.0, 2.0)]), np.array([np.clip(pitch, 0.0, 9.0)]))
        e = [float(skfuzzy.trimf(inside[0], list(term))[0]) for term in of_error]
        p = [float(skfuzzy.trimf(inside[1], list(term))[0]) for term in of_pitch]
        union = np.zeros_like(out)
        for i, row in enumerate(params.rules):
            for j, level in enumerate(row):
                union = np.maximum(union, np.minimum(min(e[i], p[j]), shapes[LEVELS.index(level)]))
        expected = skfuzzy.defuzz(out, union, "centroid")
        assert evaluate(error, radians(pitch), params) == pytest.approx(expected, abs=1e-3 * spread(params))


def test_agrees_with_simpful() -> None:
    params = PRINTED
    simpful = pytest.importorskip("simpful")
    # Its integration wants a range of order one: the output is computed in units of the range.
    system = simpful.FuzzySystem(show_banner=False, verbose=False)
    for name, low, high, names in (
        ("F", params.force_error_low, params.force_error_high, LEVELS),
        ("T", params.pitch_low_deg, params.pitch_high_deg, PITCH_TERMS),
        ("A", 0.0, 1.0, LEVELS),
    ):
        sets = [
            simpful.TriangleFuzzySet(*corners, term=term)
            for corners, term in zip(triangles(low, high, len(names)), names, strict=True)
        ]
        system.add_linguistic_variable(name, simpful.LinguisticVariable(sets, universe_of_discourse=[low, high]))
    system.add_rules(
        [
            f"IF (F IS {error}) AND (T IS {pitch}) THEN (A IS {level})"
            for error, row in zip(LEVELS, params.rules, strict=True)
            for pitch, level in zip(PITCH_TERMS, row, strict=True)
        ]
    )
    for error, pitch in GRID[::7]:
        system.set_variable("F", float(np.clip(error, -2.0, 2.0)))
        system.set_variable("T", float(np.clip(pitch, 0.0, 9.0)))
        fraction = system.Mamdani_inference(["A"], subdivisions=1000, aggregation_function=max)["A"]
        expected = params.output_low + fraction * (params.output_high - params.output_low)
        assert evaluate(error, radians(pitch), params) == pytest.approx(expected, abs=1e-3 * spread(params))


def triangles(low: float, high: float, count: int) -> list[tuple[float, float, float]]:
    """Corners of evenly spread triangles; the outermost are cut at the range's ends."""
    peaks = np.linspace(low, high, count).tolist()
    return [(peaks[max(0, k - 1)], peaks[k], peaks[min(count - 1, k + 1)]) for k in range(count)]


def rules_with(row: int, column: int, level: str) -> Any:
    table = [list(line) for line in PRINTED.rules]
    table[row][column] = cast(Any, level)
    return tuple(tuple(line) for line in table)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rules": PRINTED.rules[:4]}, "want 5 rows"),
        ({"rules": (*PRINTED.rules[:4], ("PL", "PL", "PS"))}, r"of 4 terms .* not 5 rows of 4, 4, 4, 4, 3"),
        ({"rules": rules_with(2, 1, "PM")}, r"F_e = Z, theta = PS: 'PM' is none of NL NS Z PS PL"),
        ({"rules": rules_with(3, 2, "NL")}, r"theta = PM: the output falls from Z \(F_e = Z\) to NL \(F_e = PS\)"),
        ({"force_error_low": 0.0, "force_error_high": 0.0}, "force_error_low = 0.0 must be less than"),
        ({"pitch_low_deg": 9.0}, "pitch_low_deg = 9.0 must be less than pitch_high_deg = 9.0"),
        ({"output_low": 0.0, "output_high": 0.0}, "output_low = 0.0 must be less than output_high"),
    ],
)
def test_bad_parameters_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Params(**change)
    with pytest.raises(ValueError, match=words):
        replace(PRINTED, **change)


def test_bad_parameters_are_refused_when_read() -> None:
    with pytest.raises(msgspec.ValidationError, match=r"\$\.rules\[2\]\[1\]"):
        msgspec.convert({"rules": rules_with(2, 1, "PM")}, Params)
    with pytest.raises(msgspec.ValidationError, match="the output falls from"):
        msgspec.convert({"rules": rules_with(3, 2, "NL")}, Params)
    assert msgspec.convert(msgspec.to_builtins(PRINTED), Params) == PRINTED


@pytest.mark.parametrize("bad", [float("nan")])
def test_what_is_not_a_number_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="NaN"):
        evaluate(bad, 0.0, PRINTED)
    with pytest.raises(ValueError, match="NaN"):
        evaluate(0.0, bad, PRINTED)
    assert evaluate(inf, 0.0, PRINTED) == evaluate(2.0, 0.0, PRINTED)
