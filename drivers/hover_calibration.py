"""The thrust map from hovering: what set-points carried a known weight, at which battery voltage.

In a hover the thrust is known without a sensor for it: T = m (g + a) / cos(tilt), with the vertical acceleration a.
The set-point that was sent for it is known too, so each sample tells the full thrust F at its voltage,
T = F(V) r(u(s)), with the curves r of the map that was flown (``drivers/thrust.py``); curves stay as they are, for a
hover shows one point of them only. F(V) = F_0 (V / V_0)^k, and k is identified too where the voltage went far enough.

Rotors and airframe follow a set-point late. So that motion does not spoil the fit, the equations are those of
instruments that do not follow it, the constant and log V: sum w e = 0 and sum w e log(V / V_0) = 0 with
e = T - F(V) r. Least squares on r would take noise of r for a smaller F. Outliers lose weight after Huber.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, exp, isfinite, log, radians, sqrt
from statistics import median

from msgspec import Struct
from msgspec.structs import replace

from drivers.thrust import ThrustMap, motor_signal, thrust_fraction

LEAST_SAMPLES = 200
_STEEPEST, _HARDEST = radians(20.0), 2.0  # rad and m/s^2: beyond, it is no hover
_LEAST_SPAN = 0.04  # of log V, about 0.6 V of a 4S battery: less tells nothing about the exponent
_HUBER = 1.5
_ROUNDS = 30
_LARGEST_CHANGE = 0.5
_CORRELATED = (
    50.0  # so many ticks at 250 Hz are one independent sample: motion of a hover lasts some tenths of a second
)


class HoverSample(Struct, frozen=True, gc=False):
    """One tick of a hover, hands off and away from everything."""

    force: float
    """Thrust that was commanded through the map, N."""
    voltage: float
    """Battery voltage, V."""
    tilt: float
    """Angle between +z of B and the vertical, rad."""
    acceleration: float
    """Vertical acceleration of the body origin, m/s^2, upwards."""


class HoverFit(Struct, frozen=True):
    """A map, and how well the hover bears it out."""

    thrust: ThrustMap
    correction: float
    """Full thrust at the mean voltage by that of the map flown: 0.93 says that the motors gave 7 % less than told."""
    uncertainty: float
    """Standard error of ``correction``, from the scatter; slow errors (weight, wind) come on top."""
    residual: float
    """Root mean square of what the fit leaves, N."""
    samples: int
    rejected: int
    """Samples that were no hover, or not finite."""
    voltage_span: float
    """From the lowest to the highest voltage, V."""
    exponent_identified: bool
    """Otherwise the exponent is that of the map flown."""

    def words(self) -> str:
        """The figures in a sentence."""
        exponent = "identified" if self.exponent_identified else "kept: the voltage hardly changed"
        return (
            f"hovers at set-point {self.thrust.hover_thrust:.3f} at {self.thrust.hover_voltage:.2f} V; full "
            f"thrust is {100.0 * (self.correction - 1.0):+.1f} % (+-{100.0 * self.uncertainty:.1f} %) off the map; "
            f"voltage exponent {self.thrust.voltage_exponent:.2f} ({exponent}); {self.samples} samples over "
            f"{self.voltage_span:.2f} V, {self.rejected} rejected, {self.residual:.2f} N left"
        )


def calibrate(flown: ThrustMap, samples: Sequence[HoverSample], weight: float, gravity: float) -> HoverFit:
    """The map that the hover tells. ``flown`` is the map the forces went through, ``weight`` m g in N.

    Raises ValueError: too few samples that are a hover, or a result that no map can be.
    """
    mass = weight / gravity
    good = [s for s in samples if _is_hover(s)]
    if len(good) < LEAST_SAMPLES:
        raise ValueError(
            f"hover calibration: {len(good)} of {len(samples)} samples are a hover; want {LEAST_SAMPLES}, below "
            f"20 degrees of tilt, {_HARDEST:g} m/s^2 and thrust between nothing and full"
        )
    middle = median(s.voltage for s in good)
    x = [log(s.voltage / middle) for s in good]
    thrust = [mass * (gravity + s.acceleration) / cos(s.tilt) for s in good]
    share = [_fraction(flown, s) for s in good]
    identified = max(x) - min(x) >= _LEAST_SPAN
    full, exponent, weights = _fit(x, thrust, share, flown.voltage_exponent, identified)
    errors = [t - full * r * exp(exponent * p) for t, r, p in zip(thrust, share, x, strict=True)]
    residual = sqrt(sum(e * e for e in errors) / len(errors))
    scatter = sqrt(sum(w * e * e for w, e in zip(weights, errors, strict=True)) / sum(weights))
    mean_thrust = sum(thrust) / len(thrust)
    correction = full / flown.full_force(middle)
    if abs(correction - 1.0) > _LARGEST_CHANGE:
        raise ValueError(
            f"hover calibration: full thrust comes out {correction:.2f} times that of the map flown; want a weight "
            f"({weight:.2f} N) and a map that are nearer to each other"
        )
    fraction = weight / full
    if not 0.05 < fraction < 0.95:
        raise ValueError(f"hover calibration: hovers at {fraction:.2f} of full thrust; want between 0.05 and 0.95")
    return HoverFit(
        thrust=replace(
            flown,
            hover_force=weight,
            hover_thrust=thrust_fraction(motor_signal(fraction, flown.curve), flown.px4_curve),
            hover_voltage=middle,
            voltage_exponent=exponent,
        ),
        correction=correction,
        uncertainty=correction * scatter / (mean_thrust * sqrt(len(good) / _CORRELATED)),
        residual=residual,
        samples=len(good),
        rejected=len(samples) - len(good),
        voltage_span=max(s.voltage for s in good) - min(s.voltage for s in good),
        exponent_identified=identified,
    )


def _is_hover(s: HoverSample) -> bool:
    if not isfinite(s.force + s.voltage + s.tilt + s.acceleration):
        return False
    return s.voltage > 0.0 and s.force > 0.0 and abs(s.tilt) < _STEEPEST and abs(s.acceleration) < _HARDEST


def _fraction(flown: ThrustMap, s: HoverSample) -> float:
    """Share of the full thrust that the motors were told, whatever the full thrust is."""
    return thrust_fraction(motor_signal(flown.set_point(s.force, s.voltage), flown.px4_curve), flown.curve)


def _fit(
    x: Sequence[float], thrust: Sequence[float], share: Sequence[float], exponent: float, identify: bool
) -> tuple[float, float, list[float]]:
    """Full thrust at x = log(V / V_0) = 0 (N), exponent, and the weights of the samples at the end."""
    weights = [1.0] * len(x)
    full = 0.0
    for _ in range(_ROUNDS):
        power = [r * exp(exponent * p) for r, p in zip(share, x, strict=True)]
        new = _dot(weights, thrust) / _dot(weights, power)
        errors = [t - new * r for t, r in zip(thrust, power, strict=True)]
        turn = 0.0
        if identify:
            middle = _dot(weights, x) / sum(weights)
            lever = [w * (p - middle) for w, p in zip(weights, x, strict=True)]
            # one step of Newton's method on sum w (x - mean x) e = 0
            turn = _dot(lever, errors) / (new * sum(v * p * r for v, p, r in zip(lever, x, power, strict=True)))
            exponent = min(max(exponent + turn, 0.0), 3.0)
        spread = max(1.4826 * median(abs(e) for e in errors), 1e-9)
        weights = [min(1.0, _HUBER * spread / abs(e)) if e else 1.0 for e in errors]
        if abs(new - full) < 1e-9 * new and abs(turn) < 1e-9:
            break
        full = new
    return full, exponent, weights


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))
