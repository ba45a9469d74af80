"""The sleeve on the pipe: stick-slip, touchdown, release, and convergence in the step."""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams
from sim_backend.contact import SLIDE, STICK, ContactParams, GroundParams, friction
from sim_backend.dynamics import accelerations
from sim_backend.pipe import Pipe
from sim_backend.rigid_body import RigidBody
from sim_backend.world import WorldParams
from tests.sim_backend.flying import PIPE, frictionless, plant_at, world_at_pipe
from tests.sim_backend.test_rigid_body import balance

STEP = 1e-4
K, D, MU_S, MU_K = 20e3, 40.0, 1.0, 0.9


class Block:
    """A mass on a surface, pressed with a normal force and pulled in the tangential plane."""

    def __init__(self, mass: float = 0.2, normal: float = 2.0) -> None:
        self.mass, self.normal = mass, normal
        self.x, self.v = np.zeros(2), np.zeros(2)
        self.mode, self.z1, self.z2, self.slid = STICK, 0.0, 0.0, 0.0
        self.force = np.zeros(2)

    def pull(self, force: tuple[float, float], seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            f1, f2, self.mode, self.z1, self.z2, slid = friction(
                self.mode, self.z1, self.z2, self.v[0], self.v[1], self.normal, STEP, K, D, MU_S, MU_K
            )
            self.force = np.array((f1, f2))
            self.v += STEP * (np.array(force) + self.force) / self.mass
            self.x += STEP * self.v
            self.slid += slid


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5, -1.5])
def test_friction_holds_below_the_static_limit_and_slides_above(angle: float) -> None:
    way = np.array((cos(angle), sin(angle)))
    block = Block()
    for share in np.linspace(0.0, 0.97, 100):
        block.pull(tuple(share * MU_S * block.normal * way), 0.02)
    assert block.mode == STICK
    assert block.slid == 0.0
    assert np.linalg.norm(block.x) == pytest.approx(0.97 * MU_S * block.normal / K, rel=0.02)
    assert block.force @ way == pytest.approx(-0.97 * MU_S * block.normal, rel=0.01)

    block.pull(tuple(1.05 * MU_S * block.normal * way), 0.2)
    assert block.mode == SLIDE
    assert block.force @ way == pytest.approx(-MU_K * block.normal, rel=1e-6)
    # From rest under the surplus force, once it has broken loose.
    assert block.v @ way == pytest.approx(0.15 * block.normal / block.mass * 0.2, rel=0.1)
    assert block.slid == pytest.approx(0.5 * 0.15 * block.normal / block.mass * 0.04, rel=0.2)


def test_between_the_two_limits_it_keeps_sliding_but_does_not_begin_to() -> None:
    moving, resting = Block(), Block()
    moving.v[0] = 0.1
    for share in np.linspace(0.0, 0.95, 100):
        resting.pull((share * resting.normal, 0.0), 0.01)
    moving.pull((0.95 * moving.normal, 0.0), 0.3)
    assert resting.mode == STICK
    assert resting.slid == 0.0
    assert moving.mode == SLIDE
    assert moving.v[0] > 0.1


def test_a_sliding_block_is_braked_and_sticks() -> None:
    block = Block()
    block.v[:] = (0.3, 0.4)
    block.pull((0.0, 0.0), 0.2)
    assert block.mode == STICK
    assert block.slid == pytest.approx(0.5 * 0.5**2 * block.mass / (MU_K * block.normal), rel=0.02)
    assert block.v == pytest.approx((0.0, 0.0), abs=1e-6)
    assert block.x / np.linalg.norm(block.x) == pytest.approx((0.6, 0.8), rel=1e-3)


def test_a_belt_makes_the_block_stick_and_slip() -> None:
    # A block on a spring, on a belt moving slowly: the textbook relaxation oscillation between the two limits.
    normal, mass, spring, belt = 2.0, 0.2, 200.0, 0.01
    mode, z1, z2, x, v = STICK, 0.0, 0.0, 0.0, 0.0
    pulls, modes = [], []
    for _ in range(30000):
        f1, _, mode, z1, z2, _ = friction(mode, z1, z2, v - belt, 0.0, normal, STEP, K, D, MU_S, MU_K)
        v += STEP * (f1 - spring * x) / mass
        x += STEP * v
        pulls.append(spring * x)
        modes.append(mode)
    late = np.array(pulls[15000:])
    assert late.max() == pytest.approx(MU_S * normal, rel=0.03)
    assert 0.7 * normal < late.min() < MU_K * normal
    switches = np.count_nonzero(np.diff(modes[15000:]))
    assert switches >= 4


