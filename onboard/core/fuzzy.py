"""Mamdani fuzzy law: force error and pitch to the compliant acceleration (paper, section V-B and Table I).

Triangular terms, their peaks spread evenly over each range, each reaching to its neighbours' peaks; beyond a
range its outermost term stays 1. A rule holds to the smaller of its two memberships (min), a term of the output to
the largest of its rules (max), and the output is the centroid of the union of the clipped terms, in closed form.

Signs: a positive force error (too little force) gives a positive acceleration, towards the pipe.

Two properties of the method, not of this file:

- The peak of Z is the middle of the output range. Table I's range is not symmetric, so that law pushes with
  0.00075 m/s^2 at no error.
- Min-max inference with a centroid is not monotone everywhere. Halfway between two rows of F_e all memberships are at
  most 1/2: where both rows name the same term its clip dips there, which moves the centroid towards the other terms,
  or, for an outermost term, inwards. With the rules below the output never falls with rising force error in the
  lower half of the pitch range (Table I: up to 4.5 deg), and above falls by at most 2.3 % of the output range. A
  ``pitch_high_deg`` of twice the largest pitch in use keeps the law where it is monotone.
"""

from __future__ import annotations

from itertools import pairwise
from math import radians
from typing import Annotated, Literal, get_args

from msgspec import Struct

from onboard.core.spec import note, spec

Level = Literal["NL", "NS", "Z", "PS", "PL"]
Row = tuple[Level, Level, Level, Level]
Rules = tuple[Row, Row, Row, Row, Row]

LEVELS: tuple[Level, ...] = get_args(Level)
"""Terms of the force error and of the output, in rising order."""
PITCH_TERMS = ("Z", "PS", "PM", "PL")
"""Terms of the pitch, in rising order."""

