"""The translation law: equations as printed, bounded adaptation, compliance, no jump at take-over."""

from __future__ import annotations

import itertools
from math import cos, isfinite, sin

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.samples import Vec3
from onboard.core import backstepping
from onboard.core.backstepping import Params, State
from tests.core.strategies import number, vector

MASS, WEIGHT, DT = 2.4, 23.5, 0.004
PRINTED = Params(compliant=False, freeze_in_contact=False, feed_forward=0.0, leak=0.0)


START = State()
ZERO: Vec3 = (0.0, 0.0, 0.0)


def law(
    state: State = START,
    error: Vec3 = ZERO,
    rate: Vec3 = ZERO,
    acceleration: Vec3 = ZERO,
    heading: float = 0.0,
    contact: float = 0.0,
    adapt: bool = True,
    hold: bool = False,
    force: float = 0.0,
    params: Params = PRINTED,
    wind: Vec3 = ZERO,
) -> tuple[State, Vec3, Vec3]:
    normal = (cos(heading), sin(heading))
    return backstepping.step(
        state, error, rate, acceleration, MASS, WEIGHT, normal, contact, adapt, hold, force, wind, params, DT
    )


@given(vector(2.0), vector(2.0), vector(3.0), vector(3.0))
def test_is_equations_2_and_3(error: Vec3, rate: Vec3, acceleration: Vec3, disturbance: Vec3) -> None:
    p = PRINTED
    alpha, gamma = (p.alpha, p.alpha, p.alpha_z), (p.gamma, p.gamma, p.gamma_z)
    _, force, v = law(State(disturbance), error, rate, acceleration, adapt=False)
    for i in range(3):
        e2 = rate[i] + alpha[i] * error[i]
        expected = acceleration[i] - alpha[i] * rate[i] - gamma[i] * e2 - error[i]
        assert v[i] == pytest.approx(expected, abs=1e-9)
        assert force[i] == pytest.approx(MASS * expected + disturbance[i] + (WEIGHT if i == 2 else 0.0), abs=1e-9)


def test_the_wind_is_leant_against_as_it_is_observed() -> None:
    params = Params(wind=0.5, wind_bandwidth=5.0, alpha=1.0, beta=0.0, beta_z=0.0)
    state, wind = START, (0.4, -0.2, 0.3)
    for _ in range(1000):
        state, force, _ = law(state, wind=wind, params=params)
    assert force == pytest.approx((-0.2, 0.1, WEIGHT), abs=1e-6)
    off, force, _ = law(state, wind=wind, params=Params())
    assert force == pytest.approx((0.0, 0.0, WEIGHT))
    assert off.wind == state.wind


def test_while_friction_holds_the_tip_nothing_is_learnt_across_the_normal() -> None:
    params = Params(wind=1.0, grip=1.0)
    error, wind = (0.0, 0.1, -0.1), (0.3, 0.3, 0.0)
    held, _, _ = law(error=error, wind=wind, contact=1.0, hold=True, force=1.5, params=params)
    assert held.disturbance == (0.0, 0.0, 0.0)
    assert held.wind[0] > 0.0
    assert held.wind[1] == 0.0
    loose, _, _ = law(error=error, wind=wind, contact=1.0, hold=True, force=0.5, params=params)
    assert loose.disturbance[1] < 0.0 < loose.disturbance[2]
    assert loose.wind[1] > 0.0


def test_adaptation_opposes_the_augmented_error_and_is_bounded() -> None:
    state, _, _ = law(error=(0.1, 0.0, -0.2))
    assert state.disturbance[0] < 0.0 < state.disturbance[2]
    assert state.disturbance[0] == pytest.approx(-PRINTED.beta * PRINTED.alpha * 0.1 * DT)
    for _ in range(200_000):
        state, _, _ = law(state, error=(5.0, 0.0, -5.0))
    assert state.disturbance == (-PRINTED.bound, 0.0, PRINTED.bound)


def test_leak_forgets() -> None:
    state = State((1.0, 0.0, 0.0))
    for _ in range(1000):
        state, _, _ = law(state, params=Params(leak=0.5))
    assert state.disturbance[0] == pytest.approx(2.718281828 ** (-0.5 * 1000 * DT), rel=1e-2)


@given(vector(1e6), vector(1e6), vector(1e6), number(3.2), st.floats(0.0, 1.0), st.booleans(), number(10.0))
def test_finite_in_finite_out(
    error: Vec3, rate: Vec3, acceleration: Vec3, heading: float, contact: float, hold: bool, force: float
) -> None:
    state, tau, v = law(State(), error, rate, acceleration, heading, contact, True, hold, force, Params())
    assert all(isfinite(x) for x in (*tau, *v, *state.disturbance))
    assert all(abs(x) <= Params().bound for x in state.disturbance)


@given(vector(1.0), vector(1.0), vector(1.0), number(3.2), st.floats(0.0, 1.0))
def test_is_odd_but_for_the_weight(error: Vec3, rate: Vec3, acceleration: Vec3, heading: float, contact: float) -> None:
    def flip(v: Vec3) -> Vec3:
        return (-v[0], -v[1], -v[2])

    _, tau, _ = law(
        error=error, rate=rate, acceleration=acceleration, heading=heading, contact=contact, params=Params()
    )
    _, back, _ = law(
        error=flip(error),
        rate=flip(rate),
        acceleration=flip(acceleration),
        heading=heading,
        contact=contact,
        params=Params(),
    )
    for i in range(3):
        assert tau[i] + back[i] == pytest.approx(2.0 * WEIGHT if i == 2 else 0.0, abs=1e-9)


@given(number(3.2))
@settings(max_examples=30)
def test_compliance_acts_along_the_normal_alone(heading: float) -> None:
    p = Params(contact_stiffness=0.5, contact_damping=0.7)
    n, t = (cos(heading), sin(heading)), (-sin(heading), cos(heading))
    _, along, _ = law(error=(0.1 * n[0], 0.1 * n[1], 0.0), heading=heading, contact=1.0, adapt=False, params=p)
    assert along[0] * n[0] + along[1] * n[1] == pytest.approx(-MASS * 0.5 * 0.1)
    _, across, _ = law(error=(0.1 * t[0], 0.1 * t[1], 0.0), heading=heading, contact=1.0, adapt=False, params=p)
    assert across[0] * t[0] + across[1] * t[1] == pytest.approx(-MASS * (p.alpha * p.gamma + 1.0) * 0.1)


def test_adaptation_rests_along_the_normal_at_the_pipe() -> None:
    state, _, _ = law(error=(0.1, 0.2, 0.0), hold=True, params=Params(freeze_in_contact=True))
    assert state.disturbance[0] == 0.0
    assert state.disturbance[1] < 0.0


def test_the_desired_force_is_fed_forward_along_the_normal() -> None:
    _, tau, _ = law(heading=0.5, contact=1.0, force=2.0, params=Params(feed_forward=1.0))
    assert tau[0] == pytest.approx(2.0 * cos(0.5))
    assert tau[1] == pytest.approx(2.0 * sin(0.5))


def test_turning_compliant_is_continuous() -> None:
    """No jump at take-over: a small change of the blend changes the force a little."""
    forces = [law(error=(0.05, 0.0, 0.0), contact=c / 100.0, force=0.2, params=Params())[1][0] for c in range(101)]
    assert max(abs(a - b) for a, b in itertools.pairwise(forces)) < 0.02
