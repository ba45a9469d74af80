"""Safety: conditions over facts, one table, and the most severe action wins.

A condition is a row of ``TABLE``: a predicate that holds while all is *well*, how long it may be violated, what is
demanded then on the ground, in free flight and in contact, and how it clears. The table is printed, with its
bounds, in docs/safety.md.

- Predicates say ``value <= bound``, so that a NaN violates them; every float is also checked for being finite, at
  once. The two conditions that cut the motors are the exception: what is not finite never does that. A sample
  from the future is as bad as an old one: its age would never tell.
- The ground are the phases PREFLIGHT and STOPPED: nothing is demanded there beyond a warning (preflight itself
  refuses to start), but for a tipped vehicle with its motors armed. In contact is where contact is expected.
- Without position or attitude the core cannot fly: such conditions demand LAND, and ``blind`` tells the mission to
  keep any retreat short and to let the autopilot land by itself.
- A condition clears when all has been well for ``clear_time``; a latched one only in PREFLIGHT, after a reset.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from math import inf
from types import MappingProxyType
from typing import Annotated, Final, NamedTuple

from msgspec import Struct

from drivers.samples import Vec3
from onboard.core.spec import spec
from onboard.core.types import Action, Phase, Severity, Verdict

Says = tuple[str, Severity, str]
"""Code, severity and text of an event; the caller stamps the time."""


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """Bounds, and the time for which each may be violated (none: at once)."""

    clear_time: Annotated[float, spec("s", 0.0, 60.0, "all well for this long clears a condition")] = 1.0
    non_finite_time: Annotated[float, spec("s", 0.0, 2.0, "of values that are not finite, before landing")] = 0.10

    odometry_late: Annotated[float, spec("s", 0.01, 2.0, "age of the odometry")] = 0.15
    odometry_lost: Annotated[float, spec("s", 0.02, 5.0, "age of the odometry at which the position is lost")] = 0.5
    odometry_jump: Annotated[float, spec("m", 0.005, 5.0, "jump between samples beyond the possible motion")] = 0.08
    odometry_wild: Annotated[float, spec("m", 0.05, 50.0, "jump at which the position is lost")] = 1.0
    confidence_low: Annotated[float, spec("1", 0.0, 3.0, "tracker confidence")] = 2.0
    confidence_low_time: Annotated[float, spec("s", 0.0, 10.0, "of low confidence")] = 0.5
    confidence_none: Annotated[float, spec("1", 0.0, 3.0, "tracker confidence at which the position is lost")] = 1.0
    confidence_none_time: Annotated[float, spec("s", 0.0, 10.0, "of no confidence")] = 0.3
    disagreement: Annotated[float, spec("rad", 0.01, 1.0, "between the verticals of odometry and autopilot")] = 0.15
    disagreement_time: Annotated[float, spec("s", 0.0, 10.0, "of disagreement")] = 0.5
    autopilot_late: Annotated[float, spec("s", 0.01, 2.0, "age of the attitude")] = 0.10
    autopilot_lost: Annotated[float, spec("s", 0.02, 5.0, "age at which the attitude is lost")] = 0.4
    servos_late: Annotated[float, spec("s", 0.01, 2.0, "age of the servo state")] = 0.10
    servos_lost: Annotated[float, spec("s", 0.02, 5.0, "age at which the arm is lost")] = 0.5
    offboard_lost_time: Annotated[float, spec("s", 0.0, 5.0, "out of offboard")] = 0.0
    disarmed_time: Annotated[float, spec("s", 0.0, 5.0, "disarmed in flight")] = 0.30

    tilt: Annotated[float, spec("rad", 0.1, 1.5, "of the body")] = 0.60
    tilt_time: Annotated[float, spec("s", 0.0, 5.0, "of too much tilt")] = 0.20
    tipped: Annotated[float, spec("rad", 0.5, 3.2, "tilt at which the vehicle has tipped over")] = 1.40
    tipped_time: Annotated[float, spec("s", 0.0, 5.0, "tipped over")] = 0.40
    fence_low: tuple[
        Annotated[float, spec("m", -1000.0, 1000.0, "least x, W")],
        Annotated[float, spec("m", -1000.0, 1000.0, "least y, W")],
        Annotated[float, spec("m", -1000.0, 1000.0, "least z, W")],
    ] = (-10.0, -10.0, -1.0)
    fence_high: tuple[
        Annotated[float, spec("m", -1000.0, 1000.0, "largest x, W")],
        Annotated[float, spec("m", -1000.0, 1000.0, "largest y, W")],
        Annotated[float, spec("m", -1000.0, 1000.0, "largest z, W: the height")],
    ] = (10.0, 10.0, 6.0)
    fence_margin: Annotated[float, spec("m", 0.1, 100.0, "outside of the fence by this: landing")] = 1.0
    fence_time: Annotated[float, spec("s", 0.0, 5.0, "outside of the fence")] = 0.10

    force: Annotated[float, spec("N", 0.5, 50.0, "estimated contact force, either sign")] = 8.0
    force_time: Annotated[float, spec("s", 0.0, 2.0, "of too much force")] = 0.10
    contact_force: Annotated[float, spec("N", -1.0, 3.0, "least estimated force while pressing")] = 0.05
    contact_time: Annotated[float, spec("s", 0.0, 10.0, "without force while pressing")] = 0.5
    free_force: Annotated[float, spec("N", 0.2, 50.0, "external force where no contact should be")] = 5.0
    free_force_time: Annotated[float, spec("s", 0.0, 10.0, "of force where no contact should be")] = 0.5

    servo_error_time: Annotated[float, spec("s", 0.0, 5.0, "of hardware-error bits")] = 0.05
    torque_off_time: Annotated[float, spec("s", 0.0, 5.0, "in flight without servo torque")] = 0.10
    temperature_warm: Annotated[float, spec("degC", 0.0, 100.0, "of the hottest servo")] = 60.0
    temperature_hot: Annotated[float, spec("degC", 0.0, 100.0, "of the hottest servo")] = 68.0
    temperature_time: Annotated[float, spec("s", 0.0, 10.0, "too warm or too hot")] = 1.0
    servo_voltage_min: Annotated[float, spec("V", 0.0, 24.0, "least servo voltage")] = 4.2
    servo_voltage_max: Annotated[float, spec("V", 0.0, 24.0, "largest servo voltage")] = 6.0
    servo_voltage_time: Annotated[float, spec("s", 0.0, 10.0, "of servo voltage out of range")] = 0.5
    joint_error: Annotated[float, spec("rad", 0.02, 3.2, "of the worst arm joint against its reference")] = 0.5
    joint_error_time: Annotated[float, spec("s", 0.0, 10.0, "of joint error")] = 1.0

    link_silent: Annotated[float, spec("s", 0.3, 60.0, "since the commanding station was heard: hold")] = 2.0
    link_lost: Annotated[float, spec("s", 0.5, 600.0, "since the commanding station was heard: land")] = 10.0

    battery_low: Annotated[float, spec("1", 0.0, 1.0, "remaining charge")] = 0.25
    battery_low_voltage: Annotated[float, spec("V", 0.0, 60.0, "battery voltage")] = 14.0
    battery_critical: Annotated[float, spec("1", 0.0, 1.0, "remaining charge")] = 0.12
    battery_critical_voltage: Annotated[float, spec("V", 0.0, 60.0, "battery voltage")] = 13.4
    battery_time: Annotated[float, spec("s", 0.0, 30.0, "of low battery (voltage sags under load)")] = 2.0

    tick_late: Annotated[float, spec("s", 0.001, 1.0, "time between two ticks")] = 0.020
    tick_slow: Annotated[float, spec("s", 0.001, 1.0, "time between two ticks, sustained")] = 0.010
    tick_slow_time: Annotated[float, spec("s", 0.0, 10.0, "of slow ticks: hold")] = 0.5
    tick_stalled_time: Annotated[float, spec("s", 0.0, 20.0, "of slow ticks: land")] = 2.0


class Facts(Struct, frozen=True, gc=False):
    """What the predicates need in one tick."""

    phase: Phase
    airborne: bool
    armed: bool
    contact_expected: bool
    """Contact may be: ADVANCE, PRESS, RELEASE, RETREAT, and the retreats to hold or land out of them."""
    pressing: bool
    """The force loop is closed on contact."""
    age_odometry: float
    age_autopilot: float
    age_servos: float
    """Ages of the samples, s; infinity before the first, negative in the future."""
    odometry_jump: float
    """Displacement between the last two samples beyond the possible motion, m; 0 when there is no new sample."""
    odometry_reset: bool
    """The tracker's reset counter has changed."""
    confidence: float
    """0 failed, 1 low, 2 medium, 3 high."""
    tilt: float
    """Angle between z of B and z of W, rad."""
    position: Vec3
    """m, W."""
    contact_force: float
    """Estimated compressive force, N."""
    free_flight_force: float
    """Magnitude of the estimated external force, N."""
    servo_error: int
    """Hardware-error bits of all servos, or-ed."""
    temperature: float
    """Of the hottest servo, degC."""
    servo_voltage_min: float
    servo_voltage_max: float
    """Lowest and highest over the servos, V."""
    torque_on: bool
    joint_error: float
    """Largest joint tracking error, rad."""
    battery_voltage: float
    """V."""
    battery_remaining: float
    """Fraction, 0..1."""
    dt: float
    """Measured time since the last tick, s."""
    inputs_finite: bool
    """Everything that came from the devices is finite."""
    offboard_lost: bool
    """The autopilot was in offboard and has left it without being asked; true in that tick, or from then on."""
    disagreement: float = 0.0
    """Angle between the verticals of odometry and autopilot, rad."""
    missing: str = ""
    """Names of the devices that have not told anything yet; their ages count as 0."""
    obstacles: str = ""
    """Sentences on why the vehicle must not arm, from outside the core."""
    commander: str = ""
    """Name of the station that commands; empty: nobody does."""
    link_age: float = 0.0
    """Time since the commander was certainly there, s; 0 when nobody commands."""


