"""A truth that is off the model: by what is declared, either way, and felt by the world alone."""

from __future__ import annotations

from math import degrees, hypot

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams, constants
from sim_backend.contact import SLIDE, SLIPPERIEST, ContactParams, pipe_contact
from sim_backend.deviations import AS_MODELLED, DeviationParams, deviations, mass_of
from sim_backend.motors import near_surfaces
from sim_backend.pipe import Pipe
from sim_backend.servos import joint_torque
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import PIPE, REACH, plant_at

Array = NDArray[np.float64]
SIZES = DeviationParams(
    thrust=0.05, mass=0.03, centre=0.005, inertia=0.1, pipe_ahead=0.05, pipe_up=0.01, pipe_turn_deg=5.0
)


def test_by_default_the_truth_is_the_model(vehicle: Vehicle) -> None:
    truth = deviations(DeviationParams(), 7)
    assert msgspec.structs.replace(truth, waves=AS_MODELLED.waves) == AS_MODELLED
    assert truth.vehicle(vehicle) == vehicle
    assert truth.pipe_of(Pipe(heading=0.3)) == Pipe(heading=0.3)


def test_every_seed_is_off_by_the_whole_size_and_seeds_differ_in_the_sign() -> None:
    drawn = [deviations(SIZES, seed) for seed in range(60)]
    assert drawn[0] == deviations(SIZES, 0) != drawn[1]
    signed = np.array(
        [(d.thrust - 1.0, d.mass - 1.0, *(k - 1.0 for k in d.inertia), *d.pipe[:2], degrees(d.pipe[2])) for d in drawn]
    )
    assert np.abs(signed) == pytest.approx(np.tile([0.05, 0.03, 0.1, 0.1, 0.1, 0.05, 0.01, 5.0], (60, 1)))
    assert np.abs(np.sign(signed).mean(axis=0)).max() < 0.45
    centres = np.array([d.centre for d in drawn])
    assert np.linalg.norm(centres, axis=1) == pytest.approx(np.full(60, 0.005))
    assert np.abs(centres.mean(axis=0)).max() < 0.0015


def test_the_true_vehicle_weighs_and_balances_as_declared(vehicle: Vehicle) -> None:
    """First moment and mass of the world against those of the model, sleeve included."""
    truth = deviations(SIZES, 3)
    base = at.LUMPED + at.LUMPED_SIZE
    model = constants(vehicle, PlantParams(), PIPE)
    real = constants(vehicle, PlantParams(), PIPE, truth)
    masses = model[base + at.L_MASS], real[base + at.L_MASS]
    assert masses[0] == pytest.approx(mass_of(vehicle))
    assert masses[1] == pytest.approx(truth.mass * masses[0])
    first = slice(base + at.L_FIRST, base + at.L_FIRST + 3)
    moved = (real[first] - model[first]) / masses[1]
    assert moved == pytest.approx(truth.centre, abs=1e-9)
    about = slice(base + at.L_INERTIA, base + at.L_INERTIA + 3)
    change = (real[about] - model[about]) / np.array(vehicle.base.inertia)
    assert change == pytest.approx(np.array(truth.inertia) - 1.0, abs=0.01)


def test_the_world_hovers_on_another_thrust_than_the_model_says(vehicle: Vehicle) -> None:
    params = DeviationParams(thrust=0.05, mass=0.03)
    for seed in range(4):
        world = World(vehicle, WorldParams(deviations=params), seed=seed)
        plant, truth = world.plant, world.deviations
        assert world.vehicle is vehicle
        x, u = plant.x, plant.u
        x[at.POSITION + 2] = 5.0
        u[at.U_ROTOR : at.U_ROTOR + 4] = 0.25 * mass_of(vehicle) * vehicle.gravity
        plant.move(1)
        lift = x[at.ROTOR : at.ROTOR + 4].sum() / (truth.mass * mass_of(vehicle) * vehicle.gravity)
        assert lift == pytest.approx(truth.thrust / truth.mass)


