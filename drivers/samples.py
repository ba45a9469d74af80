"""What crosses the hardware edge: time-stamped facts coming in, commands going out.

Conventions: world frame W is x forward/east, y left/north, z up; body frame B is x forward, y left, z up.
Quaternions are (w, x, y, z) and ``q_WB`` takes B to W. SI units; ``t_ns`` is nanoseconds on the process's
monotonic clock. All structs are frozen.
"""

from __future__ import annotations

from enum import StrEnum

from msgspec import Struct

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Five = tuple[float, float, float, float, float]

#: Order of the five servos in every five-element tuple.
SERVO_NAMES = ("theta_1", "theta_2", "theta_3", "pump", "gripper")


class Odometry(Struct, frozen=True, gc=False):
    """Pose and velocity of the body origin from visual-inertial odometry (T265, after the mounting offset)."""

    t_ns: int
    p_WB: Vec3
    """Position, m, W."""
    q_WB: Quat
    v_WB: Vec3
    """Velocity of the body origin, m/s, expressed in W."""
    confidence: int
    """Tracker confidence: 0 failed, 1 low, 2 medium, 3 high."""
    reset_counter: int = 0
    """Increases by one whenever the tracker's frame has jumped."""


class Landed(StrEnum):
    """Answer of the autopilot's land detector."""

    UNKNOWN = "unknown"
    ON_GROUND = "on_ground"
    IN_AIR = "in_air"


class FlightMode(StrEnum):
    """The autopilot's mode, as far as the core needs to tell modes apart."""

    OFFBOARD = "offboard"
    HOLD = "hold"
    LAND = "land"
    OTHER = "other"


class AutopilotState(Struct, frozen=True, gc=False):
    """The newest attitude, inertial data and status that the autopilot has told."""

    t_ns: int
    """Time of the attitude."""
    q_WB: Quat
    w_WB_B: Vec3
    """Angular velocity of B in W, rad/s, expressed in B."""
    t_imu_ns: int
    f_B: Vec3
    """Specific force at the body origin, m/s^2, in B: (0, 0, +9.81) at rest and level."""
    armed: bool
    mode: FlightMode
    landed: Landed
    battery_voltage: float
    """V."""
    battery_remaining: float
    """Fraction, 0..1."""


class ServoState(Struct, frozen=True, gc=False):
    """One cycle of the servo bus: five servos, in the order of ``SERVO_NAMES``, after sign and homing offset."""

    t_ns: int
    position: Five
    """rad."""
    velocity: Five
    """rad/s."""
    current: Five
    """A, signed in the direction of the torque."""
    voltage: Five
    """V."""
    temperature: Five
    """degC."""
    error: tuple[int, int, int, int, int]
    """Hardware-error bits of each servo (XC330 control table, address 70); 0 is healthy."""
    torque_on: bool


class Interface(StrEnum):
    """What the vehicle accepts from the laws."""

    WRENCH = "wrench"
    """Thrust and body torque (the paper's simulation; no real autopilot accepts it)."""
    ATTITUDE = "attitude"
    """Attitude quaternion and thrust."""
    BODY_RATE = "body_rate"
    """Body angular velocity and thrust."""


class Engage(StrEnum):
    """The state the autopilot is wanted in. The device works towards it; ``command`` never waits."""

    IDLE = "idle"
    """Disarmed on the ground. In the air this is ignored by every device."""
    OFFBOARD = "offboard"
    """Armed and following the set-points of this process."""
    LAND = "land"
    """The autopilot lands by itself."""
    KILL = "kill"
    """Motors cut at once, wherever the vehicle is."""


class AutopilotCommand(Struct, frozen=True, gc=False):
    """One fresh set-point. Fields that ``interface`` does not use are still filled, for the log."""

    engage: Engage
    interface: Interface
    thrust: float
    """Total thrust along +z of B, N."""
    torque_B: Vec3
    """Body torque, N m, in B."""
    q_WB: Quat
    """Attitude set-point."""
    w_WB_B: Vec3
    """Body-rate set-point, rad/s."""


class JointMode(StrEnum):
    """How the three arm joints are driven."""

    TORQUE = "torque"
    POSITION = "position"
    OFF = "off"
    """Torque disabled on all servos."""


class ServoCommand(Struct, frozen=True, gc=False):
    """Goals of the five servos. Pump and gripper are always position-controlled."""

    mode: JointMode
    torque: Vec3
    """Joint torques for theta_1..theta_3, N m (JointMode.TORQUE)."""
    position: Five
    """Goal positions, rad (the first three under JointMode.POSITION)."""
    current_limit: float
    """Current limit of the arm joints under JointMode.POSITION, A."""
