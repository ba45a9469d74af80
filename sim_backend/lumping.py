"""The vehicle as a few rigid bodies on joints: the mechanism that the PyBullet world simulates.

The arm is the chain base, link 1, link 2, tool, whose joints turn by the differences of the absolute link angles. The
plates, which only translate, hang on it by joints that turn back what the links before them have turned, and the crank,
parallel to link 2, stands on the base by joints that repeat it. Each such joint copies one joint of the chain, or its
opposite, as a gear does (``GEARS``): the closed loops, written so that they know no dead point, and so that the gears
hardly disturb each other, which an iterating solver rewards.

The bars of the parallelograms are lumped into these bodies without approximation. A bar that joins two pins moves like
two point masses at the pins with the same centre, and what its moment of inertia then has too much goes to the link
that it is parallel to. The inertia of a motor counts, through its gear, only against the base: half of it is on its
link and half on a wheel in the base that turns the other way, and the base gives up what the two add to it.
"""

from __future__ import annotations

from math import atan2, sqrt
from typing import NamedTuple

from msgspec import Struct

from drivers.samples import Vec3
from drivers.vehicle import Carrier, Part, Vehicle

#: The links that the servos drive, in their order.
DRIVEN = ("link_1", "link_2", "tool")
#: Joint of a link that copies one of the chain, with what sign, and which.
GEARS = (
    ("elbow_plate", -1.0, "link_1"),
    ("wrist_turn", -1.0, "link_2"),
    ("wrist_plate", -1.0, "link_1"),
    ("crank_turn", 1.0, "link_1"),
    ("crank", 1.0, "link_2"),
)
#: The same for the halves of the motors that turn the other way.
WHEELS = (
    ("wheel_1", -1.0, "link_1"),
    ("wheel_2", -1.0, "link_2"),
    ("wheel_3", -1.0, "tool"),
)
#: Links without a joint of their own.
SHOULDER, SLEEVE = "shoulder", "sleeve"
#: Mass of what only turns between two others, taken from its neighbour, kg.
TOKEN_MASS = 1e-4
#: Its inertia as a share of that of link 1, with which it turns, and from which it is taken. Less is slower to iterate.
TOKEN_SHARE = 0.45

_LINK_OF = {Carrier.LINK_1: "link_1", Carrier.LINK_2: "link_2", Carrier.TOOL: "tool"}
_EPSILON = 1e-9


class Body(Struct):
    """Mass, and first and second moments about the origin of a link's frame; all in its x-z plane."""

    mass: float = 0.0
    x: float = 0.0
    z: float = 0.0
    """First moments, kg m."""
    xx: float = 0.0
    yy: float = 0.0
    zz: float = 0.0
    xz: float = 0.0
    """Inertia about the origin, kg m^2."""

    def add(self, mass: float, x: float = 0.0, z: float = 0.0, own: Vec3 = (0.0, 0.0, 0.0)) -> None:
        """Add a mass at (x, z), with principal moments ``own`` along the axes of the frame."""
        self.mass += mass
        self.x += mass * x
        self.z += mass * z
        self.xx += own[0] + mass * z * z
        self.yy += own[1] + mass * (x * x + z * z)
        self.zz += own[2] + mass * x * x
        self.xz -= mass * x * z


class Inertial(NamedTuple):
    """A body about its centre of mass: principal moments, and how its principal axes are turned about y (rad)."""

    mass: float
    centre: Vec3
    pitch: float
    moments: Vec3


def inertial(body: Body) -> Inertial:
    """What URDF wants to hear of a body."""
    x, z = body.x / body.mass, body.z / body.mass
    xx = body.xx - body.mass * z * z
    yy = body.yy - body.mass * (x * x + z * z)
    zz = body.zz - body.mass * x * x
    xz = body.xz + body.mass * x * z
    mean, half = 0.5 * (xx + zz), 0.5 * (xx - zz)
    spread = sqrt(half * half + xz * xz)
    if abs(xz) < 1e-9 * (xx + zz):
        return Inertial(body.mass, (x, 0.0, z), 0.0, (xx, yy, zz))
    # The axis of the largest moment, at angle a from x towards z; a turn by b about y takes x to (cos b, 0, -sin b).
    a = 0.5 * atan2(xz, half)
    return Inertial(body.mass, (x, 0.0, z), -a, (mean + spread, yy, mean - spread))


def gears(vehicle: Vehicle) -> tuple[tuple[str, float, str], ...]:
    """The gears that this vehicle needs: without inertia of its motors there are no wheels."""
    return (*GEARS, *WHEELS) if vehicle.servo.rotor_inertia > 0.0 else GEARS


