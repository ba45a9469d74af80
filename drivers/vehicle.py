"""The vehicle, described once: the physical facts that the flight core, the worlds and the drivers share.

Every value comes from ``configs/vehicle*.yaml``, where it stands with its unit and source; there are no
defaults here. Frames: B is the body frame at the base's centre of mass. The arm moves in the x-z plane of B.
M is the arm's base frame at ``arm.mount``: x_M = x_B, y_M = z_B, z_M = -y_B. A joint angle is positive about
z_M (as seen from the vehicle's right side: counter-clockwise), so angle a points along
u(a) = (cos a, 0, sin a) in B. This is the reading of the paper's joint definition for which its eq. 17,
R_ee = R_y(3*pi/2 - theta_3), is the rotation from E to B, with the gripper pointing along -z_E = u(theta_3).
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from msgspec import Meta, Struct


def _meta(unit: str, doc: str, low: float | None = None, high: float | None = None) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


Mass = Annotated[float, _meta("kg", "mass", 0.0, 20.0)]
Length = Annotated[float, _meta("m", "length", 0.0, 2.0)]
Offset = Annotated[float, _meta("m", "signed offset", -2.0, 2.0)]
Angle = Annotated[float, _meta("rad", "mechanical stop of a joint", -6.3, 6.3)]
Inertia = Annotated[float, _meta("kg m^2", "moment of inertia about the part's centre of mass", 0.0, 5.0)]


class Carrier(StrEnum):
    """What a part of the arm turns with."""

    BASE = "base"
    LINK_1 = "link_1"
    LINK_2 = "link_2"
    TOOL = "tool"


class Base(Struct, frozen=True, forbid_unknown_fields=True):
    """Airframe with everything that does not move against it (arm servos, computer, battery)."""

    mass: Mass
    inertia: tuple[Inertia, Inertia, Inertia]
    """Principal moments about x, y, z of B."""
    drag: tuple[
        Annotated[float, _meta("N s/m", "linear drag", 0.0, 5.0)],
        Annotated[float, _meta("N s/m", "linear drag", 0.0, 5.0)],
        Annotated[float, _meta("N s/m", "linear drag", 0.0, 5.0)],
    ]
    gear_height: Length
    """Height of the body origin above the ground when standing."""
    gear_span: Length
    """Half the distance between the landing skids (square footprint)."""


class Rotors(Struct, frozen=True, forbid_unknown_fields=True):
    """Four rotors in the X500's X layout (PX4 numbering: front right, rear left, front left, rear right)."""

    arm_x: Length
    """|x| of each rotor in B."""
    arm_y: Length
    """|y| of each rotor in B."""
    max_thrust: Annotated[float, _meta("N", "largest thrust of one rotor", 0.0, 100.0)]
    torque_per_thrust: Annotated[float, _meta("N m/N", "yaw reaction per thrust", 0.0, 0.2)]
    time_constant: Annotated[float, _meta("s", "first-order lag of the thrust; 0 is none", 0.0, 0.5)]
    curve: Annotated[float, _meta("1", "PX4 THR_MDL_FAC: thrust = f*u^2 + (1-f)*u of full thrust", 0.0, 1.0)]
    radius: Length
    """Propeller radius (clearance to the pipe)."""


class Part(Struct, frozen=True, forbid_unknown_fields=True):
    """One rigid part of the arm.

    Its centre of mass lies at mount + offset + along[0]*u(theta_1) + along[1]*u(theta_2) + along[2]*u(theta_3).
    Principal axes: x along the direction it turns with, y along y_B. Bars of the parallelograms turn with the
    link they are parallel to; the connecting plates only translate (they turn with the base).
    """

    name: str
    mass: Mass
    inertia: tuple[Inertia, Inertia, Inertia]
    turns_with: Carrier
    offset: tuple[Offset, Offset]
    """Constant (x, z) in B."""
    along: tuple[Offset, Offset, Offset]


class Arm(Struct, frozen=True, forbid_unknown_fields=True):
    """The 3-DOF parallelogram arm with its dual tool."""

    mount: tuple[Offset, Offset, Offset]
    """Origin of M in B."""
    link_1: Length
    link_2: Length
    gripper: Length
    """Wrist to sleeve contact point, along u(theta_3)."""
    needle: Length
    """Wrist to needle tip, along u(theta_3 + pi/2)."""
    joint_min: tuple[Angle, Angle, Angle]
    """Lowest joint angles, rad."""
    joint_max: tuple[Angle, Angle, Angle]
    """Highest joint angles, rad."""
    elbow_min: Annotated[float, _meta("rad", "smallest |theta_2 - theta_1| and distance to pi", 0.0, 1.5)]
    parts: tuple[Part, ...]
    sleeve: Part
    """The payload: present until it is released onto the pipe."""


class Servo(Struct, frozen=True, forbid_unknown_fields=True):
    """Dynamixel XC330-M288-T."""

    stall_torque: Annotated[float, _meta("N m", "at the rated voltage", 0.0, 10.0)]
    stall_current: Annotated[float, _meta("A", "at the rated voltage", 0.0, 10.0)]
    no_load_speed: Annotated[float, _meta("rad/s", "at the rated voltage", 0.0, 100.0)]
    voltage: Annotated[float, _meta("V", "rated", 0.0, 24.0)]
    counts: Annotated[int, _meta("1/rev", "encoder counts per turn", 1, 1_000_000)]
    friction_static: Annotated[float, _meta("N m", "gear breakaway friction at the output", 0.0, 1.0)]
    friction_viscous: Annotated[float, _meta("N m s/rad", "gear viscous friction at the output", 0.0, 1.0)]
    rotor_inertia: Annotated[float, _meta("kg m^2", "motor inertia reflected to the output", 0.0, 0.1)]
    stiffness: Annotated[float, _meta("N m/rad", "position mode: proportional gain at the output", 0.0, 200.0)]
    damping: Annotated[float, _meta("N m s/rad", "position mode: derivative gain at the output", 0.0, 10.0)]


class Battery(Struct, frozen=True, forbid_unknown_fields=True):
    """4S LiPo."""

    full_voltage: Annotated[float, _meta("V", "open circuit, full", 0.0, 60.0)]
    empty_voltage: Annotated[float, _meta("V", "open circuit, empty", 0.0, 60.0)]
    capacity: Annotated[float, _meta("A h", "capacity", 0.0, 100.0)]
    resistance: Annotated[float, _meta("ohm", "internal resistance", 0.0, 1.0)]
    hover_current: Annotated[float, _meta("A", "drawn at hover thrust", 0.0, 200.0)]


class Vehicle(Struct, frozen=True, forbid_unknown_fields=True):
    """Everything physical about one vehicle."""

    gravity: Annotated[float, _meta("m/s^2", "local gravity", 9.0, 10.0)]
    base: Base
    rotors: Rotors
    arm: Arm
    servo: Servo
    battery: Battery
