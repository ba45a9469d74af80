"""The mission: one table of transitions, and one function that reads it.

Three things move the mission: a person's request, an action that safety demands, and facts about the phase (its
end, or its time running out). A row of ``TABLE`` says: in these phases, on this cause, if this condition holds,
enter that phase (None refuses the request) and say this sentence. Rows are tried in order; the first that fits
wins.

- An action outranks a request that asks for less than it (``RANK``); such a request is refused. KILL always passes.
- In contact, HOLD leads through RETREAT_HOLD and LAND through RETREAT_LAND. Contact are the phases PRESS, RELEASE
  and RETREAT (until it is clear of the pipe), and any other flying phase while ``Facts.in_contact``.
- Nothing resumes by itself. A hold inside TARE, ADVANCE or PRESS resumes at TARE. One inside RELEASE resumes at
  RETURN when the payload is gone, else at TARE (opening the gripper away from the pipe would drop the sleeve).
- Lost contact in PRESS goes back to TARE (the reference backs off, the observer is tared anew) and presses again;
  after ``max_attempts`` of these, or when ADVANCE finds no contact in time or in reach, the mission gives up: it
  retreats, returns and lands, and does not count as completed.
- The autopilot lands by itself (``State.autoland``) when the position is lost or LAND takes too long. Once it has
  left offboard by itself, or a pilot has taken it (``State.yielded``), nothing is asked of it any more but KILL.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from drivers.samples import Engage
from onboard.core.spec import spec
from onboard.core.types import Action, Phase, Request, Severity

P, R, A = Phase, Request, Action
Says = tuple[str, Severity, str]
"""Code, severity and text of an event; the caller stamps the time."""


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """How long each phase may take, and how often contact may be lost."""

    preflight_timeout: Annotated[float, spec("s", 1.0, 86400.0, "without a start, then STOPPED")] = 3600.0
    takeoff_timeout: Annotated[float, spec("s", 1.0, 600.0, "then LAND")] = 30.0
    approach_timeout: Annotated[float, spec("s", 1.0, 600.0, "then HOLD")] = 120.0
    align_timeout: Annotated[float, spec("s", 1.0, 600.0, "then HOLD")] = 60.0
    adhesive_timeout: Annotated[float, spec("s", 1.0, 600.0, "then HOLD")] = 120.0
    tool_change_timeout: Annotated[float, spec("s", 1.0, 600.0, "then HOLD")] = 60.0
    tare_timeout: Annotated[float, spec("s", 1.0, 600.0, "then HOLD")] = 60.0
    advance_timeout: Annotated[float, spec("s", 1.0, 600.0, "no contact: give up (RETREAT_HOLD, RETURN, LAND)")] = 45.0
    press_timeout: Annotated[float, spec("s", 1.0, 600.0, "then RETREAT_HOLD")] = 180.0
    release_timeout: Annotated[float, spec("s", 1.0, 600.0, "then RETREAT_HOLD")] = 20.0
    retreat_timeout: Annotated[float, spec("s", 1.0, 600.0, "then RETREAT_HOLD")] = 30.0
    return_timeout: Annotated[float, spec("s", 1.0, 600.0, "then HOLD")] = 120.0
    land_timeout: Annotated[float, spec("s", 1.0, 600.0, "then LAND by the autopilot itself")] = 60.0
    hold_timeout: Annotated[float, spec("s", 1.0, 3600.0, "hover without a request, then LAND")] = 300.0
    retreat_hold_timeout: Annotated[float, spec("s", 1.0, 600.0, "then HOLD where it is")] = 30.0
    retreat_land_timeout: Annotated[float, spec("s", 1.0, 600.0, "then LAND where it is")] = 30.0
    blind_retreat_time: Annotated[float, spec("s", 0.0, 5.0, "dead-reckoned retreat without position, then LAND")] = 1.5
    max_attempts: Annotated[int, spec("1", 0, 10, "presses begun again after lost contact before giving up")] = 3


class Facts(Struct, frozen=True, gc=False):
    """What the mission needs to know in one tick."""

    ready: bool
    """Preflight passed: devices valid, on the ground, battery charged."""
    engaged: bool
    """Armed and in offboard."""
    airborne: bool
    arrived: bool
    """The phase's motion has ended and the vehicle has settled."""
    triggered: bool
    """The contact trigger has fired."""
    pressed: bool
    """The force profile has ended."""
    released: bool
    """The gripper is open and the payload gone."""
    tared: bool
    landed: bool
    """The autopilot reports the ground, and the thrust is low."""
    disarmed: bool
    in_contact: bool
    contact_lost: bool
    """No contact force for the configured time while pressing."""
    overtravel: bool = False
    """The tip is farther than where contact must have come."""
    blind: bool = False
    """The core cannot know where the vehicle is (``safety.blind``)."""
    offboard_lost: bool = False
    """The autopilot has left offboard by itself (``safety.yielded``)."""


