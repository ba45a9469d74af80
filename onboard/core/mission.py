"""The mission: one table of transitions, and one function that reads it.

Three things move the mission: a person's request, an action that safety demands, and facts about the phase (its
end, or its time running out). A row of ``TABLE`` says: in these phases, on this cause, if this condition holds,
enter that phase (None refuses the request) and say this sentence. Rows are tried in order; the first that fits
wins.

- An action outranks a request that asks for less than it (``RANK``); such a request is refused. KILL always passes.
- STOP escalates and remembers nothing: where the vehicle is decides which request it stands for (``meant``).
- In contact, HOLD leads through RETREAT_HOLD and LAND through RETREAT_LAND. Contact are the phases PRESS, RELEASE
  and RETREAT (until it is clear of the pipe), and any other flying phase while ``Facts.in_contact``.
- Nothing resumes by itself. A hold inside TARE, ADVANCE or PRESS resumes at TARE. One inside RELEASE resumes at
  RETURN when the payload is gone, else at TARE (opening the gripper away from the pipe would drop the sleeve).
- GO leads from HOLD only, and only to where the way is known to be free: to APPROACH and RETURN, and, when the mission
  was interrupted beside the pipe, to what is done there. Whoever is not clear of the pipe retreats first.
- ARMED is on the ground: whatever breaks it off leads through LAND, which disarms, as a takeoff broken off does.
- Lost contact in PRESS goes back to TARE (the reference backs off, the observer is tared anew) and presses again;
  after ``max_attempts`` of these, or when ADVANCE (or ALIGN, feeling for the pipe) finds no contact in reach, the
  mission gives up: it retreats, returns and lands, and does not count as completed.
- The autopilot lands by itself (``State.autoland``) when the position is lost or LAND takes too long. Once it has
  left offboard by itself, or a pilot has taken it (``State.yielded``), nothing is asked of it any more but KILL.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from drivers.samples import Engage, Vec3
from onboard.core.spec import spec
from onboard.core.types import Action, Phase, Request, Severity

P, R, A = Phase, Request, Action
Says = tuple[str, Severity, str]
"""Code, severity and text of an event; the caller stamps the time."""


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """How long each phase may take, and how often contact may be lost."""

    preflight_timeout: Annotated[float, spec("s", 1.0, 86400.0, "without a start, then STOPPED")] = 3600.0
    armed_timeout: Annotated[float, spec("s", 1.0, 600.0, "idling on the ground without a takeoff, then LAND")] = 20.0
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
    """The force profile has ended, and contact is felt."""
    released: bool
    """The gripper is open and the payload gone."""
    tared: bool
    landed: bool
    """The autopilot reports the ground, and the thrust is low."""
    disarmed: bool
    in_contact: bool
    contact_lost: bool
    """While pressing: no force for the configured time, the tip slipping off or the vehicle swinging about it."""
    overtravel: bool = False
    """The tip is farther than where contact must have come."""
    blind: bool = False
    """The core cannot know where the vehicle is (``safety.blind``)."""
    offboard_lost: bool = False
    """The autopilot has left offboard by itself (``safety.yielded``)."""
    payload: bool = True
    """The sleeve is in the gripper."""
    tare: Vec3 = (0.0, 0.0, 0.0)
    """What the observer takes for no force, N, B."""
    tare_used: bool = True
    go: Phase | None = None
    """Where to, with a request to go."""


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
    armed: bool = False
    """In ARMED, the autopilot has armed."""
    taring: bool = False
    """In HOLD, a tare was asked for and is under way."""
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
ALL: Final = (*GROUND, P.ARMED, *FLYING)
#: Where a request to go may lead: always; and beside the pipe, when the mission was interrupted there.
GO_ALWAYS: Final = (P.APPROACH, P.RETURN)
GO_BESIDE: Final = (P.ALIGN, P.ADHESIVE, P.TOOL_CHANGE, P.TARE)

#: Where a phase is taken up again after a hold. RELEASE is decided by the payload, at the time of the request.
RESUMES_AT: Final[Mapping[Phase, Phase]] = MappingProxyType(
    {phase: phase for phase in (*FREE, *CONTACT)} | {P.ADVANCE: P.TARE, P.PRESS: P.TARE}
)
#: How much a request asks for, to weigh it against safety's action. RESET is judged by its rows alone; STOP stands for
#: another (``meant``).
RANK: Final[Mapping[Request, Action]] = MappingProxyType(
    dict.fromkeys((R.TAKEOFF, R.START, R.RESUME, R.ARM, R.TARE, R.GO), A.NONE)
    | {R.HOLD: A.HOLD, R.RETREAT: A.RETREAT, R.LAND: A.LAND, R.KILL: A.KILL, R.RESET: A.KILL}
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
    """Force profile ended, contact felt."""
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


def armed(state: State, facts: Facts, params: Params) -> bool:
    """The autopilot has armed."""
    return facts.engaged and not state.armed


def disarmed(state: State, facts: Facts, params: Params) -> bool:
    """The autopilot, which had armed, has disarmed or left offboard."""
    return state.armed and not facts.engaged


def late_unarmed(state: State, facts: Facts, params: Params) -> bool:
    """The phase's time is up, and the autopilot has not armed."""
    return not state.armed and late(state, facts, params)


