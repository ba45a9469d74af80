"""The force estimators, each against forces that are known: constant, stepped and rising; in wind; with model errors.

The vehicle here is a body that does not turn unless told to, whose arm holds still or swings: the linear rows of the
dynamics are integrated, and what the servos must give follows from the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import isfinite, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from drivers.samples import ServoState, Vec3
from onboard.config import load_config
from onboard.core import contact_trigger, estimators, math3, momentum_observer, tare, thrust_model
from onboard.core.derived import derive
from onboard.core.estimators import Command, Sight, State
from onboard.core.params import Params
from onboard.core.types import Estimator, Forces
from onboard.ukf import Ukf

#: Without drag, so that the paper's observer, which knows none, sees what the others see.
CONFIG = load_config("paper", sets=["vehicle.base.drag=[0,0,0]"])
DERIVED = derive(CONFIG)
DT, G = 0.004, CONFIG.vehicle.gravity
MASS = DERIVED.model.mass(True)
JOINTS: Vec3 = (-1.0, 1.0, 0.0)
ZERO: Vec3 = (0.0, 0.0, 0.0)
NAMES = tuple(estimator.value for estimator in Estimator)
Profile = Callable[[float], float]


class Craft:
    """A vehicle that is pushed at its tip by a pipe (along -x) and at its base by wind, and its estimators."""

    def __init__(self, config: Params = CONFIG, mass: float = 1.0, thrust: float = 1.0, lag: float = 0.0) -> None:
        """Mass, thrust: the true ones over those the estimators know; lag: of the true thrust, s."""
        self.config, self.mass, self.share, self.lag = config, mass, thrust, lag
        self.state, self.forces = State(), Forces()
        self.v = np.zeros(3)
        self.thrust = MASS * mass * G
        self.command = self.thrust / thrust
        self.joints, self.joint_rates = np.array(JOINTS), np.zeros(3)

    def tick(
        self, push: float = 0.0, wind: Vec3 = ZERO, pitch: float = 0.0, near: bool = True, hovering: bool = False,
        taring: bool = False, tared: bool = False, swing: Vec3 = ZERO, noise: Vec3 = ZERO,
    ) -> Forces:  # fmt: skip
        """push: true compression, N; swing: acceleration of the joints, rad/s^2; noise: of the accelerometer."""
        model, mass = DERIVED.model, MASS * self.mass
        rpy = (0.0, pitch, 0.0)
        R = math3.matrix_from_euler(rpy)
        wanted = self.share * self.command
        self.thrust += (wanted - self.thrust) * (DT / (self.lag + DT))
        v, joints, rates = three(self.v), three(self.joints), three(self.joint_rates)
        turned = np.array(R).reshape(3, 3)
        drag = -turned @ (np.array(self.config.vehicle.base.drag) * (turned.T @ self.v))
        given = self.thrust * turned[:, 2] + drag + np.array(wind) + np.array((-push, 0.0, 0.0))
        q, qd = (*ZERO, *rpy, *joints), (*v, *ZERO, *rates)
        without = np.array(model.inverse_dynamics(q, qd, (*ZERO, *ZERO, *swing), True))[:3]
        without[2] += (mass - MASS) * G
        a = three((given - without) / mass)
        tau = np.array(model.inverse_dynamics(q, qd, (*a, *ZERO, *swing), True))
        tau -= np.array(model.contact_torque(q, (-push, 0.0, 0.0)))
        torque = math3.body_torque_from_euler(rpy, three(tau[3:6]))
        servo = CONFIG.vehicle.servo
        friction = servo.friction_viscous * self.joint_rates
        friction += servo.friction_static * np.clip(self.joint_rates / 0.05, -1.0, 1.0)
        current = three(servo.stall_current * (tau[6:] + friction) / servo.stall_torque)
        f_B = math3.rotate_transposed(R, (a[0], a[1], a[2] + G))
        seen = (f_B[0] + noise[0], f_B[1] + noise[1], f_B[2] + noise[2])
        x, y, z = math3.rotate(R, seen)
        five = (0.0, 0.0, 0.0, 0.0, 0.0)
        servos = ServoState(
            0, (*joints, 0.0, 0.0), (*rates, 0.0, 0.0), (*current, 0.0, 0.0), five, five, (0, 0, 0, 0, 0), True,
        )  # fmt: skip
        sight = Sight(
            seen, (x, y, z - G), v, 0.0, True, R, ZERO, rpy, ZERO, servos, 0.0, True, ZERO, near, hovering
        )  # fmt: skip
        self.state, self.forces = estimators.step(
            self.state, sight, Command(self.command, torque), taring, tared, not taring, DERIVED, self.config, DT,
        )  # fmt: skip
        self.v += DT * np.array(a)
        self.joints += DT * self.joint_rates
        self.joint_rates += DT * np.array(swing)
        return self.forces

    def hover(self, seconds: float = 5.0, bias: Vec3 = ZERO) -> None:
        """Held where it is, calibrated and tared; the vehicle's own velocity stays what it is."""
        for _ in range(250):
            self.tick(near=False, noise=bias)
        for _ in range(round(seconds / DT)):
            self.tick(near=False, hovering=True, noise=bias)
        for k in range(250):
            self.tick(near=False, taring=True, tared=k == 249, noise=bias)

    def press(self, push: Profile, seconds: float, lean: bool = False) -> Iterator[tuple[float, Forces]]:
        """Pressed by ``push`` of the time; the thrust leans so that the vehicle stays, when asked for."""
        for k in range(round(seconds / DT)):
            f = push(k * DT)
            pitch = float(np.arctan2(f, MASS * self.mass * G)) if lean else 0.0
            if lean:
                self.command = float(np.hypot(f, MASS * self.mass * G)) / self.share
            yield f, self.tick(f, pitch=pitch)