def test_the_pipe_is_not_where_it_is_believed(vehicle: Vehicle) -> None:
    world = World(vehicle, WorldParams(deviations=SIZES), PIPE, seed=5)
    p, (ahead, up, turn) = world.plant.p, world.deviations.pipe
    assert p[at.PIPE_POINT : at.PIPE_POINT + 3] == pytest.approx((2.0 + ahead, 0.0, 1.5 + up))
    assert p[at.PIPE_NORMAL : at.PIPE_NORMAL + 2] == pytest.approx((np.cos(turn), np.sin(turn)))


# --- friction ------------------------------------------------------------------------------------------------------


def grips(vehicle: Vehicle, unevenness: float, seed: int) -> Array:
    """Kinetic friction over normal force at places along a pipe of 2 m, sliding upwards."""
    params = PlantParams(contact=ContactParams(unevenness=unevenness, patch=0.05))
    p = constants(vehicle, params, PIPE, deviations(DeviationParams(), seed))
    x = np.zeros(at.STATE_SIZE)
    found = []
    for y in np.linspace(-0.95, 0.95, 800):
        x[at.CONTACT_MODE] = SLIDE
        x[at.CONTACT_STRETCH : at.CONTACT_STRETCH + 2] = (1e-5, 0.0)
        fx, fy, fz = pipe_contact(x, p, (PIPE.position[0] - PIPE.radius + 5e-5, y, PIPE.position[2]), (0.0, 0.0, 0.05))
        found.append(hypot(fy, fz) / abs(fx))
    return np.array(found)


def test_friction_is_uneven_along_the_pipe(vehicle: Vehicle) -> None:
    assert grips(vehicle, 0.0, 0) == pytest.approx(np.full(800, 0.9), rel=1e-3)
    several = np.array([grips(vehicle, 0.15, seed) for seed in range(12)])
    assert several.mean() == pytest.approx(0.9, rel=0.06)
    assert (several / 0.9).std() == pytest.approx(0.15, rel=0.25)
    assert (several >= 0.9 * SLIPPERIEST).all()
    step = 1.9 / 799
    assert np.abs(np.diff(several, axis=1)).max() < 0.9 * 0.15 * 4.0 * (2.0 * np.pi * 2.0 / 0.05) * step
    assert (several[0] != several[1]).any()


# --- near surfaces -------------------------------------------------------------------------------------------------

LEVEL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def pushed(vehicle: Vehicle, params: PlantParams, place: tuple[float, float, float]) -> Array:
    p = constants(vehicle, params, PIPE)
    x = np.zeros(at.STATE_SIZE)
    x[at.POSITION : at.POSITION + 3] = place
    x[at.ROTOR : at.ROTOR + 4] = 5.0
    return np.array(near_surfaces(x, p, LEVEL))


@pytest.mark.parametrize("radii", [1.0, 2.0, 4.0])
def test_the_ground_lifts_as_cheeseman_and_bennett_say(vehicle: Vehicle, radii: float) -> None:
    fx, fy, fz, mx, my, mz = pushed(vehicle, PlantParams(ground_effect=1.0), (-3.0, 0.0, radii * vehicle.rotors.radius))
    assert fz == pytest.approx(20.0 * (1.0 / (1.0 - (1.0 / (4.0 * radii)) ** 2) - 1.0))
    assert (fx, fy, mx, my, mz) == pytest.approx((0.0,) * 5, abs=1e-12)


def test_below_half_a_radius_the_lift_grows_no_more(vehicle: Vehicle) -> None:
    lifts = [
        pushed(vehicle, PlantParams(ground_effect=1.0), (-3.0, 0.0, k * vehicle.rotors.radius))[2] for k in (0.1, 0.5)
    ]
    assert lifts[0] == lifts[1] == pytest.approx(20.0 / 3.0)