def taring(state: State, facts: Facts, params: Params) -> bool:
    """A tare is under way."""
    return state.taring


def tare_done(state: State, facts: Facts, params: Params) -> bool:
    """A tare by hand is under way, and done."""
    return state.taring and facts.tared


def tare_unused(state: State, facts: Facts, params: Params) -> bool:
    """The observer does not use a tare."""
    return not facts.tare_used


def go_nowhere(state: State, facts: Facts, params: Params) -> bool:
    """No phase was named."""
    return facts.go is None


def go_to_contact(state: State, facts: Facts, params: Params) -> bool:
    """To a phase that only TARE leads to."""
    return facts.go in (P.ADVANCE, P.PRESS, P.RELEASE)


def go_elsewhere(state: State, facts: Facts, params: Params) -> bool:
    """To a phase that nobody can go to."""
    return facts.go not in (*GO_ALWAYS, *GO_BESIDE)


def go_without_sleeve(state: State, facts: Facts, params: Params) -> bool:
    """To work on the pipe, without the sleeve."""
    return facts.go is not P.RETURN and not facts.payload


def go_far_off(state: State, facts: Facts, params: Params) -> bool:
    """To a phase beside the pipe, and the mission was not interrupted there."""
    return facts.go in GO_BESIDE and state.resume_phase not in (*GO_BESIDE, *CONTACT)


def go_from_pipe(state: State, facts: Facts, params: Params) -> bool:
    """Not clear of the pipe."""
    return facts.in_contact or (not state.clear and state.resume_phase is not P.APPROACH)


def go_home_done(state: State, facts: Facts, params: Params) -> bool:
    """To RETURN, the sleeve released."""
    return facts.go is P.RETURN and facts.released


def go_home_undone(state: State, facts: Facts, params: Params) -> bool:
    """To RETURN."""
    return facts.go is P.RETURN


def not_killed(state: State, facts: Facts, params: Params) -> bool:
    """Not killed before."""
    return not state.killed


# --- the table --------------------------------------------------------------------------------------------------------

INTERRUPTED: Final = "interrupted"
"""In place of a phase: the one that was interrupted."""
NAMED: Final = "named"
"""In place of a phase: the one that a request to go names."""

Cause = Request | Action | None
"""None: the facts alone."""


class Row(NamedTuple):
    """In ``phases``, on one of ``causes``, if ``condition`` holds: enter ``to``, say ``code``, set the rest."""

    phases: tuple[Phase, ...]
    causes: tuple[Cause, ...]
    condition: Condition
    to: Phase | Literal["interrupted", "named"] | None
    code: str
    sets: Mapping[str, Any] = MappingProxyType({})


