"""What the plants share: parameters, the arrays of ``layout``, the start on the ground, time, and the truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import StrEnum
from math import cos, floor, hypot, isfinite, pi, sin, sqrt
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.contact import SLIDE, ContactParams, GroundParams
from sim_backend.deviations import AS_MODELLED, Deviations
from sim_backend.dynamics import lump
from sim_backend.knob import knob, switch
from sim_backend.motors import lag_gain, rated_voltage
from sim_backend.pipe import Pipe
from sim_backend.plant import Actuation, Truth

Array = NDArray[np.float64]

#: Texts of the crash codes 1.., with the value that goes with each.
CRASHES = (
    "",
    "hit the ground at {:.1f} m/s",
    "turned over at {:.1f} m above the ground",
    "propeller struck the pipe, {:.3f} m from its axis",
)

StartAngle = Annotated[float, knob("rad", "joint angle that the servos hold at the start", -4.0, 4.0)]


class PlantKind(StrEnum):
    """Who computes the motion."""

    RIGID = "rigid"
    """The coupled equations of motion of ``dynamics``."""
    PYBULLET = "pybullet"
    """The physics engine of that name."""


class BulletParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How the PyBullet plant is simulated."""

    step: Annotated[float, knob("s", "physics step; 1 ms is 35 % off in a contact of 50 kN/m", 5e-5, 5e-4)] = 2.5e-4
    iterations: Annotated[int, knob("1", "of the solver, over gears and contacts, each step", 10, 1000)] = 50
    window: Annotated[bool, switch("show the world on the screen while it moves")] = False


class PlantParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How a plant is simulated, and which parts of it are ideal."""

    kind: Annotated[PlantKind, switch("who computes the motion: rigid or pybullet")] = PlantKind.RIGID
    step: Annotated[float, knob("s", "physics step of the rigid-body plant", 1e-5, 2e-4)] = 1e-4
    bullet: BulletParams = BulletParams()
    ideal_motors: Annotated[bool, switch("no thrust lag, full thrust at any battery voltage")] = True
    ideal_servos: Annotated[bool, switch("no gear friction, current proportional to torque")] = True
    tool_servo_time: Annotated[float, knob("s", "time constant of the pump and gripper servos", 0.005, 1.0)] = 0.04
    friction_speed: Annotated[
        float, knob("rad/s", "joint speed below which gear friction is regularised", 1e-4, 1.0)
    ] = 0.02
    stop_stiffness: Annotated[float, knob("N m/rad", "mechanical stops of the joints", 1.0, 200.0)] = 50.0
    stop_damping: Annotated[float, knob("N m s/rad", "mechanical stops of the joints", 0.0, 5.0)] = 0.5
    motor_lag: Annotated[
        float, knob("s", "thrust lag in place of the vehicle file's; 0: as ``ideal_motors`` says", 0.0, 0.5)
    ] = 0.0
    battery_sag: Annotated[
        float, knob("1", "share of the thrust's fall with the voltage squared that no map makes up for", 0.0, 1.0)
    ] = 0.0
    rotor_constant: Annotated[float, knob("N s^2", "thrust of a rotor over its speed squared", 1e-6, 1e-3)] = 1.37e-5
    rotor_drag: Annotated[
        float, knob("N s^2/m", "drag of a rotor in its plane, over its speed and that of the air", 0.0, 1e-2)
    ] = 0.0
    ground_effect: Annotated[float, knob("1", "share of Cheeseman and Bennett's gain of thrust", 0.0, 2.0)] = 0.0
    wall_effect: Annotated[
        float, knob("1", "share of a rotor's thrust that pulls it to the pipe at one radius from it", 0.0, 0.5)
    ] = 0.0
    backlash: Annotated[float, knob("rad", "play of the joint servos' gears, end to end", 0.0, 0.1)] = 0.0
    gear_stiffness: Annotated[float, knob("N m/rad", "of the teeth where there is play", 10.0, 1e3)] = 200.0
    gear_damping: Annotated[float, knob("N m s/rad", "of the teeth where there is play", 0.0, 5.0)] = 0.3
    start_joints: tuple[StartAngle, StartAngle, StartAngle] = (-2.80, -0.35, 0.0)
    """The arm folded above the ground."""
    contact: ContactParams = ContactParams()
    ground: GroundParams = GroundParams()

    @property
    def physics_step(self) -> float:
        """Step of the plant that is chosen, s."""
        return self.step if self.kind is PlantKind.RIGID else self.bullet.step

    def rotor_inertia(self, vehicle: Vehicle) -> float:
        """What of a joint servo's rotor weighs on its joint, kg m^2: with play it is a side of its own (servos.py)."""
        return 0.0 if self.backlash else vehicle.servo.rotor_inertia


