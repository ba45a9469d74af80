"""The core as a whole: pure, replayable, and safe against whatever it is told."""

from __future__ import annotations

from math import inf, isfinite, nan
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from drivers.samples import Engage, Interface, JointMode
from onboard.config import load_config
from onboard.core.step import State, initial_state, step
from onboard.core.types import Inputs, Outputs, Phase, Request
from tests.core.sampled import spoilt
from tests.stories.conftest import Log
from tests.stories.flight import PERIOD, Flight

CONFIG = load_config("paper")
MOMENTS = ["takeoff", "approach", "adhesive", "advance", "press", "release", "landing"]


@pytest.fixture(scope="module")
def log() -> Log:
    return Log()


def commands(outputs: Outputs) -> list[float]:
    """Every number that leaves the core for a device."""
    a, s = outputs.autopilot, outputs.servos
    return [a.thrust, *a.torque_B, *a.q_WB, *a.w_WB_B, *s.torque, *s.position, s.current_limit]


def followed(outputs: Outputs) -> list[float]:
    """The numbers that a wrench and torque-driven joints take from the commands."""
    a, s = outputs.autopilot, outputs.servos
    assert a.interface is Interface.WRENCH
    joints = s.torque if s.mode is JointMode.TORQUE else s.position[:3]
    return [a.thrust, *a.torque_B, *joints, *s.position[3:]]


def sampled(flight: Flight, request: Request | None = None) -> Inputs:
    """The inputs of the next tick."""
    return Inputs(
        round(flight.world.time * 1e9), PERIOD,
        flight.odometry.latest(), flight.autopilot.latest(), flight.servos.latest(), request, link=flight.link,
    )  # fmt: skip


# --- purity -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moment", MOMENTS)
def test_same_arguments_same_bits(log: Log, moment: str) -> None:
    flight = log.at(moment)
    seen, state = sampled(flight), flight.state
    first, second = (step(state, seen, flight.config, PERIOD) for _ in range(2))
    assert msgspec.json.encode(first) == msgspec.json.encode(second)
    assert first == second
    other = load_config("paper", sets=["pipe.heading_deg=20.0"])
    step(initial_state(other), seen, other, PERIOD)  # another parameter set in between leaves no trace
    assert step(state, seen, flight.config, PERIOD) == first


@pytest.mark.parametrize("moment", MOMENTS)
def test_the_state_survives_json_to_the_bit(log: Log, moment: str) -> None:
    flight = log.at(moment)
    state = msgspec.json.decode(msgspec.json.encode(flight.state), type=State)
    assert state == flight.state
    for _ in range(25):
        seen = sampled(flight)
        state, outputs = step(state, seen, flight.config, PERIOD)
        assert outputs == flight.tick()
        assert state == flight.state


@pytest.mark.parametrize("request_", [Request.STOP, Request.ARM, Request.TARE, Request.GO])
def test_every_input_is_in_the_log_to_the_bit(log: Log, request_: Request) -> None:
    """What a log keeps of the inputs gives the same state and outputs again."""
    flight = log.at("adhesive").command_from("bench")
    flight.tick(Request.HOLD)
    flight.run(1.0).reached = False
    flight.run(1.99)  # the link is lost within the ticks that are compared
    for i in range(25):
        before, asked = flight.state, request_ if i == 12 else None
        outputs = flight.tick(asked, go=Phase.RETURN if asked is Request.GO else None)
        kept = msgspec.json.decode(msgspec.json.encode(flight.inputs), type=Inputs)
        assert kept == flight.inputs
        assert step(before, kept, flight.config, kept.dt) == (flight.state, outputs)
    assert "link_silent" in flight.said


def test_the_initial_state_survives_json() -> None:
    state = initial_state(CONFIG)
    assert msgspec.json.decode(msgspec.json.encode(state), type=State) == state


# --- what it is told --------------------------------------------------------------------------------------------------


def test_without_samples_it_waits_and_commands_nothing() -> None:
    state = initial_state(CONFIG)
    for i in range(500):
        request = Request.START if i == 250 else None
        state, outputs = step(state, Inputs(i * 4_000_000, PERIOD, None, None, None, request), CONFIG, PERIOD)
        assert outputs.phase is Phase.PREFLIGHT
        assert outputs.autopilot.engage is Engage.IDLE
        assert outputs.autopilot.thrust == 0.0
        assert outputs.servos.mode is JointMode.OFF
        assert outputs.verdict.reasons
        assert all(isfinite(x) for x in commands(outputs))


FIELDS = [
    ("odometry", "p_WB", 3), ("odometry", "v_WB", 3), ("odometry", "q_WB", 4),
    ("autopilot", "q_WB", 4), ("autopilot", "w_WB_B", 3), ("autopilot", "f_B", 3),
    ("servos", "position", 5), ("servos", "velocity", 5), ("servos", "current", 5), ("servos", "voltage", 5),
    ("servos", "temperature", 5),
]  # fmt: skip
SCALARS = [("autopilot", "battery_voltage"), ("autopilot", "battery_remaining")]