def three(values: NDArray[np.float64]) -> Vec3:
    x, y, z = values.tolist()
    return (x, y, z)


def read(forces: Forces, name: str) -> float:
    value: float = getattr(forces, name).contact
    return value


def constant(t: float) -> float:
    return 2.0


def step(t: float) -> float:
    return 0.0 if t < 0.5 else 1.5


def ramp(t: float) -> float:
    return min(2.5, 0.6 * t)


@pytest.mark.parametrize("lean", [False, True], ids=["driven back", "standing"])
@pytest.mark.parametrize("profile", [constant, step, ramp])
@pytest.mark.parametrize("name", NAMES)
def test_a_known_force_is_read(name: str, profile: Profile, lean: bool) -> None:
    craft = Craft()
    craft.hover()
    last = [(f, read(forces, name)) for f, forces in craft.press(profile, 6.0, lean)][-250:]
    error = np.array([b - a for a, b in last])
    assert abs(error).max() < 0.05


@pytest.mark.parametrize("name", NAMES)
def test_a_step_is_read_within_a_tenth_of_a_second(name: str) -> None:
    craft = Craft()
    craft.hover()
    values = [read(forces, name) for _, forces in craft.press(step, 1.0)]
    assert max(map(abs, values[:125])) < 0.02
    assert 0.63 * 1.5 < values[125 + 25] < 1.2 * 1.5


def test_the_joints_feel_the_tip() -> None:
    craft = Craft()
    craft.hover()
    assert [forces.felt for _, forces in craft.press(constant, 2.0)][-1] == pytest.approx(2.0, abs=0.02)


def test_where_there_is_no_force_none_is_read() -> None:
    craft = Craft()
    for k in range(1000):
        forces = craft.tick(pitch=0.1 * sin(0.01 * k), near=k > 500)
        for name in NAMES:
            assert getattr(forces, name).force_W == pytest.approx(ZERO, abs=0.02), (name, k)
        assert abs(forces.felt) < 0.02


def test_the_drag_of_the_vehicle_s_own_speed_is_no_force() -> None:
    craft = Craft(load_config("paper"))
    craft.v[:] = (1.0, 0.5, -0.5)
    for _ in range(500):
        forces = craft.tick(near=False)
    assert math3.norm(forces.paper.force_W) > 0.1, "it knows of none"
    for name in ("body", "momentum", "kalman"):
        assert getattr(forces, name).force_W == pytest.approx(ZERO, abs=0.02), name


def test_the_swinging_arm_is_no_force_to_the_one_that_knows_it() -> None:
    craft = Craft()
    worst = dict.fromkeys(NAMES, 0.0)
    for k in range(500):
        swing = 6.0 * sin(8.0 * k * DT)
        forces = craft.tick(swing=(swing, -swing, 0.0), near=False)
        for name in NAMES:
            worst[name] = max(worst[name], math3.norm(getattr(forces, name).force_W))
    assert worst["momentum"] < 0.03
    assert worst["paper"] > 0.1
    assert worst["body"] > 0.1


@pytest.mark.parametrize("name", NAMES)
def test_wind_in_contact(name: str) -> None:
    """A gust of 0.5 N against the vehicle while it presses: all take it for force but the one that asks the joints."""
    craft = Craft()
    craft.hover()
    for k in range(1500):
        gust = 0.5 * min(1.0, max(0.0, k * DT - 2.0))
        forces = craft.tick(1.5, wind=(-gust, 0.0, 0.0))
    error = read(forces, name) - 1.5
    if name == "kalman":
        assert abs(error) < 0.05
    else:
        assert error == pytest.approx(0.5, abs=0.05)


