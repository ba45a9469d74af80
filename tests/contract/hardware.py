"""Which contract tests run on real hardware: the environment names it, and says whether it may move.

``PIPEWRIGHT_SERVO_PORT``  port, or port@baud: /dev/servos@4000000
``PIPEWRIGHT_T265``        1, a serial number, or a recording (.bag) of a camera that stands still
``PIPEWRIGHT_AUTOPILOT``   MAVSDK URL of a real vehicle, propellers off
``PIPEWRIGHT_MAY_MOVE=1``  servos may have torque, and nothing is in the arm's way
"""

from __future__ import annotations

import os

import pytest

#: The face of a suite that is the device itself.
REAL = pytest.param("real", marks=pytest.mark.real_hardware)


def named(variable: str, what: str) -> str:
    """What the environment says about a piece of hardware; the test is skipped where it says nothing."""
    value = os.environ.get(variable, "")
    if not value:
        pytest.skip(f"set {variable} to run this on {what}")
    return value


def stays_put(request: pytest.FixtureRequest, way: str = "") -> None:
    """Skip a test that moves its device; ``way`` says how it would be run."""
    if request.node.get_closest_marker("moves") is not None:
        pytest.skip(f"it moves the hardware{way}")


def may_move() -> bool:
    """Servos may have torque."""
    return os.environ.get("PIPEWRIGHT_MAY_MOVE") == "1"
