"""The PyBullet world against the rigid-body world, and what it owes to everything around a plant."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantKind, PlantParams
from sim_backend.pybullet_plant import PyBulletPlant
from sim_backend.rigid_body import RigidBody
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import PIPE, RADIUS, Hand, mass_of, world_at_pipe

BULLET = PlantParams(kind=PlantKind.PYBULLET)
BOTH = (PlantParams(), BULLET)


def plants(vehicle: Vehicle) -> tuple[RigidBody, PyBulletPlant]:
    return RigidBody(vehicle, PlantParams(), PIPE, 0.0, RADIUS), PyBulletPlant(vehicle, BULLET, PIPE, 0.0, RADIUS)


def test_it_stands_as_the_other_does(vehicle: Vehicle) -> None:
    rigid, bullet = plants(vehicle)
    bullet.begin()
    bullet.move(400)
    bullet.count(400)
    one, other = rigid.truth(), bullet.truth()
    assert other.p_WB == pytest.approx(one.p_WB, abs=5e-4)
    assert other.joints == pytest.approx(one.joints, abs=2e-4)
    assert other.tip_W == pytest.approx(one.tip_W, abs=1e-3)
    assert np.abs(other.v_WB).max() < 1e-3
    assert other.on_ground
    assert other.payload
    assert other.f_B == pytest.approx((0.0, 0.0, vehicle.gravity), abs=0.01)


def test_both_fall_alike(vehicle: Vehicle) -> None:
    for plant in plants(vehicle):
        plant.x[at.POSITION + 2] = 10.0
        plant.x[at.RATE : at.RATE + 3] = (0.4, -0.6, 0.3)
        plant.x[at.JOINT_RATE : at.JOINT_RATE + 3] = (1.0, -0.5, 0.8)
        plant.x[at.JOINT : at.JOINT + 3] = (-0.8, 0.7, 0.1)
        plant.u[at.U_TORQUE_ON] = 0.0
        plant.begin()
        plant.move(plant.steps_of(0.5))
        plant.count(plant.steps_of(0.5))
        truth = plant.truth()
        if isinstance(plant, RigidBody):
            one = truth
    assert truth.p_WB == pytest.approx(one.p_WB, abs=2e-3)
    assert truth.v_WB == pytest.approx(one.v_WB, abs=5e-3)
    assert truth.q_WB == pytest.approx(one.q_WB, abs=2e-3)
    assert truth.w_WB_B == pytest.approx(one.w_WB_B, abs=5e-3)
    assert truth.joints == pytest.approx(one.joints, abs=5e-3)
    assert abs(one.joints[0] + 0.8) > 0.1, "the arm has moved"


def flown(vehicle: Vehicle, plant: PlantParams, joints: Vec3) -> list[tuple[float, ...]]:
    """Take off, hover, then swing the arm in flight: position, attitude and joints, each 20 ms."""
    hand = Hand(World(vehicle, WorldParams(plant=plant), PIPE, 0.0, RADIUS))
    rows: list[tuple[float, ...]] = []
    for k in range(1500):
        if k == 1000:
            hand.joints = joints
        hand.tick((0.0, 0.0, 1.2))
        if k % 5 == 0:
            truth = hand.world.truth()
            rows.append((*truth.p_WB, *truth.q_WB, *truth.joints))
    return rows


def test_both_hover_and_swing_the_arm_alike(vehicle: Vehicle) -> None:
    one, other = (np.array(flown(vehicle, plant, (-1.0, 1.0, 0.0))) for plant in BOTH)
    difference = np.abs(one - other)
    assert difference[:200, :3].max() < 3e-3, "takeoff and hover, m"
    assert difference[:, :3].max() < 5e-3
    assert difference[:, 3:7].max() < 3e-3
    assert difference[:, 7:].max() < 0.02
    assert np.ptp(one[200:, 4:6]).max() > 1e-3, "the swing is felt by the base"


def test_contact_is_as_stiff_as_told(vehicle: Vehicle) -> None:
    hand = world_at_pipe(vehicle, WorldParams(plant=BULLET))
    rows = hand.press(5.0, depth=0.1)
    truth = hand.world.truth()
    assert truth.contact_force > 1.0
    plant = hand.world.plant
    assert isinstance(plant, PyBulletPlant)
    scene = plant.scene
    (point,) = scene.bullet.getContactPoints(scene.vehicle, scene.pipe, physicsClientId=scene.client)
    assert -point[8] == pytest.approx(truth.contact_force / BULLET.contact.stiffness, rel=0.05)
    assert truth.contact_W[0] == pytest.approx(-truth.contact_force, rel=0.05)
    assert not truth.sliding
    assert rows[:, 1].max() >= rows[:, 0].max()


def test_both_press_alike(vehicle: Vehicle) -> None:
    one, other = (world_at_pipe(vehicle, WorldParams(plant=plant)).press(5.0, depth=0.1) for plant in BOTH)
    assert one[-1, 0] > 1.0
    assert np.abs(one[-250:, 0] - other[-250:, 0]).max() < 0.05


@pytest.mark.parametrize("on_pipe", [True, False])
def test_the_sleeve_is_left(vehicle: Vehicle, on_pipe: bool) -> None:
    hand = world_at_pipe(vehicle, WorldParams(plant=BULLET), gap=0.02 if on_pipe else 0.2)
    if on_pipe:
        hand.press(4.0, depth=0.1)
    hand.gripper = 1.2
    place = hand.world.truth().p_WB
    for _ in range(100):
        hand.tick(place)
    truth, plant = hand.world.truth(), hand.world.plant
    assert isinstance(plant, PyBulletPlant)
    assert not truth.payload
    assert truth.sleeve_on_pipe is on_pipe
    b, client = plant.scene.bullet, plant.scene.client
    links = range(-1, b.getNumJoints(plant.scene.vehicle, client))
    mass = sum(b.getDynamicsInfo(plant.scene.vehicle, link, client)[0] for link in links)
    assert mass == pytest.approx(mass_of(vehicle) - vehicle.arm.sleeve.mass, abs=1e-6)
    height = b.getBasePositionAndOrientation(plant.scene.sleeve, client)[0][2]
    assert (height > truth.tip_W[2] - 0.05) is on_pipe, "it stays, or falls"


def test_two_runs_of_one_seed_are_the_same_to_the_bit(vehicle: Vehicle) -> None:
    def run() -> tuple[bytes, bytes]:
        hand = world_at_pipe(vehicle, WorldParams(plant=BULLET))
        rows = hand.press(1.5)
        return hand.world.plant.x.tobytes(), rows.tobytes()

    assert run() == run()


def test_what_is_written_into_the_arrays_holds(vehicle: Vehicle) -> None:
    plant = plants(vehicle)[1]
    plant.x[at.POSITION : at.POSITION + 3] = (1.0, 2.0, 5.0)
    plant.x[at.VELOCITY] = 0.5
    plant.p[at.GRAVITY] = 0.0
    plant.p[at.DRAG : at.DRAG + 3] = 0.0
    plant.move(400)
    assert plant.x[at.POSITION : at.POSITION + 3] == pytest.approx((1.05, 2.0, 5.0), abs=2e-3)
    plant.p[at.PIPE_POINT] = 3.0
    plant.move(1)
    assert plant.scene.bullet.getBasePositionAndOrientation(plant.scene.pipe, plant.scene.client)[0][0] == 3.0


@pytest.mark.parametrize(("height", "breaks"), [(0.1, False), (1.0, True)])
def test_a_hard_landing_breaks_it(vehicle: Vehicle, height: float, breaks: bool) -> None:
    plant = plants(vehicle)[1]
    plant.x[at.POSITION + 2] += height
    plant.move(plant.steps_of(0.8))
    plant.count(1)
    crashed = plant.truth().crashed
    assert ("hit the ground at 4." in crashed) is breaks, crashed


def test_without_pybullet_it_says_what_to_do(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ValueError, match=r"PyBullet is not installed .* or choose rigid"):
        World(vehicle, WorldParams(plant=BULLET), PIPE, 0.0, RADIUS)
