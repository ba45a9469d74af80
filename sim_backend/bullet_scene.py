"""Vehicle, pipe, ground and sleeve in a Bullet of their own: what is simulated, shown on the screen, or pictured."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from math import pi
from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory
from typing import Any

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams
from sim_backend.lumping import DRIVEN, SLEEVE, gears
from sim_backend.pipe import Pipe
from sim_backend.urdf import BARS, urdf

#: Share of a gear's angle error that is taken back in one step.
_GEAR_ERP = 0.2
#: More than any gear carries, N m.
_GEAR_MOST = 1e4


class NoBulletError(ValueError):
    """There is no PyBullet on this machine, or no window for it."""


def _load_bullet() -> Any:
    """The pybullet module, without the line that it greets with. Raises NoBulletError where there is none."""
    if sys.modules.get("pybullet") is not None:
        return sys.modules["pybullet"]
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        return import_module("pybullet")
    except ImportError as error:
        raise NoBulletError("PyBullet is not installed (pip install pybullet; it has no wheel for ARM)") from error
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _check_screen() -> None:
    """Raises NoBulletError where no window can be opened: Bullet ends the whole process there."""
    trial = "import pybullet; raise SystemExit(pybullet.connect(pybullet.GUI) < 0)"
    if run((sys.executable, "-c", trial), capture_output=True, check=False).returncode:
        raise NoBulletError("bullet.window: no window can be opened here; is there a screen?")


class Scene:
    """The bodies in one Bullet client. ``window`` shows them on the screen; ``bars`` adds the parallelograms' bars.

    ``centre`` is the base's centre of mass, m, B: where Bullet has the base, whose origin is what we tell.
    ``close`` gives the client back. Raises NoBulletError; ValueError for an arm that has no URDF.
    """

    def __init__(
        self, vehicle: Vehicle, window: bool = False, bars: bool = False, centre: Vec3 = (0.0, 0.0, 0.0)
    ) -> None:
        text = urdf(vehicle, bars, centre)
        self.centre = centre
        self.bullet = bullet = _load_bullet()
        if window:
            _check_screen()
        self.client: int = bullet.connect(bullet.GUI if window else bullet.DIRECT)
        bullet.setGravity(0.0, 0.0, -vehicle.gravity, physicsClientId=self.client)
        with TemporaryDirectory(prefix="pipewright-") as folder:
            path = Path(folder) / "vehicle.urdf"
            path.write_text(text, encoding="utf-8")
            flags = bullet.URDF_USE_INERTIA_FROM_FILE | bullet.URDF_MAINTAIN_LINK_ORDER
            self.vehicle: int = bullet.loadURDF(str(path), flags=flags, physicsClientId=self.client)
        count = bullet.getNumJoints(self.vehicle, physicsClientId=self.client)
        info = (bullet.getJointInfo(self.vehicle, i, physicsClientId=self.client) for i in range(count))
        self._links: dict[str, int] = {row[12].decode(): row[0] for row in info}
        self._count = count
        #: The joints that the servos drive.
        self.chain: list[int] = [self._links[name] for name in DRIVEN]
        self._arm, self._gears = vehicle.arm, gears(vehicle)
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=self.client)
        self.ground: int = bullet.createMultiBody(0.0, plane, physicsClientId=self.client)
        self.pipe = -1
        self.holds_sleeve = True
        self.sleeve = -1
        self._contact = (0.0, 0.0, 0.0)

    def close(self) -> None:
        """Give the client back."""
        if self.bullet.isConnected(self.client):
            self.bullet.disconnect(self.client)

    # -- physics ---------------------------------------------------------------------------------------------------

    def prepare(self, params: PlantParams, step: float) -> None:
        """Set what Bullet computes: step (s), gears, no damping of its own, contact of the ground."""
        bullet, client, body, links = self.bullet, self.client, self.vehicle, self._links
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=step,
            numSolverIterations=params.bullet.iterations,
            numSubSteps=1,
            solverResidualThreshold=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        for link in range(-1, self._count):
            bullet.changeDynamics(
                body,
                link,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                lateralFriction=1.0,
                physicsClientId=client,
            )
        joints = list(range(self._count))
        bullet.setJointMotorControlArray(
            body, joints, bullet.VELOCITY_CONTROL, forces=[0.0] * self._count, physicsClientId=client
        )
        for name, sign, other in self._gears:
            none = (0.0, 0.0, 0.0)
            gear = bullet.createConstraint(
                body, links[name], body, links[other], bullet.JOINT_GEAR, (0.0, 1.0, 0.0), none, none,
                physicsClientId=client,
            )  # fmt: skip
            bullet.changeConstraint(
                gear,
                gearRatio=-sign,
                erp=_GEAR_ERP,
                relativePositionTarget=0.0,
                maxForce=_GEAR_MOST,
                physicsClientId=client,
            )
        ground = params.ground
        bullet.changeDynamics(
            self.ground,
            -1,
            contactStiffness=ground.stiffness,
            contactDamping=ground.damping,
            lateralFriction=ground.friction_kinetic,
            restitution=0.0,
            physicsClientId=client,
        )
        contact = params.contact
        self._contact = (contact.stiffness, contact.damping, contact.friction_static)

    def put_pipe(self, pipe: Pipe) -> None:
        """Lay the pipe."""
        bullet, client = self.bullet, self.client
        shape = bullet.createCollisionShape(
            bullet.GEOM_CAPSULE, radius=pipe.radius, height=pipe.length, physicsClientId=client
        )
        look = bullet.createVisualShape(
            bullet.GEOM_CYLINDER,
            radius=pipe.radius,
            length=pipe.length,
            rgbaColor=(0.55, 0.58, 0.60, 1.0),
            physicsClientId=client,
        )
        turn = self._across(pipe.heading)
        self.pipe = bullet.createMultiBody(0.0, shape, look, pipe.position, turn, physicsClientId=client)
        for link in range(-1, self._count):
            touches = link == self._links["tool"]
            bullet.setCollisionFilterPair(self.vehicle, self.pipe, link, -1, int(touches), physicsClientId=client)
        self._put_contact()

    def _across(self, heading: float) -> tuple[float, float, float, float]:
        """Takes the z axis to the left of a heading."""
        turn: tuple[float, float, float, float] = self.bullet.getQuaternionFromEuler((-0.5 * pi, 0.0, heading))
        return turn

    def _put_contact(self) -> None:
        """Stiffness, damping and friction of the pipe; of it alone, since two bodies' stiffnesses are in series."""
        stiffness, damping, friction = self._contact
        self.bullet.changeDynamics(
            self.pipe,
            -1,
            contactStiffness=stiffness,
            contactDamping=damping,
            lateralFriction=friction,
            restitution=0.0,
            physicsClientId=self.client,
        )

    def set_contacts(self, p: Sequence[float]) -> None:
        """Take gravity and pipe (place and contact) anew from the constants of ``layout``."""
        bullet, client = self.bullet, self.client
        bullet.setGravity(0.0, 0.0, -p[at.GRAVITY], physicsClientId=client)
        place = p[at.PIPE_POINT : at.PIPE_POINT + 3]
        turn = bullet.getBasePositionAndOrientation(self.pipe, client)[1]
        bullet.resetBasePositionAndOrientation(self.pipe, place, turn, physicsClientId=client)
        self._contact = (p[at.CONTACT_STIFFNESS], p[at.CONTACT_DAMPING], p[at.CONTACT_STATIC])
        self._put_contact()

    def set_friction(self, friction: float) -> None:
        """Set the pipe's coefficient of friction."""
        if friction != self._contact[2]:
            self._contact = (*self._contact[:2], friction)
            self._put_contact()

    def velocity_of_tip(self) -> Vec3:
        """Velocity of the gripper's tip, m/s, W."""
        state = self.bullet.getLinkState(
            self.vehicle, self._links["tool"], computeLinkVelocity=1, physicsClientId=self.client
        )
        (x, y, z), (cx, cy, cz), (i, j, k, w) = state[4], state[0], state[5]
        reach = self._arm.gripper
        tip_x = x + reach * (1.0 - 2.0 * (j * j + k * k)) - cx
        tip_y = y + reach * 2.0 * (i * j + w * k) - cy
        tip_z = z + reach * 2.0 * (i * k - w * j) - cz
        (vx, vy, vz), (wx, wy, wz) = state[6], state[7]
        return (vx + wy * tip_z - wz * tip_y, vy + wz * tip_x - wx * tip_z, vz + wx * tip_y - wy * tip_x)

    # -- where things are ------------------------------------------------------------------------------------------

    def place_vehicle(
        self,
        position: Sequence[float],
        attitude: Sequence[float],
        angles: Sequence[float],
        rates: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Put the vehicle: position (m), attitude (x, y, z, w), absolute link angles (rad) and their rates (rad/s)."""
        bullet, client, body = self.bullet, self.client, self.vehicle
        middle, _ = bullet.multiplyTransforms(position, attitude, self.centre, (0.0, 0.0, 0.0, 1.0))
        bullet.resetBasePositionAndOrientation(body, middle, attitude, physicsClientId=client)
        chain = {
            name: (angles[k] - (angles[k - 1] if k else 0.0), rates[k] - (rates[k - 1] if k else 0.0))
            for k, name in enumerate(DRIVEN)
        }
        states = dict(chain)
        for name, sign, other in self._gears:
            states[name] = (sign * chain[other][0], sign * chain[other][1])
        for name, (angle, turn) in states.items():
            bullet.resetJointState(body, self._links[name], angle, turn, physicsClientId=client)

    def move_vehicle(self, velocity: Sequence[float], rate: Sequence[float]) -> None:
        """Set velocity (m/s) and rate (rad/s) of the vehicle where it is, both in W."""
        _, attitude = self.bullet.getBasePositionAndOrientation(self.vehicle, self.client)
        none = (0.0, 0.0, 0.0)
        (x, y, z), _ = self.bullet.multiplyTransforms(none, attitude, self.centre, (0.0, 0.0, 0.0, 1.0))
        wx, wy, wz = rate
        there = (velocity[0] + wy * z - wz * y, velocity[1] + wz * x - wx * z, velocity[2] + wx * y - wy * x)
        self.bullet.resetBaseVelocity(self.vehicle, there, rate, physicsClientId=self.client)

    def place_bars(self, angles: Sequence[float]) -> None:
        """Turn the bars that are there to look at, for absolute link angles (rad)."""
        for name, angle in BARS.items():
            if name in self._links:
                value = angle[0] * angles[0] + angle[1] * angles[1]
                self.bullet.resetJointState(self.vehicle, self._links[name], value, physicsClientId=self.client)

    def release_sleeve(self, on_pipe: bool) -> None:
        """Take the sleeve from the vehicle: it stays where it is on the pipe, or falls."""
        bullet, client, body = self.bullet, self.client, self.vehicle
        state = bullet.getLinkState(body, self._links[SLEEVE], 1, 1, physicsClientId=client)
        mass, inertia = self.take_sleeve()
        half = (0.02, 0.05, 0.035)
        shape = -1
        if not on_pipe:
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
        look = bullet.createVisualShape(
            bullet.GEOM_BOX,
            halfExtents=half,
            rgbaColor=(0.15, 0.65, 0.40, 1.0),
            visualFramePosition=(self._arm.gripper - 0.02 - self._arm.sleeve.along[2], 0.0, 0.0),
            physicsClientId=client,
        )
        self.sleeve = bullet.createMultiBody(
            0.0 if on_pipe else mass, shape, look, state[0], state[1], physicsClientId=client
        )
        if on_pipe:
            return
        bullet.changeDynamics(
            self.sleeve, -1, localInertiaDiagonal=inertia, linearDamping=0.0, angularDamping=0.0, physicsClientId=client
        )
        bullet.resetBaseVelocity(self.sleeve, state[6], state[7], physicsClientId=client)
        for other in range(-1, self._count):
            bullet.setCollisionFilterPair(body, self.sleeve, other, -1, 0, physicsClientId=client)

    def take_sleeve(self) -> tuple[float, Vec3]:
        """Take mass and look of the sleeve from the gripper; gives what they were."""
        sleeve, link = self._arm.sleeve, self._links[SLEEVE]
        self.holds_sleeve = False
        self.bullet.changeDynamics(
            self.vehicle, link, mass=0.0, localInertiaDiagonal=(0.0, 0.0, 0.0), physicsClientId=self.client
        )
        self.bullet.changeVisualShape(self.vehicle, link, rgbaColor=(0.0, 0.0, 0.0, 0.0), physicsClientId=self.client)
        return sleeve.mass, sleeve.inertia
