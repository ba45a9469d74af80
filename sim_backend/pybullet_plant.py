"""The PyBullet plant: the same vehicle, motors, servos and battery in a physics engine of others.

Bullet moves the bodies of ``lumping``, and makes the forces of contact and friction; what drives them (rotors, drag,
servos, battery) is the rigid-body plant's own code. Once a step the drive goes in as forces and torques and the motion
comes back into the array ``x``, so that everything around a plant sees no difference.
"""

from __future__ import annotations

import weakref
from copy import copy
from math import hypot, nan
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.airframe import airframe
from sim_backend.array_plant import ArrayPlant, PlantParams
from sim_backend.bullet_scene import NoBulletError, Scene
from sim_backend.compiled import compiled
from sim_backend.contact import FREE, SLIDE, STICK, grip
from sim_backend.deviations import AS_MODELLED, Deviations
from sim_backend.inner_loops import inner_loops
from sim_backend.motors import battery
from sim_backend.pipe import Pipe
from sim_backend.rigid_body import let_go, rotation, tips, watch
from sim_backend.servos import joint_torque, stop_torque, tool_servos

Array = NDArray[np.float64]

# What ``_drive`` tells for one step: force and moment on the base (W), torques on the joints of the chain (the sums of
# what acts on the links beyond), where the base is, whether pipe or ground are near, how the pipe grips there, and
# whether any of the airframe may be fast enough to break on the ground.
_FORCE, _MOMENT, _TORQUE, _PLACE, _NEAR_PIPE, _NEAR_GROUND, _GRIP, _FAST, _DRIVE_SIZE = 0, 3, 6, 9, 12, 13, 14, 15, 16
# What Bullet tells after it: place, attitude (x, y, z, w), velocity, rate (W), angles and rates of the chain's joints.
_MOVED_SIZE = 19

#: Contacts are asked for when the gripper's tip is this near to the pipe, m.
_NEAR = 0.02
#: A tip that is slower sticks, m/s: the engine's friction holds no place, so that it creeps under load.
_CREEP = 1e-3


@compiled("(f8[::1], f8[::1], f8[::1], f8[::1], b1)")
def _drive(x: Array, p: Array, u: Array, out: Array, loops: bool) -> None:
    """Inner loops when they are due, battery, rotors, drag and servos, for one step; ``out`` is told to Bullet."""
    if loops:
        if x[at.PHASE] == 0.0:
            inner_loops(x, p, u)
        x[at.PHASE] += 1.0
        if x[at.PHASE] >= p[at.LOOP_STEPS]:
            x[at.PHASE] = 0.0
    battery(x, p, p[at.STEP])
    turn = rotation(x)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
    fx, fy, fz, mx, my, mz = airframe(x, p, u, turn, x[at.VELOCITY], x[at.VELOCITY + 1], x[at.VELOCITY + 2])
    out[_FORCE] = xx * fx + xy * fy + xz * fz
    out[_FORCE + 1] = yx * fx + yy * fy + yz * fz
    out[_FORCE + 2] = zx * fx + zy * fy + zz * fz
    out[_MOMENT] = xx * mx + xy * my + xz * mz
    out[_MOMENT + 1] = yx * mx + yy * my + yz * mz
    out[_MOMENT + 2] = zx * mx + zy * my + zz * mz
    tool_servos(x, p, u)
    beyond = 0.0
    for i in range(3):
        k = 2 - i
        angle = x[at.JOINT + k]
        rate = x[at.JOINT_RATE + k]
        torque = joint_torque(x, p, u, k, angle, rate)
        x[at.JOINT_TORQUE + k] = torque
        beyond += torque + stop_torque(p, k, angle, rate)
        out[_TORQUE + k] = beyond
    for i in range(3):
        out[_PLACE + i] = x[at.POSITION + i]
    tips(x, p)
    nx = p[at.PIPE_NORMAL]
    ny = p[at.PIPE_NORMAL + 1]
    rx = x[at.TIP] - p[at.PIPE_POINT]
    ry = x[at.TIP + 1] - p[at.PIPE_POINT + 1]
    ahead = rx * nx + ry * ny
    up = x[at.TIP + 2] - p[at.PIPE_POINT + 2]
    near = hypot(ahead, up) - p[at.PIPE_RADIUS] < _NEAR
    out[_NEAR_PIPE] = 1.0 if near else 0.0
    out[_GRIP] = grip(p, ahead, up, ry * nx - rx * ny) if near else 1.0
    out[_NEAR_GROUND] = 1.0 if x[at.POSITION + 2] < p[at.GROUND_REACH] + _NEAR else 0.0
    speed = abs(x[at.VELOCITY]) + abs(x[at.VELOCITY + 1]) + abs(x[at.VELOCITY + 2])
    turning = abs(x[at.RATE]) + abs(x[at.RATE + 1]) + abs(x[at.RATE + 2])
    out[_FAST] = 1.0 if speed + turning * p[at.GROUND_REACH] > p[at.GROUND_CRASH_SPEED] else 0.0


