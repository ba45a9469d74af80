"""Admittance, observer, contact trigger and force profile."""

from __future__ import annotations

import itertools
from math import exp, isfinite

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.samples import Vec3
from onboard.core import admittance, contact_trigger, force_profile, math3, observer, tare
from tests.core.strategies import number, vector

DT = 0.004


# --- admittance -------------------------------------------------------------------------------------------------------


def test_admittance_integrates_twice_when_undamped() -> None:
    p = admittance.Params(damping=0.0)
    state = admittance.State()
    for _ in range(500):
        state, _ = admittance.step(state, 0.003, p, DT)
    assert state.velocity == pytest.approx(0.006, rel=1e-9)
    assert state.displacement == pytest.approx(0.5 * 0.003 * 2.0**2, rel=0.01)


@given(st.lists(number(5.0), min_size=1, max_size=60))
def test_admittance_is_bounded_odd_and_does_not_wind_up(accelerations: list[float]) -> None:
    p = admittance.Params()
    state, mirror = admittance.State(), admittance.State()
    for a in accelerations:
        for _ in range(20):
            state, applied = admittance.step(state, a, p, DT)
            mirror, _ = admittance.step(mirror, -a, p, DT)
            assert isfinite(applied)
            assert abs(state.displacement) <= p.displacement_max
            assert abs(state.velocity) <= p.velocity_max
            assert mirror.displacement == pytest.approx(-state.displacement, abs=1e-12)
    for _ in range(5):
        state, _ = admittance.step(admittance.State(p.displacement_max, 0.0), -0.5, p, DT)
    assert state.displacement < p.displacement_max


# --- observer ---------------------------------------------------------------------------------------------------------

MASS, G = 2.4, 9.80665
LEVEL = math3.matrix_from_euler((0.0, 0.0, 0.0))
STILL: Vec3 = (0.0, 0.0, 0.0)
REST = observer.State()


def observe(
    force: Vec3,
    params: observer.Params,
    desired: Vec3 = (0.0, 0.0, 0.0),
    seconds: float = 2.0,
    state: observer.State = REST,
    axis: Vec3 = (0.0, 0.0, 1.0),
) -> observer.State:
    thrust = MASS * G
    ax, ay, az = (thrust * a / MASS + f / MASS for a, f in zip(axis, force, strict=True))
    measured = (ax, ay, az - G)
    for _ in range(round(seconds / DT)):
        state = observer.step(state, measured, desired, thrust, axis, MASS, G, params, DT)
    return state


@given(vector(5.0), st.floats(-0.3, 0.3))
@settings(max_examples=30)
def test_observer_reads_the_external_force_at_any_tilt(force: Vec3, lean: float) -> None:
    axis = (lean, 0.0, (1.0 - lean * lean) ** 0.5)
    state = observe(force, observer.Params(), axis=axis)
    assert state.force == pytest.approx(force, abs=1e-6)


def test_observer_filter_is_equation_14() -> None:
    p = observer.Params(cutoff=20.0)
    state = observe((1.0, 0.0, 0.0), p, seconds=DT)
    assert state.force[0] == pytest.approx(20.0 * DT / (1.0 + 20.0 * DT))
    state = observe((1.0, 0.0, 0.0), p, seconds=0.1)
    assert state.force[0] == pytest.approx(1.0 - exp(-2.0), abs=0.02)


def test_printed_form_reads_the_desired_acceleration_as_force() -> None:
    """What eq. 11 does in motion, and why the other form is the default."""
    moving = (0.5, -0.25, 0.3)
    printed = observe((0.0, 0.0, 0.0), observer.Params(desired_acceleration=True), moving)
    assert printed.force == pytest.approx((-MASS * 0.5, MASS * 0.25, 0.0), abs=1e-6)
    plain = observe((0.0, 0.0, 0.0), observer.Params(desired_acceleration=False), moving)
    assert plain.force == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_tare_removes_what_is_read_in_hover() -> None:
    state = tare.State()
    for _ in range(100):
        state = tare.accumulate(state, (0.1, -0.05, 0.2))
    assert tare.drop(state) == tare.State()
    state = tare.finish(state)
    assert state.count == 0
    assert tare.less((0.1, -0.05, 1.2), state.tare, LEVEL) == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)


@pytest.mark.parametrize("share", [0.85, 1.1])
def test_a_tare_in_hover_holds_for_a_leaning_vehicle_whose_thrust_is_not_what_is_commanded(share: float) -> None:
    """A map of thrust that is wrong by a share: what it makes of 7 degrees of lean must not pass for a force."""
    p, lean = observer.Params(), math3.matrix_from_euler((0.0, 0.12, 0.0))
    told = share * MASS * G
    state = observer.State()
    for _ in range(500):
        state = observer.step(state, STILL, STILL, told, (0.0, 0.0, 1.0), MASS, G, p, DT)
    hover = tare.finish(tare.accumulate(tare.State(), state.force))
    pushed = (-MASS * G * lean[2], 0.0, MASS * G * (1.0 - lean[8]))  # stands still with the thrust of the hover
    for _ in range(500):
        state = observer.step(state, STILL, STILL, told, (lean[2], lean[5], lean[8]), MASS, G, p, DT)
    assert tare.less(state.force, hover.tare, lean) == pytest.approx(pushed, abs=1e-6)


