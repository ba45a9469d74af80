"""The PyBullet world against the rigid-body world, and what it owes to everything around a plant."""

from __future__ import annotations

import sys
from copy import deepcopy

import numpy as np
import pytest
from msgspec.structs import replace

from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import ArrayPlant, PlantKind, PlantParams
from sim_backend.contact import ContactParams
from sim_backend.deviations import DeviationParams, deviations
from sim_backend.plant import Truth
from sim_backend.pybullet_plant import PyBulletPlant
from sim_backend.rigid_body import RigidBody
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import PIPE, REACH, Hand, mass_of, to_bullet, world_at_pipe

BULLET = PlantParams(kind=PlantKind.PYBULLET)


def bullet_plant(vehicle: Vehicle, params: PlantParams = BULLET) -> PyBulletPlant:
    return PyBulletPlant(vehicle, params, PIPE)


def moved(plant: ArrayPlant, seconds: float) -> Truth:
    steps = plant.steps_of(seconds)
    plant.begin()
    plant.move(steps)
    plant.count(steps)
    return plant.truth()


def test_it_stands_as_the_other_does(vehicle: Vehicle) -> None:
    one = moved(RigidBody(vehicle, PlantParams(), PIPE), 0.1)
    other = moved(bullet_plant(vehicle), 0.1)
    assert other.p_WB == pytest.approx(one.p_WB, abs=1e-4)
    assert other.joints == pytest.approx(one.joints, abs=1e-4)
    assert other.tip_W == pytest.approx(one.tip_W, abs=1e-4)
    assert np.abs(other.v_WB).max() < 1e-6
    assert other.on_ground
    assert other.payload
    assert other.f_B == pytest.approx((0.0, 0.0, vehicle.gravity), abs=1e-3)


@pytest.mark.parametrize("off", [False, True])
def test_both_fall_alike(vehicle: Vehicle, off: bool) -> None:
    """Turning, the arm flung; as modelled, or with mass, centre and inertia off and play in the gears, in wind."""
    truth = deviations(DeviationParams(mass=0.03, centre=0.005, inertia=0.1) if off else DeviationParams(), 1)
    params = PlantParams(backlash=0.0044, rotor_drag=8e-5) if off else PlantParams()
    found = []
    for kind, plant_type in ((PlantKind.RIGID, RigidBody), (PlantKind.PYBULLET, PyBulletPlant)):
        plant = plant_type(vehicle, replace(params, kind=kind), PIPE, truth)
        plant.x[at.POSITION + 2] = 10.0
        plant.x[at.RATE : at.RATE + 3] = (0.4, -0.6, 0.3)
        plant.x[at.JOINT_RATE : at.JOINT_RATE + 3] = (1.0, -0.5, 0.8)
        plant.x[at.JOINT : at.JOINT + 3] = (-0.8, 0.7, 0.1)
        plant.u[at.U_TORQUE_ON] = 0.0
        plant.u[at.U_ROTOR : at.U_ROTOR + 4] = (1.0, 1.2, 1.1, 0.9)
        if off:
            plant.u[at.U_WIND : at.U_WIND + 3] = (3.0, -2.0, 0.5)
        found.append(moved(plant, 0.5))
    one, other = found
    assert other.p_WB == pytest.approx(one.p_WB, abs=2e-3)
    assert other.v_WB == pytest.approx(one.v_WB, abs=5e-3)
    assert other.q_WB == pytest.approx(one.q_WB, abs=2e-3)
    assert other.w_WB_B == pytest.approx(one.w_WB_B, abs=5e-3)
    assert other.joints == pytest.approx(one.joints, abs=5e-3)
    assert abs(one.joints[0] + 0.8) > 0.05, "the arm has moved"


def test_both_hover_and_swing_the_arm_alike(vehicle: Vehicle) -> None:
    """Take off, then swing the arm in flight: position, attitude and joints, each 20 ms."""
    flown = []
    for plant in (PlantParams(), BULLET):
        hand = Hand(World(vehicle, WorldParams(plant=plant), PIPE))
        rows: list[tuple[float, ...]] = []
        for k in range(800):
            if k == 500:
                hand.joints = REACH
            hand.tick((0.0, 0.0, 1.2))
            if k % 5 == 0:
                truth = hand.world.truth()
                rows.append((*truth.p_WB, *truth.q_WB, *truth.joints))
        flown.append(np.array(rows))
    difference = np.abs(flown[0] - flown[1])
    assert difference[:100, :3].max() < 5e-4, "takeoff and hover, m"
    assert difference[:, :3].max() < 1e-3
    assert difference[:, 3:7].max() < 1e-3
    assert difference[:, 7:].max() < 5e-3
    assert np.ptp(flown[0][100:, 4:6], axis=0).max() > 1e-3, "the swing is felt by the base"


@pytest.fixture(scope="module")
def at_pipe(vehicle: Vehicle) -> Hand:
    """Hovering 2 cm before the pipe in the rigid-body world."""
    return world_at_pipe(vehicle)


def test_both_press_alike_and_leave_the_sleeve(vehicle: Vehicle, at_pipe: Hand) -> None:
    one, other = deepcopy(at_pipe), deepcopy(at_pipe)
    plant = to_bullet(other.world)
    rigid, bullet = (hand.press(3.0, speed=0.1, depth=0.15) for hand in (one, other))
    assert bullet[-1, 0] > 0.5
    assert np.abs(rigid[-250:, 0] - bullet[-250:, 0]).max() < 0.03
    assert bullet[:, 1].max() == pytest.approx(rigid[:, 1].max(), rel=0.1), "the blow of the touchdown"

    truth, b, client = other.world.truth(), plant.scene.bullet, plant.scene.client
    assert truth.contact_W[0] == pytest.approx(-truth.contact_force, rel=0.05)
    assert not truth.sliding

    other.gripper = 1.2
    other.fly(truth.p_WB, 0.4)
    truth = other.world.truth()
    assert not truth.payload
    assert truth.sleeve_on_pipe
    assert weight(plant) == pytest.approx(mass_of(vehicle) - vehicle.arm.sleeve.mass, abs=1e-6)
    assert b.getBasePositionAndOrientation(plant.scene.sleeve, client)[0][2] > truth.tip_W[2] - 0.05


