"""The Plant protocol: a simulated world, and what is true in it."""

from __future__ import annotations

from typing import Protocol

from msgspec import Struct

from drivers.samples import Five, Quat, Vec3

Four = tuple[float, float, float, float]


class Actuation(Struct, frozen=True, gc=False):
    """What drives the plant during one advance (all held constant)."""

    rotor_thrust: Four
    """Thrust demanded of each rotor, N (PX4 numbering: front right, rear left, front left, rear right)."""
    joint_torque: Vec3
    """Torque demanded of the three joint servos when ``position_mode`` is false, N m."""
    position_mode: bool
    """The joint servos follow ``goal`` by their own position loop."""
    goal: Five
    """Goal angles of the five servos, rad; the last two (pump, gripper) always apply."""
    current_limit: float
    """Limit of the joint servos' current in position mode, A."""
    torque_on: bool


class Truth(Struct, frozen=True, gc=False):
    """What is true in a world at one instant. Forces in N, W unless said otherwise."""

    t: float
    """Simulated time, s."""
    p_WB: Vec3
    v_WB: Vec3
    q_WB: Quat
    w_WB_B: Vec3
    f_B: Vec3
    """Specific force at the body origin, averaged over the last advance, m/s^2, B (an ideal accelerometer)."""
    joints: Vec3
    joint_rates: Vec3
    joint_torque: Vec3
    """Torque the servos really apply at the output, after friction and limits, N m."""
    servo_current: Vec3
    """Supply-side current of the joint servos, A."""
    pump: float
    gripper: float
    """Servo angles, rad."""
    rotor_thrust: Four
    tip_W: Vec3
    """Tip of the gripper: the sleeve's contact point."""
    needle_W: Vec3
    """Tip of the needle."""
    contact_force: float
    """Compressive force of the sleeve on the pipe along the contact normal; positive presses."""
    contact_peak: float
    """Largest contact_force at any physics step since the last advance began."""
    contact_W: Vec3
    """Whole contact force on the vehicle (normal and friction)."""
    tip_slip: float
    """Length of tangential sliding of the tip on the pipe so far, m."""
    sliding: bool
    sleeve_on_pipe: bool
    on_ground: bool
    battery_voltage: float
    battery_remaining: float
    crashed: str
    """Empty, or what happened to the vehicle ("hit the ground at 3.2 m/s", "propeller struck the pipe")."""
    payload: bool = True
    """The sleeve is in the gripper; neither here nor on the pipe, it was dropped."""


class Plant(Protocol):
    """A simulated world with one vehicle and one pipe. Deterministic: same calls, same bits."""

    def advance(self, actuation: Actuation, duration: float) -> None:
        """Advance by ``duration`` seconds, a whole number of physics steps."""

    def truth(self) -> Truth:
        """What is true now."""
