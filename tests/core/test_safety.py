"""Each condition alone, by figures written down here; then all together, NaN included."""

from __future__ import annotations

import runpy
from itertools import pairwise
from math import ceil, inf, nan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from onboard.core import mission, safety
from onboard.core.safety import CLEAR, NOMINAL, TABLE, WORDS, Facts, Params, State, step
from onboard.core.types import Action, Phase, Severity, Verdict

P = Params()
DT = 0.004
GOOD = Facts(
    phase=Phase.APPROACH, airborne=True, armed=True, contact_expected=False, pressing=False, age_odometry=0.01,
    age_autopilot=0.005, age_servos=0.01, odometry_jump=0.0, odometry_reset=False, confidence=3.0, tilt=0.05,
    position=(1.0, 0.0, 1.5), contact_force=0.1, free_flight_force=0.2, servo_error=0, temperature=40.0,
    servo_voltage_min=4.9, servo_voltage_max=5.1, torque_on=True, joint_error=0.01, battery_voltage=15.5,
    battery_remaining=0.8, dt=DT, inputs_finite=True, offboard_lost=False, disagreement=0.01,
)  # fmt: skip
PRESSING = replace(
    GOOD, phase=Phase.PRESS, contact_expected=True, pressing=True, contact_force=2.5, free_flight_force=2.5
)
GROUND = replace(GOOD, phase=Phase.PREFLIGHT, airborne=False, armed=False)
WARN, HOLD, RETREAT, LAND, KILL = Action.WARN, Action.HOLD, Action.RETREAT, Action.LAND, Action.KILL


class Case:
    """A condition: the last value that is well and the first that is not, its debounce and its actions."""

    def __init__(
        self, code: str, well: dict[str, Any], bad: dict[str, Any], time: float, free: Action, contact: Action,
        *, latched: bool = False, also: tuple[str, ...] = (), base: Facts = GOOD,
    ) -> None:  # fmt: skip
        self.code, self.well, self.bad, self.time, self.free, self.contact = code, well, bad, time, free, contact
        self.latched, self.also, self.base = latched, also, base


