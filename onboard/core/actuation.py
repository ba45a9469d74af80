"""From what the laws want to what the vehicle accepts: wrench, attitude or body rate; joint torque or position."""

from __future__ import annotations

from drivers.samples import AutopilotCommand, Engage, Interface, JointMode, ServoCommand
from onboard.core.types import Control, Reference


def autopilot_command(control: Control, engage: Engage, interface: Interface) -> AutopilotCommand:
    """The set-point for the autopilot; fields beyond ``interface`` are filled for the log."""
    return AutopilotCommand(engage, interface, control.thrust, control.torque_B, control.q_WB, control.w_WB_B)


def servo_command(control: Control, reference: Reference, mode: JointMode, current_limit: float) -> ServoCommand:
    """The goals for the five servos."""
    a, b, c = control.joints
    return ServoCommand(mode, control.joint_torque, (a, b, c, reference.pump, reference.gripper), current_limit)
