"""From belief to the facts that safety, mission and gate decide on."""

from __future__ import annotations

from itertools import product
from math import inf, pi

import pytest
from msgspec.structs import replace

from drivers.samples import Engage, FlightMode, Landed
from onboard.config import load_config
from onboard.core import compensation, estimators, facts, mission, safety, tare
from onboard.core import estimate as estimating
from onboard.core.derived import derive
from onboard.core.guidance import Progress
from onboard.core.math3 import matrix_from_quat, wrap_angle
from onboard.core.types import Action, Estimate, LinkState, Phase, Verdict
from tests.core.following import RESTING, Follower
from tests.core.sampled import JOINTS, T0, autopilot, inputs, odometry, quat, servos

CONFIG = load_config("paper")
DERIVED = derive(CONFIG)
SEEN = estimating.State(odometry(), autopilot(), servos())
HOME = 0.24
HIGH = replace(RESTING, p_WB=(1.0, 0.0, 1.5), joints=JOINTS[:3])
LOW = replace(RESTING, p_WB=(0.0, 0.0, HOME))
WELL = safety.NOMINAL
REFERENCE = Follower(CONFIG).tick(Phase.PREFLIGHT).reference


# --- in the air or not ------------------------------------------------------------------------------------------------


def airborne(
    before: bool, believed: Estimate, told: object = None, phase: Phase = Phase.APPROACH, lift: float = 1.0
) -> bool:
    seen = replace(SEEN, autopilot=autopilot() if told is None else told)
    return facts.airborne(before, seen, believed, phase, HOME, lift)


def test_it_takes_off_when_it_rises_with_its_motors_on() -> None:
    assert not airborne(False, LOW, phase=Phase.TAKEOFF)
    assert not airborne(False, HIGH, phase=Phase.TAKEOFF, lift=0.4)
    assert not airborne(False, HIGH, autopilot(armed=False), phase=Phase.TAKEOFF)
    assert airborne(False, HIGH, phase=Phase.TAKEOFF)
    barely = replace(LOW, p_WB=(0.0, 0.0, HOME + facts.LIFT_OFF))
    assert not airborne(False, barely, phase=Phase.TAKEOFF)


def test_it_stays_in_the_air_until_it_stands_with_its_motors_spooling_down() -> None:
    ground = autopilot(landed=Landed.ON_GROUND)
    assert airborne(True, LOW, phase=Phase.LAND)
    assert airborne(True, LOW, ground, phase=Phase.LAND)  # PX4 takes little thrust for ground
    assert airborne(True, LOW, phase=Phase.LAND, lift=0.9)
    assert not airborne(True, LOW, ground, phase=Phase.LAND, lift=0.9)


def test_disarmed_in_the_air_is_still_in_the_air() -> None:
    for landed in Landed:
        assert airborne(True, HIGH, autopilot(armed=False, landed=landed))
    assert not airborne(True, LOW, autopilot(armed=False))


def test_the_autopilot_s_word_ends_a_landing_whatever_the_position() -> None:
    assert not airborne(True, HIGH, autopilot(armed=False, landed=Landed.ON_GROUND), phase=Phase.LAND)
    assert airborne(True, HIGH, autopilot(armed=False, landed=Landed.IN_AIR), phase=Phase.LAND)


def test_an_autopilot_that_has_never_told_anything_says_nothing() -> None:
    silent = replace(SEEN, autopilot=None)
    assert not facts.airborne(False, silent, HIGH, Phase.PREFLIGHT, HOME, 0.0)


# --- for safety -------------------------------------------------------------------------------------------------------


def dangers(
    seen: estimating.State = SEEN, believed: Estimate = HIGH, phase: Phase = Phase.APPROACH, **how: object
) -> safety.Facts:
    keys: dict[str, object] = {"flying": True, "engaged_before": True, "reference": REFERENCE, "arm": None} | how
    return facts.for_safety(seen, believed, inputs(), phase, **keys)  # type: ignore[arg-type]


def test_a_healthy_hover_is_no_danger() -> None:
    _, verdict, _ = safety.step(safety.initial(), dangers(), CONFIG.safety, 0.004)
    assert verdict == WELL


