"""The tare: the mean of what the estimators read in hover just before the contact, for each of them.

A force's tare belongs to B: errors of mass and thrust lie along the thrust, an accelerometer's along its own axes, and
both turn with the vehicle when it leans into the pipe. That of the joints' torques belongs to the joints.
"""

from __future__ import annotations

from msgspec import Struct

from drivers.samples import Vec3
from onboard.core import math3
from onboard.core.compiled import compiled
from onboard.core.types import Mat3

ZERO: Vec3 = (0.0, 0.0, 0.0)


class State(Struct, frozen=True, gc=False):
    """Tare in force, and the running sum of the next one: N in B, or N m."""

    tare: Vec3 = ZERO
    total: Vec3 = ZERO
    count: int = 0


def accumulate(state: State, value: Vec3) -> State:
    """Add a reading."""
    return State(state.tare, math3.add(state.total, value), state.count + 1)


def finish(state: State) -> State:
    """Adopt the mean of the readings, and start afresh."""
    n, t = max(1, state.count), state.total
    return State((t[0] / n, t[1] / n, t[2] / n))


def drop(state: State) -> State:
    """Forget the readings of a tare that was broken off; the one before stays in force."""
    return State(state.tare)


@compiled("UniTuple(f8, 3)(UniTuple(f8, 3), UniTuple(f8, 3), UniTuple(f8, 9))")
def less(force: Vec3, tare: Vec3, R_WB: Mat3) -> Vec3:
    """A force in W less a tare in B."""
    x, y, z = tare
    return (
        force[0] - (R_WB[0] * x + R_WB[1] * y + R_WB[2] * z),
        force[1] - (R_WB[3] * x + R_WB[4] * y + R_WB[5] * z),
        force[2] - (R_WB[6] * x + R_WB[7] * y + R_WB[8] * z),
    )
