"""The checklist before a flight: what is known at one moment, judged row by row, each cross with its remedy.

``checks`` is a pure function and takes a millisecond, so that the link's thread can call it; what follows from the
parameters alone is worked out once for each set. What the station must judge itself (clocks, contact) it adds there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from math import atan2, degrees, hypot
from typing import Final

from msgspec import Struct

from drivers.rotation import heading
from drivers.samples import SERVO_NAMES, AutopilotState, FlightMode, Landed, Odometry, ServoState, Vec3
from drivers.xc330 import error_words
from onboard.config import Config
from onboard.core import math3, plan, safety
from onboard.core.derived import check_mission
from onboard.core.plan import InfeasibleError, Site
from onboard.core.types import LinkState, Phase, Tick
from onboard.device_config import Kind
from onboard.wire import Check

#: Achieved of what is asked for, from which on a rate is enough; a share of its current limit that no servo needs.
_ENOUGH, _STRAINED = 0.8, 0.8
#: Of the tracker's poses, Hz.
_POSES: Final = 200.0
#: A newest tick older than this is no news, s.
_SILENT: Final = 0.5
_GB: Final = 1e9
#: How the sentences of ``FlightDevices.obstacles`` begin that have a row of their own.
PARAMETERS, APART = "PX4's parameters", "PX4 believes"


class Late(Struct, frozen=True):
    """How late the ticks of the last seconds were, s."""

    p99: float
    max: float


class Lateness:
    """Remembers how late the newest ticks were. One thread adds, any may read."""

    def __init__(self, ticks: int = 2500) -> None:
        self._late: deque[float] = deque(maxlen=ticks)

    def add(self, late: float) -> None:
        """Begin of a tick against its schedule, s."""
        self._late.append(late)

    def newest(self) -> Late | None:
        """None before the first tick."""
        late = sorted(self._late.copy())
        return Late(late[round(0.99 * (len(late) - 1))], late[-1]) if late else None


class Known(Struct, frozen=True, kw_only=True):
    """What the flight process knows at one moment."""

    config: Config
    """In force."""
    t_ns: int
    """Now, on the clock of the ticks."""
    tick: Tick | None
    """The newest."""
    statistics: Mapping[str, float]
    """Of the newest ``DeviceReport``."""
    late: Late | None
    link: LinkState | None
    """None: no link is configured."""
    free: int | None
    """Bytes that the disk of the runs still takes; None: it does not tell."""
    log_error: str = ""
    """Why nothing is recorded any more."""
    log_dropped: int = 0
    """Records that were lost."""


def checks(known: Known) -> tuple[Check, ...]:
    """The whole list, the rows always in the same order."""
    return tuple(row for rows in _ROWS for row in rows(known))


# --- devices ----------------------------------------------------------------------------------------------------------

_REMEDIES: Final = {
    "autopilot": "Check its power and cable, and the baud rate of the link (devices.autopilot.url).",
    "odometry": "Check the tracker's USB cable; unplug it, plug it in again, and restart the flight process.",
    "servos": "Check the supply of the servos, the cable of the bus and its adapter.",
}


def _devices(known: Known) -> Iterator[Check]:
    bounds = known.config.safety
    for name, kind in known.config.devices.kinds().items():
        sample: AutopilotState | Odometry | ServoState | None
        sample = None if known.tick is None else getattr(known.tick.inputs, name)
        if known.tick is None or sample is None:
            yield Check(name, False, f"{kind}: has told nothing yet", _REMEDIES[name])
            continue
        age = (known.tick.inputs.t_ns - sample.t_ns) * 1e-9
        well = abs(age) <= getattr(bounds, f"{name}_late")
        yield _row(name, well, f"{kind}: newest word {1e3 * age:.0f} ms old", _REMEDIES[name])


def _rates(known: Known) -> Iterator[Check]:
    devices = known.config.devices
    wanted = {
        "autopilot": (("ATTITUDE_QUATERNION", "attitude"), ("HIGHRES_IMU", "IMU")),
        "odometry": (("POSE", "poses"),),
        "servos": (("", "servos"),),
    }
    rates = {"autopilot": devices.autopilot.rate, "odometry": _POSES, "servos": 1.0 / devices.servos.period}
    told, slow = [], []
    for device, kind in devices.kinds().items():
        for part, words in () if kind is Kind.MOCK else wanted[device]:
            rate = known.statistics.get(".".join(filter(None, (device, part, "rate"))), 0.0)
            told.append(f"{words} {rate:.0f} of {rates[device]:.0f} Hz")
            if not rate >= _ENOUGH * rates[device]:
                slow.append(words)
    remedy = (
        f"Too slow: {', '.join(slow)}. Look for load on this computer; PX4: a faster link (921600 baud, MAV_1_RATE); "
        "servos: the latency timer of the adapter (configs/udev)."
    )
    yield _row("rates", not slow, ", ".join(told) or "all devices are mock: nothing to measure", remedy)


def _parameters(known: Known) -> Iterator[Check]:
    settings = known.config.devices.autopilot
    different = [text for text in _obstacles(known) if text.startswith(PARAMETERS)]
    if different:
        remedy = f"Load {settings.parameters} in QGroundControl, or set them there, and restart PX4."
        yield Check("PX4 parameters", False, " ".join(different), remedy)
    elif settings.kind is Kind.MOCK:
        yield Check("PX4 parameters", True, "mock: it has none")
    elif not settings.parameters:
        remedy = "Name the file of the vehicle: devices.autopilot.parameters: x500.params"
        yield _row("PX4 parameters", settings.kind is not Kind.REAL, "are compared with no file", remedy)
    else:
        yield Check("PX4 parameters", True, f"as in {settings.parameters}")


def _vision(known: Known) -> Iterator[Check]:
    told = None if known.tick is None else known.tick.inputs
    if told is None or told.odometry is None or told.autopilot is None:
        yield Check("vision", False, "cannot be compared yet", "See the rows of autopilot and odometry.")
        return
    bounds, tracker, px4 = known.config.safety, told.odometry, told.autopilot
    up, its_up = math3.vertical(tracker.q_WB), math3.vertical(px4.q_WB)
    leaning = atan2(math3.norm(math3.cross(up, its_up)), math3.dot(up, its_up))
    turned = abs(math3.wrap_angle(heading(tracker.q_WB) - heading(px4.q_WB)))
    text = (
        f"confidence {tracker.confidence} of 3; PX4's vertical is {degrees(leaning):.1f} deg and its heading "
        f"{degrees(turned):.1f} deg off the tracker's"
    )
    apart = [words for words in _obstacles(known) if words.startswith(APART)]
    if not tracker.confidence >= bounds.confidence_low:
        yield Check("vision", False, text, "Give the tracker light and texture, and move the vehicle a little.")
    elif not leaning <= bounds.disagreement:
        remedy = (
            "Is the camera mounted as devices.odometry.mount says (pipewright calibrate mount)? Level PX4's sensors."
        )
        yield Check("vision", False, text, remedy)
    elif not turned <= bounds.disagreement:
        remedy = "PX4 must take its heading from vision (EKF2_EV_CTRL 15, EKF2_MAG_TYPE 5); then restart PX4."
        yield Check("vision", False, text, remedy)
    elif apart:
        remedy = "Restart PX4, then the flight process, with the vehicle where it will take off."
        yield Check("vision", False, " ".join(apart), remedy)
    else:
        yield Check("vision", True, text)


# --- power and servos -------------------------------------------------------------------------------------------------


def _batteries(known: Known) -> Iterator[Check]:
    bounds = known.config.safety
    px4 = None if known.tick is None else known.tick.inputs.autopilot
    if px4 is None:
        yield Check("battery", False, "not known yet", _REMEDIES["autopilot"])
    else:
        well = px4.battery_voltage >= bounds.battery_low_voltage and px4.battery_remaining >= bounds.battery_low
        text = f"{px4.battery_voltage:.1f} V, {px4.battery_remaining:.0%}"
        wanted = f"{bounds.battery_low_voltage:g} V and {bounds.battery_low:.0%}"
        yield _row("battery", well, text, f"Change or charge it: more than {wanted} are wanted.")
    servos = None if known.tick is None else known.tick.inputs.servos
    if servos is None:
        yield Check("servo supply", False, "not known yet", _REMEDIES["servos"])
        return
    low, high = min(servos.voltage), max(servos.voltage)
    well = low >= bounds.servo_voltage_min and high <= bounds.servo_voltage_max
    wanted = f"{bounds.servo_voltage_min:g} to {bounds.servo_voltage_max:g} V"
    yield _row("servo supply", well, f"{low:.1f} to {high:.1f} V", f"Check the converter: {wanted} are wanted.")


def _servos(known: Known) -> Iterator[Check]:
    servos = None if known.tick is None else known.tick.inputs.servos
    if servos is None:
        yield Check("servo health", False, "not known yet", _REMEDIES["servos"])
        return
    warm, settings = known.config.safety.temperature_warm, known.config.devices.servos.servos
    bad, remedies = [], []
    for i, name in enumerate(SERVO_NAMES):
        if servos.error[i]:
            bad.append(f"{name}: {error_words(servos.error[i])}")
            remedies.append("Find the cause of the error, then switch the servo's supply off and on.")
        if not servos.temperature[i] <= warm:
            bad.append(f"{name}: {servos.temperature[i]:.0f} degC")
            remedies.append(f"Let it cool below {warm:g} degC.")
        if not abs(servos.current[i]) <= _STRAINED * settings[i].current_limit:
            bad.append(f"{name}: {abs(servos.current[i]):.2f} A")
            remedies.append("Something blocks or loads the arm at rest: free it.")
    text = (
        f"no errors, {max(servos.temperature):.0f} degC at most, {max(map(abs, servos.current)):.2f} A at most, "
        f"torque {'on' if servos.torque_on else 'off'}"
    )
    yield _row("servo health", not bad, "; ".join(bad) or text, " ".join(dict.fromkeys(remedies)))


# --- the process ------------------------------------------------------------------------------------------------------


def _loop(known: Known) -> Iterator[Check]:
    remedy = "Look for what holds the computer up (top -H); see process.* and the processor's clock."
    if known.tick is None:
        yield Check("loop", False, "has made no tick yet", "Wait for the devices; see the journal of the vehicle.")
        return
    age = (known.t_ns - known.tick.inputs.t_ns) * 1e-9
    if not age <= _SILENT:
        yield Check("loop", False, f"has made no tick for {age:.1f} s", "It hangs. Restart the flight process.")
    elif known.late is None:
        yield Check("loop", True, "ticks")
    else:
        text = f"99 of 100 ticks less than {1e3 * known.late.p99:.1f} ms late, the worst {1e3 * known.late.max:.1f} ms"
        yield _row("loop", known.late.p99 <= known.config.safety.tick_slow, text, remedy)


def _disk(known: Known) -> Iterator[Check]:
    wanted = known.config.logs.free * _GB
    remedy = "Fetch the logs (pipewright log fetch), then remove old runs; or set logs.budget, and restart."
    if known.free is None:
        yield Check("disk", False, "does not tell how much it takes", "Check that the folder of the runs is there.")
    else:
        text = f"{known.free / _GB:.1f} GB free, {known.config.logs.free:g} GB wanted"
        yield _row("disk", known.free >= wanted, text, remedy)
    if known.log_error:
        remedy = "Nothing is recorded any more. Make room, or change the disk, then restart the flight process."
        yield Check("recorder", False, known.log_error, remedy)
    else:
        remedy = "The disk is too slow: use a faster one."
        yield _row("recorder", not known.log_dropped, f"{known.log_dropped} records lost", remedy)


def _link(known: Known) -> Iterator[Check]:
    link = known.link
    if link is None:
        yield Check("link", True, "none is configured")
    elif not link.commander:
        yield Check("link", True, "nobody commands; pipewright lease take")
    else:
        age = link.age(known.t_ns)
        well = link.present and age <= known.config.link.silence
        remedy = "Bring it back, or seize command: pipewright lease take --seize"
        there = f"heard {age:.1f} s ago" if link.present else "has gone"
        yield _row("link", well, f"{link.commander} commands, {there}", remedy)


# --- the mission ------------------------------------------------------------------------------------------------------


class _Course(Struct, frozen=True):
    """What a parameter set makes of the mission."""

    config: Config
    site: Site | None
    why_not: str = ""


_course: _Course | None = None


def _course_of(config: Config) -> _Course:
    """Worked out once for each parameter set."""
    global _course
    course = _course
    if course is None or course.config is not config:
        try:
            course = _Course(config, check_mission(config).site)
        except InfeasibleError as error:
            course = _Course(config, None, str(error))
        _course = course
    return course


def places(site: Site, config: Config, start: Vec3) -> tuple[tuple[str, Vec3], ...]:
    """Where the base (m, W) comes to in a mission from ``start``, with a word for each."""
    pipe, params = config.pipe, config.plan
    over = (start[0], start[1], start[2] + params.takeoff_height)
    there = plan.route((*over, 0.0, 0.0, 0.0, 0.0, 0.0), plan.beside(site, site.far), pipe, site, params)
    done = plan.beside(site, max(site.near - params.gap + params.retreat, params.clearance))
    back = plan.route((*done, 0.0, 0.0, 0.0, 0.0, 0.0), over, pipe, site, params)
    return (
        ("takeoff", over),
        *(("the way to the pipe", point) for point in there),
        ("the adhesive", plan.beside(site, site.needle)),
        ("the press", plan.beside(site, site.near - params.gap)),
        ("the retreat", done),
        *(("the way back", point) for point in back),
    )


def _fence(known: Known) -> Iterator[Check]:
    low, high = known.config.safety.fence_low, known.config.safety.fence_high
    site = _course_of(known.config).site
    start = _position(known)
    if start is None:
        yield Check("geofence", False, "the vehicle's place is not known yet", "See the row of odometry.")
        return
    points = (("the vehicle", start), *(places(site, known.config, start) if site is not None else ()))
    outside = [(words, point) for words, point in points if not _within(point, low, high)]
    if outside:
        words, point = outside[0]
        text = f"{words} at {_metres(point)} is outside of {_metres(low)} to {_metres(high)}"
        remedy = "Place the vehicle nearer, correct pipe.position, or widen safety.fence_low and safety.fence_high."
        yield Check("geofence", False, text, remedy)
    else:
        yield Check("geofence", True, f"the vehicle and {len(points) - 1} places of the mission are inside")


def _mission(known: Known) -> Iterator[Check]:
    course, start = _course_of(known.config), _position(known)
    remedy = "Change what it names: pipewright params set, or the configuration and pipewright params reload."
    if course.site is None:
        yield Check("mission", False, f"cannot be flown: {course.why_not}", remedy)
        return
    if start is not None and (room := _from_axis(start, known.config, course.site)) < known.config.plan.clearance:
        text = f"the vehicle stands {room:.2f} m beside the pipe's axis"
        remedy = f"Place it {known.config.plan.clearance:g} m (plan.clearance) or more away from it."
        yield Check("mission", False, text, remedy)
        return
    first, last = (degrees(angle) for angle in course.site.arc)
    away = (
        ""
        if start is None
        else f", {hypot(*(a - b for a, b in zip(start, course.site.crack, strict=True))):.1f} m away"
    )
    yield Check("mission", True, f"the pipe can be reached{away}, and adhesive laid from {first:.0f} to {last:.0f} deg")


def _from_axis(point: Vec3, config: Config, site: Site) -> float:
    """Horizontal distance (m) from the pipe's axis, or from its nearer end: takeoff leads straight up."""
    x, y = point[0] - config.pipe.position[0], point[1] - config.pipe.position[1]
    across = x * site.normal[0] + y * site.normal[1]
    along = abs(y * site.normal[0] - x * site.normal[1])
    return hypot(across, max(0.0, along - 0.5 * config.pipe.length))


