"""Wind: a mean, and the gusts of MIL-F-8785C's low-altitude Dryden model as discrete filters.

The turbulence is frozen and carried past the vehicle by the mean wind (Taylor's hypothesis): a hovering vehicle meets
it with a speed V of its own choosing, ``carried``. Forming filters of the specification, with T = L / V:

    along the wind      H_u(s) = sigma_u sqrt(2 T_u / pi) / (1 + T_u s)
    across, vertical    H(s)   = sigma sqrt(T / pi) (1 + sqrt(3) T s) / (1 + T s)^2

Driven by white noise they give a stationary process; here each is stepped by its exact transition over one period, so
that variance and spectrum below the Nyquist frequency are those of the specification for any period.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, exp, radians, sin, sqrt
from typing import Annotated

import numpy as np
from msgspec import Struct

from drivers.samples import Vec3
from sim_backend.knob import knob

FOOT = 0.3048
#: Between two values of the wind, s; it is held meanwhile. The fastest filter is some hundred times slower.
PERIOD = 0.004
_PERIOD_NS = round(PERIOD * 1e9)


class WindParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Mean wind and gusts. Zero is off."""

    mean: Annotated[float, knob("m/s", "mean wind where the vehicle flies", 0.0, 20.0)] = 0.0
    towards_deg: Annotated[float, knob("deg", "direction it blows to, from x of W towards y", -360.0, 360.0)] = 0.0
    gusts: Annotated[float, knob("m/s", "wind at 20 ft whose turbulence there is (MIL-F-8785C: W20)", 0.0, 30.0)] = 0.0
    height: Annotated[
        float, knob("m", "above ground, for scale and intensity; the model begins at 10 ft", 0.0, 300.0)
    ] = 3.05
    carried: Annotated[float, knob("m/s", "speed at which the turbulence is carried past", 0.1, 30.0)] = 2.0


def scales(params: WindParams) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Lengths (m) and standard deviations (m/s) along, across and vertical (MIL-F-8785C, 3.7.3.4, low altitude)."""
    feet = min(max(params.height / FOOT, 10.0), 1000.0)
    shear = 0.177 + 0.000823 * feet
    long = feet / shear**1.2 * FOOT
    up = 0.1 * params.gusts
    level = up / shear**0.4
    return (long, long, feet * FOOT), (level, level, up)


class _First:
    """sigma sqrt(2 T / pi) / (1 + T s), stepped exactly."""

    def __init__(self, sigma: float, time: float, noise: Sequence[float]) -> None:
        self._keep = exp(-PERIOD / time)
        self._add = sigma * sqrt(1.0 - self._keep * self._keep)
        self.value = sigma * noise[0]

    def step(self, noise: Sequence[float]) -> None:
        self.value = self._keep * self.value + self._add * noise[0]


class _Second:
    """sigma sqrt(T / pi) (1 + sqrt(3) T s) / (1 + T s)^2, stepped exactly.

    In partial fractions it is sqrt(3) a + (1 - sqrt(3)) b with a = noise / (1 + T s), b = a / (1 + T s). The
    stationary covariance of (a, b) is sigma^2 [[1/2, 1/4], [1/4, 1/4]]; what a step adds is what keeps it.
    """

    def __init__(self, sigma: float, time: float, noise: Sequence[float]) -> None:
        share = PERIOD / time
        move = exp(-share) * np.array([[1.0, 0.0], [share, 1.0]])
        still = np.array([[0.5, 0.25], [0.25, 0.25]])
        added = still - move @ still @ move.T
        self._keep, self._share = exp(-share), share
        self._aa = sigma * sqrt(added[0, 0])
        self._ab = sigma * added[0, 1] / sqrt(added[0, 0])
        self._bb = sigma * sqrt(max(0.0, added[1, 1] - added[0, 1] ** 2 / added[0, 0]))
        self._a = sigma * sqrt(0.5) * noise[0]
        self._b = sigma * sqrt(0.125) * (noise[0] + noise[1])

    @property
    def value(self) -> float:
        return sqrt(3.0) * self._a + (1.0 - sqrt(3.0)) * self._b

    def step(self, noise: Sequence[float]) -> None:
        a, b = self._a, self._b
        self._a = self._keep * a + self._aa * noise[0]
        self._b = self._keep * (b + self._share * a) + self._ab * noise[0] + self._bb * noise[1]


class Wind:
    """The wind at the vehicle, the same over all of it. Deterministic: same seed and times, same bits."""

    def __init__(self, params: WindParams, seed: int) -> None:
        self._random = np.random.default_rng([seed, 8785])
        heading = radians(params.towards_deg)
        self._cos, self._sin = cos(heading), sin(heading)
        self._mean = params.mean
        self._next_ns = 0
        self._filters: tuple[_First | _Second, ...] = ()
        if params.gusts:
            (lu, lv, lw), (su, sv, sw) = scales(params)
            start = self._random.standard_normal(6).tolist()
            speed = params.carried
            self._filters = (
                _First(su, lu / speed, start[0:1]),
                _Second(sv, lv / speed, start[2:4]),
                _Second(sw, lw / speed, start[4:6]),
            )
        self.blows = bool(params.mean or params.gusts)
        self.velocity: Vec3 = self._turned()

    def until(self, t_ns: int) -> Vec3:
        """Velocity of the air at this time of the world, m/s, W; it never goes back."""
        if self._filters:
            while self._next_ns <= t_ns:
                noise = self._random.standard_normal(6).tolist()
                for k, each in enumerate(self._filters):
                    each.step(noise[2 * k : 2 * k + 2])
                self._next_ns += _PERIOD_NS
                self.velocity = self._turned()
        return self.velocity

    def _turned(self) -> Vec3:
        u = v = w = 0.0
        if self._filters:
            u, v, w = (each.value for each in self._filters)
        u += self._mean
        return (self._cos * u - self._sin * v, self._sin * u + self._cos * v, w)