class State(Struct, frozen=True, gc=False):
    """Where the mission stands."""

    phase: Phase
    phase_time: float
    """Time since the phase was entered, s."""
    resume_phase: Phase | None = None
    """The phase that was interrupted."""
    mode: Literal["takeoff", "mission"] = "mission"
    completed: bool = False
    """The sleeve was released onto the pipe, the vehicle came back and landed."""
    attempts: int = 0
    """Presses begun again after lost contact."""
    giving_up: bool = False
    """RETREAT_HOLD goes on to RETURN."""
    homeward: bool = False
    """The work is done and the way back not broken off."""
    clear: bool = True
    """No pipe is near: there is nothing to retreat from."""
    autoland: bool = False
    """In LAND, the autopilot lands by itself."""
    yielded: bool = False
    """The autopilot, or a pilot, has taken command."""
    killed: bool = False


def initial() -> State:
    """On the ground, before preflight."""
    return State(Phase.PREFLIGHT, 0.0)


# --- groups of phases -------------------------------------------------------------------------------------------------

GROUND: Final = (P.PREFLIGHT, P.STOPPED)
BESIDE: Final = (P.APPROACH, P.ALIGN, P.ADHESIVE, P.TOOL_CHANGE, P.TARE, P.ADVANCE)
CONTACT: Final = (P.PRESS, P.RELEASE, P.RETREAT)
FREE: Final = (P.TAKEOFF, *BESIDE, P.RETURN)
SAFE: Final = (P.HOLD, P.RETREAT_HOLD, P.RETREAT_LAND, P.LAND)
FLYING: Final = (*FREE, *CONTACT, *SAFE)
ALL: Final = (*GROUND, *FLYING)

#: Where a phase is taken up again after a hold. RELEASE is decided by the payload, at the time of the request.
RESUMES_AT: Final[Mapping[Phase, Phase]] = MappingProxyType(
    {phase: phase for phase in (*FREE, *CONTACT)} | {P.ADVANCE: P.TARE, P.PRESS: P.TARE}
)
#: How much a request asks for, to weigh it against safety's action. RESET is judged by its rows alone.
RANK: Final[Mapping[Request, Action]] = MappingProxyType(
    {R.TAKEOFF: A.NONE, R.START: A.NONE, R.RESUME: A.NONE, R.HOLD: A.HOLD, R.RETREAT: A.RETREAT, R.LAND: A.LAND}
    | {R.KILL: A.KILL, R.RESET: A.KILL}
)

# --- conditions -------------------------------------------------------------------------------------------------------

Condition = Callable[[State, Facts, Params], bool]


def always(state: State, facts: Facts, params: Params) -> bool:
    """In any case."""
    return True


def late(state: State, facts: Facts, params: Params) -> bool:
    """The phase's time is up."""
    return state.phase_time > float(getattr(params, f"{state.phase.value}_timeout"))


def ready(state: State, facts: Facts, params: Params) -> bool:
    """Preflight passed."""
    return facts.ready


def arrived(state: State, facts: Facts, params: Params) -> bool:
    """Motion ended and settled."""
    return facts.arrived


def standing(state: State, facts: Facts, params: Params) -> bool:
    """Not yet off the ground."""
    return not facts.airborne


def off(state: State, facts: Facts, params: Params) -> bool:
    """On the ground and disarmed."""
    return facts.landed and facts.disarmed


def off_and_done(state: State, facts: Facts, params: Params) -> bool:
    """On the ground and disarmed, the work done."""
    return facts.landed and facts.disarmed and state.homeward


def up_for_mission(state: State, facts: Facts, params: Params) -> bool:
    """At the takeoff height, a mission asked for."""
    return facts.engaged and facts.airborne and facts.arrived and state.mode == "mission"


