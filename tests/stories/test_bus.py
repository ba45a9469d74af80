"""Each fault of the emulated servo bus, in flight, through the real driver: it survives, tells, and safety acts."""

from __future__ import annotations

from collections.abc import Callable
from math import dist

import pytest

from drivers import xc330
from drivers.dynamixel_bus import Bus
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.samples import ServoCommand, ServoState
from drivers.xc330 import HardwareError, Mode
from onboard.core.types import Action, Phase, Request
from sim_backend.dynamixel_mechanics import WorldServos
from sim_backend.faults import Kind
from tests.drivers.on_the_wire import Bench
from tests.stories.conftest import At
from tests.stories.flight import Flight

SETTINGS = DynamixelSettings(
    "",
    (
        ServoSettings(id=1, zero=3300, center=-1.15),
        ServoSettings(id=2, zero=2600, sign=-1),
        ServoSettings(id=3, zero=3000, center=-1.0),
        ServoSettings(id=4, zero=100),
        ServoSettings(id=5, zero=2000, sign=-1),
    ),
    baud=4_000_000,
)


class ServoBus:
    """Driver and emulated bus on the world of a flight; a cycle takes its time, and commands meanwhile are missed."""

    def __init__(self, flight: Flight) -> None:
        self._world = flight.world
        self.bench = Bench(SETTINGS, latency=1e-3, mechanics=WorldServos(flight.world, SETTINGS.servos))
        self.bench.wire.now = self._world.time  # setting up took its time, but not the world's
        self.bench.driver._watch.read(self._bus)
        self._seen: ServoState | None = None
        self.told: list[str] = []

    @property
    def _bus(self) -> Bus:
        assert self.bench.driver._bus is not None
        return self.bench.driver._bus

    def latest(self) -> ServoState | None:
        """The newest sample whose cycle is over."""
        if self.bench.wire.now <= self._world.time:
            self._seen = self.bench.driver.latest()
        return self._seen

    def command(self, command: ServoCommand) -> None:
        """A cycle, unless one is still under way."""
        bench, t = self.bench, self._world.time
        bench.plugged = not bench.bus.troubles.unplugged(t)
        if bench.wire.now <= t:
            bench.wire.now = t
            bench.once(command)
        bench.bus.update(max(t, bench.wire.now))
        self.told += [notice.text for notice in bench.driver.notices()]

    def fault(self, kind: Kind, duration: float | None = None, value: float = 0.0, part: str = "") -> None:
        """One that begins now."""
        self.bench.bus.troubles.faults.inject(self._world.time, kind, duration, value, part)

    def count(self, text: str) -> int:
        """How often this was told."""
        return sum(text in told for told in self.told)


Fly = Callable[[str], tuple[Flight, ServoBus]]


@pytest.fixture
def fly(at: At) -> Fly:
    """``fly(moment)``: a flight from that moment on, with the bus as its servos."""

    def begin(moment: str) -> tuple[Flight, ServoBus]:
        flight = at(moment)
        bus = ServoBus(flight)
        flight.servos = bus  # type: ignore[assignment]
        flight.run(0.2)
        assert flight.said == [], flight.said
        assert bus.told == [] or all("set from" in text for text in bus.told)
        bus.told.clear()
        return flight, bus

    return begin


def acts(flight: Flight, code: str, within: float) -> None:
    """The condition is met, and the vehicle holds; or gets away first, if the limp arm has not let go of the pipe."""
    flight.until(lambda outputs: code in outputs.verdict.reasons, within)
    assert flight.outputs is not None
    away = flight.outputs.verdict.action is Action.RETREAT
    assert away or flight.outputs.verdict.action is Action.HOLD
    flight.reach(*((Phase.RETREAT_HOLD, Phase.HOLD) if away else (Phase.HOLD,)), within=30.0)
    flight.run(1.0)
    assert flight.truth.crashed == ""


def lands(flight: Flight) -> None:
    flight.tick(Request.LAND)
    flight.until(lambda outputs: outputs.phase is Phase.STOPPED, 60.0).run(0.5)
    assert flight.truth.crashed == ""
    assert flight.truth.on_ground
    assert not flight.world.autopilot.armed


