"""A flight that does not keep a test waiting."""

from __future__ import annotations

#: A near pipe, brisk motion, a light press: takes off to 0.8 m and presses about 25 s later.
BRISK = (
    "pipe.position=[1.6,0,1.2]",
    "plan.takeoff_height=0.8",
    "plan.standoff=0.8",
    "plan.gap=0.03",
    "plan.speed=0.8",
    "plan.acceleration=0.8",
    "plan.jerk=2",
    "plan.near_speed=0.25",
    "plan.advance_speed=0.015",
    "plan.arm_speed=0.25",
    "plan.needle_speed=0.1",
    "plan.arc_max=0.6",
    "plan.retreat=0.2",
    "plan.descent_speed=0.3",
    "guidance.tare_settle=1",
    "guidance.tare_time=1",
    "force_profile.settle=0.5",
    "force_profile.bias_hold=0.5",
    "force_profile.ramp=3",
    "repair.force=1.5",
)