def up_for_hover(state: State, facts: Facts, params: Params) -> bool:
    """At the takeoff height, no mission asked for."""
    return facts.engaged and facts.airborne and facts.arrived and state.mode == "takeoff"


def tared(state: State, facts: Facts, params: Params) -> bool:
    """Settled and the observer tared."""
    return facts.arrived and facts.tared


def touching(state: State, facts: Facts, params: Params) -> bool:
    """The tool is in contact."""
    return facts.in_contact


def triggered(state: State, facts: Facts, params: Params) -> bool:
    """The contact trigger fired."""
    return facts.triggered


def overtravel(state: State, facts: Facts, params: Params) -> bool:
    """The tip is past the pipe's surface."""
    return facts.overtravel


def lost_again(state: State, facts: Facts, params: Params) -> bool:
    """Contact lost, attempts left."""
    return facts.contact_lost and state.attempts < params.max_attempts


def lost_for_good(state: State, facts: Facts, params: Params) -> bool:
    """Contact lost, no attempt left."""
    return facts.contact_lost


def pressed(state: State, facts: Facts, params: Params) -> bool:
    """Force profile ended."""
    return facts.pressed


def released(state: State, facts: Facts, params: Params) -> bool:
    """Gripper open, payload gone."""
    return facts.released


def gave_up(state: State, facts: Facts, params: Params) -> bool:
    """Motion ended and settled, the mission given up."""
    return facts.arrived and state.giving_up


def giving_up(state: State, facts: Facts, params: Params) -> bool:
    """The mission is given up."""
    return state.giving_up


def beside(state: State, facts: Facts, params: Params) -> bool:
    """Near the pipe or in contact."""
    return facts.in_contact or not state.clear


def can_hover(state: State, facts: Facts, params: Params) -> bool:
    """In the air, and the core in command."""
    return facts.airborne and not state.autoland and not state.yielded


def can_hover_touching(state: State, facts: Facts, params: Params) -> bool:
    """In the air, the core in command, the tool in contact."""
    return facts.in_contact and can_hover(state, facts, params)


def hover_only(state: State, facts: Facts, params: Params) -> bool:
    """Hovering after a takeoff that was all that was asked for."""
    return state.mode == "takeoff" and state.resume_phase is None


def nothing_interrupted(state: State, facts: Facts, params: Params) -> bool:
    """No phase was interrupted."""
    return state.resume_phase is None


def out_of_release(state: State, facts: Facts, params: Params) -> bool:
    """RELEASE was interrupted, the payload is gone."""
    return state.resume_phase is P.RELEASE and facts.released


def still_holding(state: State, facts: Facts, params: Params) -> bool:
    """RELEASE was interrupted, the payload is still held."""
    return state.resume_phase is P.RELEASE


def blind(state: State, facts: Facts, params: Params) -> bool:
    """No position, the autopilot not yet landing."""
    return facts.blind and not state.autoland and not state.yielded


def blind_long_enough(state: State, facts: Facts, params: Params) -> bool:
    """No position, the short retreat made."""
    return facts.blind and state.phase_time > params.blind_retreat_time


def yielded(state: State, facts: Facts, params: Params) -> bool:
    """The autopilot or a pilot has command."""
    return state.yielded


def late_in_command(state: State, facts: Facts, params: Params) -> bool:
    """The phase's time is up, the core in command."""
    return not state.yielded and late(state, facts, params)


def late_touching(state: State, facts: Facts, params: Params) -> bool:
    """The phase's time is up, the tool in contact."""
    return facts.in_contact and late(state, facts, params)


def not_killed(state: State, facts: Facts, params: Params) -> bool:
    """Not killed before."""
    return not state.killed


# --- the table --------------------------------------------------------------------------------------------------------

INTERRUPTED: Final = "interrupted"
"""In place of a phase: the one that was interrupted."""

Cause = Request | Action | None
"""None: the facts alone."""


class Row(NamedTuple):
    """In ``phases``, on one of ``causes``, if ``condition`` holds: enter ``to``, say ``code``, set the rest."""

    phases: tuple[Phase, ...]
    causes: tuple[Cause, ...]
    condition: Condition
    to: Phase | Literal["interrupted"] | None
    code: str
    sets: Mapping[str, Any] = MappingProxyType({})


