"""The vehicle as URDF, made from its one description: the bodies of ``lumping``, what touches, and how they look."""

from __future__ import annotations

from math import atan2, hypot
from xml.etree import ElementTree as ET

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend.lumping import SHOULDER, SLEEVE, Inertial, bodies, inertial

#: Radius of the balls that touch pipe or ground, m.
TOUCH_RADIUS = 0.002
#: Links that are only there to look at; each one's joint turns by so much of theta_1 and theta_2.
BARS = {"rod": (1.0, -1.0), "level_rod_1": (1.0, 0.0), "level_rod_2": (0.0, 1.0)}
#: The link with the needle's tip.
NEEDLE = "needle"

_COLOURS = {
    "frame": (0.16, 0.18, 0.22),
    "battery": (0.25, 0.35, 0.55),
    "front": (0.85, 0.25, 0.20),
    "rear": (0.55, 0.58, 0.62),
    "arm": (0.95, 0.62, 0.12),
    "bar": (0.75, 0.75, 0.72),
    "tool": (0.20, 0.50, 0.70),
    "sleeve": (0.15, 0.65, 0.40),
}
_ORIGIN = (0.0, 0.0, 0.0)
_WEIGHTLESS = Inertial(1e-9, _ORIGIN, 0.0, (1e-12, 1e-12, 1e-12))


def urdf(vehicle: Vehicle, bars: bool = False, centre: Vec3 = _ORIGIN) -> str:
    """The URDF text of the vehicle with the sleeve in the gripper.

    The base's frame is B; all link frames are parallel to it while the joint angles, each against the link before, are
    zero. ``bars`` adds the parallelograms' bars as links to look at; their mass is in the other bodies already.
    ``centre`` is the base's centre of mass, m, B. Raises ValueError for an arm that is no such parallelogram.
    """
    arm, masses = vehicle.arm, bodies(vehicle)
    robot = ET.Element("robot", name="vehicle")
    for name, rgb in _COLOURS.items():
        material = ET.SubElement(robot, "material", name=name)
        ET.SubElement(material, "color", rgba=_text(*rgb, 1.0))
    _airframe(_link(robot, "base", inertial(masses["base"])._replace(centre=centre)), vehicle)
    if masses[SHOULDER].mass > 0.0:
        _link(robot, SHOULDER, inertial(masses[SHOULDER]))
        _joint(robot, SHOULDER, "base", arm.mount, turning=False)
    elbow, wrist = (arm.link_1, 0.0, 0.0), (arm.link_2, 0.0, 0.0)
    # Name, parent, origin in the parent.
    for name, parent, origin in (
        ("link_1", "base", arm.mount),
        ("link_2", "link_1", elbow),
        ("tool", "link_2", wrist),
        ("elbow_plate", "link_1", elbow),
        ("wrist_turn", "link_2", wrist),
        ("wrist_plate", "wrist_turn", _ORIGIN),
        ("crank_turn", "base", arm.mount),
        ("crank", "crank_turn", _ORIGIN),
        ("wheel_1", "base", _ORIGIN),
        ("wheel_2", "wheel_1", _ORIGIN),
        ("wheel_3", "wheel_2", _ORIGIN),
    ):
        if name not in masses:
            continue
        link = _link(robot, name, inertial(masses[name]))
        _joint(robot, name, parent, origin)
        if name in ("link_1", "link_2"):
            _rod(link, _ORIGIN, (arm.link_1 if name == "link_1" else arm.link_2, 0.0, 0.0), 0.008, "arm")
        elif name in ("elbow_plate", "wrist_plate"):
            _ball(link, _ORIGIN)
            _shape(link, "visual", _ORIGIN, "sphere", "arm", radius=0.016)
        elif name == "tool":
            _rod(link, _ORIGIN, (arm.gripper - 0.03, 0.0, 0.0), 0.013, "tool")
            _rod(link, _ORIGIN, (0.0, 0.0, arm.needle), 0.003, "rear")
            # Two capsules (pipe and tip) have a closed-form distance; anything else is iterated.
            tip = (arm.gripper - TOUCH_RADIUS, 0.0, 0.0)
            _shape(link, "collision", tip, "capsule", radius=TOUCH_RADIUS, length=1e-4)
    # A link of its own, since it touches what the gripper's tip does not, and the other way round.
    _ball(_link(robot, NEEDLE, _WEIGHTLESS), (0.0, 0.0, arm.needle - TOUCH_RADIUS))
    _joint(robot, NEEDLE, "tool", _ORIGIN, turning=False)
    sleeve = arm.sleeve
    reach = sleeve.along[2]
    look = _link(robot, SLEEVE, Inertial(sleeve.mass, (reach, 0.0, 0.0), 0.0, sleeve.inertia))
    _shape(look, "visual", (arm.gripper - 0.02, 0.0, 0.0), "box", "sleeve", size=(0.04, 0.10, 0.07))
    _joint(robot, SLEEVE, "tool", _ORIGIN, turning=False)
    if bars:
        _bars(robot, vehicle)
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode")


