"""Motion of the plant: what is conserved, what falls, what stands, what breaks."""

from __future__ import annotations

from math import cos, sin

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.vehicle import Carrier, Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams
from sim_backend.plant import Actuation
from sim_backend.rigid_body import RigidBody
from tests.sim_backend.flying import PIPE, mass_of, plant_at

Array = NDArray[np.float64]
OFF = Actuation((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False, (0.0, 0.0, 0.0, 0.0, 0.0), 0.0, False)
CARRIERS = (Carrier.LINK_1, Carrier.LINK_2, Carrier.TOOL)


def rotation(q: Array) -> Array:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def balance(plant: RigidBody, vehicle: Vehicle) -> tuple[float, Array, Array]:
    """Kinetic energy, momentum and angular momentum about the origin of W, part by part."""
    x = plant.x
    R = rotation(x[at.ATTITUDE : at.ATTITUDE + 4])
    w, joints, rates = x[at.RATE : at.RATE + 3], x[at.JOINT : at.JOINT + 3], x[at.JOINT_RATE : at.JOINT_RATE + 3]
    u = np.array([[cos(a), 0.0, sin(a)] for a in joints])
    du = np.array([[-sin(a), 0.0, cos(a)] for a in joints])
    y = np.array([0.0, 1.0, 0.0])
    bodies = [(vehicle.base.mass, np.zeros(3), np.zeros(3), np.diag(vehicle.base.inertia), w)]
    for part in (*vehicle.arm.parts, vehicle.arm.sleeve):
        along = np.array(part.along)
        c = np.array(vehicle.arm.mount) + (part.offset[0], 0.0, part.offset[1]) + along @ u
        k = None if part.turns_with is Carrier.BASE else CARRIERS.index(part.turns_with)
        axes = np.eye(3) if k is None else np.column_stack((u[k], y, du[k]))
        spin = w if k is None else w - y * rates[k]
        bodies.append((part.mass, c, (along * rates) @ du, axes @ np.diag(part.inertia) @ axes.T, spin))
    energy = 0.5 * vehicle.servo.rotor_inertia * float(rates @ rates)
    momentum, angular = np.zeros(3), np.zeros(3)
    for mass, c, speed, inertia, spin in bodies:
        v = x[at.VELOCITY : at.VELOCITY + 3] + R @ (np.cross(w, c) + speed)
        energy += 0.5 * mass * float(v @ v) + 0.5 * float(spin @ inertia @ spin)
        momentum += mass * v
        angular += mass * np.cross(x[at.POSITION : at.POSITION + 3] + R @ c, v) + R @ inertia @ spin
    return energy, momentum, angular


def tumbling(vehicle: Vehicle, step: float = 1e-4) -> RigidBody:
    plant = plant_at(vehicle, PlantParams(step=step), gap=-20.0, velocity=(0.3, -0.2, 0.1))
    plant.x[at.RATE : at.RATE + 3] = (0.6, -0.9, 1.2)
    plant.x[at.JOINT_RATE : at.JOINT_RATE + 3] = (1.0, -0.5, 0.8)
    plant.p[at.PIPE_POINT : at.PIPE_POINT + 3] = 1000.0
    return plant


def test_energy_and_momentum_are_conserved_without_forces(vehicle: Vehicle) -> None:
    plant = tumbling(vehicle)
    energy, momentum, angular = balance(plant, vehicle)
    plant.advance(OFF, 0.4)
    assert plant.x[at.JOINT] != pytest.approx(-1.0, abs=0.1)
    after = balance(plant, vehicle)
    assert after[0] == pytest.approx(energy, rel=1e-6)
    assert after[1] == pytest.approx(momentum, abs=1e-6)
    # The rotors of the servos count only on their joints' diagonal, so that angular momentum about y_B leaks there.
    light = msgspec.structs.replace(vehicle, servo=msgspec.structs.replace(vehicle.servo, rotor_inertia=0.0))
    plant = tumbling(light)
    angular = balance(plant, light)[2]
    plant.advance(OFF, 0.4)
    assert balance(plant, light)[2] == pytest.approx(angular, abs=2e-6)


def test_integration_is_of_second_order(vehicle: Vehicle) -> None:
    ends = []
    for step in (2e-4, 1e-4, 2e-5):
        plant = tumbling(vehicle, step)
        plant.advance(OFF, 0.4)
        ends.append(plant.x[: at.ACCELERATION].copy())
    coarse, fine = np.abs(ends[0] - ends[2]).max(), np.abs(ends[1] - ends[2]).max()
    assert fine < 1e-6
    assert coarse > 3.0 * fine


def test_free_fall(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=1.0)
    plant.p[at.GRAVITY] = vehicle.gravity
    height = plant.x[at.POSITION + 2]
    plant.advance(OFF, 0.3)
    truth = plant.truth()
    assert truth.p_WB[2] - height == pytest.approx(-0.5 * vehicle.gravity * 0.09, abs=1e-9)
    assert truth.v_WB[2] == pytest.approx(-vehicle.gravity * 0.3, abs=1e-9)
    assert truth.f_B == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert truth.t == pytest.approx(0.3)


def test_drag_slows_towards_its_terminal_speed(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=1.0)
    plant.p[at.DRAG] = 5.0
    plant.u[at.U_TORQUE_ON] = 1.0
    plant.x[at.VELOCITY] = 1.0
    before = balance(plant, vehicle)[1][0]
    hold = msgspec.structs.replace(OFF, position_mode=True, goal=(-1.0, 1.0, 0.0, 0.0, 0.0), current_limit=1.8)
    plant.advance(msgspec.structs.replace(hold, torque_on=True), 0.01)
    assert balance(plant, vehicle)[1][0] - before == pytest.approx(-5.0 * 1.0 * 0.01, rel=0.02)


def test_a_limp_arm_touches_the_ground_before_the_skids(vehicle: Vehicle) -> None:
    """Where it hangs down, the vehicle stands on it; that is on the ground too."""
    plant = RigidBody(vehicle, PlantParams(), PIPE)
    plant.x[at.JOINT : at.JOINT + 3] = (-1.62, 0.287, -2.356)
    for height, touches in ((0.015, True), (0.03, False)):
        plant.x[at.POSITION + 2] = vehicle.base.gear_height + height
        plant.advance(OFF, 1e-3)
        assert plant.truth().on_ground is touches


def test_starts_at_rest_on_its_skids_and_stays(vehicle: Vehicle) -> None:
    plant = RigidBody(vehicle, PlantParams(), PIPE)
    start = plant.truth()
    assert start.t == 0.0
    assert start.on_ground
    assert start.payload
    assert start.battery_remaining == 1.0
    assert start.p_WB == pytest.approx((0.0, 0.0, vehicle.base.gear_height), abs=1e-3)
    assert start.joints == pytest.approx((-2.80, -0.35, 0.0), abs=0.03)
    for values in (start.v_WB, start.w_WB_B, start.joint_rates):
        assert values == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert start.f_B[2] == pytest.approx(vehicle.gravity, abs=1e-3)
    plant.advance(
        msgspec.structs.replace(
            OFF, position_mode=True, goal=(-2.80, -0.35, 0.0, 0.0, 0.0), current_limit=1.8, torque_on=True
        ),
        5.0,
    )
    end = plant.truth()
    assert end.p_WB == pytest.approx(start.p_WB, abs=1e-7)
    assert end.q_WB == pytest.approx(start.q_WB, abs=1e-7)


def test_skids_hold_a_side_force_until_friction_breaks(vehicle: Vehicle) -> None:
    def pushed(share: float) -> float:
        plant = RigidBody(vehicle, PlantParams(), PIPE)
        # Gravity leaning along x is a horizontal push of that share of the weight.
        plant.p[at.DRAG] = 0.0
        for _ in range(500):
            plant.x[at.VELOCITY] += share * vehicle.gravity * 1e-3
            plant.advance(
                msgspec.structs.replace(
                    OFF, position_mode=True, goal=(-2.80, -0.35, 0.0, 0.0, 0.0), current_limit=1.8, torque_on=True
                ),
                1e-3,
            )
        return plant.truth().p_WB[0]

    assert abs(pushed(0.5)) < 2e-3
    assert pushed(1.0) > 0.2


def test_a_limp_arm_comes_to_rest_on_the_ground(vehicle: Vehicle) -> None:
    plant = RigidBody(vehicle, PlantParams(ideal_servos=False), PIPE)
    plant.advance(OFF, 6.0)
    truth = plant.truth()
    assert truth.crashed == ""
    assert truth.joint_rates == pytest.approx((0.0, 0.0, 0.0), abs=0.02)
    assert truth.tip_W[2] > -2e-3


def test_hard_hits_break_the_vehicle_and_soft_ones_do_not(vehicle: Vehicle) -> None:
    def dropped(height: float) -> RigidBody:
        plant = RigidBody(vehicle, PlantParams(), PIPE)
        plant.x[at.POSITION + 2] += height
        plant.advance(
            msgspec.structs.replace(
                OFF, position_mode=True, goal=(-2.80, -0.35, 0.0, 0.0, 0.0), current_limit=1.8, torque_on=True
            ),
            2.0,
        )
        return plant

    assert dropped(0.1).truth().crashed == ""
    assert dropped(0.1).truth().v_WB == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    broken = dropped(0.5)
    assert broken.truth().crashed == "hit the ground at 3.1 m/s"
    broken.advance(msgspec.structs.replace(OFF, rotor_thrust=(9.0, 9.0, 9.0, 9.0)), 0.1)
    assert broken.truth().rotor_thrust == (0.0, 0.0, 0.0, 0.0)


def test_turning_over_is_a_crash(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=1.0)
    plant.x[at.RATE] = 4.0
    plant.advance(OFF, 0.1)
    assert plant.truth().crashed == ""
    for _ in range(60):
        plant.advance(OFF, 0.01)
    assert plant.truth().crashed.startswith("turned over at 1.")


@pytest.mark.parametrize(("height", "struck"), [(0.0, True), (0.079, True), (0.09, False), (-0.3, False)])
def test_a_propeller_in_the_pipe_is_a_crash(vehicle: Vehicle, height: float, struck: bool) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=1.0)
    plant.x[at.POSITION] = PIPE.position[0] - vehicle.rotors.arm_x
    plant.x[at.POSITION + 2] = PIPE.position[2] + height
    plant.advance(OFF, 1e-4)
    assert (plant.truth().crashed != "") is struck