def _position(known: Known) -> Vec3 | None:
    if known.tick is None or not known.tick.outputs.estimate.valid:
        return None
    return known.tick.outputs.estimate.p_WB


def _within(point: Vec3, low: Vec3, high: Vec3) -> bool:
    return all(a <= x <= b for x, a, b in zip(point, low, high, strict=True))


def _metres(point: Vec3) -> str:
    return f"({', '.join(f'{x:.1f}' for x in point)}) m"


# --- what else keeps it on the ground ---------------------------------------------------------------------------------


def _ground(known: Known) -> Iterator[Check]:
    if known.tick is None or (px4 := known.tick.inputs.autopilot) is None:
        yield Check("on the ground", False, "not known yet", _REMEDIES["autopilot"])
        return
    phase = known.tick.outputs.phase
    told = f"phase {phase}, {px4.landed.value.replace('_', ' ')}, {'armed' if px4.armed else 'disarmed'}"
    if phase is Phase.STOPPED:
        yield Check("on the ground", False, told, "Begin anew: pipewright reset")
    elif phase is not Phase.PREFLIGHT:
        yield Check("on the ground", False, told, "It flies. Land first: pipewright land, then pipewright reset")
    elif px4.armed:
        yield Check("on the ground", False, told, "Disarm it: pipewright land, or by radio.")
    elif px4.landed is not Landed.ON_GROUND:
        yield Check("on the ground", False, told, "Stand it level and still until PX4 knows that it has landed.")
    else:
        pilot = px4.mode is not FlightMode.OFFBOARD
        yield Check("on the ground", True, told + ("" if pilot else ", in offboard"))