_START, _RESET, _RESUME, _FACTS = (R.START,), (R.RESET,), (R.RESUME,), (None,)
_HOLD, _RETREAT, _LAND, _KILL = (R.HOLD, A.HOLD), (R.RETREAT, A.RETREAT), (R.LAND, A.LAND), (R.KILL, A.KILL)
_GO = (R.START, R.TAKEOFF)

_FRESH = {"resume_phase": None, "attempts": 0, "giving_up": False}
_GIVE_UP = {"giving_up": True}
_BROKEN_OFF = {"homeward": False}
_AUTOLAND = {"autoland": True}
_CLEAR = {"clear": True}

# fmt: off
TABLE: Final[tuple[Row, ...]] = (
    # Kill: from everywhere, at once.
    Row(ALL, _KILL, not_killed, P.STOPPED, "killed", {"killed": True}),
    Row((P.STOPPED,), (R.KILL,), always, None, "refused_killed"),

    # Start, reset, resume: requests alone.
    Row((P.PREFLIGHT,), _START, ready, P.TAKEOFF, "start", {"mode": "mission"}),
    Row((P.PREFLIGHT,), (R.TAKEOFF,), ready, P.TAKEOFF, "takeoff", {"mode": "takeoff"}),
    Row((P.PREFLIGHT,), _GO, always, None, "refused_not_ready"),
    Row((P.HOLD,), _START, hover_only, P.APPROACH, "approach", {**_FRESH, "mode": "mission"}),
    Row((P.HOLD,), _START, always, None, "refused_started"),
    Row((P.STOPPED,), _GO, always, None, "refused_ended"),
    Row(FLYING, _GO, always, None, "refused_flying"),

    Row((P.STOPPED,), _RESET, off, P.PREFLIGHT, "reset"),
    Row((P.STOPPED,), _RESET, always, None, "refused_not_off"),
    Row((P.PREFLIGHT,), _RESET, always, None, "refused_preflight"),
    Row(FLYING, _RESET, always, None, "refused_reset"),

    Row((P.HOLD,), _RESUME, nothing_interrupted, None, "refused_nothing"),
    Row((P.HOLD,), _RESUME, out_of_release, P.RETURN, "return", {**_FRESH, "homeward": True}),
    Row((P.HOLD,), _RESUME, still_holding, P.TARE, "resume", _FRESH),
    Row((P.HOLD,), _RESUME, always, INTERRUPTED, "resume", _FRESH),
    Row((P.RETREAT_HOLD,), _RESUME, always, None, "refused_retreating"),
    Row((P.LAND, P.RETREAT_LAND), _RESUME, always, None, "refused_landing"),
    Row((*FREE, *CONTACT, *GROUND), _RESUME, always, None, "refused_not_on_hold"),

    # Hold.
    Row((P.TAKEOFF,), _HOLD, standing, P.LAND, "takeoff_aborted"),
    Row((*FREE, P.HOLD), _HOLD, touching, P.RETREAT_HOLD, "retreat_hold"),
    Row(FREE, _HOLD, always, P.HOLD, "hold"),
    Row(CONTACT, _HOLD, always, P.RETREAT_HOLD, "retreat_hold"),
    Row((P.RETREAT_LAND,), (R.HOLD,), can_hover, P.RETREAT_HOLD, "retreat_hold"),
    Row((P.LAND,), (R.HOLD,), can_hover_touching, P.RETREAT_HOLD, "retreat_hold"),
    Row((P.LAND,), (R.HOLD,), can_hover, P.HOLD, "hold"),
    Row((P.LAND, P.RETREAT_LAND), (R.HOLD,), always, None, "refused_hold"),
    Row((P.RETREAT_HOLD,), (R.HOLD,), giving_up, P.RETREAT_HOLD, "retreat_hold"),
    Row((P.RETREAT_HOLD,), (R.HOLD,), always, None, "refused_retreating"),
    Row((P.HOLD,), (R.HOLD,), always, None, "refused_holding"),
    Row(GROUND, (R.HOLD,), always, None, "refused_grounded"),

    # Retreat.
    Row((P.TAKEOFF,), _RETREAT, standing, P.LAND, "takeoff_aborted"),
    Row((*FREE, P.HOLD), _RETREAT, beside, P.RETREAT_HOLD, "retreat_hold"),
    Row(FREE, _RETREAT, always, P.HOLD, "hold"),
    Row(CONTACT, _RETREAT, always, P.RETREAT_HOLD, "retreat_hold"),
    Row((P.HOLD,), (R.RETREAT,), always, None, "refused_clear"),
    Row((P.RETREAT_HOLD, P.RETREAT_LAND), (R.RETREAT,), always, None, "refused_retreating"),
    Row((P.LAND,), (R.RETREAT,), always, None, "refused_landing"),
    Row(GROUND, (R.RETREAT,), always, None, "refused_grounded"),

    # Land.
    Row((*FREE, P.HOLD), _LAND, touching, P.RETREAT_LAND, "retreat_land", _BROKEN_OFF),
    Row((*FREE, P.HOLD), _LAND, always, P.LAND, "land", _BROKEN_OFF),
    Row((*CONTACT, P.RETREAT_HOLD), _LAND, always, P.RETREAT_LAND, "retreat_land", _BROKEN_OFF),
    Row((P.LAND, P.RETREAT_LAND), (R.LAND,), always, None, "refused_landing"),
    Row(GROUND, (R.LAND,), always, None, "refused_grounded"),

    # The autopilot or a pilot has taken command: the mission waits for the ground.
    Row((*FREE, *CONTACT, P.HOLD, P.RETREAT_HOLD, P.RETREAT_LAND), _FACTS, yielded, P.LAND, "yielded", _BROKEN_OFF),

    # The nominal chain: the end of each phase, and its timeout.
    Row((P.PREFLIGHT,), _FACTS, late, P.STOPPED, "timeout_preflight"),
    Row((P.TAKEOFF,), _FACTS, up_for_mission, P.APPROACH, "approach"),
    Row((P.TAKEOFF,), _FACTS, up_for_hover, P.HOLD, "hover", {"resume_phase": None}),
    Row((P.TAKEOFF,), _FACTS, late, P.LAND, "timeout_takeoff"),
    Row((P.APPROACH,), _FACTS, arrived, P.ALIGN, "align"),
    Row((P.ALIGN,), _FACTS, arrived, P.ADHESIVE, "adhesive"),
    Row((P.ADHESIVE,), _FACTS, arrived, P.TOOL_CHANGE, "tool_change"),
    Row((P.TOOL_CHANGE,), _FACTS, arrived, P.TARE, "tare"),
    Row((P.TARE,), _FACTS, tared, P.ADVANCE, "advance"),
    Row((P.ADVANCE,), _FACTS, triggered, P.PRESS, "press"),
    Row((P.ADVANCE,), _FACTS, overtravel, P.RETREAT_HOLD, "no_contact", _GIVE_UP),
    Row((P.ADVANCE,), _FACTS, late, P.RETREAT_HOLD, "no_contact", _GIVE_UP),
    Row((P.PRESS,), _FACTS, lost_again, P.TARE, "press_again"),
    Row((P.PRESS,), _FACTS, lost_for_good, P.RETREAT_HOLD, "press_given_up", _GIVE_UP),
    Row((P.PRESS,), _FACTS, pressed, P.RELEASE, "release"),
    Row((P.PRESS,), _FACTS, late, P.RETREAT_HOLD, "timeout_contact"),
    Row((P.RELEASE,), _FACTS, released, P.RETREAT, "retreat"),
    Row((P.RELEASE,), _FACTS, late, P.RETREAT_HOLD, "timeout_release"),
    Row((P.RETREAT,), _FACTS, arrived, P.RETURN, "return", {"homeward": True, **_CLEAR}),
    Row((P.RETREAT,), _FACTS, late, P.RETREAT_HOLD, "timeout_contact"),
    Row((P.RETURN,), _FACTS, arrived, P.LAND, "land", {"resume_phase": None}),
    Row((*BESIDE, P.RETURN), _FACTS, late_touching, P.RETREAT_HOLD, "timeout_contact"),
    Row((*BESIDE, P.RETURN), _FACTS, late, P.HOLD, "timeout"),
    Row((P.LAND,), _FACTS, off_and_done, P.STOPPED, "completed", {"completed": True}),
    Row((P.LAND,), _FACTS, off, P.STOPPED, "stopped"),
    Row((P.LAND,), _FACTS, blind, P.LAND, "autoland_blind", _AUTOLAND),
    Row((P.LAND,), _FACTS, late_in_command, P.LAND, "autoland_late", _AUTOLAND),

    # The safe states.
    Row((P.HOLD,), _FACTS, late_touching, P.RETREAT_LAND, "timeout_hold", _BROKEN_OFF),
    Row((P.HOLD,), _FACTS, late, P.LAND, "timeout_hold", _BROKEN_OFF),
    Row((P.RETREAT_HOLD,), _FACTS, gave_up, P.RETURN, "return_undone", {**_FRESH, **_CLEAR}),
    Row((P.RETREAT_HOLD,), _FACTS, arrived, P.HOLD, "hold", _CLEAR),
    Row((P.RETREAT_HOLD,), _FACTS, late, P.HOLD, "timeout", {"giving_up": False, **_CLEAR}),
    Row((P.RETREAT_LAND,), _FACTS, arrived, P.LAND, "land", _CLEAR),
    Row((P.RETREAT_LAND,), _FACTS, blind_long_enough, P.LAND, "land"),
    Row((P.RETREAT_LAND,), _FACTS, late, P.LAND, "timeout_landing"),
)
# fmt: on