def test_the_pipe_pulls_more_the_nearer_it_is(vehicle: Vehicle) -> None:
    params = PlantParams(wall_effect=0.02)
    near, far = (pushed(vehicle, params, (PIPE.position[0] - gap, 0.0, PIPE.position[2])) for gap in (0.45, 0.9))
    front, rear = (gap - PIPE.radius for gap in (0.45 - vehicle.rotors.arm_x, 0.45 + vehicle.rotors.arm_x))
    radius = vehicle.rotors.radius
    assert near[0] == pytest.approx(2.0 * 5.0 * 0.02 * ((radius / front) ** 2 + (radius / rear) ** 2))
    assert near[0] > 3.0 * far[0] > 0.0
    assert near[1:] == pytest.approx(np.zeros(5), abs=1e-12)
    assert pushed(vehicle, params, (PIPE.position[0] - 0.45, 3.0, PIPE.position[2])) == pytest.approx(np.zeros(6))


# --- play in the gears ---------------------------------------------------------------------------------------------

PLAY = PlantParams(backlash=0.0044)


def test_a_torque_that_reverses_crosses_the_play_first(vehicle: Vehicle) -> None:
    """The output held fast: nothing arrives while the motor side crosses the play, then all of it does."""
    p = constants(vehicle, PLAY, PIPE)
    x, u = np.zeros(at.STATE_SIZE), np.zeros(at.DRIVE_SIZE)
    u[at.U_TORQUE_ON] = 1.0

    def turn(demand: float, seconds: float) -> list[float]:
        u[at.U_TORQUE + 1] = demand
        return [joint_torque(x, p, u, 1, 0.0, 0.0) for _ in range(round(seconds / p[at.STEP]))]

    assert turn(0.1, 0.3)[-1] == pytest.approx(0.1, rel=1e-3)
    assert x[at.SERVO_LAG + 1] == pytest.approx(0.0022 + 0.1 / 200.0, rel=1e-2)
    back = np.array(turn(-0.1, 0.3))
    left = int(np.flatnonzero(back == 0.0)[0])
    crossing = int(np.flatnonzero(back[left:] < 0.0)[0]) * p[at.STEP]
    # From one end to the other under constant torque, a little quicker for the push of the teeth at its start.
    assert 0.6 < crossing / (2.0 * 0.0044 * 1.5e-3 / 0.1) ** 0.5 <= 1.02
    assert (back[:left] > 0.0).all()
    assert back[-1] == pytest.approx(-0.1, rel=1e-3)


def test_within_the_play_the_arm_moves_freely(vehicle: Vehicle) -> None:
    """Without torque an output that moves less than the play feels nothing; without play it feels the rotor."""
    p = constants(vehicle, PLAY, PIPE)
    x, u = np.zeros(at.STATE_SIZE), np.zeros(at.DRIVE_SIZE)
    felt = [joint_torque(x, p, u, 0, 0.0, 0.2 * np.cos(200.0 * k * p[at.STEP])) for k in range(1000)]
    assert set(felt) == {0.0}
    assert p[at.LUMPED + at.L_ROTOR] == 0.0
    assert constants(vehicle, PlantParams(), PIPE)[at.LUMPED + at.L_ROTOR] == pytest.approx(1.5e-3)


def test_play_creates_no_energy(vehicle: Vehicle) -> None:
    """An arm that swings freely on teeth with losses never gets faster than it was."""
    plant = plant_at(vehicle, msgspec.structs.replace(PLAY, gear_damping=0.3), REACH)
    plant.x[at.JOINT_RATE : at.JOINT_RATE + 3] = (0.5, -0.4, 0.6)
    swings = []
    for _ in range(200):
        plant.move(10)
        swings.append(float(np.abs(plant.x[at.JOINT_RATE : at.JOINT_RATE + 3]).max()))
    assert max(swings) < 1.5
    assert np.isfinite(plant.x).all()