def weight(plant: PyBulletPlant) -> float:
    b, client, body = plant.scene.bullet, plant.scene.client, plant.scene.vehicle
    return float(sum(b.getDynamicsInfo(body, link, client)[0] for link in range(-1, b.getNumJoints(body, client))))


def test_a_sleeve_let_go_in_the_air_falls(at_pipe: Hand) -> None:
    hand = deepcopy(at_pipe)
    plant = to_bullet(hand.world)
    hand.gripper = 1.2
    hand.fly(hand.world.truth().p_WB, 0.4)
    truth = hand.world.truth()
    assert not truth.payload
    assert not truth.sleeve_on_pipe
    place, _ = plant.scene.bullet.getBasePositionAndOrientation(plant.scene.sleeve, plant.scene.client)
    assert place[2] < truth.tip_W[2] - 0.05


@pytest.mark.parametrize("unevenness", [0.0, 0.3])
def test_a_tip_that_is_pushed_too_hard_slides(vehicle: Vehicle, unevenness: float) -> None:
    """Pressed on by 5 N without weight, then pushed along the pipe by more and by less than friction holds."""
    pipe = ContactParams(unevenness=unevenness)
    plant = bullet_plant(vehicle, replace(BULLET, contact=pipe))
    one = RigidBody(vehicle, PlantParams(contact=pipe), PIPE)
    for each in (plant, one):
        x, p = each.x, each.p
        reach = np.array(each.truth().tip_W) - x[at.POSITION : at.POSITION + 3]
        x[at.POSITION : at.POSITION + 3] = np.array(PIPE.position) - (PIPE.radius, 0.0, 0.0) - reach
        p[at.GRAVITY] = 0.0
        p[at.DRAG : at.DRAG + 3] = 0.0
    found = []
    for each in (plant, one):
        each.x[at.VELOCITY : at.VELOCITY + 3] = (0.05, 0.3, 0.0)
        seen = [moved(each, 0.0005) for _ in range(24)]
        found.append(seen)
        assert any(truth.sliding for truth in seen)
        assert seen[-1].tip_slip > 1e-4
    slips = [seen[-1].tip_slip for seen in found]
    assert slips[0] == pytest.approx(slips[1], rel=0.15)
    peaks = [max(truth.contact_peak for truth in seen) for seen in found]
    assert peaks[0] == pytest.approx(peaks[1], rel=0.1), "as stiff, and as damped"


def test_two_runs_of_one_seed_are_the_same_to_the_bit(at_pipe: Hand) -> None:
    def run() -> tuple[bytes, bytes]:
        hand = deepcopy(at_pipe)
        to_bullet(hand.world)
        rows = hand.press(1.0, speed=0.2)
        assert rows[-1, 0] > 0.0
        return hand.world.plant.x.tobytes(), rows.tobytes()

    assert run() == run()


def test_a_copy_goes_its_own_way(vehicle: Vehicle) -> None:
    one = bullet_plant(vehicle)
    one.x[at.POSITION + 2] = 5.0
    moved(one, 0.01)
    twin = deepcopy(one)
    after, again = moved(one, 0.05), moved(twin, 0.05)
    assert again.t == after.t
    assert again.p_WB == pytest.approx(after.p_WB, abs=1e-6)
    assert again.joints == pytest.approx(after.joints, abs=1e-5)
    twin.x[at.POSITION] = 1.0
    assert moved(one, 0.01).p_WB[0] == pytest.approx(0.0, abs=1e-3)


def test_what_is_written_into_the_arrays_holds(vehicle: Vehicle) -> None:
    plant = bullet_plant(vehicle)
    plant.x[at.POSITION : at.POSITION + 3] = (1.0, 2.0, 5.0)
    plant.x[at.VELOCITY] = 0.5
    plant.p[at.GRAVITY] = 0.0
    plant.p[at.DRAG : at.DRAG + 3] = 0.0
    plant.move(400)
    assert plant.x[at.POSITION : at.POSITION + 3] == pytest.approx((1.05, 2.0, 5.0), abs=2e-3)
    plant.p[at.PIPE_POINT] = 3.0
    plant.move(1)
    assert plant.scene.bullet.getBasePositionAndOrientation(plant.scene.pipe, plant.scene.client)[0][0] == 3.0


def test_a_hard_landing_breaks_it(vehicle: Vehicle) -> None:
    plant = bullet_plant(vehicle)
    for height, words in ((0.1, ""), (0.5, "hit the ground at 3.")):
        plant.x[at.POSITION + 2] = vehicle.base.gear_height + height
        plant.x[at.VELOCITY : at.VELOCITY + 3] = 0.0
        crashed = moved(plant, 0.4).crashed
        assert crashed.startswith(words)
        assert bool(crashed) is bool(words)


def test_without_pybullet_it_says_what_to_do(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ValueError, match=r"PyBullet is not installed .* or choose rigid"):
        World(vehicle, WorldParams(plant=BULLET), PIPE)


def test_without_a_screen_it_says_so(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":999")
    shown = replace(BULLET, bullet=replace(BULLET.bullet, window=True))
    with pytest.raises(ValueError, match="no window can be opened here"):
        World(vehicle, WorldParams(plant=shown), PIPE)