# --- the table --------------------------------------------------------------------------------------------------------


class Clears(StrEnum):
    """How a condition ends."""

    WELL = "after clear_time"
    LATCHED = "latched"


class Group(StrEnum):
    """Phase groups that the actions are told apart by."""

    GROUND = "ground"
    FREE = "free flight"
    CONTACT = "contact"


class Actions(NamedTuple):
    """What is demanded in each phase group."""

    ground: Action
    free: Action
    contact: Action

    def of(self, group: Group) -> Action:
        """What is demanded in one."""
        if group is Group.GROUND:
            return self.ground
        return self.contact if group is Group.CONTACT else self.free


class Condition(NamedTuple):
    """One row: ``code`` is active once ``well`` has been false for the time of that parameter (None: at once)."""

    code: str
    well: Callable[[Facts, Params], bool]
    time: str | None
    actions: Actions
    clears: Clears


WARNS: Final = Actions(Action.WARN, Action.WARN, Action.WARN)
WARNS_GROUNDED: Final = Actions(Action.WARN, Action.NONE, Action.NONE)
HOLDS: Final = Actions(Action.WARN, Action.HOLD, Action.RETREAT)
BACKS_OFF: Final = Actions(Action.WARN, Action.RETREAT, Action.RETREAT)
LANDS: Final = Actions(Action.WARN, Action.LAND, Action.LAND)
CUTS: Final = Actions(Action.WARN, Action.KILL, Action.KILL)
CUTS_ANYWHERE: Final = Actions(Action.KILL, Action.KILL, Action.KILL)
WELL, LATCHED = Clears