@compiled("(f8[::1], f8[::1], f8[::1], f8[::1])")
def _take(x: Array, p: Array, moved: Array, centre: Array) -> None:
    """Write into ``x`` what Bullet has moved in one step; ``centre`` is where it has the base, m, B."""
    share = 1.0 / p[at.STEP]
    x[at.ATTITUDE] = moved[6]
    for i in range(3):
        x[at.ATTITUDE + 1 + i] = moved[3 + i]
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation(x)
    cx = xx * centre[0] + xy * centre[1] + xz * centre[2]
    cy = yx * centre[0] + yy * centre[1] + yz * centre[2]
    cz = zx * centre[0] + zy * centre[1] + zz * centre[2]
    x[at.POSITION] = moved[0] - cx
    x[at.POSITION + 1] = moved[1] - cy
    x[at.POSITION + 2] = moved[2] - cz
    vx = moved[7] - (moved[11] * cz - moved[12] * cy)
    vy = moved[8] - (moved[12] * cx - moved[10] * cz)
    vz = moved[9] - (moved[10] * cy - moved[11] * cx)
    for i in range(3):
        speed = vx if i == 0 else (vy if i == 1 else vz)
        x[at.ACCELERATION + i] = (speed - x[at.VELOCITY + i]) * share
        x[at.VELOCITY + i] = speed
    ax = x[at.ACCELERATION]
    ay = x[at.ACCELERATION + 1]
    az = x[at.ACCELERATION + 2] + p[at.GRAVITY]
    x[at.SPECIFIC_FORCE_SUM] += xx * ax + yx * ay + zx * az
    x[at.SPECIFIC_FORCE_SUM + 1] += xy * ax + yy * ay + zy * az
    x[at.SPECIFIC_FORCE_SUM + 2] += xz * ax + yz * ay + zz * az
    wx = xx * moved[10] + yx * moved[11] + zx * moved[12]
    wy = xy * moved[10] + yy * moved[11] + zy * moved[12]
    wz = xz * moved[10] + yz * moved[11] + zz * moved[12]
    for i in range(3):
        rate = wx if i == 0 else (wy if i == 1 else wz)
        x[at.ACCELERATION + 3 + i] = (rate - x[at.RATE + i]) * share
        x[at.RATE + i] = rate
    angle = 0.0
    rate = 0.0
    for k in range(3):
        angle += moved[13 + k]
        rate += moved[16 + k]
        x[at.JOINT + k] = angle
        x[at.ACCELERATION + 6 + k] = (rate - x[at.JOINT_RATE + k]) * share
        x[at.JOINT_RATE + k] = rate


@compiled("(f8[::1], f8[::1])")
def _settle(x: Array, p: Array) -> None:
    """What is left to do after the last step of several."""
    tips(x, p)
    watch(x, p)


@compiled("(f8[::1], f8[::1])")
def _let_go(x: Array, p: Array) -> None:
    let_go(x, p)