@pytest.mark.parametrize("missing", ["odometry", "autopilot", "servos"])
def test_before_its_first_sample_a_device_is_missing_and_that_is_all(missing: str) -> None:
    seen = replace(SEEN, **{missing: None})
    believed = replace(HIGH, **{f"age_{missing}": inf})
    told = dangers(seen, believed, Phase.PREFLIGHT, flying=False)
    assert told.missing == missing
    _, verdict, said = safety.step(safety.initial(), told, CONFIG.safety, 1.0)
    assert verdict == Verdict(Action.WARN, ("devices_missing",))
    assert missing in said[0][2]


def test_the_devices_that_have_told_something_are_watched_meanwhile() -> None:
    old = replace(HIGH, age_odometry=CONFIG.safety.odometry_lost + 0.1, age_servos=inf)
    told = dangers(replace(SEEN, servos=None, finite=False), old, Phase.PREFLIGHT, flying=False)
    _, verdict, _ = safety.step(safety.initial(), told, CONFIG.safety, 0.004)
    assert {"devices_missing", "odometry_late", "odometry_lost", "non_finite"} <= set(verdict.reasons)


@pytest.mark.parametrize("seen", [SEEN, replace(SEEN, servos=None)], ids=["seen", "waiting"])
@pytest.mark.parametrize("phase", Phase)
def test_before_arming_and_only_then_every_obstacle_is_told(phase: Phase, seen: estimating.State) -> None:
    obstacles = ("The servos are emulated.", "COM_OF_LOSS_T is 1, and must be 0.5.")
    told = facts.for_safety(seen, HIGH, inputs(obstacles=obstacles), phase, True, True, REFERENCE, None)
    _, verdict, said = safety.step(safety.initial(), told, CONFIG.safety, 0.004)
    reasons = set(verdict.reasons) - {"devices_missing"}
    if phase is Phase.PREFLIGHT:
        assert reasons == {"must_not_arm"}
        assert verdict.action is Action.WARN
        assert all(sentence in said[-1][2] for sentence in obstacles)
    else:
        assert not reasons


@pytest.mark.parametrize("phase", Phase)
def test_contact_is_expected_at_the_pipe_and_on_the_way_back_from_it(phase: Phase) -> None:
    at_pipe = {"advance", "press", "release", "retreat", "retreat_hold", "retreat_land"}
    assert dangers(phase=phase).contact_expected is (phase.value in at_pipe)


def test_pressing_is_the_closed_force_loop() -> None:
    closed = replace(REFERENCE, pressing=True)
    assert dangers(phase=Phase.PRESS, reference=closed).pressing
    assert not dangers(phase=Phase.PRESS).pressing
    assert not dangers(phase=Phase.RELEASE, reference=closed).pressing
    assert not dangers(phase=Phase.PRESS, reference=None).pressing


def test_the_worst_servo_counts() -> None:
    ill = servos(
        error=(0, 1, 0, 0x20, 0), temperature=(30.0, 55.0, 40.0, 30.0, 30.0), voltage=(5.0, 4.9, 5.2, 5.0, 5.0),
        torque_on=False,
    )  # fmt: skip
    told = dangers(replace(SEEN, servos=ill))
    assert (told.servo_error, told.temperature, told.servo_voltage_min, told.servo_voltage_max) == (
        0x21,
        55.0,
        4.9,
        5.2,
    )
    assert not told.torque_on


def test_the_joint_error_is_the_worst_joint_s_and_counts_in_flight() -> None:
    a, b, c = JOINTS[:3]
    arm = compensation.State((a + 0.1, b - 0.4, c + 0.2))
    assert dangers(arm=arm).joint_error == pytest.approx(0.4)
    assert dangers(arm=arm, flying=False).joint_error == 0.0
    assert dangers(arm=None).joint_error == 0.0


def test_force_tilt_and_place_are_what_is_believed() -> None:
    believed = replace(
        HIGH, force_W=(2.0, 3.0, 6.0), contact_force=-1.5, R_WB=matrix_from_quat(quat(yaw=1.0, pitch=0.3))
    )
    told = dangers(believed=believed)
    assert told.free_flight_force == pytest.approx(7.0)
    assert told.contact_force == -1.5
    assert told.tilt == pytest.approx(0.3)
    assert told.position == HIGH.p_WB