def _finite(f: Facts) -> bool:
    # Ages may be infinite before the first sample; their own predicates catch a NaN. A sum is NaN or infinite when
    # any of its terms is, and x - x is 0 only for a finite x.
    x, y, z = f.position
    total = (
        f.odometry_jump + f.confidence + f.tilt + x + y + z + f.contact_force + f.free_flight_force + f.temperature
        + f.servo_voltage_min + f.servo_voltage_max + f.joint_error + f.battery_voltage + f.battery_remaining + f.dt
        + f.disagreement + f.link_age
    )  # fmt: skip
    return f.inputs_finite and total - total == 0.0


def _inside(f: Facts, p: Params, margin: float) -> bool:
    if not f.airborne:
        return True
    x, y, z = f.position
    (x0, y0, z0), (x1, y1, z1) = p.fence_low, p.fence_high
    return (
        x0 - margin <= x <= x1 + margin and y0 - margin <= y <= y1 + margin and z0 - margin <= z <= z1 + margin
    )  # fmt: skip


def _no_stray_force(f: Facts, p: Params) -> bool:
    # The ground pushes too: in takeoff and landing that is no contact with the pipe.
    if not f.airborne or f.contact_expected or f.phase is Phase.TAKEOFF or f.phase is Phase.LAND:
        return True
    return f.free_flight_force <= p.free_force