_START, _RESET, _RESUME, _FACTS = (R.START,), (R.RESET,), (R.RESUME,), (None,)
_HOLD, _RETREAT, _LAND, _KILL = (R.HOLD, A.HOLD), (R.RETREAT, A.RETREAT), (R.LAND, A.LAND), (R.KILL, A.KILL)
_UP, _ARM, _TARE, _GO = (R.START, R.TAKEOFF), (R.ARM,), (R.TARE,), (R.GO,)
_BREAK_OFF = (R.HOLD, R.RETREAT, R.LAND, A.HOLD, A.RETREAT, A.LAND)

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

    # Arm, start, reset, resume, go: requests alone.
    Row((P.PREFLIGHT,), _ARM, ready, P.ARMED, "arm"),
    Row((P.PREFLIGHT,), _START, ready, P.TAKEOFF, "start", {"mode": "mission"}),
    Row((P.PREFLIGHT,), (R.TAKEOFF,), ready, P.TAKEOFF, "takeoff", {"mode": "takeoff"}),
    Row((P.PREFLIGHT,), (*_UP, *_ARM), always, None, "refused_not_ready"),
    Row((P.ARMED,), _START, always, P.TAKEOFF, "start", {"mode": "mission"}),
    Row((P.ARMED,), (R.TAKEOFF,), always, P.TAKEOFF, "takeoff", {"mode": "takeoff"}),
    Row((P.ARMED,), _ARM, always, None, "refused_armed"),
    Row((P.HOLD,), _START, hover_only, P.APPROACH, "approach", {**_FRESH, "mode": "mission"}),
    Row((P.HOLD,), _START, always, None, "refused_started"),
    Row((P.STOPPED,), (*_UP, *_ARM), always, None, "refused_ended"),
    Row(FLYING, (*_UP, *_ARM), always, None, "refused_flying"),

    Row((P.STOPPED,), _RESET, off, P.PREFLIGHT, "reset"),
    Row((P.STOPPED,), _RESET, always, None, "refused_not_off"),
    Row((P.PREFLIGHT,), _RESET, always, None, "refused_preflight"),
    Row((P.ARMED, *FLYING), _RESET, always, None, "refused_reset"),

    Row((P.HOLD,), _RESUME, nothing_interrupted, None, "refused_nothing"),
    Row((P.HOLD,), _RESUME, out_of_release, P.RETURN, "return", {**_FRESH, "homeward": True}),
    Row((P.HOLD,), _RESUME, still_holding, P.TARE, "resume", _FRESH),
    Row((P.HOLD,), _RESUME, always, INTERRUPTED, "resume", _FRESH),
    Row((P.RETREAT_HOLD,), _RESUME, always, None, "refused_retreating"),
    Row((P.LAND, P.RETREAT_LAND), _RESUME, always, None, "refused_landing"),
    Row((P.ARMED, *FREE, *CONTACT, *GROUND), _RESUME, always, None, "refused_not_on_hold"),

    Row((P.HOLD,), _GO, go_nowhere, None, "refused_go_nowhere"),
    Row((P.HOLD,), _GO, go_to_contact, None, "refused_go_to_contact"),
    Row((P.HOLD,), _GO, go_elsewhere, None, "refused_go_elsewhere"),
    Row((P.HOLD,), _GO, go_without_sleeve, None, "refused_without_sleeve"),
    Row((P.HOLD,), _GO, go_far_off, None, "refused_go_far_off"),
    Row((P.HOLD,), _GO, go_from_pipe, None, "refused_beside"),
    Row((P.HOLD,), _GO, go_home_done, P.RETURN, "return", {**_FRESH, **_CLEAR, "homeward": True}),
    Row((P.HOLD,), _GO, go_home_undone, P.RETURN, "go_return", {**_FRESH, **_CLEAR, **_BROKEN_OFF}),
    Row((P.HOLD,), _GO, always, NAMED, "go", {**_FRESH, "mode": "mission"}),

    Row((P.HOLD,), _TARE, taring, None, "refused_taring"),
    Row((P.HOLD,), _TARE, tare_unused, None, "refused_tare_unused"),
    Row((P.HOLD,), _TARE, beside, None, "refused_beside"),
    Row((P.HOLD,), _TARE, arrived, P.HOLD, "tare_by_hand", {"taring": True}),
    Row((P.HOLD,), _TARE, always, None, "refused_moving"),

    Row((P.RETREAT_HOLD,), (*_GO, *_TARE), always, None, "refused_retreating"),
    Row((P.LAND, P.RETREAT_LAND), (*_GO, *_TARE), always, None, "refused_landing"),
    Row((*FREE, *CONTACT), (*_GO, *_TARE), always, None, "refused_hold_first"),
    Row((P.ARMED, *GROUND), (*_GO, *_TARE), always, None, "refused_grounded"),

    # Armed on the ground: whatever breaks it off.
    Row((P.ARMED,), _BREAK_OFF, always, P.LAND, "disarm"),

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
    Row((P.LAND, P.RETREAT_LAND), (R.LAND,), always, None, "refused_landing_already"),
    Row(GROUND, (R.LAND,), always, None, "refused_grounded"),

    # The autopilot or a pilot has taken command: the mission waits for the ground.
    Row((*FREE, *CONTACT, P.HOLD, P.RETREAT_HOLD, P.RETREAT_LAND), _FACTS, yielded, P.LAND, "yielded", _BROKEN_OFF),

    # The nominal chain: the end of each phase, and its timeout.
    Row((P.PREFLIGHT,), _FACTS, late, P.STOPPED, "timeout_preflight"),
    Row((P.ARMED,), _FACTS, armed, P.ARMED, "armed", {"armed": True}),
    Row((P.ARMED,), _FACTS, disarmed, P.LAND, "disarmed"),
    Row((P.ARMED,), _FACTS, late_unarmed, P.LAND, "timeout_arming"),
    Row((P.ARMED,), _FACTS, late, P.LAND, "timeout_armed"),
    Row((P.TAKEOFF,), _FACTS, up_for_mission, P.APPROACH, "approach"),
    Row((P.TAKEOFF,), _FACTS, up_for_hover, P.HOLD, "hover", {"resume_phase": None}),
    Row((P.TAKEOFF,), _FACTS, late, P.LAND, "timeout_takeoff"),
    Row((P.APPROACH,), _FACTS, arrived, P.ALIGN, "align"),
    Row((P.ALIGN,), _FACTS, arrived, P.ADHESIVE, "adhesive"),
    Row((P.ADHESIVE,), _FACTS, arrived, P.TOOL_CHANGE, "tool_change"),
    Row((P.TOOL_CHANGE,), _FACTS, arrived, P.TARE, "tare"),
    Row((P.TARE,), _FACTS, tared, P.ADVANCE, "advance"),
    Row((P.ADVANCE,), _FACTS, triggered, P.PRESS, "press"),
    Row((P.ALIGN, P.ADVANCE), _FACTS, overtravel, P.RETREAT_HOLD, "no_contact", _GIVE_UP),
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
    Row((P.HOLD,), _FACTS, tare_done, P.HOLD, "tared"),
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

