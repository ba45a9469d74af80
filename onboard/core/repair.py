"""Where the pipe is and what is to be done to it."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

Coordinate = Annotated[
    float, Meta(ge=-100.0, le=100.0, description="coordinate in W", extra={"unit": "m", "in_flight": False})
]


class Pipe(Struct, frozen=True, forbid_unknown_fields=True):
    """A horizontal pipe. The crack is the point of its surface that faces the vehicle."""

    position: tuple[Coordinate, Coordinate, Coordinate] = (2.0, 0.0, 1.5)
    """Point of the pipe's axis at the crack's cross-section, m, W."""
    heading_deg: Annotated[
        float,
        Meta(
            ge=-180.0,
            le=180.0,
            description="direction in which the vehicle faces and presses (psi of eq. 9); the axis is square to it",
            extra={"unit": "deg", "in_flight": False},
        ),
    ] = 0.0
    length: Annotated[
        float,
        Meta(
            ge=0.2,
            le=50.0,
            description="length, half of it to either side of the crack; routes keep clear of all of it",
            extra={"unit": "m", "in_flight": False},
        ),
    ] = 2.0
    radius: Annotated[
        float, Meta(ge=0.03, le=0.15, description="outer radius", extra={"unit": "m", "in_flight": False})
    ] = 0.08


class Repair(Struct, frozen=True, forbid_unknown_fields=True):
    """The force to press the sleeve on with, and for how long."""

    force: Annotated[float, Meta(ge=0.5, le=4.0, description="force held", extra={"unit": "N", "in_flight": False})] = (
        2.5
    )
    hold: Annotated[
        float, Meta(ge=0.5, le=120.0, description="time the force is held", extra={"unit": "s", "in_flight": False})
    ] = 12.0