# fmt: off
TABLE: Final[tuple[Condition, ...]] = (
    Condition("non_finite", lambda f, p: _finite(f), None, WARNS, WELL),
    Condition("non_finite_sustained", lambda f, p: _finite(f), "non_finite_time", LANDS, LATCHED),

    Condition("devices_missing", lambda f, p: not f.missing, None, WARNS, WELL),
    Condition("must_not_arm", lambda f, p: not (f.obstacles and f.phase is Phase.PREFLIGHT), None, WARNS_GROUNDED,
              WELL),

    Condition("odometry_late", lambda f, p: abs(f.age_odometry) <= p.odometry_late, None, HOLDS, WELL),
    Condition("odometry_lost", lambda f, p: abs(f.age_odometry) <= p.odometry_lost, None, LANDS, LATCHED),
    Condition("odometry_jump", lambda f, p: f.odometry_jump <= p.odometry_jump, None, HOLDS, WELL),
    Condition("odometry_wild", lambda f, p: f.odometry_jump <= p.odometry_wild, None, LANDS, LATCHED),
    Condition("odometry_reset", lambda f, p: not f.odometry_reset, None, HOLDS, WELL),
    Condition("odometry_unsure", lambda f, p: f.confidence >= p.confidence_low, "confidence_low_time", HOLDS, WELL),
    Condition("odometry_failed",
              lambda f, p: f.confidence >= p.confidence_none,
              "confidence_none_time", LANDS, LATCHED),
    Condition("odometry_disagrees",
              lambda f, p: not f.airborne or f.disagreement <= p.disagreement,
              "disagreement_time", LANDS, LATCHED),

    Condition("autopilot_late", lambda f, p: abs(f.age_autopilot) <= p.autopilot_late, None, HOLDS, WELL),
    Condition("autopilot_lost", lambda f, p: abs(f.age_autopilot) <= p.autopilot_lost, None, LANDS, LATCHED),
    Condition("offboard_lost", lambda f, p: not (f.offboard_lost and f.airborne), "offboard_lost_time", LANDS, LATCHED),
    Condition("disarmed",
              lambda f, p: f.armed or not f.airborne or f.phase is Phase.LAND,
              "disarmed_time", CUTS, LATCHED),

    Condition("servos_late", lambda f, p: abs(f.age_servos) <= p.servos_late, None, WARNS, WELL),
    Condition("servos_lost", lambda f, p: abs(f.age_servos) <= p.servos_lost, None, HOLDS, LATCHED),
    Condition("servo_error", lambda f, p: f.servo_error == 0, "servo_error_time", HOLDS, LATCHED),
    Condition("servo_torque", lambda f, p: f.torque_on or not f.airborne, "torque_off_time", HOLDS, LATCHED),
    Condition("servo_warm", lambda f, p: f.temperature <= p.temperature_warm, "temperature_time", WARNS, WELL),
    Condition("servo_hot", lambda f, p: f.temperature <= p.temperature_hot, "temperature_time", HOLDS, LATCHED),
    Condition("servo_voltage",
              lambda f, p: f.servo_voltage_min >= p.servo_voltage_min and f.servo_voltage_max <= p.servo_voltage_max,
              "servo_voltage_time", HOLDS, WELL),
    Condition("joint_error",
              lambda f, p: not f.airborne or f.joint_error <= p.joint_error,
              "joint_error_time", HOLDS, WELL),

    Condition("tilt", lambda f, p: not f.airborne or f.tilt <= p.tilt, "tilt_time", HOLDS, WELL),
    Condition("tipped", lambda f, p: not (f.armed and p.tipped < f.tilt < inf), "tipped_time", CUTS_ANYWHERE, LATCHED),
    Condition("fence", lambda f, p: _inside(f, p, 0.0), "fence_time", HOLDS, WELL),
    Condition("fence_breached", lambda f, p: _inside(f, p, p.fence_margin), "fence_time", LANDS, LATCHED),

    Condition("force_high",
              lambda f, p: not f.airborne or -p.force <= f.contact_force <= p.force,
              "force_time", BACKS_OFF, WELL),
    Condition("contact_lost",
              lambda f, p: not f.pressing or f.contact_force >= p.contact_force,
              "contact_time", WARNS, WELL),
    Condition("contact_stray", _no_stray_force, "free_force_time", BACKS_OFF, WELL),

    Condition("link_silent", lambda f, p: f.link_age <= p.link_silent, None, HOLDS, WELL),
    Condition("link_lost", lambda f, p: f.link_age <= p.link_lost, None, LANDS, WELL),

    Condition("battery_low",
              lambda f, p: f.battery_remaining >= p.battery_low and f.battery_voltage >= p.battery_low_voltage,
              "battery_time", BACKS_OFF, LATCHED),
    Condition("battery_critical",
              lambda f, p: (f.battery_remaining >= p.battery_critical
                            and f.battery_voltage >= p.battery_critical_voltage),
              "battery_time", LANDS, LATCHED),

    Condition("tick_late", lambda f, p: 0.0 <= f.dt <= p.tick_late, None, WARNS, WELL),
    Condition("tick_slow", lambda f, p: 0.0 <= f.dt <= p.tick_slow, "tick_slow_time", HOLDS, WELL),
    Condition("tick_stalled", lambda f, p: 0.0 <= f.dt <= p.tick_slow, "tick_stalled_time", LANDS, LATCHED),
)
# fmt: on