@given(
    st.sampled_from((0.0, STICK, SLIDE)),
    st.tuples(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3)),
    st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    st.floats(0.0, 100.0),
)
def test_friction_is_bounded_by_its_cone(
    mode: float, z: tuple[float, float], v: tuple[float, float], normal: float
) -> None:
    f1, f2, after, *_ = friction(mode, *z, *v, normal, STEP, K, D, MU_S, MU_K)
    force = sqrt(f1 * f1 + f2 * f2)
    assert force <= MU_S * normal * (1.0 + 1e-9) + 1e-12
    if after == SLIDE:
        assert force == pytest.approx(MU_K * normal, rel=1e-9)
        assert f1 * v[0] + f2 * v[1] <= 0.0


def tip_mass(plant: RigidBody) -> float:
    """Mass that a push at the tip along -x feels, from the equations of motion."""
    p, joints, arm = plant.p, plant.x[at.JOINT : at.JOINT + 3], plant.vehicle.arm
    angles = [g(a) for a in joints for g in (cos, sin)]
    c1, s1, c2, s2, c3, s3 = angles
    bz = arm.mount[2] + arm.link_1 * s1 + arm.link_2 * s2 + arm.gripper * s3
    lean = np.array((-arm.link_1 * s1, -arm.link_2 * s2, -arm.gripper * s3))
    result = accelerations(
        p, at.LUMPED + at.LUMPED_SIZE, c1, s1, c2, s2, c3, s3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        (-1.0, 0.0, 0.0), (0.0, -bz, 0.0), tuple(-lean),
    )  # fmt: skip
    return -1.0 / float(result[0] + bz * result[4] + lean @ np.array(result[6:]))


def touchdown(plant: RigidBody, seconds: float = 0.03) -> list[float]:
    plant.move(plant.steps_of(seconds))
    return plant.x.tolist()


def test_touchdown_peak_is_speed_times_root_of_stiffness_and_mass(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, frictionless(PlantParams()), gap=1e-4, velocity=(0.02, 0.0, 0.0))
    mass = tip_mass(plant)
    assert 0.05 < mass < 0.5
    peak = touchdown(plant)[at.CONTACT_PEAK]
    assert peak == pytest.approx(0.02 * sqrt(50e3 * mass), rel=0.02)
    assert plant.x[at.CONTACT_FORCE] == 0.0
    # With damping, friction and three joints that give way, the peak stays near that estimate.
    real = plant_at(vehicle, PlantParams(), gap=1e-4, velocity=(0.02, 0.0, 0.0))
    assert touchdown(real)[at.CONTACT_PEAK] == pytest.approx(0.02 * sqrt(50e3 * mass), rel=0.3)


def test_a_lossless_bounce_gives_the_energy_back(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, frictionless(PlantParams()), gap=1e-4, velocity=(0.1, 0.0, 0.0))
    before = balance(plant, vehicle)[0]
    touchdown(plant)
    assert plant.x[at.CONTACT_FORCE] == 0.0
    assert balance(plant, vehicle)[0] == pytest.approx(before, rel=2e-3)


@pytest.mark.parametrize("heading", [0.0, 0.9, pi / 2, -2.7, pi])
def test_contact_is_the_same_at_any_heading(vehicle: Vehicle, heading: float) -> None:
    """The force points out of the pipe and against the motion, in whichever direction the pipe lies."""
    plant = RigidBody(vehicle, PlantParams(), Pipe(heading=heading))
    reference = plant_at(vehicle, PlantParams(), gap=-1e-4, velocity=(0.0, 0.05, 0.02))
    c, s = cos(heading), sin(heading)
    plant.x[:] = reference.x
    plant.u[:] = reference.u
    plant.p[at.GRAVITY] = 0.0
    plant.p[at.DRAG : at.DRAG + 3] = 0.0
    offset, v = reference.x[:3] - np.array(PIPE.position), reference.x[at.VELOCITY : at.VELOCITY + 3].copy()
    plant.x[:3] = PIPE.position + np.array((c * offset[0] - s * offset[1], s * offset[0] + c * offset[1], offset[2]))
    plant.x[at.VELOCITY : at.VELOCITY + 3] = (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])
    plant.x[at.ATTITUDE : at.ATTITUDE + 4] = (cos(heading / 2), 0.0, 0.0, sin(heading / 2))
    for each in (reference, plant):
        each.move(3)
    force = reference.truth().contact_W
    assert force[0] < -3.0
    assert force[1] < 0.0
    assert force[2] < 0.0
    assert plant.truth().contact_force == pytest.approx(reference.truth().contact_force, rel=1e-6)
    turned = (c * force[0] - s * force[1], s * force[0] + c * force[1], force[2])
    assert plant.truth().contact_W == pytest.approx(turned, rel=1e-6)


