"""Draws docs/images/frames.svg from the model itself: frames, joint angles, tools, and the wrist's workspace.

Run from the repository's root: python -m docs.figures.frames
"""

from __future__ import annotations

from math import cos, degrees, sin
from pathlib import Path

import matplotlib

matplotlib.use("svg")

import matplotlib.pyplot as plt
import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Polygon

from drivers.vehicle import Arm, Vehicle
from onboard.core import kinematics
from onboard.core.kinematics import Plane, Tool

ROOT = Path(__file__).parents[2]
POSE = (-1.25, 0.55, -0.3)
LINK, BAR, FRAME, ANGLE = "#1f3b57", "#8fa6ba", "#b03a2e", "#2e7d32"


def polar(origin: Plane, length: float, angle: float) -> Plane:
    """The point at ``length`` from ``origin`` in the direction ``angle``."""
    return (origin[0] + length * cos(angle), origin[1] + length * sin(angle))


def line(axes: Axes, a: Plane, b: Plane, **style: object) -> None:
    """A line from a to b."""
    axes.plot([a[0], b[0]], [a[1], b[1]], solid_capstyle="round", **style)  # type: ignore[arg-type]


def axis(axes: Axes, origin: Plane, angle: float, text: str, length: float = 0.075) -> None:
    """An axis of a frame, with its name."""
    end = polar(origin, length, angle)
    axes.annotate("", end, origin, arrowprops={"arrowstyle": "-|>", "color": FRAME, "shrinkA": 0, "shrinkB": 0})
    axes.annotate(text, polar(origin, length * 1.22, angle), color=FRAME, ha="center", va="center", fontsize=9)


def angle_mark(axes: Axes, origin: Plane, angle: float, text: str, radius: float, out: float = 1.35) -> None:
    """The arc of a joint angle, from the horizontal."""
    low, high = sorted((0.0, degrees(angle)))
    axes.add_patch(Arc(origin, 2 * radius, 2 * radius, theta1=low, theta2=high, color=ANGLE, lw=1.2))
    line(axes, origin, (origin[0] + radius * 1.25, origin[1]), color=ANGLE, lw=0.8, ls=":")
    end, before = polar(origin, radius, angle), polar(origin, radius, angle * 0.9)
    axes.annotate("", end, before, arrowprops={"arrowstyle": "-|>", "color": ANGLE, "shrinkA": 0, "shrinkB": 0})
    axes.annotate(text, polar(origin, radius * out, angle / 2), color=ANGLE, ha="center", va="center", fontsize=10)