#: Of each condition: the violation, formatted with p (Params), and the event, formatted with f (Facts).
WORDS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType({
    "non_finite": ("any value is not finite", "A value is not finite: see the inputs of this tick."),
    "non_finite_sustained": (
        "any value is not finite, sustained",
        "Values are not finite: landing by the autopilot. Take over if you can.",
    ),

    "devices_missing": (
        "a device has not told anything yet",
        "Waiting for the first word of: {f.missing}. Check power and cables if this stays.",
    ),
    "must_not_arm": (
        "in PREFLIGHT, a reason not to arm from outside the core",
        "The vehicle must not arm. {f.obstacles}",
    ),

    "odometry_late": (
        "odometry older than {p.odometry_late} s",
        "Odometry is {f.age_odometry:.2f} s old: the tracker is silent, late, or repeats itself. Check cable and load.",
    ),
    "odometry_lost": (
        "odometry older than {p.odometry_lost} s",
        "Odometry is lost: position control is impossible. Restart the tracker on the ground.",
    ),
    "odometry_jump": (
        "position jumps by more than {p.odometry_jump} m",
        "Odometry jumped by {f.odometry_jump:.2f} m. Check that the pipe is where the mission believes it.",
    ),
    "odometry_wild": (
        "position jumps by more than {p.odometry_wild} m",
        "Odometry jumped by {f.odometry_jump:.2f} m: the position is lost.",
    ),
    "odometry_reset": (
        "the tracker has moved its frame",
        "The tracker has moved its frame. Check that the pipe is where the mission believes it.",
    ),
    "odometry_unsure": (
        "confidence below {p.confidence_low:g}",
        "The tracker's confidence is {f.confidence:g}. Give it light and texture.",
    ),
    "odometry_failed": (
        "confidence below {p.confidence_none:g}",
        "The tracker has lost itself: position control is impossible.",
    ),
    "odometry_disagrees": (
        "verticals of odometry and autopilot differ by more than {p.disagreement} rad",
        "Odometry and autopilot disagree about the vertical by {f.disagreement:.2f} rad: one of them is wrong.",
    ),

    "autopilot_late": (
        "attitude older than {p.autopilot_late} s",
        "The autopilot's attitude is {f.age_autopilot:.2f} s old. Check the link and its rates.",
    ),
    "autopilot_lost": (
        "attitude older than {p.autopilot_lost} s",
        "The autopilot is silent: asking it to land. Take over by radio.",
    ),
    "offboard_lost": (
        "the autopilot leaves offboard by itself in flight",
        "The autopilot left offboard: it, or a pilot, has command now.",
    ),
    "disarmed": ("disarmed in flight", "The autopilot disarmed in flight: the motors stay cut."),

    "servos_late": (
        "servo state older than {p.servos_late} s",
        "The servo bus is {f.age_servos:.2f} s behind. Check its cable and latency timer.",
    ),
    "servos_lost": (
        "servo state older than {p.servos_lost} s",
        "The servo bus is silent: the arm cannot be moved. Land, and check power and cable.",
    ),
    "servo_error": (
        "any hardware-error bit",
        "Servo trouble, bits {f.servo_error:#04x} (0x20 overload, 0x80 silent). Land, and see to the servo.",
    ),
    "servo_torque": ("servo torque off in flight", "The servos have no torque: the arm hangs. Land with care."),
    "servo_warm": (
        "hottest servo above {p.temperature_warm:g} degC",
        "A servo is at {f.temperature:.0f} degC: finish soon.",
    ),
    "servo_hot": (
        "hottest servo above {p.temperature_hot:g} degC",
        "A servo is at {f.temperature:.0f} degC: land and let it cool.",
    ),
    "servo_voltage": (
        "servo voltage outside {p.servo_voltage_min:g} to {p.servo_voltage_max:g} V",
        "Servo voltage is {f.servo_voltage_min:.1f} to {f.servo_voltage_max:.1f} V. Check the converter.",
    ),
    "joint_error": (
        "a joint is off its reference by more than {p.joint_error:g} rad in flight",
        "A joint is {f.joint_error:.2f} rad off its reference: the arm may be blocked.",
    ),

    "tilt": ("tilt above {p.tilt:g} rad in flight", "Tilt is {f.tilt:.2f} rad. Check wind and load."),
    "tipped": ("armed, and tilt above {p.tipped:g} rad", "The vehicle has tipped over: motors cut."),
    "fence": (
        "outside of the fence {p.fence_low} to {p.fence_high} m in flight",
        "Outside of the fence at {f.position[0]:.1f}, {f.position[1]:.1f}, {f.position[2]:.1f} m: land or fly back.",
    ),
    "fence_breached": (
        "outside of the fence by more than {p.fence_margin:g} m in flight",
        "Far outside of the fence: landing here.",
    ),

    "force_high": (
        "contact force beyond {p.force:g} N in flight",
        "Contact force is {f.contact_force:.1f} N. Check the pipe, then the force asked for.",
    ),
    "contact_lost": (
        "pressing with less than {p.contact_force:g} N (the mission presses again)",
        "No contact force while pressing.",
    ),
    "contact_stray": (
        "external force above {p.free_force:g} N in flight where no contact should be",
        "External force of {f.free_flight_force:.1f} N where none should be: an obstacle, wind, or the payload.",
    ),

    "link_silent": (
        "the commanding station silent for more than {p.link_silent:g} s",
        "{f.commander} commands, and is silent for {f.link_age:.1f} s. Bring it back into reach, or seize command.",
    ),
    "link_lost": (
        "the commanding station silent for more than {p.link_lost:g} s",
        "{f.commander} commands, and is lost: silent for {f.link_age:.1f} s. Seize command from another station.",
    ),

    "battery_low": (
        "battery below {p.battery_low:.0%} or {p.battery_low_voltage:g} V",
        "Battery low ({f.battery_voltage:.1f} V, {f.battery_remaining:.0%}): land now.",
    ),
    "battery_critical": (
        "battery below {p.battery_critical:.0%} or {p.battery_critical_voltage:g} V",
        "Battery critical ({f.battery_voltage:.1f} V, {f.battery_remaining:.0%}): landing.",
    ),

    "tick_late": (
        "a tick later than {p.tick_late:g} s",
        "A tick came after {f.dt:.3f} s. Look for what holds the computer up.",
    ),
    "tick_slow": (
        "ticks later than {p.tick_slow:g} s, sustained",
        "The loop is slow, {f.dt:.3f} s a tick. Look for what holds the computer up.",
    ),
    "tick_stalled": (
        "ticks later than {p.tick_slow:g} s, for long",
        "The loop stays slow, {f.dt:.3f} s a tick: landing.",
    ),
})  # fmt: skip

