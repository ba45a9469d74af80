"""What every force estimator is told in one tick."""

from __future__ import annotations

from msgspec import Struct

from drivers.samples import Vec3
from drivers.vehicle import Servo
from onboard.core.types import Mat3

#: Nine generalised coordinates, rates or forces.
Nine = Mat3


class Told(Struct, frozen=True, gc=False):
    """Samples and model of one tick, as all estimators see them. SI."""

    f_B: Vec3
    """Specific force at the body origin, m/s^2, B."""
    a_W: Vec3
    """Acceleration of the body origin, m/s^2, W."""
    desired: Vec3
    """Acceleration of the reference, m/s^2, W."""
    R: Mat3
    """R_WB."""
    v_W: Vec3
    """Velocity of the body origin as the tracker tells it, carried forward to this tick, m/s, W."""
    fresh: bool
    """The tracker has told something new."""
    q: Nine
    qd: Nine
    """Generalised coordinates and rates (``dynamics``); ``qd[0:3]`` is ``v_W``."""
    sent: float
    """Thrust commanded over the last tick, N."""
    thrust: float
    """What the rotors gave of it, by the thrust model, N."""
    drag: Vec3
    """Air drag at the vehicle's own speed, N, B."""
    torque: Vec3
    """Generalised forces of the commanded body torque on the Euler angles, N m."""
    torque_known: bool
    """The autopilot is sent torques; what its own loops do is not known."""
    currents: Vec3
    """Of the joints' servos, A."""
    servo: Servo
    felt: Vec3
    """Force at the tip by the joints' torques one tick ago, tared, N, W."""
    joints_known: bool
    """The servos are under torque, told lately, and without errors: what they feel counts."""
    near: bool
    """The tip is where there may be contact: the contact gate."""
    normal: tuple[float, float]
    """Horizontal direction into the pipe."""
    mass: float
    """Of the whole vehicle, kg."""
    gravity: float
    payload: bool
