"""A vehicle without dynamics: it is where the reference wants it, the pipe holds it while it presses."""

from __future__ import annotations

from typing import NamedTuple

from msgspec.structs import replace

from onboard.config import Config
from onboard.core import guidance, kinematics
from onboard.core.derived import derive
from onboard.core.guidance import PRESSING, Progress
from onboard.core.types import Estimate, Phase, Reference

DT = 0.004
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
ZERO = (0.0, 0.0, 0.0)
#: Nothing is known of it yet.
RESTING = Estimate(
    p_WB=ZERO, v_WB=ZERO, rpy=ZERO, rpy_rate=ZERO, R_WB=IDENTITY, w_WB_B=ZERO, a_WB=ZERO, joints=ZERO,
    joint_rates=ZERO, tip_W=ZERO, force_W=ZERO, force_ee=ZERO, contact_force=0.0, in_contact=False, payload=True,
    age_odometry=0.0, age_autopilot=0.0, age_servos=0.0, valid=True,
)  # fmt: skip


class Step(NamedTuple):
    """What one tick of the reference gave."""

    phase: Phase
    reference: Reference
    progress: Progress


class Follower:
    """Guidance, and an estimate that agrees with its reference."""

    def __init__(self, config: Config, heading: float = 0.0) -> None:
        self.config = config
        self.site = derive(config).site
        self.state = guidance.initial()
        theta_1, theta_2, _ = kinematics.nearest_wrist(config.vehicle.arm, *config.plan.fold)
        self.estimate = replace(
            RESTING,
            p_WB=(0.0, 0.0, config.vehicle.base.gear_height),
            rpy=(0.0, 0.0, heading),
            joints=(theta_1, theta_2, 0.0),
        )
        self.steps: list[Step] = []

    def copy(self) -> Follower:
        """The same moment, on its own from here."""
        twin = Follower.__new__(Follower)
        twin.__dict__ = self.__dict__ | {"steps": self.steps[-1:]}
        return twin

    def tick(self, phase: Phase, engaged: bool = True, tare: bool = False) -> Step:
        """One tick in ``phase``."""
        self.state, reference, progress = guidance.step(
            self.state, self.estimate, phase, tare, engaged, 0.0, derive(self.config), self.config, DT
        )
        self.steps.append(Step(phase, reference, progress))
        theta_1, theta_2, _ = kinematics.nearest_wrist(self.config.vehicle.arm, *reference.wrist)
        held = reference.pressing
        ground = self.config.vehicle.base.gear_height
        x, y, z = reference.p
        self.estimate = replace(
            self.estimate,
            p_WB=self.estimate.p_WB if held else (x, y, max(ground, z)),
            v_WB=ZERO if held or z < ground else reference.v,
            rpy=(0.0, 0.0, reference.yaw),
            joints=(theta_1, theta_2, reference.elevation),
            contact_force=reference.force if held else 0.0,
        )
        return self.steps[-1]

    def run(self, phase: Phase, seconds: float) -> Follower:
        """So long in one phase."""
        for _ in range(round(seconds / DT)):
            self.tick(phase)
        return self

    def finish(self, phase: Phase, within: float = 120.0) -> Follower:
        """To the end of a phase; ADVANCE ends where the crack is."""
        for _ in range(round(within / DT)):
            step = self.tick(phase)
            if phase is Phase.PREFLIGHT or (phase is Phase.ADVANCE and self.from_crack <= self.reach):
                return self
            if phase is Phase.PRESS and step.progress.pressed:
                return self
            if phase is Phase.RELEASE:
                self.estimate = replace(self.estimate, payload=False)
                if step.progress.released:
                    return self
            if phase is Phase.LAND and step.progress.grounded:
                return self
            if phase is Phase.TARE and step.progress.tared:
                return self
            if phase not in (Phase.ADVANCE, *PRESSING, Phase.TARE, Phase.LAND) and step.progress.arrived:
                return self
        msg = f"{phase} does not end within {within} s"
        raise AssertionError(msg)

    @property
    def from_crack(self) -> float:
        """Distance of the base from the crack against the normal, m."""
        (cx, cy, _), (nx, ny), (x, y, _) = self.site.crack, self.site.normal, self.estimate.p_WB
        return (cx - x) * nx + (cy - y) * ny

    @property
    def reach(self) -> float:
        """Distance of the base from the crack at which the gripper touches it, m."""
        return self.site.near - self.config.plan.gap


#: The phases of a mission, in their order.
CHAIN = (
    Phase.PREFLIGHT, Phase.TAKEOFF, Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE,
    Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, Phase.RETURN, Phase.LAND,
)  # fmt: skip
