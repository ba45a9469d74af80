"""From what the laws want to what the vehicle accepts: wrench, attitude or body rate; joint torque or position."""

from __future__ import annotations

from drivers.samples import AutopilotCommand, Engage, Interface, JointMode, ServoCommand
from drivers.vehicle import Servo
from onboard.core.types import Control, Reference


def autopilot_command(control: Control, engage: Engage, interface: Interface) -> AutopilotCommand:
    """The set-point for the autopilot; fields beyond ``interface`` are filled for the log."""
    return AutopilotCommand(engage, interface, control.thrust, control.torque_B, control.q_WB, control.w_WB_B)


def servo_command(
    control: Control, reference: Reference, mode: JointMode, current_limit: float, servo: Servo | None
) -> ServoCommand:
    """The goals for the five servos.

    A position-controlled servo is a spring and a damper, k (goal - theta) - d theta': the goal leads the reference by
    what the known torque and the reference's rate need of them (without ``servo``, it is the reference).
    """
    (a, b, c), torque = control.joints, control.joint_torque
    if mode is JointMode.POSITION and servo is not None:
        k, d, rate = servo.stiffness, servo.damping, control.joint_rates
        a += (torque[0] + d * rate[0]) / k
        b += (torque[1] + d * rate[1]) / k
        c += (torque[2] + d * rate[2]) / k
    return ServoCommand(mode, torque, (a, b, c, reference.pump, reference.gripper), current_limit)