CASES = [
    Case("non_finite", {}, {"inputs_finite": False}, 0.0, WARN, WARN, also=("non_finite_sustained",)),
    Case("non_finite_sustained", {}, {"inputs_finite": False}, 0.1, LAND, LAND, latched=True, also=("non_finite",)),
    Case("devices_missing", {}, {"missing": "servos"}, 0.0, WARN, WARN),
    Case("must_not_arm", {}, {"obstacles": "A cable is loose."}, 0.0, WARN, Action.NONE, base=GROUND),
    Case("odometry_late", {"age_odometry": 0.15}, {"age_odometry": 0.151}, 0.0, HOLD, RETREAT),
    Case("odometry_lost", {"age_odometry": 0.5}, {"age_odometry": 0.501}, 0.0, LAND, LAND, latched=True,
         also=("odometry_late",)),
    Case("odometry_jump", {"odometry_jump": 0.08}, {"odometry_jump": 0.081}, 0.0, HOLD, RETREAT),
    Case("odometry_wild", {"odometry_jump": 1.0}, {"odometry_jump": 1.01}, 0.0, LAND, LAND, latched=True,
         also=("odometry_jump",)),
    Case("odometry_reset", {}, {"odometry_reset": True}, 0.0, HOLD, RETREAT),
    Case("odometry_unsure", {"confidence": 2.0}, {"confidence": 1.0}, 0.5, HOLD, RETREAT),
    Case("odometry_failed", {"confidence": 1.0}, {"confidence": 0.0}, 0.3, LAND, LAND, latched=True,
         also=("odometry_unsure",)),
    Case("odometry_disagrees", {"disagreement": 0.15}, {"disagreement": 0.16}, 0.5, LAND, LAND, latched=True),
    Case("autopilot_late", {"age_autopilot": 0.1}, {"age_autopilot": 0.101}, 0.0, HOLD, RETREAT),
    Case("autopilot_lost", {"age_autopilot": 0.4}, {"age_autopilot": 0.401}, 0.0, LAND, LAND, latched=True,
         also=("autopilot_late",)),
    Case("offboard_lost", {}, {"offboard_lost": True}, 0.0, LAND, LAND, latched=True),
    Case("disarmed", {}, {"armed": False}, 0.3, KILL, KILL, latched=True),
    Case("servos_late", {"age_servos": 0.1}, {"age_servos": 0.101}, 0.0, WARN, WARN),
    Case("servos_lost", {"age_servos": 0.5}, {"age_servos": 0.501}, 0.0, HOLD, RETREAT, latched=True,
         also=("servos_late",)),
    Case("servo_error", {}, {"servo_error": 0x20}, 0.05, HOLD, RETREAT, latched=True),
    Case("servo_torque", {}, {"torque_on": False}, 0.1, HOLD, RETREAT, latched=True),
    Case("servo_warm", {"temperature": 60.0}, {"temperature": 60.1}, 1.0, WARN, WARN),
    Case("servo_hot", {"temperature": 68.0}, {"temperature": 68.1}, 1.0, HOLD, RETREAT, latched=True,
         also=("servo_warm",)),
    Case("servo_voltage", {"servo_voltage_min": 4.2}, {"servo_voltage_min": 4.19}, 0.5, HOLD, RETREAT),
    Case("servo_voltage", {"servo_voltage_max": 6.0}, {"servo_voltage_max": 6.01}, 0.5, HOLD, RETREAT),
    Case("joint_error", {"joint_error": 0.5}, {"joint_error": 0.51}, 1.0, HOLD, RETREAT),
    Case("tilt", {"tilt": 0.6}, {"tilt": 0.61}, 0.2, HOLD, RETREAT),
    Case("tipped", {"tilt": 1.4}, {"tilt": 1.41}, 0.4, KILL, KILL, latched=True, also=("tilt",)),
    Case("fence", {"position": (10.0, 0.0, 1.0)}, {"position": (10.1, 0.0, 1.0)}, 0.1, HOLD, RETREAT),
    Case("fence", {"position": (-10.0, 0.0, 1.0)}, {"position": (-10.1, 0.0, 1.0)}, 0.1, HOLD, RETREAT),
    Case("fence", {"position": (0.0, 10.0, 1.0)}, {"position": (0.0, 10.1, 1.0)}, 0.1, HOLD, RETREAT),
    Case("fence", {"position": (0.0, -10.0, 1.0)}, {"position": (0.0, -10.1, 1.0)}, 0.1, HOLD, RETREAT),
    Case("fence", {"position": (0.0, 0.0, 6.0)}, {"position": (0.0, 0.0, 6.1)}, 0.1, HOLD, RETREAT),
    Case("fence", {"position": (0.0, 0.0, -1.0)}, {"position": (0.0, 0.0, -1.1)}, 0.1, HOLD, RETREAT),
    Case("fence_breached", {"position": (0.0, 0.0, 7.0)}, {"position": (0.0, 0.0, 7.1)}, 0.1, LAND, LAND, latched=True,
         also=("fence",)),
    Case("force_high", {"contact_force": 8.0}, {"contact_force": 8.1}, 0.1, RETREAT, RETREAT),
    Case("force_high", {"contact_force": -8.0}, {"contact_force": -8.1}, 0.1, RETREAT, RETREAT, also=("contact_lost",)),
    Case("contact_lost", {"contact_force": 0.05}, {"contact_force": 0.049}, 0.5, WARN, WARN, base=PRESSING),
    Case("contact_stray", {"free_flight_force": 5.0}, {"free_flight_force": 5.1}, 0.5, RETREAT, Action.NONE),
    Case("link_silent", {"commander": "bench", "link_age": 2.0}, {"commander": "bench", "link_age": 2.01}, 0.0, HOLD,
         RETREAT),
    Case("link_lost", {"link_age": 10.0}, {"link_age": 10.1}, 0.0, LAND, LAND, also=("link_silent",)),
    Case("battery_low", {"battery_remaining": 0.25}, {"battery_remaining": 0.249}, 2.0, RETREAT, RETREAT, latched=True),
    Case("battery_low", {"battery_voltage": 14.0}, {"battery_voltage": 13.9}, 2.0, RETREAT, RETREAT, latched=True),
    Case("battery_critical", {"battery_remaining": 0.12}, {"battery_remaining": 0.119}, 2.0, LAND, LAND, latched=True,
         also=("battery_low",)),
    Case("battery_critical", {"battery_voltage": 13.4}, {"battery_voltage": 13.3}, 2.0, LAND, LAND, latched=True,
         also=("battery_low",)),
    Case("tick_late", {"dt": 0.02}, {"dt": 0.021}, 0.0, WARN, WARN, also=("tick_slow", "tick_stalled")),
    Case("tick_slow", {"dt": 0.01}, {"dt": 0.0101}, 0.5, HOLD, RETREAT, also=("tick_stalled",)),
    Case("tick_stalled", {"dt": 0.01}, {"dt": 0.0101}, 2.0, LAND, LAND, latched=True, also=("tick_slow",)),
]  # fmt: skip
each_case = pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.code}-{'-'.join(case.bad)}")