def test_wind_away_from_the_pipe_is_no_contact() -> None:
    craft = Craft()
    for _ in range(500):
        forces = craft.tick(wind=(-1.0, 0.0, 0.0), near=False)
    assert forces.kalman.contact == 0.0
    assert forces.kalman.force_W == pytest.approx((-1.0, 0.0, 0.0), abs=0.05)
    assert forces.momentum.contact == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("mass", "thrust", "bias", "bound"),
    [(1.0, 0.95, ZERO, 0.06), (1.0, 1.05, ZERO, 0.06), (1.03, 1.0, ZERO, 0.12), (1.0, 1.0, (0.05, -0.03, 0.02), 0.06)],
    ids=["weak", "strong", "heavy", "biased accelerometer"],
)
def test_model_errors_are_tared(name: str, mass: float, thrust: float, bias: Vec3, bound: float) -> None:
    """Of the mass, 3 % of the force stays: the lean that balances the force is that of another mass."""
    craft = Craft(mass=mass, thrust=thrust)
    craft.hover(bias=bias)
    for k in range(1500):
        f = ramp(k * DT)
        craft.command = float(np.hypot(f, MASS * mass * G)) / thrust
        forces = craft.tick(f, pitch=float(np.arctan2(f, MASS * mass * G)), noise=bias)
    assert abs(read(forces, name) - 2.5) < bound


def test_the_scale_of_the_thrust_is_measured_in_hover_and_kept_elsewhere() -> None:
    craft = Craft(thrust=0.95)
    craft.hover()
    assert craft.forces.thrust_scale == pytest.approx(0.95, abs=1e-3)
    before = craft.forces.thrust_scale
    for _, forces in craft.press(constant, 1.0):
        assert forces.thrust_scale == before


@given(st.floats(0.0, 60.0), st.floats(-40.0, 40.0), st.integers(1, 50))
def test_the_scale_stays_within_reason(command: float, f_z: float, ticks: int) -> None:
    state = thrust_model.State()
    for _ in range(ticks):
        state = thrust_model.step(state, command, f_z, MASS, True, thrust_model.Params(), DT)
        assert thrust_model.LOWEST <= state.scale <= thrust_model.HIGHEST


def test_the_lag_of_the_motors_is_in_the_model() -> None:
    """Thrust steps by 5 N: unmodelled, most of it is read as force for a moment."""
    lagging = replace(
        CONFIG,
        estimators=replace(CONFIG.estimators, thrust=replace(CONFIG.estimators.thrust, lag=0.04)),
        observer=replace(CONFIG.observer, thrust_lag=0.04),
    )
    worst = {}
    for config in (CONFIG, lagging):
        craft = Craft(config, lag=0.04)
        craft.hover()
        craft.command += 5.0
        seen = [craft.tick(near=False) for _ in range(100)]
        for name in NAMES:
            worst[config is lagging, name] = max(abs(getattr(forces, name).force_W[2]) for forces in seen)
    for name in NAMES:
        assert worst[False, name] > 0.4, name
        assert worst[True, name] < 0.05, name


@pytest.mark.parametrize("name", NAMES)
def test_noise_is_filtered(name: str) -> None:
    random = np.random.default_rng(3)
    craft = Craft()
    craft.hover()
    read_now = []
    for _ in range(1000):
        x, y, z = (0.04 * random.standard_normal(3)).tolist()
        read_now.append(read(craft.tick(1.5, noise=(x, y, z)), name) - 1.5)
    assert float(np.std(read_now[250:])) < 0.04


@pytest.mark.parametrize("value", [1e300, -1e300, 1e160])
def test_an_absurd_sample_does_not_stay(value: float) -> None:
    craft = Craft()
    craft.hover()
    craft.tick(noise=(value, value, value))
    for _ in range(1500):
        forces = craft.tick()
    for name in ("body", "momentum", "kalman"):
        assert getattr(forces, name).force_W == pytest.approx(ZERO, abs=0.02), name


@given(st.lists(st.tuples(*[st.floats(-50.0, 50.0)] * 3), min_size=1, max_size=30), st.booleans())
@settings(max_examples=40)
def test_estimates_are_finite_and_the_same_bits_again(noises: list[Vec3], near: bool) -> None:
    def fly() -> list[Forces]:
        craft = Craft()
        return [craft.tick(1.0, near=near, noise=noise) for noise in noises]

    once = fly()
    assert once == fly()
    for forces in once:
        for name in NAMES:
            assert all(map(isfinite, (*getattr(forces, name).force_W, getattr(forces, name).contact)))


@pytest.mark.parametrize("estimator", Estimator)
def test_the_selected_one_is_believed(estimator: Estimator) -> None:
    params = replace(CONFIG.estimators, selected=estimator)
    craft = Craft()
    craft.hover(bias=(0.02, 0.0, 0.0))
    for _, forces in craft.press(constant, 0.05):
        assert estimators.selected(forces, params) == getattr(forces, estimator.value)
    own = craft.state.tares[NAMES.index(estimator.value)].tare
    assert estimators.tare_in_force(craft.state, params) == own


