"""From what the laws want to what the vehicle accepts."""

from __future__ import annotations

from itertools import product

import pytest
from msgspec.structs import replace

from drivers.samples import Engage, Interface, JointMode
from onboard.config import load_config
from onboard.core.actuation import autopilot_command, servo_command
from onboard.core.types import Control, Phase
from tests.core.following import Follower

CONFIG = load_config("paper")
SERVO = CONFIG.vehicle.servo
REFERENCE = replace(Follower(CONFIG).tick(Phase.PREFLIGHT).reference, pump=4.0, gripper=1.0)
CONTROL = Control(
    thrust=23.0, torque_B=(0.1, -0.2, 0.3), joint_torque=(0.24, -0.12, 0.06), attitude=(0.01, 0.02, 0.03),
    attitude_rate=(0.0, 0.0, 0.0), joints=(-1.0, 1.0, 0.1), joint_rates=(0.4, -0.2, 0.0), w_WB_B=(0.5, 0.6, 0.7),
    q_WB=(0.8, 0.6, 0.0, 0.0),
)  # fmt: skip


@pytest.mark.parametrize(("engage", "interface"), list(product(Engage, Interface)))
def test_all_fields_of_a_set_point_are_filled(engage: Engage, interface: Interface) -> None:
    command = autopilot_command(CONTROL, engage, interface)
    assert (command.engage, command.interface) == (engage, interface)
    assert (command.thrust, command.torque_B) == (CONTROL.thrust, CONTROL.torque_B)
    assert (command.q_WB, command.w_WB_B) == (CONTROL.q_WB, CONTROL.w_WB_B)


def test_torque_mode_hands_the_torques_on_and_the_goals_of_the_tools() -> None:
    command = servo_command(CONTROL, REFERENCE, JointMode.TORQUE, 1.2, SERVO)
    assert (command.mode, command.torque, command.current_limit) == (JointMode.TORQUE, CONTROL.joint_torque, 1.2)
    assert command.position == (*CONTROL.joints, 4.0, 1.0)


def test_without_the_servo_s_data_the_goal_is_the_reference() -> None:
    command = servo_command(CONTROL, REFERENCE, JointMode.POSITION, 1.2, None)
    assert command.position == (*CONTROL.joints, 4.0, 1.0)


def test_the_goal_leads_so_that_the_servo_s_spring_gives_the_torque() -> None:
    """On its reference, at the reference's rate, k (goal - theta) - d theta' is the torque that is wanted."""
    command = servo_command(CONTROL, REFERENCE, JointMode.POSITION, 1.2, SERVO)
    for goal, at, rate, torque in zip(
        command.position[:3], CONTROL.joints, CONTROL.joint_rates, CONTROL.joint_torque, strict=True
    ):
        assert SERVO.stiffness * (goal - at) - SERVO.damping * rate == pytest.approx(torque)
    assert command.position[3:] == (4.0, 1.0)
