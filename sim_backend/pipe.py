"""The pipe that a world holds."""

from __future__ import annotations

from msgspec import Struct

from drivers.samples import Vec3


class Pipe(Struct, frozen=True):
    """A horizontal pipe. Its axis is square to ``heading`` (rad, from x of W), along which it is pressed."""

    position: Vec3 = (2.0, 0.0, 1.5)
    """Middle of the axis, m, W."""
    heading: float = 0.0
    radius: float = 0.08
    """Outer, m."""
    length: float = 2.0
    """m."""