class PyBulletPlant(ArrayPlant):
    """The plant that PyBullet moves. Raises ValueError when PyBullet is not there, or for an arm it cannot have."""

    # A second is dear here, and by then nothing moves by more than 1e-7 rad/s.
    SETTLING = 1.0

    def __init__(
        self,
        vehicle: Vehicle,
        params: PlantParams,
        pipe: Pipe,
        truth: Deviations = AS_MODELLED,
    ) -> None:
        super().__init__(vehicle, params, pipe, truth)
        servo = replace(vehicle.servo, rotor_inertia=params.rotor_inertia(vehicle))
        self._real = replace(truth.vehicle(vehicle), servo=servo)
        self._centre = np.array(truth.base_centre(vehicle))
        self._pipe = truth.pipe_of(pipe)
        self._build()
        self.stand()

    def __deepcopy__(self, memo: dict[int, Any]) -> PyBulletPlant:
        """The same moment on its own from here; a sleeve that was let go is at the gripper again, and goes anew."""
        twin = copy(self)
        twin.x, twin.p, twin.u = self.x.copy(), self.p.copy(), self.u.copy()
        twin._build()
        return twin

    def _build(self) -> None:
        """Make the scene; what is in the arrays is told to it before the next step."""
        try:
            self.scene = scene = Scene(self._real, self.params.bullet.window, centre=tuple(self._centre.tolist()))
        except NoBulletError as error:
            raise ValueError(f"world.plant.kind = pybullet: {error}; or choose rigid") from error
        self._finalizer = weakref.finalize(self, scene.close)
        self._bullet: Any = scene.bullet
        scene.prepare(self.params, self.step)
        scene.put_pipe(self._pipe)
        self._out = np.zeros(_DRIVE_SIZE)
        self._moved = np.zeros(_MOVED_SIZE)
        self._known_x = np.full(at.ACCELERATION, nan)
        self._known_p = np.full(at.LUMPED, nan)
        self._frame_on_ground = False

    def move(self, steps: int) -> None:
        """Move ``x`` on by so many physics steps under the drive ``u`` as it stands."""
        self._run(steps, loops=False)

    def fly(self, steps: int) -> None:
        """The same, with the autopilot's inner loops whenever they are due."""
        self._run(steps, loops=True)

    def _run(self, steps: int, loops: bool) -> None:
        x, p, u, out, moved = self.x, self.p, self.u, self._out, self._moved
        scene, bullet = self.scene, self._bullet
        client, body, chain = scene.client, scene.vehicle, scene.chain
        push, twist, turn = bullet.applyExternalForce, bullet.applyExternalTorque, bullet.setJointMotorControlArray
        place_of, velocity_of, joints_of = (
            bullet.getBasePositionAndOrientation, bullet.getBaseVelocity, bullet.getJointStates
        )  # fmt: skip
        world, torque = bullet.WORLD_FRAME, bullet.TORQUE_CONTROL
        self._hear()
        for left in range(steps - 1, -1, -1):
            _drive(x, p, u, out, loops)
            told = out.tolist()
            push(body, -1, told[_FORCE:_MOMENT], told[_PLACE:_NEAR_PIPE], world, client)
            twist(body, -1, told[_MOMENT:_TORQUE], world, client)
            turn(body, chain, torque, forces=told[_TORQUE:_PLACE], physicsClientId=client)
            bullet.stepSimulation(client)
            place, attitude = place_of(body, client)
            velocity, rate = velocity_of(body, client)
            a, b, c = joints_of(body, chain, client)
            moved[:] = (*place, *attitude, *velocity, *rate, a[0], b[0], c[0], a[1], b[1], c[1])
            # To ask for contacts is dear: after the last step, and whenever a touch may be a crash.
            looks = told[_NEAR_GROUND] != 0.0 and (left == 0 or told[_FAST] != 0.0)
            climb = float(x[at.VELOCITY + 2])
            _take(x, p, moved, self._centre)
            if told[_NEAR_PIPE] != 0.0 or x[at.CONTACT_FORCE] != 0.0:
                self._feel_pipe(told[_GRIP])
            if x[at.PAYLOAD] != 0.0 and x[at.GRIPPER] > p[at.RELEASE_ANGLE]:
                _let_go(x, p)
                self._release()
            if looks:
                self._feel_ground(climb)
            elif left == 0:
                x[at.ON_GROUND] = 0.0
        _settle(x, p)
        self._known_x[:] = x[: at.ACCELERATION]

    def _hear(self) -> None:
        """Tell Bullet what others have written into the arrays."""
        x, p = self.x, self.p
        if not np.array_equal(self._known_p, p[: at.LUMPED]):
            self.scene.set_contacts(p.tolist())
            self._known_p[:] = p[: at.LUMPED]
        if not np.array_equal(self._known_x, x[: at.ACCELERATION]):
            self._put(x.tolist())
        if x[at.PAYLOAD] == 0.0 and self.scene.holds_sleeve:
            self._release()

    def _put(self, x: list[float]) -> None:
        """Place and move the vehicle as ``x`` says."""
        w, i, j, k = x[at.ATTITUDE : at.ATTITUDE + 4]
        m = rotation(self.x)
        rate = x[at.RATE : at.RATE + 3]
        turning = [sum(m[3 * row + n] * rate[n] for n in range(3)) for row in range(3)]
        angles, rates = x[at.JOINT : at.JOINT + 3], x[at.JOINT_RATE : at.JOINT_RATE + 3]
        self.scene.place_vehicle(x[at.POSITION : at.POSITION + 3], (i, j, k, w), angles, rates)
        self.scene.move_vehicle(x[at.VELOCITY : at.VELOCITY + 3], turning)

    def _release(self) -> None:
        self.scene.release_sleeve(on_pipe=self.x[at.SLEEVE_ON_PIPE] != 0.0)

    def _feel_pipe(self, grip: float) -> None:
        """Take force and slip of the tip on the pipe from Bullet, and choose between static and dynamic friction.

        ``grip`` is the factor on both at this place of the pipe.
        """
        x, p, scene = self.x, self.p, self.scene
        normal = 0.0
        sum_x = sum_y = sum_z = 0.0
        nx = ny = nz = 0.0
        for point in self._bullet.getContactPoints(scene.vehicle, scene.pipe, physicsClientId=scene.client):
            press = point[9]
            n, r, s = point[7], point[11], point[13]
            normal += press
            sum_x += press * n[0] + point[10] * r[0] + point[12] * s[0]
            sum_y += press * n[1] + point[10] * r[1] + point[12] * s[1]
            sum_z += press * n[2] + point[10] * r[2] + point[12] * s[2]
            nx, ny, nz = n
        x[at.CONTACT_FORCE] = normal
        x[at.CONTACT_VECTOR : at.CONTACT_VECTOR + 3] = (sum_x, sum_y, sum_z)
        if normal == 0.0:
            x[at.CONTACT_MODE] = FREE
            scene.set_friction(grip * p[at.CONTACT_STATIC])
            return
        if normal > x[at.CONTACT_PEAK]:
            x[at.CONTACT_PEAK] = normal
        vx, vy, vz = scene.velocity_of_tip()
        through = vx * nx + vy * ny + vz * nz
        speed = hypot(vx - through * nx, vy - through * ny, vz - through * nz)
        rub = hypot(sum_x - normal * nx, sum_y - normal * ny, sum_z - normal * nz)
        sliding = x[at.CONTACT_MODE] == SLIDE
        limit = grip * (p[at.CONTACT_KINETIC] if sliding else p[at.CONTACT_STATIC])
        sliding = bool(rub >= 0.999 * limit * normal and speed > _CREEP)
        x[at.CONTACT_MODE] = SLIDE if sliding else STICK
        if sliding:
            x[at.TIP_SLIP] += speed * p[at.STEP]
        scene.set_friction(grip * p[at.CONTACT_KINETIC if sliding else at.CONTACT_STATIC])

    def _feel_ground(self, climb: float) -> None:
        """Note whether anything touches the ground, and whether the airframe has hit it too hard.

        ``climb`` is the velocity upwards at the start of the step, m/s.
        """
        x, p, scene = self.x, self.p, self.scene
        frame = False
        x[at.ON_GROUND] = 0.0
        for point in self._bullet.getContactPoints(scene.vehicle, scene.ground, physicsClientId=scene.client):
            if point[9] <= 0.0:
                continue
            x[at.ON_GROUND] = 1.0
            if point[3] != -1:
                continue
            frame = True
            if not self._frame_on_ground and x[at.CRASH] == 0.0:
                w = self._moved[10:13]
                arm_x, arm_y = point[5][0] - float(x[at.POSITION]), point[5][1] - float(x[at.POSITION + 1])
                speed = -(climb + float(w[0]) * arm_y - float(w[1]) * arm_x)
                if speed > p[at.GROUND_CRASH_SPEED]:
                    x[at.CRASH] = 1.0
                    x[at.CRASH_VALUE] = speed
        self._frame_on_ground = frame
