from __future__ import annotations

from math import cos, hypot, inf, isfinite, nan, pi, sin
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from onboard.core import kinematics, math3
from onboard.core.kinematics import Tool, Unreachable

CONFIG = Path(__file__).parents[2] / "configs" / "vehicle.yaml"
ARM = msgspec.yaml.decode(CONFIG.read_bytes(), type=Vehicle).arm
LOW, HIGH = ARM.joint_min, ARM.joint_max

steady = settings(max_examples=300)
branches = st.booleans()
tools = st.sampled_from(Tool)
joints = st.tuples(*(st.floats(low, high) for low, high in zip(LOW, HIGH, strict=True)))
targets = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
rates = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))


def allowed(theta_1: float, theta_2: float, elbow_up: bool, slack: float = 1e-9) -> bool:
    bend = theta_1 - theta_2 if elbow_up else theta_2 - theta_1
    return (
        LOW[0] - slack <= theta_1 <= HIGH[0] + slack
        and LOW[1] - slack <= theta_2 <= HIGH[1] + slack
        and ARM.elbow_min - slack <= bend <= pi - ARM.elbow_min + slack
    )


def grid(elbow_up: bool) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Wrist positions all over the workspace, edges included."""
    one, two = np.meshgrid(np.linspace(LOW[0], HIGH[0], 400), np.linspace(LOW[1], HIGH[1], 300), indexing="ij")
    bend = (one - two) if elbow_up else (two - one)
    inside = (bend >= ARM.elbow_min) & (bend <= pi - ARM.elbow_min)
    one, two = one[inside], two[inside]
    return np.array(
        [
            ARM.link_1 * np.cos(one) + ARM.link_2 * np.cos(two),
            ARM.link_1 * np.sin(one) + ARM.link_2 * np.sin(two),
        ]
    )


GRID = {up: grid(up) for up in (False, True)}


def test_joint_signs_by_hand() -> None:
    mx, my, mz = ARM.mount
    reach = ARM.link_1 + ARM.link_2
    assert kinematics.forward(ARM, (0.0, 0.0, 0.0), Tool.GRIPPER) == (mx + reach + ARM.gripper, my, mz)
    # Positive angles lift; at theta_3 = 0 the needle points up, at -pi/2 forward with the gripper down.
    assert kinematics.forward(ARM, (0.0, 0.0, 0.0), Tool.NEEDLE) == (mx + reach, my, mz + ARM.needle)
    assert kinematics.forward(ARM, (pi / 2, pi / 2, pi / 2), Tool.GRIPPER)[2] == pytest.approx(mz + reach + ARM.gripper)
    needle = kinematics.forward(ARM, (0.0, 0.0, -pi / 2), Tool.NEEDLE)
    assert needle == pytest.approx((mx + reach + ARM.needle, my, mz))


@steady
@given(joints)
def test_end_effector_frame_is_eq_17(angles: Vec3) -> None:
    """R_ee = R_y(3*pi/2 - theta_3); the gripper points along -z_E, the needle along +x_E."""
    R_BE = kinematics.tool_rotation(angles[2])
    a = 3.0 * pi / 2.0 - angles[2]
    R_y = (cos(a), 0.0, sin(a), 0.0, 1.0, 0.0, -sin(a), 0.0, cos(a))
    assert R_BE == pytest.approx(R_y, abs=1e-12)  # noqa: SIM300
    wrist_x, wrist_z = kinematics.wrist(ARM, angles[0], angles[1])
    wrist_B = math3.add(ARM.mount, (wrist_x, 0.0, wrist_z))
    for tool, in_E in ((Tool.GRIPPER, (0.0, 0.0, -ARM.gripper)), (Tool.NEEDLE, (ARM.needle, 0.0, 0.0))):
        tip = math3.add(wrist_B, math3.rotate(R_BE, in_E))
        assert kinematics.forward(ARM, angles, tool) == pytest.approx(tip, abs=1e-12)


@steady
@given(joints, branches)
def test_inverse_undoes_forward(angles: Vec3, elbow_up: bool) -> None:
    assume(allowed(angles[0], angles[1], elbow_up, 0.0))
    for tool in Tool:
        x, _, z = math3.subtract(kinematics.forward(ARM, angles, tool), ARM.mount)
        assert kinematics.inverse_tip(ARM, x, z, angles[2], tool, elbow_up) == pytest.approx(angles, abs=1e-7)


@steady
@given(targets, branches)
def test_clamped_target_is_the_nearest_reachable_point(target: tuple[float, float], elbow_up: bool) -> None:
    x, z = target
    theta_1, theta_2, distance = kinematics.nearest_wrist(ARM, x, z, elbow_up)
    assert allowed(theta_1, theta_2, elbow_up)
    near_x, near_z = kinematics.wrist(ARM, theta_1, theta_2)
    assert hypot(near_x - x, near_z - z) == pytest.approx(distance, abs=1e-12)
    # No point of a dense grid over the workspace is nearer, and the grid comes as near as its spacing allows.
    best = float(np.hypot(GRID[elbow_up][0] - x, GRID[elbow_up][1] - z).min())
    assert distance <= best + 1e-12
    assert best <= distance + 0.005
    cx, cz, clamped_by = kinematics.clamp_wrist(ARM, x, z, elbow_up)
    assert clamped_by == pytest.approx(distance, abs=kinematics.TOLERANCE)
    assert kinematics.wrist(ARM, *kinematics.inverse_wrist(ARM, cx, cz, elbow_up)) == pytest.approx((cx, cz), abs=1e-8)


@steady
@given(targets, branches)
def test_unreachable_exactly_when_clamped(target: tuple[float, float], elbow_up: bool) -> None:
    x, z = target
    clamped_by = kinematics.clamp_wrist(ARM, x, z, elbow_up)[2]
    if clamped_by == 0.0:
        assert allowed(*kinematics.inverse_wrist(ARM, x, z, elbow_up), elbow_up)
    else:
        with pytest.raises(Unreachable, match="unreachable by") as caught:
            kinematics.inverse_wrist(ARM, x, z, elbow_up)
        assert caught.value.distance == clamped_by


def test_message_tells_the_millimetres_and_the_nearest_point() -> None:
    # Straight ahead, the elbow's margin leaves 2 L cos(elbow_min / 2).
    reach = 2.0 * ARM.link_1 * cos(ARM.elbow_min / 2.0)
    with pytest.raises(Unreachable) as caught:
        kinematics.inverse_wrist(ARM, reach + 0.0123, 0.0)
    assert str(caught.value) == (
        "wrist target (0.4078, 0.0) m in M is unreachable by 12.3 mm with the elbow down; "
        "the nearest reachable point is (0.3955, 0.0)"
    )
    assert caught.value.distance == pytest.approx(0.0123)


def test_tool_angle_beyond_its_stops_is_unreachable() -> None:
    with pytest.raises(Unreachable, match=r"theta_3 = 1\.2000 rad is beyond its limits \[-3\.0, 1\.0\]") as caught:
        kinematics.inverse_tip(ARM, 0.25, -0.1, 1.2, Tool.GRIPPER)
    assert caught.value.distance == pytest.approx(0.2)


@pytest.mark.parametrize("target", [(nan, 0.0), (0.2, nan), (inf, 0.0), (-inf, inf)])
@pytest.mark.parametrize("elbow_up", [False, True])
def test_a_target_that_is_not_finite(target: tuple[float, float], elbow_up: bool) -> None:
    theta_1, theta_2, distance = kinematics.nearest_wrist(ARM, *target, elbow_up)
    assert distance == inf
    assert allowed(theta_1, theta_2, elbow_up)
    with pytest.raises(Unreachable, match="no reachable point"):
        kinematics.inverse_wrist(ARM, *target, elbow_up)


@pytest.mark.parametrize("target", [(0.0, 0.0), (1e300, -1e300), (1e-320, 0.0)])
def test_extreme_targets_are_clamped(target: tuple[float, float]) -> None:
    x, z, clamped_by = kinematics.clamp_wrist(ARM, *target)
    assert clamped_by > 0.0
    assert isfinite(x)
    assert isfinite(z)
    with pytest.raises(Unreachable):
        kinematics.inverse_wrist(ARM, *target)


@steady
@given(joints, rates, tools)
def test_jacobian_is_the_derivative_of_the_tip(angles: Vec3, speed: Vec3, tool: Tool) -> None:
    step = 1e-6
    ahead, behind = (
        kinematics.forward(ARM, (angles[0] + h * speed[0], angles[1] + h * speed[1], angles[2] + h * speed[2]), tool)
        for h in (step, -step)
    )
    x, _, z = math3.scale(0.5 / step, math3.subtract(ahead, behind))
    assert kinematics.tip_velocity(ARM, angles, speed, tool) == pytest.approx((x, z), abs=1e-8)


@steady
@given(joints, rates, tools)
def test_joint_rates_undo_tip_velocity(angles: Vec3, speed: Vec3, tool: Tool) -> None:
    assume(abs(sin(angles[1] - angles[0])) >= sin(ARM.elbow_min))
    velocity = kinematics.tip_velocity(ARM, angles, speed, tool)
    assert kinematics.joint_rates(ARM, angles, velocity, speed[2], tool) == pytest.approx(speed, abs=1e-9)
    j = np.reshape(kinematics.wrist_jacobian(ARM, angles[0], angles[1]), (2, 2))
    inverse = np.reshape(kinematics.wrist_jacobian_inverse(ARM, angles[0], angles[1]), (2, 2))
    assert np.allclose(j @ inverse, np.eye(2), atol=1e-12)


@steady
@given(joints, st.tuples(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(-3.0, 3.0)), tools)
def test_tip_in_the_world(angles: Vec3, rpy: Vec3, tool: Tool) -> None:
    R_WB, p_WB = math3.matrix_from_euler(rpy), (1.0, -2.0, 3.0)
    expected = math3.add(p_WB, math3.rotate(R_WB, kinematics.forward(ARM, angles, tool)))
    assert kinematics.tip_W(ARM, p_WB, R_WB, angles, tool) == pytest.approx(expected, abs=1e-12)