def hold(state: State, facts: Facts, ticks: int) -> tuple[State, Verdict, list[str]]:
    """Many ticks of the same facts; the codes of all events."""
    verdict, codes = NOMINAL, []
    for _ in range(ticks):
        state, verdict, said = step(state, facts, P, DT)
        codes += [code for code, _, _ in said]
    return state, verdict, codes


def lasting(seconds: float) -> int:
    """Ticks for which facts must hold to last so long."""
    return max(1, ceil(round(seconds / DT, 6)))


def test_every_condition_has_a_case_and_words() -> None:
    codes = [condition.code for condition in TABLE]
    assert len(codes) == len(set(codes))
    assert {case.code for case in CASES} == set(codes) == set(WORDS)
    assert set(codes) >= safety.BLIND


@pytest.mark.parametrize("facts", [GOOD, PRESSING, GROUND], ids=["free", "contact", "ground"])
def test_when_all_is_well_nothing_is_built(facts: Facts) -> None:
    state, verdict, said = step(CLEAR, facts, P, DT)
    assert state is CLEAR
    assert verdict is NOMINAL
    assert said == ()
    again = State(CLEAR.active, tuple(0.0 for _ in TABLE))  # as read back from a log
    assert step(again, facts, P, DT) == (CLEAR, NOMINAL, ())


@each_case
def test_at_its_bound_a_condition_is_quiet(case: Case) -> None:
    _, verdict, codes = hold(safety.initial(), replace(case.base, **case.well), 2 * lasting(case.time) + 2)
    assert case.code not in verdict.reasons
    assert case.code not in codes


@each_case
def test_beyond_its_bound_it_fires_after_its_debounce(case: Case) -> None:
    facts = replace(case.base, **case.bad)
    state, verdict, codes = hold(safety.initial(), facts, lasting(case.time) - 1)
    assert case.code not in verdict.reasons
    assert case.code not in codes
    state, verdict, said = step(state, facts, P, DT)
    assert case.code in verdict.reasons
    assert set(verdict.reasons) <= {case.code, *case.also}, "no other condition may hide behind this one"
    fired = {code: (severity, text) for code, severity, text in said}
    assert fired[case.code][0] is (Severity.WARNING if case.free is WARN else Severity.ERROR)
    assert "{" not in fired[case.code][1]
    assert hold(state, facts, 1)[2] == [], "said once"


@each_case
def test_an_interruption_starts_the_debounce_again(case: Case) -> None:
    facts = replace(case.base, **case.bad)
    state = safety.initial()
    for _ in range(3):
        state, verdict, _ = hold(state, facts, lasting(case.time) - 1)
        state, verdict, _ = step(state, case.base, P, DT)
        assert case.code not in verdict.reasons


@each_case
def test_its_action_in_each_phase_group(case: Case) -> None:
    ticks = lasting(case.time)
    if case.base is GOOD:
        verdict = hold(safety.initial(), replace(GOOD, **case.bad), ticks)[1]
        assert verdict.action is case.free
    pressing = hold(safety.initial(), replace(PRESSING, **case.bad), ticks)[1]
    if case.contact is Action.NONE:
        assert case.code not in pressing.reasons
    else:
        assert pressing.action is case.contact
    standing = hold(safety.initial(), replace(GROUND, **case.bad), ticks)[1]
    assert standing.action <= WARN
    if pressing.action >= HOLD:
        assert_leads_out_through_retreat(pressing)


def assert_leads_out_through_retreat(verdict: Verdict) -> None:
    facts = mission.Facts(
        ready=False, engaged=True, airborne=True, arrived=False, triggered=True, pressed=False, released=False,
        tared=True, landed=False, disarmed=False, in_contact=True, contact_lost=False, blind=safety.blind(verdict),
        offboard_lost=safety.yielded(verdict),
    )  # fmt: skip
    for phase in (Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT):
        after, _ = mission.step(mission.State(phase, 1.0), None, verdict.action, facts, mission.Params(), DT)
        wanted = {
            Action.HOLD: Phase.RETREAT_HOLD, Action.RETREAT: Phase.RETREAT_HOLD, Action.LAND: Phase.RETREAT_LAND,
            Action.KILL: Phase.STOPPED,
        }  # fmt: skip
        assert after.phase is wanted[verdict.action]