_I, _W, _E = Severity.INFO, Severity.WARNING, Severity.ERROR

#: What each code says; ``phase`` is the phase left (or resumed), ``attempt`` and ``max`` count presses begun again.
SENTENCES: Final[Mapping[str, tuple[Severity, str]]] = MappingProxyType({
    "start": (_I, "Taking off for the mission."),
    "takeoff": (_I, "Taking off to hover."),
    "approach": (_I, "Flying to the pipe."),
    "align": (_I, "Turning to the pipe."),
    "adhesive": (_I, "Dispensing adhesive."),
    "tool_change": (_I, "Changing from needle to gripper."),
    "tare": (_I, "Taring the force observer."),
    "advance": (_I, "Advancing to the crack."),
    "press": (_I, "Contact: pressing."),
    "release": (_I, "Opening the gripper."),
    "retreat": (_I, "Sleeve released: retreating."),
    "return": (_I, "The sleeve is on the pipe: returning."),
    "land": (_I, "Landing."),
    "completed": (_I, "Mission completed."),
    "hover": (_I, "Takeoff done, hovering. Ask to start or to land."),
    "hold": (_I, "Hovering in place. Ask to resume, retreat or land."),
    "retreat_hold": (_I, "Taking any force back and retreating, then hovering."),
    "retreat_land": (_I, "Taking any force back and retreating, then landing."),
    "resume": (_I, "Going on with {phase}."),
    "reset": (_I, "Preflight begins anew."),
    "takeoff_aborted": (_W, "Takeoff broken off on the ground."),
    "stopped": (_W, "On the ground and disarmed; the mission was not completed."),
    "press_again": (_W, "Contact lost: backing off to press again, attempt {attempt} of {max}."),
    "press_given_up": (_E, "Contact lost too often: giving up and returning. Check the pipe and the wind."),
    "no_contact": (_E, "No contact where the pipe should be: giving up and returning. Check the pipe's position."),
    "return_undone": (_W, "Clear of the pipe: returning without the repair."),
    "timeout": (_E, "{phase} took too long: hovering in place. Ask to resume, retreat or land."),
    "timeout_preflight": (_W, "No start was asked for in time. Ask to reset when ready."),
    "timeout_takeoff": (_E, "Takeoff took too long: landing. Check arming, offboard and thrust."),
    "timeout_contact": (_E, "{phase} took too long: retreating, then hovering. Ask to resume or to land."),
    "timeout_release": (_E, "The gripper did not let go in time: retreating, then hovering. Check the gripper."),
    "timeout_hold": (_W, "Nobody asked for anything while hovering: landing here."),
    "timeout_landing": (_E, "The retreat took too long: landing here."),
    "autoland_blind": (_E, "Position lost: the autopilot lands by itself. Be ready to take over."),
    "autoland_late": (_E, "Landing takes too long: the autopilot lands by itself. Be ready to take over."),
    "yielded": (_E, "The autopilot or a pilot has command. Land it by hand, or let it land."),
    "killed": (_E, "Motors cut. Make the vehicle safe before you touch it."),
    "refused_outranked": (_W, "Safety demands {action}: see to its reasons first."),
    "refused_not_ready": (_W, "Preflight has not passed: see to the conditions shown, then ask again."),
    "refused_started": (_W, "The mission was started already: ask to resume, retreat or land."),
    "refused_ended": (_W, "The run has ended: ask to reset first."),
    "refused_flying": (_W, "The vehicle is under way already."),
    "refused_not_off": (_W, "Wait until the autopilot reports the ground and disarmed."),
    "refused_preflight": (_W, "Preflight is under way already."),
    "refused_reset": (_W, "Only when stopped on the ground: ask to land first."),
    "refused_nothing": (_W, "Nothing was interrupted: ask to start or to land."),
    "refused_not_on_hold": (_W, "Nothing is on hold."),
    "refused_retreating": (_W, "Retreating: wait until the vehicle is clear of the pipe."),
    "refused_landing": (_W, "Landing: ask to hold first."),
    "refused_hold": (_W, "This landing cannot be broken off: the vehicle is down, or the core is not in command."),
    "refused_holding": (_W, "Hovering already."),
    "refused_clear": (_W, "The vehicle is clear of the pipe already."),
    "refused_grounded": (_W, "The vehicle is not flying."),
    "refused_killed": (_W, "The motors are cut already."),
})  # fmt: skip


