"""Hover calibration: the thrust map of a vehicle, from what carried it while it hovered.

Every moment of hover tells how much the rotors would give at full set-point: the force that carried the vehicle over
the fraction that its set-point stands for (``drivers.thrust``). Their logarithms lie on a line over the logarithm of
the battery voltage, whose level is the thrust and whose slope is the exponent. The curves cannot be seen at one weight.
Points far off the others (something carried or pulled, a gust) are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, log, sqrt
from statistics import median

from msgspec import Struct
from msgspec.structs import replace

from drivers.thrust import ThrustMap, motor_signal, thrust_fraction

#: A slope that is known no better than this is not taken (standard error, 1).
SLOPE_ERROR = 0.3
_LARGEST_EXPONENT = 3.0
#: Standard deviations, and share of the thrust, beyond which a point does not belong to the others.
_FAR, _LEAST_FAR = 4.0, 0.03


class HoverPoint(Struct, frozen=True, gc=False):
    """Means over a short stretch of hover."""

    force: float
    """Thrust along +z of B, N."""
    set_point: float
    """What was sent, 0..1."""
    voltage: float
    """V."""


class HoverFit(Struct, frozen=True):
    """What a hover tells."""

    thrust: ThrustMap
    spread: float
    """Root mean square of the points about the map, as a share of the force."""
    slope_error: float
    """Standard error of the voltage's exponent; infinite where the voltage never changed."""
    slope_taken: bool
    """The exponent is the hover's; else that of the map before."""
    left_out: int
    """Points that were far off the others."""


def identify(points: Sequence[HoverPoint], before: ThrustMap) -> HoverFit:
    """Fit the thrust, and the exponent where the voltage changed enough; the curves are those of ``before``.

    Raises ValueError for fewer than three points, or one without force, set-point or voltage.
    """
    if len(points) < 3:
        raise ValueError(f"{len(points)} points of hover; at least 3 are needed")
    for point in points:
        if not (0.0 < point.force < 1e4 and 0.0 < point.set_point < 1.0 and 0.0 < point.voltage < 1e3):
            raise ValueError(f"{point} is no hover; force, set-point (below 1) and voltage must be above 0")
    given = len(points)
    points = _together(points, before)
    levels = [_level(point, before) for point in points]
    volts = [log(point.voltage) for point in points]
    n = len(points)
    level, volt = sum(levels) / n, sum(volts) / n
    width = sum((v - volt) ** 2 for v in volts)
    slope, error, taken = before.voltage_exponent, float("inf"), False
    if width > 1e-9:
        steep = sum((v - volt) * (y - level) for v, y in zip(volts, levels, strict=True)) / width
        rest = sum((y - level - steep * (v - volt)) ** 2 for v, y in zip(volts, levels, strict=True))
        error = sqrt(rest / max(1, n - 2) / width)
        if error <= SLOPE_ERROR and 0.0 <= steep <= _LARGEST_EXPONENT:
            slope, taken = steep, True
    force = sum(point.force for point in points) / n
    fraction = force / exp(level)
    return HoverFit(
        thrust=replace(
            before,
            hover_force=force,
            hover_thrust=thrust_fraction(motor_signal(fraction, before.curve), before.px4_curve),
            hover_voltage=exp(volt),
            voltage_exponent=slope,
        ),
        spread=sqrt(sum((y - level - slope * (v - volt)) ** 2 for v, y in zip(volts, levels, strict=True)) / n),
        slope_error=error,
        slope_taken=taken,
        left_out=given - n,
    )


def _together(points: Sequence[HoverPoint], before: ThrustMap) -> Sequence[HoverPoint]:
    """Without those whose full thrust, brought to one voltage, is far off the median."""
    full = [_level(point, before) - before.voltage_exponent * log(point.voltage) for point in points]
    middle = median(full)
    far = max(_FAR * 1.4826 * median(abs(level - middle) for level in full), _LEAST_FAR)
    return [point for point, level in zip(points, full, strict=True) if abs(level - middle) <= far]


def _level(point: HoverPoint, thrust: ThrustMap) -> float:
    """Logarithm of the full thrust that a point tells."""
    return log(point.force / _fraction(point.set_point, thrust))


def _fraction(set_point: float, thrust: ThrustMap) -> float:
    """Share of the full thrust that a set-point stands for."""
    return thrust_fraction(motor_signal(set_point, thrust.px4_curve), thrust.curve)