def bad(sample: Any, field: str, index: int, value: float) -> Any:
    now = getattr(sample, field)
    return replace(sample, **{field: spoilt(now, index, value) if isinstance(now, tuple) else value})


@pytest.mark.parametrize("moment", ["approach", "press"])
@pytest.mark.parametrize(
    ("device", "field", "index"),
    [(d, f, i) for d, f, n in FIELDS for i in (0, n - 1)] + [(d, f, 0) for d, f in SCALARS],
)
def test_what_is_not_finite_never_reaches_a_command(log: Log, moment: str, device: str, field: str, index: int) -> None:
    for value in (nan, inf, -inf):
        flight = log.at(moment)
        getattr(flight, device).spoil = lambda sample, value=value: bad(sample, field, index, value)
        for _ in range(12):
            outputs = flight.tick()
            assert all(isfinite(x) for x in commands(outputs)), outputs
            assert "non_finite" in outputs.verdict.reasons


@pytest.mark.parametrize("moment", ["approach", "press"])
@pytest.mark.parametrize("value", [3.4e38, -3.4e38, 1e9, -1e3, 0.0])
def test_what_is_absurd_does_not_end_the_loop(log: Log, moment: str, value: float) -> None:
    """All that a single-precision wire can carry: the core goes on, and what is followed stays within its bounds."""
    for device, field, size in FIELDS:
        flight = log.at(moment)
        absurd = (value,) * size
        getattr(flight, device).spoil = lambda sample, f=field, a=absurd: replace(sample, **{f: a})
        for _ in range(12):
            outputs = flight.tick()
            assert all(abs(x) < 300.0 for x in followed(outputs)), (device, field, outputs)


@pytest.mark.parametrize(("dt", "taken"), [(0.0, "min"), (-1.0, "min"), (nan, "min"), (1.0, "max"), (inf, "max")])
def test_dt_is_kept_within_its_bounds(log: Log, dt: float, taken: str) -> None:
    flight = log.at("approach")
    seen = sampled(flight)
    bound = flight.config.dt_min if taken == "min" else flight.config.dt_max
    assert step(flight.state, seen, flight.config, dt) == step(flight.state, seen, flight.config, bound)
    inside = step(flight.state, seen, flight.config, 0.005)
    assert inside != step(flight.state, seen, flight.config, bound)


@pytest.mark.parametrize("dt", [nan, inf])
def test_a_measured_dt_that_is_not_finite_is_told(log: Log, dt: float) -> None:
    flight = log.at("approach")
    _, outputs = step(flight.state, replace(sampled(flight), dt=dt), flight.config, dt)
    assert "non_finite" in outputs.verdict.reasons
    assert all(isfinite(x) for x in commands(outputs))


# --- requests ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hovering() -> Flight:
    flight = Flight(CONFIG).run(0.4)
    flight.tick(Request.TAKEOFF)
    return flight.until(lambda outputs: outputs.phase is Phase.HOLD, 20.0).run(2.0)


@pytest.mark.parametrize(
    ("request_", "phase", "code"),
    [
        (Request.TAKEOFF, Phase.HOLD, "refused_flying"),
        (Request.START, Phase.APPROACH, "approach"),
        (Request.HOLD, Phase.HOLD, "refused_holding"),
        (Request.RESUME, Phase.HOLD, "refused_nothing"),
        (Request.RETREAT, Phase.HOLD, "refused_clear"),
        (Request.LAND, Phase.LAND, "land"),
        (Request.STOP, Phase.LAND, "land"),
        (Request.ARM, Phase.HOLD, "refused_flying"),
        (Request.TARE, Phase.HOLD, "tare_by_hand"),
        (Request.GO, Phase.APPROACH, "go"),
        (Request.KILL, Phase.STOPPED, "killed"),
        (Request.RESET, Phase.HOLD, "refused_reset"),
    ],
)
def test_every_request_in_hover(hovering: Flight, request_: Request, phase: Phase, code: str) -> None:
    flight = hovering.copy()
    outputs = flight.tick(request_, go=Phase.APPROACH)
    assert outputs.phase is phase
    assert [event.code for event in outputs.events] == [code]
    assert outputs.events[0].t_ns == flight.inputs.t_ns if flight.inputs else False
    assert outputs.autopilot.engage is (Engage.KILL if request_ is Request.KILL else Engage.OFFBOARD)
    before = hovering.copy().tick()
    if phase is not Phase.STOPPED:  # nothing jumps
        assert outputs.reference.p == pytest.approx(before.reference.p, abs=1e-6)
        assert outputs.autopilot.thrust == pytest.approx(before.autopilot.thrust, abs=0.05)


def test_events_are_sentences_of_the_tick(log: Log) -> None:
    flight = log.at("approach")
    for event in flight.tick(Request.HOLD).events:
        assert flight.inputs is not None
        assert event.t_ns == flight.inputs.t_ns
        assert event.text.endswith(".")
    assert flight.tick().events == ()