def test_offboard_is_lost_when_it_was_there_and_not_otherwise() -> None:
    for before, mode in product((True, False), FlightMode):
        told = dangers(replace(SEEN, autopilot=autopilot(mode=mode)), engaged_before=before)
        assert told.offboard_lost is (before and mode is not FlightMode.OFFBOARD)


def test_what_the_estimate_noticed_is_handed_on() -> None:
    seen = replace(SEEN, jump=0.2, reset=True, finite=False, disagreement=0.07, odometry=odometry(confidence=1))
    told = dangers(seen)
    assert (told.odometry_jump, told.odometry_reset, told.inputs_finite) == (0.2, True, False)
    assert (told.disagreement, told.confidence) == (0.07, 1)


@pytest.mark.parametrize("seen", [SEEN, replace(SEEN, servos=None)], ids=["seen", "waiting"])
def test_the_commander_s_age_counts_while_somebody_commands(seen: estimating.State) -> None:
    for link, age in (
        (LinkState("bench", T0 - 3_000_000_000, present=True), 3.0),
        (LinkState("bench", T0 + 1_000_000, present=True), 0.0),  # heard while this tick was begun
        (LinkState(), 0.0),
        (LinkState("", T0 - 3_000_000_000), 0.0),
    ):
        told = facts.for_safety(seen, HIGH, inputs(link=link), Phase.HOLD, True, True, REFERENCE, None)
        assert told.commander == link.commander
        assert told.link_age == pytest.approx(age)


# --- for the mission --------------------------------------------------------------------------------------------------


def known(
    seen: estimating.State = SEEN, believed: Estimate = HIGH, phase: Phase = Phase.APPROACH,
    progress: Progress = Progress(), flying: bool = True, verdict: Verdict = WELL,  # noqa: B008 - frozen
) -> mission.Facts:  # fmt: skip
    return facts.for_mission(seen, believed, progress, phase, flying, verdict, Phase.ALIGN, DERIVED, CONFIG)


READY = replace(SEEN, autopilot=autopilot(armed=False, landed=Landed.ON_GROUND, mode=FlightMode.HOLD))


def test_ready_is_valid_disarmed_on_the_ground_and_nothing_amiss() -> None:
    ground = {"believed": LOW, "phase": Phase.PREFLIGHT, "flying": False}
    assert known(READY, **ground).ready  # type: ignore[arg-type]
    assert not known(SEEN, **ground).ready  # type: ignore[arg-type]
    assert not known(READY, **(ground | {"believed": replace(LOW, valid=False)})).ready  # type: ignore[arg-type]
    warned = Verdict(Action.WARN, ("servos_late",))
    assert not known(READY, verdict=warned, **ground).ready  # type: ignore[arg-type]
    in_air = replace(READY, autopilot=autopilot(armed=False, mode=FlightMode.HOLD))
    assert not known(in_air, **ground).ready  # type: ignore[arg-type]


def test_engaged_is_armed_and_in_offboard() -> None:
    for armed, mode in product((True, False), FlightMode):
        told = known(replace(SEEN, autopilot=autopilot(armed=armed, mode=mode)))
        assert told.engaged is (armed and mode is FlightMode.OFFBOARD)
        assert told.disarmed is not armed


def test_landed_takes_both_witnesses() -> None:
    for flying, landed in product((True, False), Landed):
        told = known(replace(SEEN, autopilot=autopilot(landed=landed)), flying=flying)
        assert told.landed is (landed is Landed.ON_GROUND and not flying)


def test_progress_is_that_of_the_reference() -> None:
    told = known(progress=Progress(arrived=True, pressed=True, released=True, tared=True))
    assert all((told.arrived, told.pressed, told.released, told.tared))
    told = known()
    assert not any((told.arrived, told.pressed, told.released, told.tared))


def test_without_attitude_no_motion_is_waited_for() -> None:
    lost = CONFIG.safety.autopilot_lost
    assert not known(believed=replace(HIGH, age_autopilot=lost)).arrived
    assert known(believed=replace(HIGH, age_autopilot=lost + 0.01)).arrived


@pytest.mark.parametrize("phase", Phase)
def test_contact_is_lost_only_in_press(phase: Phase) -> None:
    assert known(phase=phase).contact_lost is (phase is Phase.PRESS)
    crack = derive(CONFIG).site.crack
    assert not known(phase=phase, believed=replace(HIGH, in_contact=True, tip_W=crack)).contact_lost