def test_servos_that_say_nothing_are_not_asked() -> None:
    """A limp servo feels nothing, which is not the same as no contact."""
    craft = Craft()
    craft.hover()
    told = [forces for _, forces in craft.press(constant, 1.0)][-1]
    state = craft.state
    five = (0.0, 0.0, 0.0, 0.0, 0.0)
    limp = ServoState(0, (*JOINTS, 0.0, 0.0), five, five, five, five, (0, 0, 0, 0, 0), False)
    f_B = (-2.0 / MASS, 0.0, G)
    for _ in range(500):
        sight = Sight(f_B, (f_B[0], 0.0, 0.0), ZERO, 0.0, False, math3.matrix_from_euler(ZERO), ZERO, ZERO, ZERO, limp, 0.0, True, ZERO, True, False)  # noqa: E501 # fmt: skip
        state, told = estimators.step(state, sight, Command(MASS * G, ZERO), False, False, True, DERIVED, CONFIG, DT)
    assert told.kalman.contact == pytest.approx(2.0, abs=0.2)


# --- joints -----------------------------------------------------------------------------------------------------------


@given(st.floats(-0.9, 0.9), st.floats(-4.0, 4.0))
def test_the_torque_is_found_from_the_current_of_the_supply(torque: float, rate: float) -> None:
    """Back from what a servo that drives shows: motor current times duty cycle."""
    servo = CONFIG.vehicle.servo
    share, speed = torque / servo.stall_torque, rate / servo.no_load_speed
    if (share * speed < 0.0 and abs(share) < 1.3 * abs(speed)) or abs(share + speed) > 1.0:
        return  # braking, where two torques draw the same current, or beyond what the supply can give
    current = servo.stall_current * share * abs(share + speed)
    quiet = replace(servo, friction_static=0.0, friction_viscous=0.0)
    constants = momentum_observer.servo_constants(quiet)
    assert momentum_observer.servo_torque(current, rate, constants, True) == pytest.approx(torque, abs=1e-6)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-0.4, 0.4))
@settings(max_examples=50)
def test_the_force_at_the_tip_is_found_from_its_torques(x: float, z: float, theta_3: float) -> None:
    angles = (-1.0, 1.0, theta_3)
    rows = DERIVED.model.contact_torque((*ZERO, *ZERO, *angles), (x, 0.0, z))
    state = momentum_observer.State(residual=(*ZERO, *ZERO, *rows[6:]))
    found = momentum_observer.felt(state, ZERO, angles, math3.matrix_from_euler(ZERO), CONFIG.vehicle.arm)
    assert found == pytest.approx((x, 0.0, z), abs=0.02)


# --- tare, gate and trigger -------------------------------------------------------------------------------------------


def test_a_tare_broken_off_is_forgotten() -> None:
    craft = Craft()
    for _ in range(50):
        craft.tick(taring=True, noise=(0.1, 0.0, 0.0))
    assert craft.state.joints.count == 50
    craft.tick()
    assert (craft.state.tares, craft.state.joints) == ((tare.State(),) * 4, tare.State())


@pytest.mark.parametrize(("selected", "false"), [(Estimator.PAPER, True), (Estimator.KALMAN, False)])
def test_a_gust_with_the_tip_at_the_crack(selected: Estimator, false: bool) -> None:
    """0.8 N of wind within a second: the paper's observer pulls the trigger, unless the joints are asked as well."""
    craft, params = Craft(), CONFIG.contact
    asking = replace(params, felt=0.1)
    craft.hover()
    states = [contact_trigger.State(), contact_trigger.State()]
    pulled = [False, False]
    for k in range(750):
        forces = craft.tick(wind=(-0.8 * min(1.0, k * DT), 0.0, 0.0))
        force = estimators.selected(forces, replace(CONFIG.estimators, selected=selected)).contact
        for i, own in enumerate((params, asking)):
            states[i] = contact_trigger.step(states[i], 0.0, force, forces.felt, 0.0, own, DT, False)
            pulled[i] |= states[i].contact
    assert pulled == [false, False]


# --- the literature's baseline ----------------------------------------------------------------------------------------


def test_the_unscented_filter_reads_a_known_force() -> None:
    craft = Craft()
    started = None
    force: Vec3 = ZERO
    for k in range(700):
        push = 0.0 if k < 300 else 1.5
        v = three(craft.v)
        craft.tick(push)
        f_B = (-push / MASS, 0.0, G)
        if started is None:
            started = Ukf(MASS, G, v, ZERO)
        force = started.step(MASS * G, f_B, ZERO, ZERO, v, math3.matrix_from_euler(ZERO), DT)
        if 100 <= k < 200:
            started.tare(done=k == 199)
    assert force == pytest.approx((-1.5, 0.0, 0.0), abs=0.1)