def test_a_tipped_vehicle_is_cut_on_the_ground_too_but_only_when_armed() -> None:
    tipped = replace(GROUND, tilt=3.0)
    ticks = lasting(0.4)
    assert hold(safety.initial(), tipped, ticks)[1] is NOMINAL
    assert hold(safety.initial(), replace(tipped, armed=True), ticks)[1] == Verdict(KILL, ("tipped",))


def test_armed_on_the_ground_counts_as_flight() -> None:
    """Motors idle: what would hold a flight disarms. That the vehicle is not in the air is known all the same."""
    idling = replace(GROUND, phase=Phase.ARMED, armed=True)
    assert step(CLEAR, idling, P, DT)[1] is NOMINAL
    assert step(CLEAR, replace(idling, link_age=2.5), P, DT)[1].action is HOLD
    assert hold(CLEAR, replace(idling, tilt=3.0), lasting(P.tipped_time))[1].action is KILL
    assert hold(CLEAR, replace(idling, armed=False, joint_error=3.0, offboard_lost=True), 1000)[1] is NOMINAL


def test_a_station_heard_again_is_told_and_that_is_all() -> None:
    state, verdict, codes = hold(CLEAR, replace(GOOD, commander="bench", link_age=12.0), 10)
    assert (verdict.action, codes) == (LAND, ["link_silent", "link_lost"])
    state, verdict, codes = hold(state, replace(GOOD, commander="bench", link_age=0.1), lasting(P.clear_time))
    assert (verdict, codes) == (NOMINAL, ["link_silent_cleared", "link_lost_cleared"])
    said = step(CLEAR, replace(GOOD, commander="bench", link_age=2.5), P, DT)[2]
    assert said[0][2].startswith("bench commands, and is silent for 2.5 s.")


def test_landing_is_told_from_a_crash_and_the_ground_from_a_pipe() -> None:
    landing = replace(GOOD, phase=Phase.LAND, armed=False, free_flight_force=30.0)
    assert hold(safety.initial(), landing, 1000)[1] is NOMINAL
    takeoff = replace(GOOD, phase=Phase.TAKEOFF, free_flight_force=30.0)
    assert hold(safety.initial(), takeoff, 1000)[1] is NOMINAL


def test_on_the_ground_a_takeoff_counts_as_flight() -> None:
    """Motors may turn already: a lost tracker must stop the takeoff."""
    takeoff = replace(GROUND, phase=Phase.TAKEOFF, armed=True, age_odometry=1.0)
    assert step(CLEAR, takeoff, P, DT)[1].action is LAND


@each_case
def test_it_clears_by_its_rule(case: Case) -> None:
    state = hold(safety.initial(), replace(case.base, **case.bad), lasting(case.time))[0]
    ticks = lasting(P.clear_time)
    state, verdict, codes = hold(state, case.base, ticks - 1)
    assert case.code in verdict.reasons
    assert f"{case.code}_cleared" not in codes
    state, verdict, codes = hold(state, case.base, 1)
    if case.latched:
        state, verdict, codes = hold(state, case.base, 2 * ticks)
        assert case.code in verdict.reasons, "latched"
        assert f"{case.code}_cleared" not in codes
        stopped = replace(GROUND, phase=Phase.STOPPED)
        assert case.code in hold(state, stopped, 2 * ticks)[1].reasons, "only a reset clears it"
        state, verdict, codes = hold(state, GROUND, 1)
    assert f"{case.code}_cleared" in codes
    state, verdict, _ = hold(state, GROUND, ticks)
    assert state is CLEAR
    assert verdict is NOMINAL


def test_what_comes_back_before_it_clears_stays() -> None:
    late = replace(GOOD, age_odometry=0.2)
    state = step(CLEAR, late, P, DT)[0]
    for _ in range(5):
        state, verdict, codes = hold(state, GOOD, lasting(P.clear_time) - 1)
        assert codes == []
        state, verdict, codes = hold(state, late, 1)
        assert (verdict.reasons, codes) == (("odometry_late",), [])