def test_contact_is_not_lost_while_it_is_looked_for_at_the_crack() -> None:
    x, y, z = derive(CONFIG).site.crack
    seeking = Progress(lost=False)
    limits = CONFIG.contact
    for tip, touching, lost in (
        ((x - 0.01, y, z), False, False),
        ((x, y + 2.0 * limits.tolerance + 0.01, z), False, True),
        ((x, y + 2.0 * limits.tolerance + 0.01, z), True, False),
        ((x, y, z - limits.height - 0.01), True, True),
    ):
        believed = replace(HIGH, in_contact=touching, tip_W=tip)
        assert known(phase=Phase.PRESS, believed=believed, progress=seeking).contact_lost is lost


@pytest.mark.parametrize("heading", [0.0, pi, -2.5])
def test_a_press_is_over_when_the_vehicle_swings_about_the_tip(heading: float) -> None:
    config = replace(CONFIG, pipe=replace(CONFIG.pipe, heading_deg=heading * 180.0 / pi))
    derived = derive(config)
    for turn, lost in ((0.0, False), (0.19, False), (-0.19, False), (0.21, True), (-0.21, True)):
        rpy = (0.0, 0.1, wrap_angle(heading + turn))
        believed = replace(HIGH, in_contact=True, tip_W=derived.site.crack, rpy=rpy)
        told = facts.for_mission(SEEN, believed, Progress(), Phase.PRESS, True, WELL, None, derived, config)
        assert told.contact_lost is lost


def test_a_pipe_that_was_not_felt_is_overtravel() -> None:
    assert known(phase=Phase.ALIGN, progress=Progress(missed=True)).overtravel
    assert not known(phase=Phase.ALIGN).overtravel


@pytest.mark.parametrize("heading", [0.0, 0.5 * pi, -2.5])
def test_overtravel_is_how_far_the_tip_is_past_the_crack_in_the_advance(heading: float) -> None:
    config = replace(CONFIG, pipe=replace(CONFIG.pipe, heading_deg=heading * 180.0 / pi))
    site = derive(config).site
    for beyond, told in ((-0.01, False), (0.01, True)):
        way = config.plan.overtravel + beyond
        tip = (site.crack[0] + way * site.normal[0], site.crack[1] + way * site.normal[1], site.crack[2])
        for phase in (Phase.ADVANCE, Phase.PRESS):
            seen = facts.for_mission(
                SEEN, replace(HIGH, tip_W=tip), Progress(), phase, True, WELL, None, derive(config), config
            )
            assert seen.overtravel is (told and phase is Phase.ADVANCE)


def test_blind_and_yielded_come_from_the_verdict() -> None:
    assert known(verdict=Verdict(Action.LAND, ("odometry_lost",))).blind
    assert not known(verdict=Verdict(Action.LAND, ("battery_critical",))).blind
    assert known(verdict=Verdict(Action.LAND, ("offboard_lost",))).offboard_lost


def test_what_a_request_to_go_or_to_tare_depends_on() -> None:
    told = known()
    assert (told.go, told.payload, told.tare_used) == (Phase.ALIGN, True, CONFIG.observer.tare)
    assert not known(believed=replace(HIGH, payload=False)).payload
    assert known(
        replace(SEEN, forces=estimators.State(tares=(tare.State((0.1, 0.2, 0.3)), *(tare.State(),) * 3)))
    ).tare == (0.1, 0.2, 0.3)


# --- for the gate -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", Phase)
def test_what_the_gate_may_let_through(phase: Phase) -> None:
    for engage, aloft in product(Engage, (True, False)):
        allowed = facts.permission(phase, engage, HIGH, aloft)
        assert allowed.motors is (phase not in (Phase.PREFLIGHT, Phase.STOPPED))
        assert allowed.joints is (engage is not Engage.KILL)
        assert allowed.floor is (aloft and phase is not Phase.LAND)
    assert not facts.permission(phase, Engage.OFFBOARD, replace(HIGH, valid=False), True).joints


def test_the_gate_takes_its_rates_up_where_the_vehicle_is() -> None:
    now = facts.measured(SEEN)
    assert (now.q_WB, now.servos) == (autopilot().q_WB, JOINTS)
    nothing = facts.measured(estimating.State())
    assert (nothing.q_WB, nothing.servos) == (None, None)
