"""The mission against rules written down here, not against its own table."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import islice, product
from math import inf, nan
from typing import Any

import pytest
from msgspec.structs import replace

from drivers.samples import Engage
from onboard.core import mission
from onboard.core.mission import Facts, Params, State, step
from onboard.core.types import Action, Phase, Request, Severity

P = Params()
DT = 0.004
NOTHING = Facts(
    ready=False, engaged=False, airborne=False, arrived=False, triggered=False, pressed=False, released=False,
    tared=False, landed=False, disarmed=False, in_contact=False, contact_lost=False,
)  # fmt: skip
FLYING = replace(NOTHING, engaged=True, airborne=True)
DOWN = replace(NOTHING, landed=True, disarmed=True)

ON_GROUND = {Phase.PREFLIGHT, Phase.STOPPED}
TOOL_IN_PIPE = {Phase.PRESS, Phase.RELEASE, Phase.RETREAT}
LANDING = {Phase.LAND, Phase.RETREAT_LAND}
STANDING = ON_GROUND | {Phase.ARMED}
NOMINAL = [
    Phase.PREFLIGHT, Phase.TAKEOFF, Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE,
    Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, Phase.RETURN, Phase.LAND, Phase.STOPPED,
]  # fmt: skip
WORK = set(NOMINAL) - ON_GROUND - {Phase.LAND}


def run(state: State, request: Request | None = None, action: Action = Action.NONE, facts: Facts = FLYING) -> State:
    return step(state, request, action, facts, P, DT)[0]


def situations(phase: Phase) -> Iterator[tuple[State, Facts]]:
    """Every combination of what the answer to a demand may depend on."""
    for airborne, contact, ready, clear in product((True, False), repeat=4):
        for resume, mode in product((None, Phase.ALIGN, Phase.RELEASE), ("mission", "takeoff")):
            for down, released in product((True, False), repeat=2):
                state = State(
                    phase, 0.5, resume_phase=resume, mode=mode, clear=clear  # type: ignore[arg-type]
                )  # fmt: skip
                facts = replace(
                    FLYING, airborne=airborne, in_contact=contact, ready=ready, landed=down, disarmed=down,
                    released=released,
                )  # fmt: skip
                yield state, facts


def demanded(phase: Phase, action: Action, state: State, facts: Facts, *, by_person: bool) -> Phase | None:
    """Where HOLD, RETREAT, LAND or KILL leads; None: nowhere."""
    if action is Action.KILL:
        return Phase.STOPPED
    if phase in ON_GROUND:
        return None
    if phase is Phase.ARMED:
        return Phase.LAND
    if phase is Phase.TAKEOFF and not facts.airborne and action is not Action.LAND:
        return Phase.LAND
    in_contact = phase in TOOL_IN_PIPE or facts.in_contact
    if action is Action.LAND:
        if phase in LANDING:
            return None
        return Phase.RETREAT_LAND if in_contact or phase is Phase.RETREAT_HOLD else Phase.LAND
    if phase in LANDING:
        if by_person and action is Action.HOLD and facts.airborne:
            return Phase.RETREAT_HOLD if phase is Phase.RETREAT_LAND or in_contact else Phase.HOLD
        return None
    if phase is Phase.RETREAT_HOLD:
        return None
    if in_contact or (action is Action.RETREAT and not state.clear):
        return Phase.RETREAT_HOLD
    return None if phase is Phase.HOLD else Phase.HOLD


def stopping(phase: Phase, facts: Facts) -> Action:
    """What a stop asks for, where the vehicle is."""
    if phase in {Phase.HOLD, Phase.RETREAT_HOLD, *STANDING, *LANDING}:
        return Action.LAND
    return Action.RETREAT if phase in TOOL_IN_PIPE or facts.in_contact else Action.HOLD


def asked(phase: Phase, request: Request, state: State, facts: Facts) -> Phase | None:
    """Where a request leads; None: it is refused."""
    if request is Request.STOP:
        return demanded(phase, stopping(phase, facts), state, facts, by_person=True)
    if request in (Request.HOLD, Request.RETREAT, Request.LAND, Request.KILL):
        return demanded(phase, Action[request.name], state, facts, by_person=True)
    if request is Request.RESET:
        return Phase.PREFLIGHT if phase is Phase.STOPPED and facts.landed and facts.disarmed else None
    if request is Request.ARM:
        return Phase.ARMED if phase is Phase.PREFLIGHT and facts.ready else None
    if request in (Request.START, Request.TAKEOFF) and (
        phase is Phase.ARMED or (phase is Phase.PREFLIGHT and facts.ready)
    ):
        return Phase.TAKEOFF
    if phase is not Phase.HOLD:
        return None
    if request is Request.START and state.mode == "takeoff" and state.resume_phase is None:
        return Phase.APPROACH
    if request is Request.RESUME and state.resume_phase is Phase.RELEASE:
        return Phase.RETURN if facts.released else Phase.TARE
    return state.resume_phase if request is Request.RESUME else None


@pytest.mark.parametrize("request_", Request)
@pytest.mark.parametrize("phase", Phase)
def test_every_phase_and_request(phase: Phase, request_: Request) -> None:
    for state, facts in situations(phase):
        wanted = asked(phase, request_, state, facts)
        after, said = step(state, request_, Action.NONE, facts, P, DT)
        if wanted is not None:
            assert after.phase is wanted, (state, facts)
            assert after.phase_time == 0.0
            assert not said[0][0].startswith("refused")
        else:
            code, severity, text = said[0]
            assert code.startswith("refused"), (state, facts)
            assert severity is Severity.WARNING
            assert text.startswith(f"{request_.value} refused. ")
            # A refused request changes nothing: the tick goes on as if it had not been made.
            assert after == run(state, None, Action.NONE, facts)
            assert said[1:] == step(state, None, Action.NONE, facts, P, DT)[1]


@pytest.mark.parametrize("action", Action)
@pytest.mark.parametrize("phase", Phase)
def test_every_phase_and_action(phase: Phase, action: Action) -> None:
    for state, facts in situations(phase):
        wanted = demanded(phase, action, state, facts, by_person=False) if action >= Action.HOLD else None
        after, said = step(state, None, action, facts, P, DT)
        if wanted is not None:
            assert after.phase is wanted, (state, facts)
            assert len(said) == 1
        else:
            assert (after, said) == step(state, None, Action.NONE, facts, P, DT)


def asks(request: Request, phase: Phase, facts: Facts) -> Action:
    """How much a request asks for."""
    if request is Request.STOP:
        return stopping(phase, facts)
    return Action[request.name] if request.name in Action.__members__ else Action.NONE


@pytest.mark.parametrize("action", [Action.HOLD, Action.RETREAT, Action.LAND, Action.KILL])
@pytest.mark.parametrize("request_", Request)
@pytest.mark.parametrize("phase", Phase)
def test_the_more_severe_of_request_and_action_wins(phase: Phase, request_: Request, action: Action) -> None:
    for state, facts in islice(situations(phase), 0, None, 5):
        after, said = step(state, request_, action, facts, P, DT)
        by_action = run(state, None, action, facts)
        if request_ is Request.RESET:
            wanted = asked(phase, request_, state, facts)
            assert after == (mission.initial() if wanted else by_action)
        elif asks(request_, phase, facts) < action:
            assert said[0][0] == "refused_outranked"
            assert action.name in said[0][2]
            assert after == by_action
        else:
            wanted = asked(phase, request_, state, facts)
            assert after == (run(state, request_, Action.NONE, facts) if wanted else by_action)


def test_a_mission_from_start_to_stop() -> None:
    state = mission.initial()
    state = run(state, Request.START, facts=replace(NOTHING, ready=True))
    phases = [Phase.PREFLIGHT, state.phase]
    ends = {
        Phase.TARE: {"tared": True, "arrived": True}, Phase.ADVANCE: {"triggered": True},
        Phase.PRESS: {"pressed": True}, Phase.RELEASE: {"released": True},
        Phase.LAND: {"landed": True, "disarmed": True},
    }  # fmt: skip
    for _ in range(len(NOMINAL) - 2):
        waiting = run(state)
        over = replace(FLYING, **ends.get(state.phase, {"arrived": True}))
        assert waiting == replace(state, phase_time=DT), "no phase ends without its fact"
        state, said = step(waiting, None, Action.NONE, over, P, DT)
        assert len(said) == 1
        assert said[0][1] is Severity.INFO
        phases.append(state.phase)
    assert phases == NOMINAL
    assert state.completed
    assert state.attempts == 0
    assert run(state, Request.RESET, facts=DOWN) == mission.initial()


def test_takeoff_alone_ends_in_hold_and_start_goes_on() -> None:
    state = run(mission.initial(), Request.TAKEOFF, facts=replace(NOTHING, ready=True))
    assert run(state, facts=replace(FLYING, airborne=False, arrived=True)).phase is Phase.TAKEOFF
    assert run(state, facts=replace(FLYING, engaged=False, arrived=True)).phase is Phase.TAKEOFF
    state = run(state, facts=replace(FLYING, arrived=True))
    assert (state.phase, state.resume_phase) == (Phase.HOLD, None)
    assert run(state, Request.RESUME).phase is Phase.HOLD
    state = run(state, Request.START)
    assert (state.phase, state.mode) == (Phase.APPROACH, "mission")
    assert run(run(state, Request.HOLD), Request.START).phase is Phase.HOLD, "an interrupted mission is resumed instead"


@pytest.mark.parametrize("phase", sorted(WORK))
def test_a_hold_resumes_where_it_was_interrupted(phase: Phase) -> None:
    held = run(State(phase, 1.0, clear=False, attempts=2), Request.HOLD)
    while held.phase is not Phase.HOLD:
        assert held.phase is Phase.RETREAT_HOLD
        held = run(held, facts=replace(FLYING, arrived=True))
    for _ in range(1000):
        held = run(held)
    assert held.phase is Phase.HOLD, "nothing resumes by itself"
    resumed = run(held, Request.RESUME)
    force_phases = {Phase.TARE, Phase.ADVANCE, Phase.PRESS, Phase.RELEASE}
    assert resumed.phase is (Phase.TARE if phase in force_phases else phase)
    assert (resumed.resume_phase, resumed.attempts) == (None, 0)


def test_out_of_release_the_sleeve_decides() -> None:
    held = State(Phase.HOLD, 1.0, resume_phase=Phase.RELEASE)
    home = run(held, Request.RESUME, facts=replace(FLYING, released=True))
    assert (home.phase, home.homeward) == (Phase.RETURN, True)
    assert run(held, Request.RESUME).phase is Phase.TARE


TIMEOUTS = {
    Phase.PREFLIGHT: Phase.STOPPED, Phase.ARMED: Phase.LAND,
    Phase.TAKEOFF: Phase.LAND, Phase.APPROACH: Phase.HOLD, Phase.ALIGN: Phase.HOLD,
    Phase.ADHESIVE: Phase.HOLD, Phase.TOOL_CHANGE: Phase.HOLD, Phase.TARE: Phase.HOLD,
    Phase.ADVANCE: Phase.RETREAT_HOLD, Phase.PRESS: Phase.RETREAT_HOLD, Phase.RELEASE: Phase.RETREAT_HOLD,
    Phase.RETREAT: Phase.RETREAT_HOLD, Phase.RETURN: Phase.HOLD, Phase.LAND: Phase.LAND, Phase.HOLD: Phase.LAND,
    Phase.RETREAT_HOLD: Phase.HOLD, Phase.RETREAT_LAND: Phase.LAND,
}  # fmt: skip


@pytest.mark.parametrize("phase", Phase)
def test_every_timeout(phase: Phase) -> None:
    assert set(TIMEOUTS) == set(Phase) - {Phase.STOPPED}, "only STOPPED may last for ever"
    if phase is Phase.STOPPED:
        state = State(phase, 1e9)
        assert run(state).phase is Phase.STOPPED
        return
    limit = float(getattr(P, f"{phase.value}_timeout"))
    before, said = step(State(phase, limit, clear=False, armed=True), None, Action.NONE, FLYING, P, DT)
    assert (before.phase, before.phase_time, said) == (phase, limit + DT, ())
    after, said = step(before, None, Action.NONE, FLYING, P, DT)
    assert (after.phase, after.phase_time) == (TIMEOUTS[phase], 0.0)
    assert len(said) == 1
    assert said[0][1] in (Severity.WARNING, Severity.ERROR)
    assert after.autoland is (phase is Phase.LAND)
    assert after.giving_up is (phase is Phase.ADVANCE)
    if phase in WORK - TOOL_IN_PIPE - {Phase.TAKEOFF}:
        assert run(before, facts=replace(FLYING, in_contact=True)).phase is Phase.RETREAT_HOLD
    if phase is Phase.HOLD:
        assert run(before, facts=replace(FLYING, in_contact=True)).phase is Phase.RETREAT_LAND


@pytest.mark.parametrize("dt", [nan, -1.0, 0.0])
def test_a_bad_dt_does_not_stop_the_clock(dt: float) -> None:
    state, _ = step(State(Phase.APPROACH, 1.0), None, Action.NONE, FLYING, P, dt)
    assert state.phase_time == 1.0
    assert run(state).phase_time == 1.0 + DT
    late, _ = step(state, None, Action.NONE, FLYING, P, inf)
    assert run(late).phase is Phase.HOLD


def test_lost_contact_presses_again_then_gives_up() -> None:
    lost = replace(FLYING, contact_lost=True, pressed=True)
    state = State(Phase.PRESS, 1.0, clear=False)
    for attempt in range(1, P.max_attempts + 1):
        state, said = step(state, None, Action.NONE, lost, P, DT)
        assert (state.phase, state.attempts) == (Phase.TARE, attempt)
        assert f"{attempt} of {P.max_attempts}" in said[0][2]
        state = run(state, facts=replace(FLYING, tared=True, arrived=True))
        state = run(state, facts=replace(FLYING, triggered=True))
        assert state.phase is Phase.PRESS
    state = run(state, facts=lost)
    assert (state.phase, state.giving_up) == (Phase.RETREAT_HOLD, True)
    go_home(state)


@pytest.mark.parametrize("fact", ["overtravel", "late"])
def test_no_contact_gives_up(fact: str) -> None:
    state = State(Phase.ADVANCE, P.advance_timeout + 1.0 if fact == "late" else 1.0, clear=False)
    state = run(state, facts=replace(FLYING, overtravel=fact == "overtravel"))
    assert (state.phase, state.giving_up) == (Phase.RETREAT_HOLD, True)
    go_home(state)


def go_home(state: State) -> None:
    """A mission given up returns and lands, and is not completed; a person may hold it."""
    held = run(state, Request.HOLD)
    assert (held.phase, held.giving_up) == (Phase.RETREAT_HOLD, False)
    assert run(held, facts=replace(FLYING, arrived=True)).phase is Phase.HOLD
    for phase in (Phase.RETURN, Phase.LAND):
        state = run(state, facts=replace(FLYING, arrived=True))
        assert state.phase is phase
    state = run(state, facts=DOWN)
    assert (state.phase, state.completed) == (Phase.STOPPED, False)


def test_breaking_off_the_way_back_is_not_completing() -> None:
    state = State(Phase.RETURN, 1.0, homeward=True)
    landed = run(run(state, None, Action.LAND), facts=DOWN)
    assert (landed.phase, landed.completed) == (Phase.STOPPED, False)
    resumed = run(run(state, Request.HOLD), Request.RESUME)
    landed = run(run(resumed, facts=replace(FLYING, arrived=True)), facts=DOWN)
    assert (landed.phase, landed.completed) == (Phase.STOPPED, True)


def test_a_retreat_is_made_once() -> None:
    """A lasting demand for retreat must not walk the vehicle backwards for ever."""
    state = run(State(Phase.ALIGN, 1.0, clear=False), None, Action.RETREAT)
    assert state.phase is Phase.RETREAT_HOLD
    state = run(state, None, Action.RETREAT, replace(FLYING, arrived=True))
    for _ in range(100):
        assert state.phase is Phase.HOLD
        state = run(state, None, Action.RETREAT, replace(FLYING, arrived=True))


def test_without_position_the_retreat_is_short_and_the_autopilot_lands() -> None:
    lost = replace(FLYING, blind=True)
    state = run(State(Phase.PRESS, 1.0), None, Action.LAND, lost)
    assert state.phase is Phase.RETREAT_LAND
    assert mission.engage(state, lost) is Engage.OFFBOARD
    way = [state]
    for _ in range(round(P.blind_retreat_time / DT) + 3):
        way.append(run(way[-1], None, Action.LAND, lost))
    backing = sum(state.phase is Phase.RETREAT_LAND for state in way)
    assert backing * DT == pytest.approx(P.blind_retreat_time, abs=3 * DT)
    state = way[-1]
    assert (state.phase, state.autoland) == (Phase.LAND, True)
    assert mission.engage(state, lost) is Engage.LAND
    assert run(state, Request.HOLD).phase is Phase.LAND, "the autopilot's landing is not broken off"
    assert mission.engage(state, replace(lost, landed=True)) is Engage.IDLE
    assert run(state, None, Action.LAND, DOWN).phase is Phase.STOPPED


@pytest.mark.parametrize("phase", sorted(WORK | {Phase.HOLD, Phase.RETREAT_HOLD, Phase.RETREAT_LAND, Phase.LAND}))
def test_whoever_took_command_keeps_it(phase: Phase) -> None:
    taken = replace(FLYING, offboard_lost=True)
    state = run(State(phase, 1.0, homeward=True), facts=taken)
    assert (state.phase, state.yielded) == (Phase.LAND, True)
    for request in set(Request) - {Request.KILL}:
        after = run(state, request)
        assert after.phase is Phase.LAND
        assert mission.engage(after, FLYING) is Engage.IDLE
    after = run(replace(state, phase_time=1e6))
    assert not after.autoland
    assert mission.engage(after, FLYING) is Engage.IDLE
    assert mission.engage(run(state, Request.KILL), FLYING) is Engage.KILL
    assert run(state, facts=DOWN).phase is Phase.STOPPED


def test_on_the_ground_nobody_takes_command() -> None:
    state = run(mission.initial(), facts=replace(NOTHING, offboard_lost=True))
    assert not state.yielded


@pytest.mark.parametrize("phase", Phase)
def test_what_is_wanted_of_the_autopilot(phase: Phase) -> None:
    wanted = Engage.IDLE if phase in ON_GROUND else Engage.OFFBOARD  # ARMED included: the motors are to idle
    assert mission.engage(State(phase, 0.0), FLYING) is wanted
    assert mission.engage(State(phase, 0.0, killed=True), FLYING) is Engage.KILL
    down = Engage.IDLE if phase in ON_GROUND | {Phase.LAND} else Engage.OFFBOARD
    assert mission.engage(State(phase, 0.0), DOWN) is down


def test_kill_lasts_until_reset_on_the_ground() -> None:
    state, said = step(State(Phase.PRESS, 1.0), Request.KILL, Action.NONE, FLYING, P, DT)
    assert (state.phase, state.killed, said[0][0]) == (Phase.STOPPED, True, "killed")
    assert step(state, None, Action.KILL, FLYING, P, DT)[1] == (), "said once"
    assert run(state, Request.RESET, Action.KILL, FLYING).killed
    assert run(state, Request.RESET, Action.KILL, DOWN) == mission.initial()


# --- stop, arm, tare, go ----------------------------------------------------------------------------------------------


#: Stop asked for again and again: the phases it leads through while nothing else happens, and the last refusal.
STOPS = {
    Phase.PREFLIGHT: ([], "refused_grounded"), Phase.STOPPED: ([], "refused_grounded"),
    Phase.ARMED: ([Phase.LAND], "refused_landing_already"),
    **dict.fromkeys(sorted(WORK - TOOL_IN_PIPE - {Phase.ARMED}), ([Phase.HOLD, Phase.LAND], "refused_landing_already")),
    **dict.fromkeys(sorted(TOOL_IN_PIPE), ([Phase.RETREAT_HOLD, Phase.RETREAT_LAND], "refused_landing_already")),
    Phase.HOLD: ([Phase.LAND], "refused_landing_already"),
    Phase.RETREAT_HOLD: ([Phase.RETREAT_LAND], "refused_landing_already"),
    Phase.RETREAT_LAND: ([], "refused_landing_already"), Phase.LAND: ([], "refused_landing_already"),
}  # fmt: skip


@pytest.mark.parametrize("phase", Phase)
def test_stop_again_and_again(phase: Phase) -> None:
    state, (way, refusal) = State(phase, 1.0, clear=False), STOPS[phase]
    for wanted in way:
        state = run(state, Request.STOP)
        assert state.phase is wanted
    for _ in range(3):
        after, said = step(state, Request.STOP, Action.NONE, FLYING, P, DT)
        assert after.phase is state.phase
        assert (said[0][0], said[0][2][:13]) == (refusal, "stop refused.")


def test_stop_in_a_takeoff_that_still_stands_breaks_it_off() -> None:
    state = run(State(Phase.TAKEOFF, 1.0), Request.STOP, facts=replace(FLYING, airborne=False))
    assert state.phase is Phase.LAND
    assert run(state, Request.STOP, facts=DOWN).phase is Phase.STOPPED


def test_stop_holds_a_mission_that_was_given_up_before_it_lands_it() -> None:
    state = State(Phase.RETREAT_HOLD, 1.0, clear=False, giving_up=True)
    state = run(state, Request.STOP)
    assert (state.phase, state.giving_up) == (Phase.RETREAT_HOLD, False)
    assert run(state, facts=replace(FLYING, arrived=True)).phase is Phase.HOLD
    assert run(state, Request.STOP).phase is Phase.RETREAT_LAND
    landing = run(State(Phase.RETREAT_HOLD, 1.0, giving_up=True), Request.LAND)
    assert run(landing, Request.STOP).phase is Phase.RETREAT_LAND, "a stop undoes no landing"


READY = replace(NOTHING, ready=True, landed=True, disarmed=True)
IDLING = replace(NOTHING, engaged=True, landed=True)


def armed() -> State:
    """Standing with the motors idling, as the autopilot has said."""
    state = run(mission.initial(), Request.ARM, facts=READY)
    assert state.phase is Phase.ARMED
    assert mission.engage(state, READY) is Engage.OFFBOARD
    for _ in range(100):
        state, said = step(state, None, Action.NONE, DOWN, P, DT)
        assert said == ()
    state, said = step(state, None, Action.NONE, IDLING, P, DT)
    assert [code for code, _, _ in said] == ["armed"]
    assert (state.phase, state.phase_time, step(state, None, Action.NONE, IDLING, P, DT)[1]) == (Phase.ARMED, 0.0, ())
    return state


def test_arm_waits_for_the_takeoff() -> None:
    for request, mode in ((Request.TAKEOFF, "takeoff"), (Request.START, "mission")):
        for state in (armed(), State(Phase.ARMED, 0.0)):  # also before the autopilot has armed
            after = run(state, request, facts=IDLING)
            assert (after.phase, after.mode, after.armed) == (Phase.TAKEOFF, mode, False)


@pytest.mark.parametrize("by", [Request.HOLD, Request.RETREAT, Request.LAND, Request.STOP, "HOLD", "RETREAT", "LAND"])
def test_whatever_breaks_arming_off_disarms(by: Request | str) -> None:
    if isinstance(by, Request):
        state, said = step(armed(), by, Action.NONE, IDLING, P, DT)
    else:
        state, said = step(armed(), None, Action[by], IDLING, P, DT)
    assert (state.phase, said[0][0]) == (Phase.LAND, "disarm")
    assert mission.engage(state, IDLING) is Engage.IDLE
    state = run(state, facts=DOWN)
    assert (state.phase, state.completed) == (Phase.STOPPED, False)
    assert run(state, Request.RESET, facts=DOWN) == mission.initial()


def test_arming_that_fails_or_does_not_last_is_told() -> None:
    waiting = run(mission.initial(), Request.ARM, facts=READY)
    late, said = step(replace(waiting, phase_time=LATE), None, Action.NONE, DOWN, P, DT)
    assert (late.phase, said[0][0], said[0][1]) == (Phase.LAND, "timeout_arming", Severity.ERROR)
    late, said = step(replace(armed(), phase_time=LATE), None, Action.NONE, IDLING, P, DT)
    assert (late.phase, said[0][0], said[0][1]) == (Phase.LAND, "timeout_armed", Severity.WARNING)
    for lost in (DOWN, replace(IDLING, engaged=False)):
        after, said = step(armed(), None, Action.NONE, lost, P, DT)
        assert (after.phase, said[0][0], said[0][1]) == (Phase.LAND, "disarmed", Severity.ERROR)


STILL = replace(FLYING, arrived=True)


def test_a_tare_by_hand_ends_by_itself_and_tells_the_force() -> None:
    state, said = step(State(Phase.HOLD, 9.0), Request.TARE, Action.NONE, STILL, P, DT)
    assert (state.phase, state.taring, state.phase_time, said[0][0]) == (Phase.HOLD, True, 0.0, "tare_by_hand")
    for _ in range(100):
        state, said = step(state, None, Action.NONE, FLYING, P, DT)
        assert (state.taring, said) == (True, ())
    tared = replace(STILL, tared=True, tare=(0.123, -0.456, 1.0))
    done, said = step(state, None, Action.NONE, tared, P, DT)
    assert (done.phase, done.taring) == (Phase.HOLD, False)
    assert [(code, text) for code, _, text in said] == [
        ("tared", "Tared: +0.12, -0.46, +1.00 N along the body's x, y, z count as no force from now on.")
    ]
    twice = step(done, None, Action.NONE, tared, P, DT)[1]
    assert twice == (), "told once"
    at_once = step(state, Request.LAND, Action.NONE, tared, P, DT)[1]
    assert [code for code, _, _ in at_once] == ["tared", "land"], "done in the tick in which the hover ends"
    for request, action in ((Request.LAND, Action.NONE), (Request.START, Action.NONE), (None, Action.LAND)):
        after, said = step(replace(state, mode="takeoff"), request, action, STILL, P, DT)
        assert not after.taring
        assert said[0][0] == "tare_broken_off"


@pytest.mark.parametrize(
    ("state", "facts", "code"),
    [
        (State(Phase.HOLD, 1.0), FLYING, "refused_moving"),
        (State(Phase.HOLD, 1.0, clear=False), STILL, "refused_beside"),
        (State(Phase.HOLD, 1.0), replace(STILL, in_contact=True), "refused_beside"),
        (State(Phase.HOLD, 1.0, taring=True), STILL, "refused_taring"),
        (State(Phase.HOLD, 1.0), replace(STILL, tare_used=False), "refused_tare_unused"),
        (State(Phase.RETREAT_HOLD, 1.0), FLYING, "refused_retreating"),
        (State(Phase.RETREAT_LAND, 1.0), FLYING, "refused_landing"),
        (State(Phase.LAND, 1.0), FLYING, "refused_landing"),
        (State(Phase.PREFLIGHT, 1.0), READY, "refused_grounded"),
        (State(Phase.ARMED, 1.0), IDLING, "refused_grounded"),
        (State(Phase.STOPPED, 1.0), DOWN, "refused_grounded"),
        *((State(phase, 1.0), FLYING, "refused_hold_first") for phase in sorted(WORK)),
    ],
)
def test_a_tare_is_refused_where_it_cannot_be_right(state: State, facts: Facts, code: str) -> None:
    after, said = step(state, Request.TARE, Action.NONE, facts, P, DT)
    assert after.taring is state.taring
    assert said[0][0] == code


GO = {Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE, Phase.RETURN}
FORCE = {Phase.ADVANCE, Phase.PRESS, Phase.RELEASE}


def go(state: State, to: Phase | None, facts: Facts = STILL) -> tuple[State, str]:
    """A request to go, and what was said first."""
    after, said = step(state, Request.GO, Action.NONE, replace(facts, go=to), P, DT)
    assert not said[0][0].startswith("refused") or after == run(state, facts=facts)
    return after, said[0][0]


@pytest.mark.parametrize("to", Phase)
def test_going_from_hover(to: Phase) -> None:
    """After a takeoff, with nothing interrupted: to the pipe, or home."""
    hover = State(Phase.HOLD, 1.0, mode="takeoff", attempts=2)
    after, code = go(hover, to)
    if to in (Phase.APPROACH, Phase.RETURN):
        assert (after.phase, after.attempts, after.homeward) == (to, 0, False)
        assert code == ("go" if to is Phase.APPROACH else "go_return")
    elif to in FORCE:
        assert code == "refused_go_to_contact"
    else:
        assert code == ("refused_go_far_off" if to in GO else "refused_go_elsewhere")


@pytest.mark.parametrize("to", sorted(GO))
@pytest.mark.parametrize("phase", sorted(WORK - {Phase.TAKEOFF, Phase.APPROACH, Phase.RETURN}))
def test_going_after_work_beside_the_pipe(phase: Phase, to: Phase) -> None:
    held = run(State(phase, 1.0, clear=False), Request.HOLD)
    if held.phase is Phase.HOLD:  # no contact: it hovers where it was
        assert go(held, to)[1] == "refused_beside"
        held = run(held, Request.RETREAT)
    assert go(held, to)[1] == "refused_retreating"
    held = run(held, facts=STILL)
    after, code = go(held, to)
    assert (after.phase, after.resume_phase) == (to, None)
    assert code == ("go_return" if to is Phase.RETURN else "go")
    empty = replace(STILL, payload=False)
    if to is not Phase.RETURN:
        assert go(held, to, empty)[1] == "refused_without_sleeve"
        return
    home, _ = go(held, to, replace(empty, released=True))
    for over, completed in ((home, True), (after, False)):
        landed = run(run(over, facts=STILL), facts=DOWN)
        assert (landed.phase, landed.completed) == (Phase.STOPPED, completed)


def test_an_approach_on_hold_is_free_to_go_home() -> None:
    held = run(State(Phase.APPROACH, 1.0, clear=False), Request.HOLD)
    home, _ = go(held, Phase.RETURN)
    assert home.phase is Phase.RETURN
    assert go(run(home, Request.HOLD), Phase.APPROACH)[0].phase is Phase.APPROACH
    assert go(held, Phase.TARE)[1] == "refused_go_far_off"


def test_going_nowhere_and_from_elsewhere_is_refused() -> None:
    assert go(State(Phase.HOLD, 1.0), None)[1] == "refused_go_nowhere"
    wanted = {
        **dict.fromkeys(WORK, "refused_hold_first"), **dict.fromkeys(LANDING, "refused_landing"),
        **dict.fromkeys(STANDING, "refused_grounded"), Phase.RETREAT_HOLD: "refused_retreating",
    }  # fmt: skip
    for phase, code in wanted.items():
        assert go(State(phase, 1.0), Phase.APPROACH, FLYING)[1] == code


def test_a_refused_way_is_named() -> None:
    text = step(State(Phase.HOLD, 1.0), Request.GO, Action.NONE, replace(STILL, go=Phase.PRESS), P, DT)[1][0][2]
    assert text == "go refused. Only the tare leads to press: ask to go to tare."


# --- everything that can happen ---------------------------------------------------------------------------------------

LATE = 1e6


def stimuli() -> list[tuple[Request | None, Action, Facts]]:
    """Requests and actions beside the facts that change the answer, in the air and on the ground."""
    ends = ("arrived", "triggered", "pressed", "released", "contact_lost", "in_contact", "overtravel", "blind", "tared")
    some = [
        *(replace(FLYING, arrived=True, go=go) for go in GO), replace(FLYING, go=Phase.ALIGN, payload=False),
        FLYING, NOTHING, DOWN, replace(NOTHING, ready=True), replace(FLYING, offboard_lost=True),
        replace(FLYING, arrived=True, tared=True), *(replace(FLYING, **{name: True}) for name in ends),
    ]  # fmt: skip
    found: list[tuple[Request | None, Action, Facts]] = [(request, Action.NONE, f) for request in Request for f in some]
    return found + [(None, action, f) for action in Action for f in some]


def explore() -> dict[State, list[tuple[tuple[Request | None, Action, Facts], State]]]:
    """All states within reach (with the clock at 0, or past every timeout), and what leads from each to which."""
    graph: dict[State, list[tuple[tuple[Request | None, Action, Facts], State]]] = {}
    start = mission.initial()
    queue, kinds, params = deque([start]), stimuli(), replace(P, max_attempts=1)
    while queue:
        state = queue.popleft()
        if state in graph:
            continue
        graph[state] = []
        for kind in kinds:
            after = step(state, *kind, params, DT)[0]
            after = replace(after, phase_time=LATE if after.phase_time >= LATE else 0.0)
            graph[state].append((kind, after))
            queue.append(after)
        if state.phase_time == 0.0:
            graph[state].append((kinds[0], replace(state, phase_time=LATE)))
            queue.append(replace(state, phase_time=LATE))
    return graph


def test_every_reachable_state() -> None:
    graph = explore()
    assert {state.phase for state in graph} == set(Phase)
    for state, moves in graph.items():
        for (request, action, facts), after in moves:
            moved = after.phase is not state.phase
            if state.phase in (Phase.PRESS, Phase.RELEASE) and moved:
                ways_out = {Phase.RETREAT_HOLD, Phase.RETREAT_LAND}
                onward = {Phase.RELEASE, Phase.TARE} if state.phase is Phase.PRESS else {Phase.RETREAT}
                cut = request is Request.KILL or action is Action.KILL
                given_away = facts.offboard_lost or state.yielded
                assert after.phase in ways_out | onward or cut or given_away
            if state.phase is Phase.HOLD and after.phase in GO and request is Request.GO:
                assert after.phase is facts.go
                assert facts.payload or after.phase is Phase.RETURN
                assert state.clear or state.resume_phase is Phase.APPROACH
            if after.phase is Phase.ARMED and moved:
                assert request is Request.ARM
            if after.taring:
                assert (after.phase, after.clear) == (Phase.HOLD, True)
            if state.phase is Phase.HOLD and moved and request is None:
                assert after.phase in {Phase.LAND, Phase.RETREAT_LAND, Phase.RETREAT_HOLD, Phase.STOPPED}
            if after.phase is Phase.RELEASE and moved and request is None:
                assert state.phase is Phase.PRESS
            if after.completed and not state.completed:
                assert (state.phase, state.homeward) == (Phase.LAND, True)
            if after.homeward and not state.homeward:
                assert state.phase is Phase.RETREAT or facts.released
            if after.phase is Phase.STOPPED and moved and not after.killed:
                assert state.phase is Phase.PREFLIGHT or (facts.landed and facts.disarmed)
            assert not (state.killed and moved) or request is Request.RESET


def test_from_everywhere_a_request_to_land_ends_on_the_ground() -> None:
    settled = replace(FLYING, arrived=True)
    for state in explore():
        if state.phase in ON_GROUND:
            continue
        after = run(state, Request.LAND, facts=settled)
        for _ in range(3):
            after = run(after, facts=settled)
        assert after.phase is Phase.LAND
        after = run(after, facts=DOWN)
        assert after.phase is Phase.STOPPED
        assert run(after, Request.RESET, facts=DOWN) == mission.initial()


def test_every_row_of_the_table_can_fire() -> None:
    """A row behind another that always fits first would be dead; so would a sentence that nobody says."""
    causes: list[mission.Cause] = [None, *Request, *Action]
    fired = {
        id(mission._first(cause, state, facts, P))
        for phase, cause in product(Phase, causes)
        for state, facts in [*situations(phase), *endings(phase)]
    }
    assert [row for row in mission.TABLE if id(row) not in fired] == []
    assert {row.code for row in mission.TABLE} | {"refused_outranked", "tare_broken_off"} == set(mission.SENTENCES)


def endings(phase: Phase) -> Iterator[tuple[State, Facts]]:
    """What facts alone may depend on: one at a time, with the flags of the state."""
    ends: list[dict[str, Any]] = [
        {"arrived": True}, {"arrived": True, "tared": True}, {"landed": True, "disarmed": True}, {}
    ]  # fmt: skip
    ends += [{"arrived": True, "payload": go is not Phase.TARE, "go": go} for go in Phase]
    ends += [{"tare_used": False}, {"engaged": False}, {"released": True, "go": Phase.RETURN}]
    single = ("triggered", "pressed", "released", "contact_lost", "in_contact", "overtravel", "blind")
    for end in [*ends, *({name: True} for name in single)]:
        facts = replace(FLYING, **end)
        for time, flag in product((0.0, LATE), (True, False)):
            yield State(phase, time, giving_up=flag, homeward=flag, armed=flag, taring=flag), facts
            yield State(phase, time, resume_phase=Phase.ALIGN, clear=flag), facts
            yield State(phase, time, mode="takeoff", attempts=99, yielded=flag, killed=flag), facts


def test_rows_name_real_parameters() -> None:
    for phase in set(Phase) - {Phase.STOPPED}:
        assert getattr(P, f"{phase.value}_timeout") > 0.0
    for code, (_, text) in mission.SENTENCES.items():
        words = {"phase": "ALIGN", "attempt": 1, "max": 3, "action": "LAND", "go": "align", "tare": "+0.10"}
        assert text.format(**words).endswith("."), code