#: Conditions without which the core cannot know where it is: the autopilot must land by itself.
BLIND: Final = frozenset(
    {
        "non_finite_sustained",
        "odometry_lost",
        "odometry_wild",
        "odometry_failed",
        "odometry_disagrees",
        "autopilot_lost",
    }
)

_WELL_IN_ORDER: Final = tuple(condition.well for condition in TABLE)
_ON_GROUND: Final = (Phase.PREFLIGHT, Phase.STOPPED)
_EPSILON: Final = 1e-9
"""Time steps are summed: a debounce of n ticks must fire on the n-th."""


class State(Struct, frozen=True, gc=False):
    """One entry per condition, in the order of ``TABLE``."""

    active: tuple[bool, ...]
    time: tuple[float, ...]
    """Of an inactive condition, for how long it has been violated; of an active one, for how long all is well. s."""


CLEAR: Final = State((False,) * len(TABLE), (0.0,) * len(TABLE))
NOMINAL: Final = Verdict(Action.NONE, ())


def initial() -> State:
    """Nothing active, nothing pending."""
    return CLEAR


def blind(verdict: Verdict) -> bool:
    """Whether the core has lost position or attitude."""
    return verdict.action is Action.LAND and any(code in BLIND for code in verdict.reasons)


def yielded(verdict: Verdict) -> bool:
    """Whether the autopilot has left offboard by itself."""
    return "offboard_lost" in verdict.reasons


