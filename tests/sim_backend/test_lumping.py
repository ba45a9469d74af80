"""The bodies and gears of the PyBullet world are the vehicle: single steps against the equations of motion."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import cos, sin
from typing import Any, cast
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import BulletParams, PlantParams
from sim_backend.bullet_scene import Scene
from sim_backend.deviations import DeviationParams, deviations
from sim_backend.dynamics import accelerations, lump
from sim_backend.lumping import bodies, gears
from sim_backend.urdf import urdf

Array = NDArray[np.float64]
STEP = 5e-5


@contextmanager
def scene_of(vehicle: Vehicle, centre: Vec3 = (0.0, 0.0, 0.0)) -> Iterator[Scene]:
    scene = Scene(vehicle, centre=centre)
    scene.prepare(PlantParams(bullet=BulletParams(step=STEP)), STEP)
    try:
        yield scene
    finally:
        scene.close()


def motion(scene: Scene) -> tuple[Array, Array, Array, Array]:
    """Velocity of B's origin and rate (W), rates of the links, and the rotation from B to W."""
    b, client = scene.bullet, scene.client
    velocity, rate = b.getBaseVelocity(scene.vehicle, client)
    attitude = b.getBasePositionAndOrientation(scene.vehicle, client)[1]
    rotation = np.array(b.getMatrixFromQuaternion(attitude)).reshape(3, 3)
    rates = np.cumsum([state[1] for state in b.getJointStates(scene.vehicle, scene.chain, client)])
    return np.array(velocity) - np.cross(rate, rotation @ scene.centre), np.array(rate), rates, rotation


def accelerated(scene: Scene, joints: Array, rate: Array, rates: Array, load: Array, attitude: Array) -> Array:
    """What one step of the engine makes of a load: specific force (B), angular acceleration (B), of the joints."""
    b, client, body = scene.bullet, scene.client, scene.vehicle
    scene.place_vehicle((0.0, 0.0, 5.0), attitude.tolist(), joints.tolist(), rates.tolist())
    rotation = motion(scene)[3]
    scene.move_vehicle((0.3, -0.2, 0.1), (rotation @ rate).tolist())
    before = motion(scene)
    b.applyExternalForce(body, -1, (rotation @ load[:3]).tolist(), (0.0, 0.0, 5.0), b.WORLD_FRAME, client)
    b.applyExternalTorque(body, -1, (rotation @ load[3:6]).tolist(), b.WORLD_FRAME, client)
    beyond = np.cumsum(load[:5:-1])[::-1].tolist()
    b.setJointMotorControlArray(body, scene.chain, b.TORQUE_CONTROL, forces=beyond, physicsClientId=client)
    b.stepSimulation(client)
    after = motion(scene)
    fall = np.array((0.0, 0.0, 9.80665))
    return np.concatenate(
        (
            rotation.T @ ((after[0] - before[0]) / STEP + fall),
            rotation.T @ ((after[1] - before[1]) / STEP),
            (after[2] - before[2]) / STEP,
        )
    )


@pytest.mark.parametrize("play", [False, True])
@pytest.mark.parametrize("off", [False, True])
@pytest.mark.parametrize("payload", [True, False])
def test_one_step_accelerates_as_the_equations_of_motion_say(
    vehicle: Vehicle, payload: bool, off: bool, play: bool
) -> None:
    """With and without the sleeve; as modelled, or off as in ``realistic``; motors on the joints, or beyond a play."""
    truth = deviations(DeviationParams(mass=0.03, centre=0.005, inertia=0.1) if off else DeviationParams(), 1)
    centre, vehicle = truth.base_centre(vehicle), truth.vehicle(vehicle)
    if play:
        vehicle = replace(vehicle, servo=replace(vehicle.servo, rotor_inertia=0.0))
    parts = (*vehicle.arm.parts, vehicle.arm.sleeve) if payload else vehicle.arm.parts
    p = np.zeros(at.CONSTANTS_SIZE)
    p[at.LUMPED : at.LUMPED + at.LUMPED_SIZE] = lump(vehicle, parts, vehicle.servo.rotor_inertia, centre)
    random = np.random.default_rng(2)
    with scene_of(vehicle, centre) as scene:
        if not payload:
            scene.take_sleeve()
        for _ in range(20):
            joints, rate, rates = random.uniform(-3, 3, 3), random.uniform(-2, 2, 3), random.uniform(-3, 3, 3)
            load, attitude = random.uniform(-1, 1, 9), random.normal(size=4)
            arguments = (*(g(a) for a in joints for g in (cos, sin)), *rate, *rates, *map(tuple, load.reshape(3, 3)))
            want = np.array(cast(Any, accelerations)(p, at.LUMPED, *arguments))
            got = accelerated(scene, joints, rate, rates, load, attitude / np.linalg.norm(attitude))
            # What is left is the solver's, after the iterations of a flight; with 200 it is below 1e-5.
            bound = 4e-3 if play else 5e-4
            assert np.abs(got - want)[:3].max() < bound * max(1.0, np.abs(want[:3]).max())
            assert np.abs(got - want)[3:].max() < bound * np.abs(want[3:]).max()


def test_the_gears_hold(vehicle: Vehicle) -> None:
    with scene_of(vehicle) as scene:
        b, client, body = scene.bullet, scene.client, scene.vehicle
        bent, turning = np.array((-0.8, 0.7, 0.0)), np.array((3.0, -2.0, 4.0))
        accelerated(scene, bent, np.ones(3), turning, np.zeros(9), np.eye(4)[3])
        index = {b.getJointInfo(body, i, client)[1].decode(): i for i in range(b.getNumJoints(body, client))}
        for _ in range(4000):
            b.stepSimulation(client)
        for name, sign, other in gears(vehicle):
            follower, leader = (b.getJointState(body, index[link], client) for link in (name, other))
            assert abs(follower[0] - sign * leader[0]) < 1e-6
        assert abs(b.getJointState(body, index["link_1"], client)[0] + 0.8) > 0.1, "the arm has swung"


def test_nothing_is_lost_of_mass(vehicle: Vehicle) -> None:
    parts = vehicle.arm.parts
    whole = vehicle.base.mass + sum(part.mass for part in parts)
    assert sum(body.mass for body in bodies(vehicle).values()) == pytest.approx(whole, rel=1e-12)


def test_bars_to_look_at_weigh_nothing(vehicle: Vehicle) -> None:
    def mass(text: str) -> float:
        return sum(float(each.attrib["value"]) for each in ET.fromstring(text).iter("mass"))

    plain, barred = urdf(vehicle), urdf(vehicle, bars=True)
    assert barred.count("<link") == plain.count("<link") + 3
    assert mass(barred) == pytest.approx(mass(plain), abs=1e-8)


def test_a_part_at_no_pin_is_refused(vehicle: Vehicle) -> None:
    stray = replace(vehicle.arm.parts[4], name="stray", along=(0.13, 0.0, 0.0))
    arm = replace(vehicle.arm, parts=(*vehicle.arm.parts, stray))
    with pytest.raises(ValueError, match="part stray is at no pin"):
        bodies(replace(vehicle, arm=arm))


def test_an_impossible_inertia_is_refused(vehicle: Vehicle) -> None:
    base = replace(vehicle.base, inertia=(0.001, 0.03, 0.05))
    with pytest.raises(ValueError, match="base has no possible mass and inertia"):
        urdf(replace(vehicle, base=base))