def constants(
    vehicle: Vehicle,
    params: PlantParams,
    pipe: Pipe,
    truth: Deviations = AS_MODELLED,
) -> Array:
    """Array ``p`` for a vehicle and a pipe (without the autopilot's gains), both off by ``truth``."""
    p = np.zeros(at.CONSTANTS_SIZE)
    centre, vehicle = truth.base_centre(vehicle), truth.vehicle(vehicle)
    pipe = truth.pipe_of(pipe)
    base, rotor, arm, servo, cell = vehicle.base, vehicle.rotors, vehicle.arm, vehicle.servo, vehicle.battery
    contact, ground, step = params.contact, params.ground, params.physics_step

    def put(index: int, *values: float) -> None:
        p[index : index + len(values)] = values

    put(at.STEP, step, vehicle.gravity, *base.drag, *arm.mount, arm.link_1, arm.link_2, arm.gripper, arm.needle)
    put(at.JOINT_MIN, *arm.joint_min, *arm.joint_max, params.stop_stiffness, params.stop_damping)
    put(at.ROTOR_X, rotor.arm_x, rotor.arm_y, rotor.max_thrust, rotor.torque_per_thrust)
    lag = params.motor_lag or (0.0 if params.ideal_motors else rotor.time_constant)
    put(at.ROTOR_GAIN, lag_gain(step, lag), rotor.radius)
    put(at.ROTOR_SCALE, truth.thrust, params.battery_sag, cell.full_voltage - cell.resistance * cell.hover_current)
    put(at.SPIN, 1.0 / sqrt(params.rotor_constant), params.rotor_drag, params.ground_effect, params.wall_effect)
    put(at.STALL_TORQUE, servo.stall_torque, servo.stall_current, servo.no_load_speed)
    put(at.FRICTION_STATIC, servo.friction_static, servo.friction_viscous, params.friction_speed)
    put(at.SERVO_STIFFNESS, servo.stiffness, servo.damping, float(params.ideal_servos))
    put(at.BACKLASH, 0.5 * params.backlash, params.gear_stiffness, params.gear_damping, servo.rotor_inertia)
    put(at.TOOL_SERVO_GAIN, lag_gain(step, params.tool_servo_time))
    put(at.PIPE_POINT, *pipe.position, cos(pipe.heading), sin(pipe.heading), pipe.radius)
    put(at.PIPE_HALF_LENGTH, 0.5 * pipe.length)
    put(at.CONTACT_STIFFNESS, contact.stiffness, contact.damping)
    put(at.CONTACT_TANGENTIAL_STIFFNESS, contact.tangential_stiffness, contact.tangential_damping)
    put(at.CONTACT_STATIC, contact.friction_static, contact.friction_kinetic, contact.release_angle)
    put(at.UNEVENNESS, contact.unevenness)
    for i, (way, number, phase) in enumerate(truth.waves):
        size = 2.0 * pi * number / contact.patch
        put(at.WAVE + 3 * i, size * cos(way), size * sin(way), phase)
    put(at.GROUND_STIFFNESS, ground.stiffness, ground.damping)
    put(at.GROUND_TANGENTIAL_STIFFNESS, ground.tangential_stiffness, ground.tangential_damping)
    put(at.GROUND_STATIC, ground.friction_static, ground.friction_kinetic, ground.crash_speed)
    reach = hypot(*arm.mount) + arm.link_1 + arm.link_2 + max(arm.gripper, arm.needle)
    frame = max(hypot(base.gear_height, base.gear_span, base.gear_span), hypot(rotor.arm_x, rotor.arm_y))
    put(at.GROUND_REACH, max(reach, frame), base.gear_height, base.gear_span)
    put(at.BATTERY_FULL, cell.full_voltage, cell.empty_voltage, cell.resistance, 3600.0 * cell.capacity)
    parts = (arm.parts, (*arm.parts, arm.sleeve))
    mass = base.mass + sum(part.mass for part in parts[1])
    put(at.HOVER_CURRENT, cell.hover_current, mass * vehicle.gravity)
    put(at.RATED_VOLTAGE, 0.0 if params.ideal_motors else rated_voltage(cell))
    for i in range(2):
        put(at.LUMPED + i * at.LUMPED_SIZE, *lump(vehicle, parts[i], params.rotor_inertia(vehicle), centre))
    return p