def debounce(condition: Condition, params: Params) -> float:
    """For how long the condition must be violated, s."""
    return 0.0 if condition.time is None else float(getattr(params, condition.time))


def group(facts: Facts) -> Group:
    """The phase group whose actions apply."""
    if facts.phase in _ON_GROUND:
        return Group.GROUND
    return Group.CONTACT if facts.contact_expected else Group.FREE


def step(state: State, facts: Facts, params: Params, dt: float) -> tuple[State, Verdict, tuple[Says, ...]]:
    """One tick: the state (the same object when nothing is amiss), the verdict, and what has begun or ended.

    dt: time to count debounces with, s; one that is not a positive number counts as none.
    """
    for well in _WELL_IN_ORDER:
        if not well(facts, params):
            break
    else:
        if state is CLEAR or state == CLEAR:
            return state, NOMINAL, ()
    return _judge(state, facts, params, dt if 0.0 < dt < 1.0 else 1.0 if dt >= 1.0 else 0.0)


def _judge(state: State, facts: Facts, params: Params, dt: float) -> tuple[State, Verdict, tuple[Says, ...]]:
    in_group = group(facts)
    active, times = list(state.active), list(state.time)
    demands: list[tuple[Action, str]] = []
    said: list[Says] = []
    for i, condition in enumerate(TABLE):
        well = condition.well(facts, params)
        if well == active[i]:  # on the way to the other state
            times[i] += dt
            latched = condition.clears is Clears.LATCHED and facts.phase is not Phase.PREFLIGHT
            needed = params.clear_time if active[i] else debounce(condition, params)
            if times[i] >= needed - _EPSILON and not (active[i] and latched):
                active[i], times[i] = not active[i], 0.0
                said.append(_event(condition, active[i], facts, params, in_group))
        else:
            times[i] = 0.0
        if active[i]:
            demands.append((condition.actions.of(in_group), condition.code))
    after = State(tuple(active), tuple(times))
    if after == CLEAR:
        after = CLEAR
    demands.sort(key=lambda demand: -demand[0])  # stable: of equals, the first in the table leads
    verdict = Verdict(demands[0][0], tuple(code for _, code in demands)) if demands else NOMINAL
    return after, verdict, tuple(said)


def _event(condition: Condition, begun: bool, facts: Facts, params: Params, in_group: Group) -> Says:
    bound, text = WORDS[condition.code]
    if not begun:
        return f"{condition.code}_cleared", Severity.INFO, f"Cleared: {bound.format(p=params)}."
    severity = Severity.ERROR if condition.actions.of(in_group) >= Action.HOLD else Severity.WARNING
    return condition.code, severity, text.format(f=facts)