at_the_pipe_and_before = pytest.mark.parametrize("moment", ["approach", "press"])


def test_healthy_the_mission_goes_on_to_its_end(fly: Fly) -> None:
    flight, bus = fly("press")
    flight.until(lambda outputs: outputs.phase is Phase.STOPPED, 120.0)
    assert bus.told == []
    assert flight.truth.sleeve_on_pipe


@pytest.mark.parametrize("kind", [Kind.DROP, Kind.CORRUPT, Kind.TRUNCATE, Kind.WRONG_ID])
def test_one_answer_in_fifty_spoilt_changes_nothing(fly: Fly, kind: Kind) -> None:
    flight, bus = fly("press")
    bus.fault(kind, value=0.02)
    flight.run(3.0)
    assert flight.said == []
    assert set(flight.phases) <= {Phase.PRESS}
    assert bus.bench.driver.statistics().errors
    assert bus.count("a reading of the servos failed") == 1
    assert bus.count("does not answer") == 0


@at_the_pipe_and_before
def test_a_silent_servo(fly: Fly, moment: str) -> None:
    """Its watchdog hears nothing any more: it goes limp, and is told as an error."""
    flight, bus = fly(moment)
    bus.fault(Kind.SILENT, part="theta_2")
    acts(flight, "servo_error", 0.3)
    lands(flight)
    assert bus.count("theta_2 (id 2) does not answer any more; the others go on") == 1


@at_the_pipe_and_before
def test_an_overload_is_rebooted_and_remembered(fly: Fly, moment: str) -> None:
    flight, bus = fly(moment)
    bus.fault(Kind.ERROR_BIT, 0.0, HardwareError.OVERLOAD, "theta_3")
    acts(flight, "servo_error", 0.2)
    lands(flight)
    assert bus.count("theta_3 (id 3): overload; its torque is off, it is rebooted in 1 s") == 1
    assert bus.count("theta_3 (id 3): reboot 1 of 3") == 1
    assert bus.count("theta_3 (id 3) answers again, restarted") == 1


@at_the_pipe_and_before
def test_a_servo_that_restarts(fly: Fly, moment: str) -> None:
    flight, bus = fly(moment)
    bus.fault(Kind.REBOOT, 0.3, part="theta_1")
    acts(flight, "servo_error", 0.3)
    lands(flight)
    assert bus.count("theta_1 (id 1) does not answer any more") == 1
    assert bus.count("theta_1 (id 1) answers again, restarted") == 1


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.UNPLUGGED])
@at_the_pipe_and_before
def test_no_servo_any_more(fly: Fly, kind: Kind, moment: str) -> None:
    """Without a word to them the servos' watchdogs take their torque; the base gets away and stays calm."""
    flight, bus = fly(moment)
    place = flight.truth.p_WB
    bus.fault(kind)
    flight.meets("servos_late", Action.WARN, 0.2)
    acts(flight, "servos_lost", flight.config.safety.servos_lost)
    lands(flight)
    assert dist(flight.truth.p_WB[:2], place[:2]) < flight.config.plan.retreat + 0.4
    told = "no servo answers any more" if kind is Kind.SILENT else "the adapter on"
    assert bus.count(told) == 1


def test_the_adapter_is_put_back(fly: Fly) -> None:
    flight, bus = fly("approach")
    bus.fault(Kind.UNPLUGGED, 0.2)
    flight.run(3.0)
    assert flight.truth.crashed == ""
    assert bus.count("the adapter on  is gone") == bus.count("the adapter on  is back") == 1
    state = bus.latest()
    assert state is not None
    assert state.torque_on


@at_the_pipe_and_before
def test_servos_that_hear_but_are_not_heard_hold_the_arm(fly: Fly, moment: str) -> None:
    flight, bus = fly(moment)
    bus.fault(Kind.DROP, value=1.0)
    flight.meets("servos_late", Action.WARN, 0.2)
    flight.run(0.05)
    for servo in bus.bench.bus.servos[:3]:
        assert servo.get(xc330.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION
        assert servo.torque_on
    joints = flight.truth.joints
    acts(flight, "servos_lost", flight.config.safety.servos_lost)
    lands(flight)
    assert flight.truth.joints == pytest.approx(joints, abs=0.1)
