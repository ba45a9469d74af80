"""The Lagrange model against Pinocchio's tree of every bar and plate, and against its own invariants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from drivers.vehicle import Part, Vehicle
from onboard.core import dynamics, kinematics, math3
from onboard.core.dynamics import Model, Nine

Array = NDArray[np.float64]

CONFIG = Path(__file__).parents[2] / "configs" / "vehicle.yaml"
VEHICLE = msgspec.yaml.decode(CONFIG.read_bytes(), type=Vehicle)
# The same, without any symmetry that could hide a mistake.
SKEWED = replace(
    VEHICLE,
    base=replace(VEHICLE.base, inertia=(0.021, 0.034, 0.052)),
    arm=replace(VEHICLE.arm, mount=(0.05, 0.03, -0.07), link_2=0.20, gripper=0.09),
)
REST: Nine = (0.0,) * 9
STATES = 40

vehicles = pytest.mark.parametrize("vehicle", [VEHICLE, SKEWED], ids=["vehicle", "skewed"])
payloads = pytest.mark.parametrize("payload", [False, True], ids=["bare", "sleeve"])


def nine(values: Array) -> Nine:
    a, b, c, d, e, f, g, h, i = values.tolist()
    return (a, b, c, d, e, f, g, h, i)


def states(seed: int) -> list[tuple[Array, Array, Array]]:
    """Random q, qd, qdd: any attitude up to 75 deg of pitch, any joint angles, fast."""
    random = np.random.default_rng(seed)
    reach = np.array([3.0, 3.0, 3.0, 3.1, 1.3, 3.1, 3.1, 3.1, 3.1])
    return [
        (random.uniform(-reach, reach), random.uniform(-5.0, 5.0, 9), random.uniform(-20.0, 20.0, 9))
        for _ in range(STATES)
    ]


class Tree:
    """The arm as it is built, in Pinocchio: each bar and plate a body on the joint that really carries it.

    The parallelograms' loops are closed by the linear map ``reduce`` from q to the tree's joint angles.
    """

    def __init__(self, vehicle: Vehicle, payload: bool) -> None:
        self.pin = pin = pytest.importorskip("pinocchio", reason="Pinocchio (pip install pin) is not installed")
        arm = vehicle.arm
        parts = {part.name: part for part in arm.parts}
        assert len(parts) == 9, "a part that this tree does not know"
        self.model = model = pin.Model()
        model.gravity.linear = np.array([0.0, 0.0, -vehicle.gravity])
        self.columns: list[list[float]] = []

        joint = 0
        for index, kind in (
            (0, pin.JointModelPX()), (1, pin.JointModelPY()), (2, pin.JointModelPZ()),
            (5, pin.JointModelRZ()), (4, pin.JointModelRY()), (3, pin.JointModelRX()),
        ):  # fmt: skip
            joint = model.addJoint(joint, kind, pin.SE3.Identity(), f"base_{index}")
            self.columns.append([1.0 if k == index else 0.0 for k in range(9)])
        base = joint
        model.appendBodyToJoint(
            base, pin.Inertia(vehicle.base.mass, np.zeros(3), np.diag(vehicle.base.inertia)), pin.SE3.Identity()
        )

        def carry(joint: int, part: Part, x: float, z: float = 0.0) -> int:
            inertia = pin.Inertia(part.mass, np.array([x, 0.0, z]), np.diag(part.inertia))
            model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
            return joint

        def hinge(parent: int, x: float, z: float, angles: tuple[float, float, float], y: float = 0.0) -> int:
            place = pin.SE3(np.eye(3), np.array([x, y, z]))
            axis = pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
            self.columns.append([0.0] * 6 + list(angles))
            return int(model.addJoint(parent, axis, place, f"hinge_{model.njoints}"))

        mx, my, mz = arm.mount
        level_1, level_2, rod = parts["level_rod_1"], parts["level_rod_2"], parts["rod"]
        # Depth first, as Pinocchio wants its joints.
        link_1 = carry(hinge(base, mx, mz, (1, 0, 0), my), parts["link_1"], parts["link_1"].along[0])
        elbow = carry(hinge(link_1, arm.link_1, 0.0, (-1, 0, 0)), parts["elbow_plate"], *parts["elbow_plate"].offset)
        rod_2 = carry(hinge(elbow, *level_2.offset, (0, 1, 0)), level_2, level_2.along[1])
        link_2 = carry(hinge(link_1, arm.link_1, 0.0, (-1, 1, 0)), parts["link_2"], parts["link_2"].along[1])
        wrist = carry(hinge(link_2, arm.link_2, 0.0, (0, -1, 0)), parts["wrist_plate"], *parts["wrist_plate"].offset)
        tool = carry(hinge(wrist, 0.0, 0.0, (0, 0, 1)), parts["end_effector"], parts["end_effector"].along[2])
        if payload:
            carry(tool, arm.sleeve, arm.sleeve.along[2])
        crank = carry(hinge(base, mx, mz, (0, 1, 0), my), parts["crank"], parts["crank"].along[1])
        drive = carry(hinge(crank, rod.along[1], 0.0, (1, -1, 0)), rod, rod.along[0])
        rod_1 = carry(
            hinge(base, mx + level_1.offset[0], mz + level_1.offset[1], (1, 0, 0), my), level_1, level_1.along[0]
        )
        # The pins that close the loops: two bodies, and where each has the pin in its own frame.
        self.pins = [
            (drive, (arm.link_1, 0.0), link_2, (rod.along[1], 0.0)),
            (rod_1, (arm.link_1, 0.0), elbow, level_1.offset),
            (rod_2, (arm.link_2, 0.0), wrist, level_2.offset),
        ]
        self.reduce = np.array(self.columns)
        self.data = model.createData()
        self.rotor = np.diag([0.0] * 6 + [vehicle.servo.rotor_inertia] * 3)

    def gaps(self, q: Array) -> list[float]:
        """Distance between the two halves of each closing pin, m."""
        self.pin.forwardKinematics(self.model, self.data, self.reduce @ q)

        def place(joint: int, pin: tuple[float, float]) -> Array:
            return np.asarray(self.data.oMi[joint].act(np.array([pin[0], 0.0, pin[1]])))

        return [float(np.linalg.norm(place(a, on_a) - place(b, on_b))) for a, on_a, b, on_b in self.pins]

    def mass_matrix(self, q: Array) -> Array:
        return np.asarray(
            self.reduce.T @ self.pin.crba(self.model, self.data, self.reduce @ q) @ self.reduce + self.rotor
        )

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array) -> Array:
        tau = self.pin.rnea(self.model, self.data, self.reduce @ q, self.reduce @ qd, self.reduce @ qdd)
        return np.asarray(self.reduce.T @ tau + self.rotor @ qdd)

    def energies(self, q: Array, qd: Array) -> tuple[float, float]:
        kinetic = self.pin.computeKineticEnergy(self.model, self.data, self.reduce @ q, self.reduce @ qd)
        potential = self.pin.computePotentialEnergy(self.model, self.data, self.reduce @ q)
        return kinetic + 0.5 * qd @ self.rotor @ qd, potential


@vehicles
@payloads
def test_equals_the_tree_of_real_parts(vehicle: Vehicle, payload: bool) -> None:
    model, tree = Model.from_vehicle(vehicle), Tree(vehicle, payload)
    for q, qd, qdd in states(1):
        assert max(tree.gaps(q)) < 1e-12
        np.testing.assert_allclose(model.mass_matrix(nine(q), payload), tree.mass_matrix(q), rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            model.coriolis(nine(q), nine(qd), payload) @ qd + model.gravity(nine(q), payload),
            tree.inverse_dynamics(q, qd, np.zeros(9)),
            rtol=0,
            atol=1e-9,
        )
        np.testing.assert_allclose(
            model.gravity(nine(q), payload), tree.inverse_dynamics(q, np.zeros(9), np.zeros(9)), rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(
            model.inverse_dynamics(nine(q), nine(qd), nine(qdd), payload),
            tree.inverse_dynamics(q, qd, qdd),
            rtol=0,
            atol=1e-9,
        )
        kinetic, potential = tree.energies(q, qd)
        assert model.kinetic(nine(q), nine(qd), payload) == pytest.approx(kinetic, abs=1e-9)
        assert model.potential(nine(q), payload) == pytest.approx(potential, abs=1e-9)


@vehicles
@payloads
def test_fast_path_is_the_sum_of_the_matrices(vehicle: Vehicle, payload: bool) -> None:
    model = Model.from_vehicle(vehicle)
    for q, qd, qdd in states(2):
        whole = (
            model.mass_matrix(nine(q), payload) @ qdd
            + model.coriolis(nine(q), nine(qd), payload) @ qd
            + model.gravity(nine(q), payload)
        )
        fast = model.inverse_dynamics(nine(q), nine(qd), nine(qdd), payload)
        np.testing.assert_allclose(fast, whole, rtol=0, atol=1e-9)


@vehicles
@payloads
def test_mass_matrix_is_symmetric_positive_definite(vehicle: Vehicle, payload: bool) -> None:
    model = Model.from_vehicle(vehicle)
    for q, _, _ in states(3):
        mass = model.mass_matrix(nine(q), payload)
        np.testing.assert_allclose(mass, mass.T, rtol=0, atol=1e-14)
        assert np.linalg.eigvalsh(mass)[0] > 1e-4


@vehicles
@payloads
def test_mass_rate_less_twice_coriolis_is_skew(vehicle: Vehicle, payload: bool) -> None:
    model, step = Model.from_vehicle(vehicle), 1e-4
    for q, qd, _ in states(4):
        # Central difference of fourth order along the motion.
        near, far = (
            model.mass_matrix(nine(q + h * qd), payload) - model.mass_matrix(nine(q - h * qd), payload)
            for h in (step, 2.0 * step)
        )
        rate = (8.0 * near - far) / (12.0 * step)
        skew = rate - 2.0 * model.coriolis(nine(q), nine(qd), payload)
        np.testing.assert_allclose(skew, -skew.T, rtol=0, atol=1e-8)
        np.testing.assert_allclose(rate, (c := model.coriolis(nine(q), nine(qd), payload)) + c.T, rtol=0, atol=1e-8)


@vehicles
@payloads
def test_gravity_is_the_gradient_of_the_potential(vehicle: Vehicle, payload: bool) -> None:
    model, step = Model.from_vehicle(vehicle), 1e-5
    for q, _, _ in states(5):
        gradient = [
            (model.potential(nine(q + e), payload) - model.potential(nine(q - e), payload)) / (2.0 * step)
            for e in step * np.eye(9)
        ]
        np.testing.assert_allclose(model.gravity(nine(q), payload), gradient, rtol=0, atol=1e-8)


@payloads
def test_a_free_motion_keeps_its_energy(payload: bool) -> None:
    model, dt = Model.from_vehicle(SKEWED), 5e-4

    def acceleration(q: Array, qd: Array) -> Array:
        bias = model.inverse_dynamics(nine(q), nine(qd), REST, payload)
        return -np.linalg.solve(model.mass_matrix(nine(q), payload), np.array(bias))

    q = np.array([0.0, 0.0, 5.0, 0.2, -0.3, 0.5, -1.2, 0.4, -0.2])
    qd = np.array([0.5, -0.3, 1.0, 1.0, -0.8, 1.5, 2.0, -3.0, 4.0])
    start = model.kinetic(nine(q), nine(qd), payload) + model.potential(nine(q), payload)
    initial = model.kinetic(nine(q), nine(qd), payload)
    for _ in range(600):
        a1 = acceleration(q, qd)
        v2 = qd + 0.5 * dt * a1
        a2 = acceleration(q + 0.5 * dt * qd, v2)
        v3 = qd + 0.5 * dt * a2
        a3 = acceleration(q + 0.5 * dt * v2, v3)
        v4 = qd + dt * a3
        a4 = acceleration(q + dt * v3, v4)
        q, qd = q + dt / 6.0 * (qd + 2.0 * v2 + 2.0 * v3 + v4), qd + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    end = model.kinetic(nine(q), nine(qd), payload) + model.potential(nine(q), payload)
    assert abs(model.kinetic(nine(q), nine(qd), payload) - initial) > 0.5, "nothing was exchanged"
    assert end == pytest.approx(start, abs=1e-8)


@vehicles
def test_contact_torque_is_the_work_of_the_force_on_the_tip(vehicle: Vehicle) -> None:
    model, step = Model.from_vehicle(vehicle), 1e-5

    def tip(q: Array) -> Array:
        x, y, z, phi, theta, psi, one, two, three = nine(q)
        R_WB = math3.matrix_from_euler((phi, theta, psi))
        return np.array(kinematics.tip_W(vehicle.arm, (x, y, z), R_WB, (one, two, three), kinematics.Tool.GRIPPER))

    for q, qd, _ in states(6):
        force = qd[:3]
        jacobian = np.array([(tip(q + e) - tip(q - e)) / (2.0 * step) for e in step * np.eye(9)])
        fx, fy, fz = force.tolist()
        np.testing.assert_allclose(model.contact_torque(nine(q), (fx, fy, fz)), jacobian @ force, rtol=0, atol=1e-8)


def test_payload_adds_the_sleeve_alone() -> None:
    model = Model.from_vehicle(VEHICLE)
    assert model.mass(True) - model.mass(False) == pytest.approx(VEHICLE.arm.sleeve.mass)
    assert model.mass(True) == pytest.approx(2.4)
    sleeveless = replace(
        VEHICLE, arm=replace(VEHICLE.arm, sleeve=replace(VEHICLE.arm.sleeve, mass=0.0, inertia=(0.0,) * 3))
    )
    q, qd, qdd = (nine(value) for value in states(7)[0])
    assert Model.from_vehicle(sleeveless).inverse_dynamics(q, qd, qdd, True) == model.inverse_dynamics(
        q, qd, qdd, False
    )
    assert model.inverse_dynamics(q, qd, qdd, True) != model.inverse_dynamics(q, qd, qdd, False)


def test_hover_needs_the_weight_and_the_arms_moment() -> None:
    model = Model.from_vehicle(VEHICLE)
    q: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.2, 0.4, 0.0)
    forces = model.gravity(q, True)
    assert forces[:3] == pytest.approx((0.0, 0.0, model.mass(True) * VEHICLE.gravity))
    # The arm hangs in front: its weight pulls the nose down (positive pitch), so holding it takes the opposite.
    assert forces[4] < 0.0
    # Servos lift: a positive torque on each link that leans forward.
    assert forces[6] > 0.0
    assert forces[7] > 0.0


def test_nothing_is_compiled_in_flight() -> None:
    with pytest.raises(TypeError):
        Model.from_vehicle(VEHICLE).inverse_dynamics(np.zeros(9), REST, REST, True)  # type: ignore[arg-type]
    kernels: tuple[Any, ...] = (dynamics._inverse_dynamics, dynamics._contact_torque, dynamics._mass_and_coriolis)
    for kernel in kernels:
        assert len(kernel.signatures) == 1


@vehicles
@payloads
def test_momentum_and_what_changes_it(vehicle: Vehicle, payload: bool) -> None:
    """p = M qd; and C^T qd - G is the gradient of the Lagrangian along q, so that p' = tau + C^T qd - G."""
    model = Model.from_vehicle(vehicle)
    for q, qd, _ in states(11)[:10]:
        p, drift = model.momentum(nine(q), nine(qd), payload)
        assert p == pytest.approx(model.mass_matrix(nine(q), payload) @ qd, abs=1e-9)
        assert drift == pytest.approx(
            model.coriolis(nine(q), nine(qd), payload).T @ qd - np.array(model.gravity(nine(q), payload)), abs=1e-9
        )
        for i in range(9):
            aside = np.zeros(9)
            aside[i] = 1e-6
            above, below = nine(q + aside), nine(q - aside)
            lagrangian = [model.kinetic(at, nine(qd), payload) - model.potential(at, payload) for at in (above, below)]
            assert drift[i] == pytest.approx((lagrangian[0] - lagrangian[1]) / 2e-6, abs=1e-4)
