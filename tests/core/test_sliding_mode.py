"""Fast terminal sliding mode: equations, continuity inside epsilon, bounds, odd symmetry, convergence."""

from __future__ import annotations

import itertools
from math import isfinite

import pytest
from hypothesis import given
from hypothesis import strategies as st

from onboard.core import sliding_mode
from onboard.core.sliding_mode import ZERO, Gains, Params, Six, State
from tests.core.strategies import number, six

P = Params()
DT = 0.004


@given(st.floats(0.021, 1.0), number(1.0), number(3.0))
def test_is_equations_5_to_7_outside_the_regularisation(error: float, rate: float, acceleration: float) -> None:
    g = P.attitude
    e = (error, 0.0, 0.0, 0.0, 0.0, 0.0)
    _, out, xi = sliding_mode.step(State(), e, (rate, *ZERO[1:]), (acceleration, *ZERO[1:]), False, P, DT)
    s = rate + g.sliding * error**g.exponent
    v = acceleration - g.sliding * g.exponent * error ** (g.exponent - 1.0) * rate
    if abs(s) > g.layer:
        expected = v - g.reaching * abs(s) ** 0.5 * (1.0 if s > 0.0 else -1.0)
    else:
        expected = v - g.reaching * g.layer**0.5 * s / g.layer
    assert out[0] == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert xi == ZERO


@pytest.mark.parametrize("gains", [P.attitude, Gains(exponent=0.5, epsilon=0.1)])
def test_surface_is_continuous_and_rising_through_epsilon_and_zero(gains: Gains) -> None:
    points = [k * 1e-4 for k in range(-2000, 2001)]
    values = [sliding_mode.surface_rate(x, gains) for x in points]
    steps = [b - a for a, b in itertools.pairwise(values)]
    slope = gains.sliding * gains.epsilon ** (gains.exponent - 1.0)
    assert all(0.0 < step <= slope * 1e-4 * 1.001 for step in steps)


@given(six(1e3), six(1e3), six(1e3), six(20.0), six(0.4))
def test_finite_bounded_and_odd(error: Six, rate: Six, acceleration: Six, integral: Six, adapted: Six) -> None:
    def flip(v: Six) -> Six:
        return (-v[0], -v[1], -v[2], -v[3], -v[4], -v[5])

    state, out, xi = sliding_mode.step(State(integral, adapted), error, rate, acceleration, True, P, DT)
    assert all(isfinite(x) for x in out)
    for i, g in enumerate((P.attitude,) * 3 + (P.joints,) * 3):
        assert abs(xi[i]) <= g.adaptation_bound
        assert abs(state.integral[i]) <= g.integral_bound
    _, other, _ = sliding_mode.step(
        State(flip(integral), flip(adapted)), flip(error), flip(rate), flip(acceleration), True, P, DT
    )
    assert other == pytest.approx(flip(out))


def test_nothing_is_learnt_on_the_ground() -> None:
    state, _, _ = sliding_mode.step(State(), (0.3,) * 6, (0.0,) * 6, ZERO, False, P, DT)
    assert state == State()


@pytest.mark.parametrize("disturbance", [0.0, 3.0, -3.0])
def test_a_disturbed_axis_converges(disturbance: float) -> None:
    """A double integrator with a constant disturbance (rad/s^2) reaches the reference and stays, without chatter."""
    state, x, v = State(), 0.3, 0.0
    tail = []
    for k in range(2500):
        state, out, xi = sliding_mode.step(state, (x, *ZERO[1:]), (v, *ZERO[1:]), ZERO, True, P, DT)
        v += DT * (out[0] + xi[0] / 0.05 + disturbance)
        x += DT * v
        if k > 2000:
            tail.append(x)
    assert max(map(abs, tail)) < 2e-4


def test_no_jump_at_take_over() -> None:
    """Seeded at the reference, the law adds nothing to the desired acceleration."""
    _, out, xi = sliding_mode.step(State(), ZERO, ZERO, (0.5, -0.2, 0.0, 0.1, 0.0, 0.0), True, P, DT)
    assert out == (0.5, -0.2, 0.0, 0.1, 0.0, 0.0)
    assert xi == ZERO