_INDEX = {level: index for index, level in enumerate(LEVELS)}


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Ranges and rules; the defaults are Table I as printed, and the rules its text describes."""

    force_error_low: Annotated[float, spec("N", -20.0, 0.0, "peak of the term NL of the force error")] = -2.0
    force_error_high: Annotated[float, spec("N", 0.0, 20.0, "peak of the term PL of the force error")] = 2.0
    pitch_low_deg: Annotated[float, spec("deg", -45.0, 45.0, "peak of the term Z of the pitch")] = 0.0
    pitch_high_deg: Annotated[float, spec("deg", -45.0, 45.0, "peak of the term PL of the pitch")] = 9.0
    output_low: Annotated[float, spec("m/s^2", -1.0, 0.0, "peak of the term NL of the acceleration")] = -0.003
    output_high: Annotated[float, spec("m/s^2", 0.0, 1.0, "peak of the term PL of the acceleration")] = 0.0045
    output_scale: Annotated[float, spec("1", 0.0, 1000.0, "factor on the acceleration")] = 1.0
    rules: Annotated[Rules, note("term of the acceleration: rows F_e = NL NS Z PS PL, columns theta = Z PS PM PL")] = (
        ("NL", "NL", "NL", "NL"),
        ("NS", "NS", "NS", "NL"),
        ("Z", "Z", "Z", "NS"),
        ("PS", "PS", "PS", "Z"),
        ("PL", "PL", "PS", "Z"),
    )

    def __post_init__(self) -> None:
        """Refuse empty ranges and rule tables that are not 5 x 4, name unknown terms, or fall with the force error."""
        for name in ("force_error", "pitch", "output"):
            unit = "_deg" if name == "pitch" else ""
            low, high = getattr(self, f"{name}_low{unit}"), getattr(self, f"{name}_high{unit}")
            if not low < high:
                raise ValueError(f"{name}_low{unit} = {low} must be less than {name}_high{unit} = {high}")
        _check(self.rules)


def evaluate(force_error: float, pitch: float, params: Params) -> float:
    """Compliant acceleration (m/s^2) for a force error (N) and a pitch (rad), both finite.

    The result lies between output_scale * output_low and output_scale * output_high.
    """
    row, upper = _place(force_error, params.force_error_low, params.force_error_high, 4)
    low, high = radians(params.pitch_low_deg), radians(params.pitch_high_deg)
    column, right = _place(pitch, low, high, 3)
    lower, left = 1.0 - upper, 1.0 - right
    heights = [0.0, 0.0, 0.0, 0.0, 0.0]
    rules_below, rules_above = params.rules[row], params.rules[row + 1]
    for level, of_error, of_pitch in (
        (rules_below[column], lower, left),
        (rules_below[column + 1], lower, right),
        (rules_above[column], upper, left),
        (rules_above[column + 1], upper, right),
    ):
        index = _INDEX[level]
        height = of_error if of_error < of_pitch else of_pitch
        if height > heights[index]:
            heights[index] = height
    spread = params.output_high - params.output_low
    return params.output_scale * (params.output_low + 0.25 * spread * centroid(heights))


def centroid(heights: list[float]) -> float:
    """Centroid, 0..4, of the union of five triangles with peaks at 0..4 and half-width 1, each clipped at its height.

    The outermost two are cut at 0 and 4. Only neighbours overlap, so the union is the sum of the clipped triangles less
    the overlaps. A triangle clipped at h has the area 2 h - h^2; two neighbours, the lower clipped at m, overlap in
    a trapezoid of area m (1 - m), or from m = 1/2 on a triangle of area 1/4, midway between the peaks.
    """
    h0, h1, h2, h3, h4 = heights
    end_0, end_4 = h0 - 0.5 * h0 * h0, h4 - 0.5 * h4 * h4
    area_1, area_2, area_3 = h1 * (2.0 - h1), h2 * (2.0 - h2), h3 * (2.0 - h3)
    over_0, over_1, over_2, over_3 = _overlap(h0, h1), _overlap(h1, h2), _overlap(h2, h3), _overlap(h3, h4)
    area = end_0 + area_1 + area_2 + area_3 + end_4 - over_0 - over_1 - over_2 - over_3
    moment = (
        _end_moment(h0) + area_1 + 2.0 * area_2 + 3.0 * area_3 + 4.0 * end_4 - _end_moment(h4)
        - 0.5 * over_0 - 1.5 * over_1 - 2.5 * over_2 - 3.5 * over_3
    )  # fmt: skip
    return moment / area


def _place(value: float, low: float, high: float, intervals: int) -> tuple[int, float]:
    """Interval between two neighbouring peaks, and the membership of the upper one (the lower one's is the rest)."""
    scaled = (value - low) * intervals / (high - low)
    if scaled <= 0.0:
        return 0, 0.0
    if scaled >= intervals:
        return intervals - 1, 1.0
    index = int(scaled)
    return index, scaled - index


def _overlap(a: float, b: float) -> float:
    least = a if a < b else b
    return least * (1.0 - least) if least < 0.5 else 0.25


def _end_moment(h: float) -> float:
    """First moment about its own peak of an outermost triangle clipped at h."""
    return h * (0.5 + h * (h / 6.0 - 0.5))


def _check(rules: Rules) -> None:
    if len(rules) != len(LEVELS) or any(len(row) != len(PITCH_TERMS) for row in rules):
        shape = f"{len(rules)} rows of {', '.join(str(len(row)) for row in rules)}"
        raise ValueError(f"rules: want 5 rows (F_e = {' '.join(LEVELS)}) of 4 terms (theta = Z PS PM PL), not {shape}")
    for term, row in zip(LEVELS, rules, strict=True):
        for pitch, level in zip(PITCH_TERMS, row, strict=True):
            if level not in _INDEX:
                raise ValueError(f"rules: F_e = {term}, theta = {pitch}: {level!r} is none of {' '.join(LEVELS)}")
    for (term, row), (above, next_row) in pairwise(zip(LEVELS, rules, strict=True)):
        for pitch, level, next_level in zip(PITCH_TERMS, row, next_row, strict=True):
            if _INDEX[next_level] < _INDEX[level]:
                raise ValueError(
                    f"rules: theta = {pitch}: the output falls from {level} (F_e = {term}) to {next_level} "
                    f"(F_e = {above}); more force error must not push less"
                )