def test_the_most_severe_wins_and_leads_the_reasons() -> None:
    facts = replace(GOOD, age_servos=0.2, age_odometry=0.2, age_autopilot=1.0, dt=0.03)
    verdict = step(CLEAR, facts, P, DT)[1]
    assert verdict.action is LAND
    assert verdict.reasons == ("autopilot_lost", "odometry_late", "autopilot_late", "servos_late", "tick_late")
    by_code = {condition.code: condition.actions.free for condition in TABLE}
    assert all(by_code[a] >= by_code[b] for a, b in pairwise(verdict.reasons))


def test_blind_and_yielded_are_read_from_the_verdict() -> None:
    for case in CASES:
        verdict = hold(safety.initial(), replace(case.base, **case.bad), lasting(case.time))[1]
        lost = case.code.startswith(("odometry", "autopilot", "non_finite")) and verdict.action is LAND
        assert safety.blind(verdict) is lost
        assert safety.yielded(verdict) is (case.code == "offboard_lost")
    assert not safety.blind(step(CLEAR, replace(GROUND, age_odometry=inf), P, DT)[1]), "on the ground nothing is flown"


FLOATS = [name for name, kind in Facts.__annotations__.items() if kind == "float"]
PLACES = [*FLOATS, "x", "y", "z"]


def spoilt(facts: Facts, place: str, value: float) -> Facts:
    if place in FLOATS:
        return replace(facts, **{place: value})
    position = list(facts.position)
    position["xyz".index(place)] = value
    return replace(facts, position=(position[0], position[1], position[2]))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("facts", [GOOD, PRESSING, GROUND], ids=["free", "contact", "ground"])
def test_what_is_not_finite_never_passes(facts: Facts, place: str, value: float) -> None:
    bad = spoilt(facts, place, value)
    state, verdict, said = step(CLEAR, bad, P, DT)
    assert verdict.action is not Action.NONE
    assert said
    lasting_verdict = hold(state, bad, 100)[1]
    if facts is not GROUND:
        assert lasting_verdict.action >= HOLD
    assert lasting_verdict.action < KILL, "what is not known must not cut the motors"


@pytest.mark.parametrize("place", ["age_odometry", "age_autopilot", "age_servos", "dt"])
def test_a_clock_that_runs_backwards_is_seen(place: str) -> None:
    assert hold(CLEAR, replace(GOOD, **{place: -1.0}), lasting(2.0))[1].action >= HOLD


@pytest.mark.parametrize("dt", [nan, -1.0, 0.0])
def test_a_bad_dt_counts_as_none(dt: float) -> None:
    facts = replace(GOOD, tilt=1.0)
    state = CLEAR
    for _ in range(1000):
        state, verdict, _ = step(state, facts, P, dt)
        assert verdict is NOMINAL
    assert hold(state, facts, lasting(P.tilt_time))[1].reasons == ("tilt",)


def test_a_long_tick_counts_as_a_second_at_most() -> None:
    state, verdict, _ = step(CLEAR, replace(GOOD, battery_remaining=0.2), P, inf)
    assert verdict is NOMINAL
    assert step(state, replace(GOOD, battery_remaining=0.2), P, 5.0)[1].reasons == ("battery_low",)


anything = st.floats(allow_nan=True, allow_infinity=True)
flags = st.booleans()
FLAGS = ("airborne", "armed", "contact_expected", "pressing", "odometry_reset", "torque_on", "offboard_lost")


@settings(deadline=None, max_examples=100, derandomize=True)
@given(st.data())
def test_any_facts_give_a_verdict_that_agrees_with_the_state(data: st.DataObject) -> None:
    state = CLEAR
    for _ in range(data.draw(st.integers(1, 4))):
        values: dict[str, Any] = {name: data.draw(st.one_of(anything, st.just(getattr(GOOD, name)))) for name in FLOATS}
        values |= {name: data.draw(flags) for name in FLAGS}
        facts = replace(GOOD, phase=data.draw(st.sampled_from(Phase)), **values)
        state, verdict, _ = step(state, facts, P, data.draw(st.sampled_from([0.004, 0.3, 3.0])))
        active = [c for c, is_active in zip(TABLE, state.active, strict=True) if is_active]
        demands = [c.actions.of(safety.group(facts)) for c in active]
        assert verdict.action == max(demands, default=Action.NONE)
        assert sorted(verdict.reasons) == sorted(c.code for c in active)


def test_the_pages_say_what_the_tables_say() -> None:
    docs = Path(__file__).parents[2] / "docs"
    for name, text in runpy.run_path(str(docs / "tables.py"))["pages"]().items():
        assert (docs / name).read_text(encoding="utf-8") == text, f"docs/{name} is stale: run python docs/tables.py"