def test_hover_and_allocation(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=1.0)
    each = 0.25 * mass_of(vehicle) * vehicle.gravity
    plant.advance(msgspec.structs.replace(OFF, rotor_thrust=(each, each, each, each)), 1e-4)
    truth = plant.truth()
    assert truth.rotor_thrust == pytest.approx((each, each, each, each))
    a, k = vehicle.rotors.arm_x, vehicle.rotors.torque_per_thrust
    expected = {
        (1.0, 0.0, 0.0, 0.0): (-a, -a, -k),  # front right: rolls left, pitches up, spins counter-clockwise
        (0.0, 1.0, 0.0, 0.0): (a, a, -k),
        (0.0, 0.0, 1.0, 0.0): (a, -a, k),
        (0.0, 0.0, 0.0, 1.0): (-a, a, k),
    }
    for thrust, signs in expected.items():
        plant = plant_at(vehicle, PlantParams(), gap=1.0)
        plant.advance(msgspec.structs.replace(OFF, rotor_thrust=thrust), 1e-3)
        angular = balance(plant, vehicle)[2] - np.cross(plant.x[:3], balance(plant, vehicle)[1])
        assert angular == pytest.approx(np.array(signs) * 1e-3, rel=0.01)


def test_motor_lag_limit_and_battery(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams(ideal_motors=False), gap=1.0)
    full = msgspec.structs.replace(OFF, rotor_thrust=(20.0, 5.0, -3.0, 0.0))
    plant.advance(full, 0.030)
    reached = plant.truth().rotor_thrust
    assert reached[0] == pytest.approx(13.0 * (1.0 - np.exp(-1.0)), rel=1e-6)
    assert reached[1] == pytest.approx(5.0 * (1.0 - np.exp(-1.0)), rel=1e-6)
    assert reached[2:] == (0.0, 0.0)

    ideal = plant_at(vehicle, PlantParams(), gap=1.0)
    ideal.advance(full, 1e-4)
    assert ideal.truth().rotor_thrust == (13.0, 5.0, 0.0, 0.0)

    plant.x[at.CHARGE] = 0.0
    plant.advance(full, 0.5)
    empty = vehicle.battery.empty_voltage
    sag = empty - plant.truth().battery_voltage
    assert 0.05 < sag < 0.5
    rated = 0.5 * (vehicle.battery.full_voltage + empty)
    assert plant.truth().rotor_thrust[0] == pytest.approx(13.0 * ((empty - sag) / rated) ** 2, rel=0.01)


def test_the_battery_lasts_as_long_as_its_capacity_says(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams(), gap=1.0)
    each = 0.25 * mass_of(vehicle) * vehicle.gravity
    for _ in range(50):
        plant.advance(msgspec.structs.replace(OFF, rotor_thrust=(each, each, each, each)), 0.01)
    drawn = vehicle.battery.hover_current * 0.5 / (3600.0 * vehicle.battery.capacity)
    assert 1.0 - plant.truth().battery_remaining == pytest.approx(drawn, rel=1e-3)


def test_a_duration_must_be_a_whole_number_of_steps(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams())
    for wrong in (0.0, -1.0, 1.5e-4, 5e-5):
        with pytest.raises(ValueError, match=r"whole number of physics steps of 0\.0001 s"):
            plant.advance(OFF, wrong)


def test_a_state_that_is_not_finite_is_an_error(vehicle: Vehicle) -> None:
    plant = plant_at(vehicle, PlantParams())
    plant.x[at.VELOCITY] = float("nan")
    with pytest.raises(FloatingPointError, match="not finite"):
        plant.advance(OFF, 1e-3)