#: What each code says; ``phase`` is the phase left (or gone on with), ``go`` the one asked for, ``attempt`` and ``max``
#: count presses begun again, ``tare`` is a force.
SENTENCES: Final[Mapping[str, tuple[Severity, str]]] = MappingProxyType({
    "start": (_I, "Taking off for the mission."),
    "takeoff": (_I, "Taking off to hover."),
    "arm": (_I, "Arming."),
    "armed": (_I, "Armed, the motors idle. Ask to take off or to start, or to land to disarm."),
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
    "go": (_I, "Going to {phase}, and on from there."),
    "go_return": (_W, "Returning without the repair, to land."),
    "tare_by_hand": (_I, "Taring the force observer: keep everything away from the vehicle."),
    "tared": (_I, "Tared: {tare} N along the body's x, y, z count as no force from now on."),
    "tare_broken_off": (_W, "The tare is broken off: the one before stays in force."),
    "reset": (_I, "Preflight begins anew."),
    "takeoff_aborted": (_W, "Takeoff broken off on the ground."),
    "disarm": (_W, "Broken off on the ground: disarming."),
    "disarmed": (_E, "The autopilot has disarmed or left offboard by itself. Read its messages before the next try."),
    "stopped": (_W, "On the ground and disarmed; the mission was not completed."),
    "press_again": (_W, "Contact lost, or swinging about it: backing off to press again, attempt {attempt} of {max}."),
    "press_given_up": (_E, "Contact lost, or swinging about it, too often: giving up. Check the pipe and the wind."),
    "no_contact": (_E, "No contact where the pipe should be: giving up and returning. Check the pipe's position."),
    "return_undone": (_W, "Clear of the pipe: returning without the repair."),
    "timeout": (_E, "{phase} took too long: hovering in place. Ask to resume, retreat or land."),
    "timeout_preflight": (_W, "No start was asked for in time. Ask to reset when ready."),
    "timeout_arming": (_E, "The autopilot did not arm in time: giving up. Read its messages."),
    "timeout_armed": (_W, "Nobody asked to take off in time: disarming."),
    "timeout_takeoff": (_E, "Takeoff took too long: landing. Check arming, offboard and thrust."),
    "timeout_contact": (_E, "{phase} took too long: retreating, then hovering. Ask to resume or to land."),
    "timeout_release": (_E, "The sleeve was not let go in time: retreating, then hovering. Check gripper and contact."),
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
    "refused_landing_already": (_W, "Landing already."),
    "refused_hold": (_W, "This landing cannot be broken off: the vehicle is down, or the core is not in command."),
    "refused_holding": (_W, "Hovering already."),
    "refused_clear": (_W, "The vehicle is clear of the pipe already."),
    "refused_grounded": (_W, "The vehicle is not flying."),
    "refused_armed": (_W, "Armed already: ask to take off or to start."),
    "refused_hold_first": (_W, "The mission is under way: ask to hold first."),
    "refused_moving": (_W, "The vehicle is not at rest yet: wait until it hovers still, then ask again."),
    "refused_beside": (_W, "The vehicle is beside the pipe: ask to retreat first, then again."),
    "refused_taring": (_W, "Taring already: wait for its end."),
    "refused_tare_unused": (_W, "The observer uses no tare: set observer.tare first."),
    "refused_go_nowhere": (_W, "Say which phase to go to: approach, align, adhesive, tool_change, tare or return."),
    "refused_go_to_contact": (_W, "Only the tare leads to {go}: ask to go to tare."),
    "refused_go_elsewhere": (
        _W, "Nobody can be sent to {go}: only to approach, align, adhesive, tool_change, tare or return."
    ),
    "refused_go_far_off": (_W, "The way to {go} is free only from beside the pipe: ask to go to approach."),
    "refused_without_sleeve": (_W, "The sleeve is gone: ask to go to return, or to land."),
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


def meant(request: Request, state: State, facts: Facts) -> Request:
    """The request that STOP stands for: to hold, in contact to retreat, and when that is done already, to land."""
    if request is not R.STOP:
        return request
    if state.phase in CONTACT or (state.phase in FREE and facts.in_contact):
        return R.RETREAT
    if state.phase in FREE or (state.phase is P.RETREAT_HOLD and state.giving_up):
        return R.HOLD
    return R.LAND


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
        asked = meant(request, state, facts)
        if action >= Action.HOLD and RANK[asked] < action:
            said = (_say("refused_outranked", prefix, action=action.name),)
        else:
            row = _first(asked, state, facts, params)
            if row is not None and row.to is None:
                said = (_say(row.code, prefix, go=facts.go.value if facts.go is not None else ""),)
                row = None
    if row is None and action >= Action.HOLD:
        row = _first(action, state, facts, params)
    if row is None:
        row = _first(None, state, facts, params)
    if row is None:
        # A dt that is not a positive number must not stop the clock for good.
        return replace(state, phase_time=state.phase_time + dt if dt > 0.0 else state.phase_time), said
    after = _enter(state, row, facts)
    tare = ", ".join(f"{force:+.2f}" for force in facts.tare)
    if state.taring and row.condition is not tare_done:
        said = (*said, _say("tared" if facts.tared else "tare_broken_off", tare=tare))
    subject = after.phase if row.to in (INTERRUPTED, NAMED) else state.phase
    event = _say(row.code, phase=subject.name, attempt=after.attempts, max=params.max_attempts, tare=tare)
    return after, (*said, event)


def _enter(state: State, row: Row, facts: Facts) -> State:
    if row.to is P.PREFLIGHT:
        return initial()
    phase = state.resume_phase if row.to == INTERRUPTED else facts.go if row.to == NAMED else row.to
    changes: dict[str, Any] = {"phase": phase, "phase_time": 0.0, "armed": False, "taring": False}
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