@pytest.mark.parametrize(("beside", "touches"), [(0.0, True), (0.99, True), (-1.01, False), (1.01, False)])
def test_the_pipe_has_two_ends(vehicle: Vehicle, beside: float, touches: bool) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=-1e-4)
    plant.x[at.POSITION + 1] += beside
    plant.move(1)
    assert bool(plant.x[at.CONTACT_FORCE] > 0.0) is touches


def test_the_contact_only_pushes(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=-1e-5, velocity=(-0.5, 0.0, 0.0))
    plant.move(1)
    assert plant.x[at.CONTACT_FORCE] == 0.0
    assert plant.truth().contact_W == pytest.approx((0.0, 0.0, 0.0))


def test_slip_is_counted_on_the_pipe(vehicle: Vehicle) -> None:
    held = world_at_pipe(vehicle)
    rows = held.press(6.0)
    assert rows[-1, 0] > 1.0
    assert rows[-1, 2] < 1e-3
    slippery = msgspec.structs.replace(ContactParams(), friction_static=0.05, friction_kinetic=0.04)
    loose = world_at_pipe(vehicle, WorldParams(plant=PlantParams(contact=slippery)))
    assert loose.press(6.0)[-1, 2] > 5.0 * rows[-1, 2]


def test_the_sleeve_stays_on_the_pipe(vehicle: Vehicle) -> None:
    hand = world_at_pipe(vehicle)
    hand.press(5.0)
    before = hand.world.truth()
    assert before.payload
    assert before.contact_force > 0.5
    x, y, z = before.p_WB
    hand.gripper = 1.0
    hand.fly((x + 0.2, y, z), 0.3)
    after = hand.world.truth()
    assert not after.payload
    assert after.sleeve_on_pipe
    assert after.contact_force > 0.2
    hand.fly((x - 0.4, y, z), 3.0)
    away = hand.world.truth()
    assert away.contact_force == 0.0
    assert away.sleeve_on_pipe
    assert away.crashed == ""


def test_a_sleeve_released_in_the_air_is_lost(vehicle: Vehicle) -> None:
    hand = world_at_pipe(vehicle, gap=0.2)
    hand.gripper = 0.5
    hand.fly(hand.world.truth().p_WB, 0.5)
    assert hand.world.truth().payload
    hand.gripper = 1.0
    hand.fly(hand.world.truth().p_WB, 0.5)
    truth = hand.world.truth()
    assert not truth.payload
    assert not truth.sleeve_on_pipe
    # Lighter by the sleeve: the same thrust lifts it.
    hand.fly(truth.p_WB, 1.0)
    assert hand.world.truth().p_WB[2] > truth.p_WB[2] + 0.01


def test_halving_the_step_changes_nothing(vehicle: Vehicle) -> None:
    figures = []
    for step in (1e-4, 5e-5):
        rows = world_at_pipe(vehicle, WorldParams(plant=PlantParams(step=step))).press(6.0)
        figures.append((rows[:, 1].max(), rows[:, 0].mean(), rows[-1, 0], rows[-1, 2]))
    assert figures[0] == pytest.approx(figures[1], rel=0.02)


@pytest.mark.parametrize("kind", [ContactParams, GroundParams])
def test_dynamic_friction_above_static_is_refused(kind: type[ContactParams | GroundParams]) -> None:
    with pytest.raises(ValueError, match=r"friction_kinetic 0\.6 is above friction_static 0\.5"):
        kind(friction_static=0.5, friction_kinetic=0.6)