class ArrayPlant(ABC):
    """A vehicle and one horizontal pipe, told by the arrays ``x``, ``p`` and ``u`` of ``layout``; a ``Plant``.

    It starts standing at the origin of W, at rest, arm folded and held by its servos, sleeve in the gripper.
    Vehicle and pipe are those of the model; they really are off by ``truth``. What is written into the arrays between
    two advances holds.
    """

    #: Time the vehicle is given to settle on its skids before the start, s.
    SETTLING: ClassVar[float] = 3.0

    def __init__(
        self,
        vehicle: Vehicle,
        params: PlantParams,
        pipe: Pipe,
        truth: Deviations = AS_MODELLED,
    ) -> None:
        self.vehicle = vehicle
        self.params = params
        #: Physics step, s.
        self.step = params.physics_step
        self.p = constants(vehicle, params, pipe, truth)
        self.x = np.zeros(at.STATE_SIZE)
        self.u = np.zeros(at.DRIVE_SIZE)
        self.steps = 0
        self.last_steps = 0

    @abstractmethod
    def move(self, steps: int) -> None:
        """Move ``x`` on by so many physics steps under the drive ``u`` as it stands."""

    @abstractmethod
    def fly(self, steps: int) -> None:
        """The same, with the autopilot's inner loops whenever they are due."""

    def stand(self) -> None:
        """Stand at rest: settle on the skids with stiff joints, then set the clock to zero."""
        x, u = self.x, self.u
        x[at.POSITION + 2] = self.vehicle.base.gear_height
        x[at.ATTITUDE] = 1.0
        x[at.JOINT : at.JOINT + 3] = self.params.start_joints
        x[at.CHARGE] = 1.0
        x[at.PAYLOAD] = 1.0
        u[at.U_GOAL : at.U_GOAL + 3] = self.params.start_joints
        u[at.U_POSITION_MODE] = 1.0
        u[at.U_TORQUE_ON] = 1.0
        u[at.U_CURRENT_LIMIT] = self.vehicle.servo.stall_current
        self.begin()
        steps = round(self.SETTLING / self.step)
        self.move(steps)
        x[at.POSITION : at.POSITION + 2] = 0.0
        x[at.CHARGE] = 1.0
        x[at.TIP_SLIP] = 0.0
        self.last_steps = steps

    def begin(self) -> None:
        """Begin an advance: the figures that are kept per advance begin anew."""
        self.x[at.CONTACT_PEAK] = 0.0
        self.x[at.SPECIFIC_FORCE_SUM : at.SPECIFIC_FORCE_SUM + 3] = 0.0

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.steps * self.step

    def steps_of(self, duration: float) -> int:
        """Number of physics steps in ``duration`` seconds; ValueError when it is not a whole number of them."""
        steps = duration / self.step
        whole = floor(steps + 0.5)
        if whole < 1 or abs(steps - whole) > 1e-6 * whole:
            raise ValueError(f"duration {duration} s is not a whole number of physics steps of {self.step} s")
        return whole

    def advance(self, actuation: Actuation, duration: float) -> None:
        """Advance by ``duration`` seconds, a whole number of physics steps, under a constant actuation."""
        steps = self.steps_of(duration)
        u = self.u
        u[at.U_ROTOR : at.U_ROTOR + 4] = actuation.rotor_thrust
        u[at.U_TORQUE : at.U_TORQUE + 3] = actuation.joint_torque
        u[at.U_POSITION_MODE] = actuation.position_mode
        u[at.U_GOAL : at.U_GOAL + 5] = actuation.goal
        u[at.U_CURRENT_LIMIT] = actuation.current_limit
        u[at.U_TORQUE_ON] = actuation.torque_on
        self.begin()
        self.move(steps)
        self.count(steps)

    def count(self, steps: int) -> None:
        """Note that ``x`` was moved by so many steps; FloatingPointError when the state is not finite."""
        if not isfinite(self.x[at.POSITION] + self.x[at.JOINT]):
            raise FloatingPointError(f"the world's state is not finite any more at {self.time:.4f} s")
        self.steps += steps
        self.last_steps = steps

    def truth(self) -> Truth:
        """What is true now."""
        return truth_of(self.x.tolist(), self.time, self.last_steps)


def truth_of(x: list[float], t: float, steps: int) -> Truth:
    """Truth from the state ``x`` at ``t`` seconds, ``steps`` being the length of the last advance."""
    share = 1.0 / steps

    def three(index: int) -> Vec3:
        return (x[index], x[index + 1], x[index + 2])

    def four(index: int) -> tuple[float, float, float, float]:
        return (x[index], x[index + 1], x[index + 2], x[index + 3])

    specific = three(at.SPECIFIC_FORCE_SUM)
    return Truth(
        t=t,
        p_WB=three(at.POSITION),
        v_WB=three(at.VELOCITY),
        q_WB=four(at.ATTITUDE),
        w_WB_B=three(at.RATE),
        f_B=(specific[0] * share, specific[1] * share, specific[2] * share),
        joints=three(at.JOINT),
        joint_rates=three(at.JOINT_RATE),
        joint_torque=three(at.JOINT_TORQUE),
        servo_current=three(at.SERVO_CURRENT),
        pump=x[at.PUMP],
        gripper=x[at.GRIPPER],
        rotor_thrust=four(at.ROTOR),
        tip_W=three(at.TIP),
        needle_W=three(at.NEEDLE_TIP),
        contact_force=x[at.CONTACT_FORCE],
        contact_peak=x[at.CONTACT_PEAK],
        contact_W=three(at.CONTACT_VECTOR),
        tip_slip=x[at.TIP_SLIP],
        sliding=x[at.CONTACT_MODE] == SLIDE,
        sleeve_on_pipe=x[at.SLEEVE_ON_PIPE] != 0.0,
        on_ground=x[at.ON_GROUND] != 0.0,
        battery_voltage=x[at.VOLTAGE],
        battery_remaining=x[at.CHARGE],
        crashed=CRASHES[int(x[at.CRASH])].format(x[at.CRASH_VALUE]),
        payload=x[at.PAYLOAD] != 0.0,
    )