def test_thrust_lag_delays_the_model() -> None:
    p = observer.Params(thrust_lag=0.04, cutoff=200.0)
    state = observer.step(
        observer.State(thrust=20.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 24.0, (0.0, 0.0, 1.0), MASS, G, p, DT
    )
    assert state.thrust == pytest.approx(20.0 + 4.0 * DT / (0.04 + DT))


@given(vector(1e4), vector(1e4), st.floats(0.0, 60.0))
def test_observer_is_finite(acceleration: Vec3, desired: Vec3, thrust: float) -> None:
    state = observer.step(
        observer.State(), acceleration, desired, thrust, (0.1, 0.0, 0.99), MASS, G, observer.Params(), DT
    )
    assert all(isfinite(x) for x in state.force)


# --- contact trigger --------------------------------------------------------------------------------------------------

T = contact_trigger.Params()
NO_CONTACT = contact_trigger.State()


def run(
    pairs: list[tuple[float, float]],
    state: contact_trigger.State = NO_CONTACT,
    desired: float = 0.0,
    felt: float = 0.0,
    params: contact_trigger.Params = T,
    again: bool = False,
) -> contact_trigger.State:
    for distance, force in pairs:
        state = contact_trigger.step(state, distance, force, felt, desired, params, DT, again)
    return state


def test_trigger_wants_place_and_force_for_the_debounce() -> None:
    n = round(T.debounce / DT) + 1
    assert run([(0.0, 1.0)] * n).contact
    assert not run([(0.0, 1.0)] * (n - 2)).contact
    assert not run([(T.tolerance * 1.1, 1.0)] * n).contact, "force far from the crack is wind"
    assert not run([(0.0, T.threshold * 0.9)] * n).contact, "at the crack without force is no contact"
    assert not run(([(0.0, 1.0)] * (n - 2) + [(0.0, 0.0)]) * 5).contact, "an interruption starts the debounce again"


def test_contact_that_was_lost_is_found_wherever_it_would_not_be_lost() -> None:
    n = round(T.debounce / DT) + 1
    for far, found in ((1.9, True), (2.1, False)):
        pairs = [(T.tolerance * far, 1.0)] * n
        assert run(pairs, again=True).contact is found
        assert not run(pairs).contact


def test_trigger_lets_go_only_after_its_time() -> None:
    held = contact_trigger.State(True)
    n = round(T.lost_time / DT) + 1
    assert run([(0.0, 0.0)] * (n - 2), held).contact
    assert not run([(0.0, 0.0)] * n, held).contact
    assert run([(0.0, 0.0), (0.0, 0.2)] * 5 * n, held).contact, "as often with force as without"
    assert not run(([(0.0, 0.0)] * 9 + [(0.0, 0.2)]) * n, held).contact, "a noisy reading now and then hides no loss"


def test_a_push_into_nothing_is_told_at_once() -> None:
    held = contact_trigger.State(True)
    n = round(T.short_time / DT) + 1
    assert not run([(0.0, 0.3 * 2.5)] * n, held, 2.5).contact
    assert run([(0.0, 0.5 * 2.5)] * 10 * n, held, 2.5).contact, "half the force is contact still"
    assert run([(0.0, 0.1)] * n, held, 0.3).contact, "at the bias, little force is nothing special"


def test_a_force_that_the_joints_do_not_feel_is_wind() -> None:
    asks = contact_trigger.Params(felt=0.2)
    assert not run([(0.0, 1.0)] * 500, felt=0.1, params=asks).contact
    assert run([(0.0, 1.0)] * 500, felt=0.3, params=asks).contact
    assert not run([(0.0, 0.0)] * 500, felt=0.3, params=asks).contact, "nor do the joints alone make a contact"


def test_a_force_that_rises_slowly_is_wind() -> None:
    asks = contact_trigger.Params(onset=0.15, onset_time=0.5)
    gust = [(0.0, 0.1 * DT * k) for k in range(round(10.0 / DT))]
    assert not run(gust, params=asks).contact
    touch = [(0.0, 0.5)] * 50 + [(0.0, 0.5 + 2.0 * DT * k) for k in range(round(0.5 / DT))]
    assert run(touch, params=asks).contact
    assert run(gust).contact, "without the onset asked for, it would pass for one"


# --- force profile ----------------------------------------------------------------------------------------------------


@given(st.floats(0.5, 4.0), st.floats(0.5, 60.0), st.floats(0.0, 2.0))
@settings(max_examples=25)
def test_profile_is_smooth_bounded_and_ends_at_the_bias(force: float, hold: bool, start: float) -> None:
    p = force_profile.Params()
    total = p.settle + 2.0 * p.bias_hold + 2.0 * p.ramp + hold
    dt = 0.01
    values = [force_profile.desired_force(k * dt, start, force, hold, p) for k in range(round(total / dt) + 3)]
    f = [v for v, _ in values]
    assert f[0] == start
    assert min(f) >= min(start, p.bias, force) - 1e-12
    assert max(f) <= max(start, p.bias, force) + 1e-12
    fastest = 15.0 / 8.0 * max(abs(force - p.bias) / p.ramp, abs(start - p.bias) / p.settle)
    assert max(abs(a - b) for a, b in itertools.pairwise(f)) <= fastest * dt * 1.01 + 1e-12
    last, ended = values[-1]
    assert ended
    assert last == pytest.approx(p.bias)
    assert not values[round((total - 0.1) / dt)][1]
    middle = p.settle + p.bias_hold + p.ramp + 0.5 * hold
    assert force_profile.desired_force(middle, start, force, hold, p)[0] == pytest.approx(force)