def _airframe(link: ET.Element, vehicle: Vehicle) -> None:
    """What the base touches with, and how it looks."""
    base, rotors = vehicle.base, vehicle.rotors
    span, height = base.gear_span, base.gear_height
    _shape(link, "visual", (0.0, 0.0, 0.01), "box", "frame", size=(0.20, 0.14, 0.05))
    _shape(link, "visual", (-0.02, 0.0, -0.035), "box", "battery", size=(0.14, 0.05, 0.04))
    for left in (-1.0, 1.0):
        for front in (-1.0, 1.0):
            hub = (front * rotors.arm_x, left * rotors.arm_y, 0.0)
            colour = "front" if front > 0.0 else "rear"
            _ball(link, hub)
            _ball(link, (front * span, left * span, TOUCH_RADIUS - height))
            _rod(link, _ORIGIN, hub, 0.008, "frame")
            disc = (hub[0], hub[1], 0.03)
            _shape(link, "visual", disc, "cylinder", colour, radius=rotors.radius, length=0.004)
        _rod(link, (-span, left * span, 0.005 - height), (span, left * span, 0.005 - height), 0.005, "frame")
        _rod(link, (0.0, 0.4 * left * span, 0.0), (0.0, left * span, 0.005 - height), 0.006, "frame")


def _bars(robot: ET.Element, vehicle: Vehicle) -> None:
    """The bars that the chain does without, where the parts of the vehicle say that they are."""
    arm, parts = vehicle.arm, {part.name: part for part in vehicle.arm.parts}
    for name in BARS:
        if name not in parts:
            continue
        part = parts[name]
        x, z = part.offset
        if name == "level_rod_2":
            parent, origin = "elbow_plate", (x, 0.0, z)
        elif part.along[1] != 0.0:
            parent, origin = "crank", (part.along[1], 0.0, 0.0)
        else:
            parent, origin = "base", (arm.mount[0] + x, arm.mount[1], arm.mount[2] + z)
        link = _link(robot, name, _WEIGHTLESS)
        _rod(link, _ORIGIN, (arm.link_2 if parent == "elbow_plate" else arm.link_1, 0.0, 0.0), 0.003, "bar")
        _joint(robot, name, parent, origin)


def _link(robot: ET.Element, name: str, body: Inertial) -> ET.Element:
    xx, yy, zz = body.moments
    if not (body.mass > 0.0 and min(xx, yy, zz) >= 0.0 and 2.0 * max(xx, yy, zz) <= (1.0 + 1e-9) * (xx + yy + zz)):
        raise ValueError(f"vehicle: {name} has no possible mass and inertia: {body.mass} kg, {(xx, yy, zz)} kg m^2")
    link = ET.SubElement(robot, "link", name=name)
    inside = ET.SubElement(link, "inertial")
    ET.SubElement(inside, "origin", xyz=_text(*body.centre), rpy=_text(0.0, body.pitch, 0.0))
    ET.SubElement(inside, "mass", value=_text(body.mass))
    values = {"ixx": xx, "iyy": yy, "izz": zz, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
    ET.SubElement(inside, "inertia", {key: _text(value) for key, value in values.items()})
    return link


def _joint(robot: ET.Element, child: str, parent: str, origin: Vec3, turning: bool = True) -> None:
    """The joint of a link, of the link's name; angles are positive about -y, as in ``drivers.vehicle``."""
    joint = ET.SubElement(robot, "joint", name=child, type="continuous" if turning else "fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_text(*origin), rpy=_text(*_ORIGIN))
    if turning:
        ET.SubElement(joint, "axis", xyz=_text(0.0, -1.0, 0.0))


def _ball(link: ET.Element, at: Vec3) -> None:
    """A point that touches ground and pipe."""
    _shape(link, "collision", at, "sphere", radius=TOUCH_RADIUS)


def _rod(link: ET.Element, start: Vec3, end: Vec3, radius: float, colour: str) -> None:
    """A cylinder to look at between two points."""
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]), 0.5 * (start[2] + end[2]))
    turn = (0.0, atan2(hypot(x, y), z), atan2(y, x))
    length = hypot(x, y, z)
    _shape(link, "visual", middle, "cylinder", colour, turn, radius=radius, length=length)


def _shape(
    link: ET.Element,
    use: str,
    at: Vec3,
    kind: str,
    colour: str = "",
    turn: Vec3 = _ORIGIN,
    **sizes: float | Vec3,
) -> None:
    element = ET.SubElement(link, use)
    ET.SubElement(element, "origin", xyz=_text(*at), rpy=_text(*turn))
    attributes = {key: _text(*(value if isinstance(value, tuple) else (value,))) for key, value in sizes.items()}
    ET.SubElement(ET.SubElement(element, "geometry"), kind, attributes)
    if colour:
        ET.SubElement(element, "material", name=colour)


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
