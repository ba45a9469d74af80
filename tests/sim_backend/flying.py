"""A plain controller that flies a world through its mock devices, and poses to start from."""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import msgspec
import numpy as np
from numpy.typing import NDArray

from drivers.samples import AutopilotCommand, Engage, Interface, JointMode, ServoCommand, Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import BulletParams, PlantKind, PlantParams
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
from sim_backend.pipe import Pipe
from sim_backend.pybullet_plant import PyBulletPlant
from sim_backend.rigid_body import RigidBody
from sim_backend.world import World, WorldParams

TICK = 0.004
REACH = (-1.0, 1.0, 0.0)
PIPE = Pipe()
#: Where the pipe begins, m, W.
SURFACE = PIPE.position[0] - PIPE.radius


def mass_of(vehicle: Vehicle) -> float:
    return vehicle.base.mass + sum(part.mass for part in vehicle.arm.parts) + vehicle.arm.sleeve.mass


def tip_in_body(vehicle: Vehicle, joints: Vec3) -> Vec3:
    arm = vehicle.arm
    lengths = (arm.link_1, arm.link_2, arm.gripper)
    return (
        arm.mount[0] + sum(length * cos(a) for length, a in zip(lengths, joints, strict=True)),
        arm.mount[1],
        arm.mount[2] + sum(length * sin(a) for length, a in zip(lengths, joints, strict=True)),
    )


def plant_at(
    vehicle: Vehicle, params: PlantParams, joints: Vec3 = REACH, gap: float = 1.0, velocity: Vec3 = (0.0, 0.0, 0.0)
) -> RigidBody:
    """A plant in the air, level and free of gravity and drag, torque off, the tip ``gap`` before the pipe (m)."""
    plant = RigidBody(vehicle, params, PIPE)
    tip = tip_in_body(vehicle, joints)
    x, p, u = plant.x, plant.p, plant.u
    x[at.POSITION : at.POSITION + 3] = (
        SURFACE - gap - tip[0],
        -tip[1],
        PIPE.position[2] - tip[2],
    )
    x[at.VELOCITY : at.VELOCITY + 3] = velocity
    x[at.ATTITUDE : at.ATTITUDE + 4] = (1.0, 0.0, 0.0, 0.0)
    x[at.RATE : at.RATE + 3] = 0.0
    x[at.JOINT : at.JOINT + 3] = joints
    x[at.JOINT_RATE : at.ROTOR] = 0.0
    p[at.GRAVITY] = 0.0
    p[at.DRAG : at.DRAG + 3] = 0.0
    u[at.U_TORQUE_ON] = 0.0
    return plant


def to_bullet(world: World) -> PyBulletPlant:
    """Have PyBullet move the vehicle of a rigid-body world from here on; gives its plant."""
    one = world.plant
    x, p, u, steps = one.x, one.p, one.u, round(one.p[at.LOOP_STEPS] * one.step / BulletParams().step)
    normal, length = p[at.PIPE_NORMAL : at.PIPE_NORMAL + 2], 2.0 * float(p[at.PIPE_HALF_LENGTH])
    where = (float(p[at.PIPE_POINT]), float(p[at.PIPE_POINT + 1]), float(p[at.PIPE_POINT + 2]))
    params = msgspec.structs.replace(one.params, kind=PlantKind.PYBULLET)
    heading, radius = atan2(normal[1], normal[0]), float(p[at.PIPE_RADIUS])
    plant = PyBulletPlant(world.vehicle, params, Pipe(where, heading, radius, length))
    plant.x[:], plant.u[:], plant.p[at.LOOP :] = x, u, p[at.LOOP :]
    plant.p[at.LOOP_STEPS], plant.x[at.PHASE] = steps, 0.0
    plant.steps = round(world.time / plant.step)
    world.plant = plant
    return plant


def frictionless(params: PlantParams) -> PlantParams:
    """The same without any loss in the contact."""
    contact = msgspec.structs.replace(params.contact, damping=0.0, friction_static=0.0, friction_kinetic=0.0)
    return msgspec.structs.replace(params, contact=contact)


class Hand:
    """Position and attitude by proportional and derivative action, the arm held in position mode."""

    def __init__(self, world: World, interface: Interface = Interface.WRENCH) -> None:
        self.world = world
        self.interface = interface
        self.autopilot, self.odometry, self.servos = MockAutopilot(world), MockOdometry(world), MockServos(world)
        self.joints: Vec3 = world.params.plant.start_joints
        self.gripper = 0.0
        self._mass = mass_of(world.vehicle)

    def command(self, target: Vec3) -> AutopilotCommand:
        pose, state = self.odometry.latest(), self.autopilot.latest()
        assert pose is not None
        assert state is not None
        ax, ay, az = (min(max(2.0 * (target[k] - pose.p_WB[k]) - 2.5 * pose.v_WB[k], -2.0), 2.0) for k in range(3))
        g = self.world.vehicle.gravity
        theta, phi = ax / g, -ay / g
        q = (sqrt(1.0 - 0.25 * (theta * theta + phi * phi)), 0.5 * phi, 0.5 * theta, 0.0)
        r, w = state.q_WB, state.w_WB_B
        error = (2.0 * (q[1] - r[1]), 2.0 * (q[2] - r[2]), -2.0 * r[3])
        inertia = (0.04, 0.05, 0.06)
        tx, ty, tz = (j * (100.0 * e - 20.0 * rate) for j, e, rate in zip(inertia, error, w, strict=True))
        rates = (6.0 * error[0], 6.0 * error[1], 6.0 * error[2])
        return AutopilotCommand(Engage.OFFBOARD, self.interface, self._mass * (g + az), (tx, ty, tz), q, rates)

    def tick(self, target: Vec3) -> None:
        self.autopilot.command(self.command(target))
        goal = (*self.joints, 0.0, self.gripper)
        self.servos.command(ServoCommand(JointMode.POSITION, (0.0, 0.0, 0.0), goal, 1.8))
        self.world.advance(TICK)

    def fly(self, target: Vec3, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self.tick(target)

    def press(self, seconds: float, speed: float = 0.05, depth: float = 0.3) -> NDArray[np.float64]:
        """From the air, advance at ``speed`` and push on; rows of (force, peak, slip), one a tick."""
        rows = []
        x, _, z = self.world.truth().p_WB
        for k in range(round(seconds / TICK)):
            self.tick((min(x + speed * k * TICK, x + depth), 0.0, z))
            truth = self.world.truth()
            rows.append((truth.contact_force, truth.contact_peak, truth.tip_slip))
        return np.array(rows)


def world_at_pipe(vehicle: Vehicle, params: WorldParams | None = None, gap: float = 0.02) -> Hand:
    """A hand hovering with the arm stretched out, the tip about ``gap`` before the pipe, m."""
    world = World(vehicle, params, PIPE)
    hand = Hand(world, Interface.ATTITUDE)
    hand.fly((0.0, 0.0, 1.2), 3.0)
    hand.joints = REACH
    tip = tip_in_body(vehicle, REACH)
    hand.fly((SURFACE - tip[0] - gap - 0.2, 0.0, PIPE.position[2] - tip[2]), 6.0)
    x = world.plant.x
    x[at.POSITION] += SURFACE - gap - world.truth().tip_W[0]
    x[at.POSITION + 1] += -world.truth().tip_W[1]
    x[at.POSITION + 2] += PIPE.position[2] - world.truth().tip_W[2]
    hand.tick(world.truth().p_WB)
    return hand