def bodies(vehicle: Vehicle) -> dict[str, Body]:
    """All links but the sleeve, by name. Raises ValueError for a part that is none of this parallelogram."""
    base, rotor = vehicle.base, vehicle.servo.rotor_inertia
    out = {name: Body() for name in ("base", SHOULDER, *DRIVEN, *(name for name, _, _ in gears(vehicle)))}
    for part in vehicle.arm.parts:
        _lump(vehicle, part, out)
    half = 0.5 * rotor
    wheels = [name for name, _, _ in WHEELS if name in out]
    for name, wheel in zip(DRIVEN, wheels, strict=False):
        out[name].add(0.0, own=(half, half, half))
        out[wheel].add(TOKEN_MASS, own=(half, half, half))
    xx, yy, zz = inertial(out["link_1"]).moments
    for turn, neighbour in (("wrist_turn", "wrist_plate"), ("crank_turn", "crank")):
        out[turn].add(TOKEN_MASS, own=(TOKEN_SHARE * xx, TOKEN_SHARE * yy, TOKEN_SHARE * zz))
        out[neighbour].add(-TOKEN_MASS)
    less = -2.0 * TOKEN_SHARE
    out["link_1"].add(0.0, own=(less * xx, less * yy, less * zz))
    x, y, z = base.inertia
    mass = base.mass - len(wheels) * TOKEN_MASS
    out["base"].add(mass, own=(x - 3.0 * rotor, y - 3.0 * rotor, z - 3.0 * rotor))
    return out


def _lump(vehicle: Vehicle, part: Part, out: dict[str, Body]) -> None:
    """Add a part of the arm to the bodies that move like it."""
    arm, (ox, oz), (a1, a2, a3) = vehicle.arm, part.offset, part.along
    carrier = part.turns_with
    plain = abs(ox) < _EPSILON and abs(oz) < _EPSILON

    def point(mass: float, b1: float, b2: float, own: Vec3 = (0.0, 0.0, 0.0)) -> None:
        """A mass that translates with mount + offset + b1 u(theta_1) + b2 u(theta_2), and does not turn."""
        at_elbow, at_wrist = abs(b1 - arm.link_1) < _EPSILON, abs(b2 - arm.link_2) < _EPSILON
        if at_elbow and at_wrist:
            out["wrist_plate"].add(mass, ox, oz, own)
        elif at_elbow and abs(b2) < _EPSILON:
            out["elbow_plate"].add(mass, ox, oz, own)
        elif abs(b1) < _EPSILON and abs(b2) < _EPSILON:
            out[SHOULDER].add(mass, ox, oz, own)
        elif plain and own == (0.0, 0.0, 0.0) and (at_elbow or abs(b1) < _EPSILON):
            out["link_2" if at_elbow else "crank"].add(mass, b2)
        else:
            raise ValueError(f"vehicle.arm: part {part.name} is at no pin of the parallelogram")

    def bar(length: float, a: float, ends: tuple[tuple[float, float], tuple[float, float]]) -> None:
        """A bar between two pins, its centre ``a`` from the first: its mass at the pins, its moment on the link."""
        share = a / length
        point((1.0 - share) * part.mass, *ends[0])
        point(share * part.mass, *ends[1])
        excess = part.mass * a * (length - a)
        along, about, across = part.inertia
        out[_LINK_OF[carrier]].add(0.0, own=(along, about - excess, across - excess))

    if carrier is Carrier.BASE:
        point(part.mass, a1, a2, part.inertia)
    elif carrier is Carrier.LINK_1 and plain and abs(a2) < _EPSILON:
        out["link_1"].add(part.mass, a1, own=part.inertia)
    elif carrier is Carrier.LINK_1:
        bar(arm.link_1, a1, ((0.0, a2), (arm.link_1, a2)))
    elif carrier is Carrier.LINK_2 and plain and abs(a1) < _EPSILON:
        out["crank"].add(part.mass, a2, own=part.inertia)
    elif carrier is Carrier.LINK_2 and plain and abs(a1 - arm.link_1) < _EPSILON:
        out["link_2"].add(part.mass, a2, own=part.inertia)
    elif carrier is Carrier.LINK_2:
        bar(arm.link_2, a2, ((a1, 0.0), (a1, arm.link_2)))
    elif plain and abs(a1 - arm.link_1) < _EPSILON and abs(a2 - arm.link_2) < _EPSILON:
        out["tool"].add(part.mass, a3, own=part.inertia)
    else:
        raise ValueError(f"vehicle.arm: part {part.name} is not fixed to the tool at the wrist")
    if a3 != 0.0 and carrier is not Carrier.TOOL:
        raise ValueError(f"vehicle.arm: part {part.name} moves with the tool but does not turn with it")