def draw_frames(axes: Axes, arm: Arm) -> None:
    """Frames, links and tools in one pose."""
    one, two, three = POSE
    mount = (arm.mount[0], arm.mount[2])
    elbow = polar(mount, arm.link_1, one)
    wrist = polar(elbow, arm.link_2, two)
    tips = {tool: kinematics.forward(arm, POSE, tool) for tool in Tool}
    parts = {part.name: part for part in arm.parts}

    axes.add_patch(Polygon([(-0.11, -0.03), (0.11, -0.03), (0.11, 0.03), (-0.11, 0.03)], fc="#e9edf1", ec=BAR))
    line(axes, (-0.18, 0.035), (0.18, 0.035), color=BAR, lw=3)
    line(axes, (0.06, -0.03), mount, color=BAR, lw=3)

    # Bars of the parallelograms, from the parts list.
    back = parts["rod"].along[1]
    crank, tail = polar(mount, back, two), polar(elbow, back, two)
    line(axes, mount, crank, color=BAR, lw=2)
    line(axes, crank, tail, color=BAR, lw=2)
    dx, dz = parts["level_rod_1"].offset
    corners = [(p[0] + dx, p[1] + dz) for p in (mount, elbow, wrist)]
    line(axes, corners[0], corners[1], color=BAR, lw=1.2)
    line(axes, corners[1], corners[2], color=BAR, lw=1.2)
    for joint, corner in zip((elbow, wrist), corners[1:], strict=True):
        line(axes, joint, corner, color=BAR, lw=2.5)

    line(axes, tail, elbow, color=LINK, lw=5)
    line(axes, mount, elbow, color=LINK, lw=5)
    line(axes, elbow, wrist, color=LINK, lw=5)
    for tool, text, place in ((Tool.GRIPPER, "gripper", (-8, -16)), (Tool.NEEDLE, "needle", (-2, 12))):
        x, _, z = tips[tool]
        line(axes, wrist, (x, z), color=LINK, lw=4 if tool is Tool.GRIPPER else 1.5)
        axes.annotate(text, (x, z), xytext=place, textcoords="offset points", fontsize=9, ha="center", va="center")
    axes.plot(*zip(mount, elbow, wrist, strict=True), "o", color="white", mec=LINK, ms=7, zorder=5)

    axis(axes, (0.0, 0.0), 0.0, "$x_B$", 0.13)
    axis(axes, (0.0, 0.0), np.pi / 2, "$z_B$", 0.11)
    axis(axes, mount, 0.0, "$x_M$", 0.16)
    axis(axes, mount, np.pi / 2, "$y_M$", 0.055)
    angle_mark(axes, mount, one, r"$\theta_1$", 0.07)
    angle_mark(axes, elbow, two, r"$\theta_2$", 0.08)
    angle_mark(axes, wrist, three, r"$\theta_3$", 0.15, 1.12)
    # E: z_E = -u(theta_3), x_E = u(theta_3 + pi/2) (eq. 17).
    gripper = (tips[Tool.GRIPPER][0], tips[Tool.GRIPPER][2])
    axis(axes, gripper, three + np.pi / 2, "$x_E$", 0.05)
    axis(axes, gripper, three + np.pi, "", 0.05)
    axes.annotate(
        "$z_E$", polar(gripper, 0.04, three + np.pi), xytext=(-8, -8), textcoords="offset points",
        color=FRAME, fontsize=9, ha="center", va="center",
    )  # fmt: skip
    axes.set(xlim=(-0.2, 0.52), ylim=(-0.31, 0.16), title="Frames, joint angles and tools, seen from the right")


def draw_workspace(axes: Axes, arm: Arm) -> None:
    """Where the wrist can be, for both elbows."""
    x, z = np.meshgrid(np.linspace(-0.45, 0.45, 361), np.linspace(-0.45, 0.45, 361))
    for elbow_up, colour, text in ((False, "#4f81bd", "elbow down"), (True, "#c58b2a", "elbow up")):
        reach = np.vectorize(lambda a, b, up=elbow_up: kinematics.nearest_wrist(arm, a, b, up)[2])(x, z)
        axes.contourf(x, z, reach, levels=[-1.0, 1e-9], colors=[colour], alpha=0.3)
        axes.contour(x, z, reach, levels=[1e-4], colors=[colour], linewidths=1.2)
        axes.plot([], [], color=colour, label=text)
    axes.plot(0.0, 0.0, "o", color="white", mec=LINK, ms=7)
    target = (0.34, -0.33)
    near_x, near_z, by = kinematics.clamp_wrist(arm, *target)
    axes.annotate(
        "", (near_x, near_z), target, arrowprops={"arrowstyle": "-|>", "color": FRAME, "shrinkA": 3, "shrinkB": 0}
    )
    axes.plot(*target, "x", color=FRAME)
    axes.annotate(
        f"a target beyond reach,\nclamped by {1e3 * by:.0f} mm", target, xytext=(0, -28), textcoords="offset points",
        fontsize=8, color=FRAME, ha="center",
    )  # fmt: skip
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    axes.set(xlim=(-0.47, 0.47), ylim=(-0.47, 0.47), title="Workspace of the wrist, in M")


def main() -> None:
    """Write the figure."""
    vehicle = msgspec.yaml.decode((ROOT / "configs" / "vehicle.yaml").read_bytes(), type=Vehicle)
    matplotlib.rcParams.update({"svg.hashsalt": "pipewright", "font.size": 9, "axes.titlesize": 10})
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.6), width_ratios=(1.45, 1.0), layout="constrained")
    draw_frames(left, vehicle.arm)
    draw_workspace(right, vehicle.arm)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_xlabel("forward, m")
        axes.set_ylabel("up, m")
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / "images" / "frames.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