def _by_phase_and_cause() -> dict[tuple[Phase, Cause], tuple[Row, ...]]:
    found: dict[tuple[Phase, Cause], tuple[Row, ...]] = {}
    for row in TABLE:
        for phase in row.phases:
            for cause in row.causes:
                found[phase, cause] = (*found.get((phase, cause), ()), row)
    return found


_ROWS: Final = _by_phase_and_cause()


def _first(cause: Cause, state: State, facts: Facts, params: Params) -> Row | None:
    for row in _ROWS.get((state.phase, cause), ()):
        if row.condition(state, facts, params):
            return row
    return None


def _say(code: str, prefix: str = "", **words: object) -> Says:
    severity, text = SENTENCES[code]
    return code, severity, prefix + text.format(**words)


def step(
    state: State, request: Request | None, action: Action, facts: Facts, params: Params, dt: float
) -> tuple[State, tuple[Says, ...]]:
    """Advance by dt seconds; at most one transition. Returns the state and the events (code, severity, text)."""
    said: tuple[Says, ...] = ()
    if facts.offboard_lost and not state.yielded and state.phase not in GROUND:
        state = replace(state, yielded=True)
    row = None
    if request is not None:
        prefix = f"{request.value} refused. "
        if action >= Action.HOLD and RANK[request] < action:
            said = (_say("refused_outranked", prefix, action=action.name),)
        else:
            row = _first(request, state, facts, params)
            if row is not None and row.to is None:
                said = (_say(row.code, prefix),)
                row = None
    if row is None and action >= Action.HOLD:
        row = _first(action, state, facts, params)
    if row is None:
        row = _first(None, state, facts, params)
    if row is None:
        # A dt that is not a positive number must not stop the clock for good.
        return replace(state, phase_time=state.phase_time + dt if dt > 0.0 else state.phase_time), said
    after = _enter(state, row)
    subject = after.phase if row.code == "resume" else state.phase
    return after, (*said, _say(row.code, phase=subject.name, attempt=after.attempts, max=params.max_attempts))


def _enter(state: State, row: Row) -> State:
    if row.to is P.PREFLIGHT:
        return initial()
    phase = state.resume_phase if row.to == INTERRUPTED else row.to
    changes: dict[str, Any] = {"phase": phase, "phase_time": 0.0}
    if phase in SAFE and state.phase in RESUMES_AT:
        changes["resume_phase"] = RESUMES_AT[state.phase]
    if phase in BESIDE:
        changes["clear"] = False
    if phase is Phase.RETREAT_HOLD:
        changes["giving_up"] = False
    if row.condition is lost_again:
        changes["attempts"] = state.attempts + 1
    return replace(state, **(changes | dict(row.sets)))


def engage(state: State, facts: Facts) -> Engage:
    """What is wanted of the autopilot. Landed in LAND: IDLE, which disarms, and does nothing in the air."""
    if state.killed:
        return Engage.KILL
    if state.phase in GROUND or state.yielded:
        return Engage.IDLE
    if state.phase is Phase.LAND and facts.landed:
        return Engage.IDLE
    if state.phase is Phase.LAND and state.autoland:
        return Engage.LAND
    return Engage.OFFBOARD