def _arming(known: Known) -> Iterator[Check]:
    others = [text for text in _obstacles(known) if not text.startswith((PARAMETERS, APART))]
    remedy = "Bring about what it asks for; it may not arm before."
    yield _row("arming", not others, " ".join(others) or "nothing speaks against it", remedy)


def _safety(known: Known) -> Iterator[Check]:
    reasons = () if known.tick is None else known.tick.outputs.verdict.reasons
    conditions = {condition.code: condition for condition in safety.TABLE}
    words = [f"{code} ({safety.WORDS[code][0].format(p=known.config.safety)})" for code in reasons]
    latched = any(conditions[code].clears is safety.LATCHED for code in reasons)
    remedy = "Its event says what to do: pipewright events." + (" Then: pipewright reset" if latched else "")
    if known.tick is None:
        yield Check("safety", False, "has not judged yet", "Wait for the first tick.")
    else:
        yield _row("safety", not words, "; ".join(words) or "no condition is active", remedy)


def _obstacles(known: Known) -> tuple[str, ...]:
    return () if known.tick is None else known.tick.inputs.obstacles


def _row(name: str, ok: bool, text: str, remedy: str) -> Check:
    """The remedy is for a cross."""
    return Check(name, ok, text, "" if ok else remedy)


_ROWS: Final[tuple[Callable[[Known], Iterator[Check]], ...]] = (
    _devices,
    _rates,
    _parameters,
    _vision,
    _batteries,
    _servos,
    _loop,
    _disk,
    _link,
    _fence,
    _mission,
    _ground,
    _arming,
    _safety,
)
