"""A mission that can be stopped at any tick, copied, and spoilt."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy, deepcopy
from math import dist, hypot, nan
from typing import Any

from msgspec.structs import replace

from drivers.samples import Landed
from onboard.config import Config
from onboard.core.derived import derive
from onboard.core.step import State, initial_state, step
from onboard.core.types import Action, Event, Inputs, LinkState, Outputs, Phase, Request
from onboard.devices import world_of
from sim_backend import layout as at
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
from sim_backend.plant import Truth

PERIOD = 0.004
#: What a fault makes of a sample.
Spoil = Callable[[Any], Any]


class Spoilt:
    """A device whose samples pass through ``spoil``, and whose commands through ``twist``, while those are set."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self.spoil: Spoil | None = None
        self.twist: Spoil | None = None

    def latest(self) -> Any:
        """The device's newest sample, spoilt."""
        sample = self._device.latest()
        return sample if self.spoil is None else self.spoil(sample)

    def command(self, command: Any) -> None:
        """Hand a command on, twisted."""
        self._device.command(command if self.twist is None else self.twist(command))


class Flight:
    """World, devices and core, one tick after the other, as the loop does it."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.world = world_of(config)
        self.state: State = initial_state(config)
        self.outputs: Outputs | None = None
        self.inputs: Inputs | None = None
        self._elapsed = PERIOD
        self._begin()

    def _begin(self) -> None:
        world = self.world
        self.odometry = Spoilt(MockOdometry(world))
        self.autopilot = Spoilt(MockAutopilot(world))
        self.servos = Spoilt(MockServos(world))
        self.link = LinkState()
        self.reached = False
        self.events: list[Event] = []
        self.phases: list[Phase] = [] if self.outputs is None else [self.outputs.phase]

    def copy(self) -> Flight:
        """The same moment with healthy devices, on its own from here. The configuration stays shared."""
        twin = copy(self)
        shared = (self.world.vehicle, self.world.params)
        twin.world = deepcopy(self.world, {id(thing): thing for thing in shared})
        twin._begin()
        return twin

    def command_from(self, station: str) -> Flight:
        """From now on a station commands, and is heard in every tick while it is in reach."""
        self.reached = True
        self.link = LinkState(station, round(self.world.time * 1e9), present=True)
        return self

    def tick(self, request: Request | None = None, period: float = PERIOD, *, go: Phase | None = None) -> Outputs:
        """One cycle of the core, then ``period`` seconds of the world."""
        now = round(self.world.time * 1e9)
        if self.reached:
            self.link = replace(self.link, heard_ns=now)
        self.inputs = Inputs(
            now, self._elapsed, self.odometry.latest(), self.autopilot.latest(), self.servos.latest(), request, (),
            go, self.link,
        )  # fmt: skip
        self.state, outputs = step(self.state, self.inputs, self.config, self.inputs.dt)
        self.autopilot.command(outputs.autopilot)
        self.servos.command(outputs.servos)
        self.outputs = outputs
        self.events += outputs.events
        if not self.phases or self.phases[-1] is not outputs.phase:
            self.phases.append(outputs.phase)
        self.world.advance(period)
        self._elapsed = period
        return outputs

    def run(self, seconds: float, period: float = PERIOD) -> Flight:
        """Go on for so long."""
        for _ in range(round(seconds / period)):
            self.tick(period=period)
        return self

    def until(self, done: Callable[[Outputs], bool], within: float, period: float = PERIOD) -> Flight:
        """Go on until ``done``; that it comes within so many seconds is asserted."""
        end = self.world.time + within
        while not done(self.tick(period=period)):
            assert self.world.time < end, f"not within {within} s; phases {self.phases}, said {self.said}"
        return self

    def reach(self, *phases: Phase, within: float) -> Flight:
        """Go on through ``phases``, one directly after the other."""
        for phase in phases:
            before = len(self.phases)
            self.until(lambda outputs, phase=phase: outputs.phase is phase, within)  # type: ignore[misc]
            assert self.phases[before:] in ([], [phase]), f"on the way to {phase}: {self.phases}"
        return self

    def meets(self, code: str, action: Action, within: float, period: float = PERIOD) -> Flight:
        """Go on until the condition ``code`` is active; it demands ``action``, and nothing asks for more."""
        self.until(lambda outputs: code in outputs.verdict.reasons, within, period)
        assert self.outputs is not None
        assert self.outputs.verdict.action is action, self.outputs.verdict
        return self

    def is_in(self, phase: Phase) -> None:
        """The phase in force is this one."""
        assert self.phases[-1] is phase, (self.phases, self.said)

    # --- ends -------------------------------------------------------------------------------------------------------

    def hovers(self, seconds: float = 2.0) -> None:
        """It holds in the air, in one piece and still, from here on."""
        assert self.outputs is not None
        assert self.outputs.phase is Phase.HOLD
        self.run(1.5)
        place = self.truth.p_WB
        self.run(seconds)
        assert self.outputs.phase is Phase.HOLD
        assert self.truth.crashed == ""
        assert not self.truth.on_ground
        assert dist(self.truth.p_WB, place) < 0.05
        assert hypot(*self.truth.v_WB) < 0.05

    def stands(self, within: float = 30.0) -> None:
        """It comes to the ground in one piece, the motors off, and the mission says that it has stopped."""
        self.until(lambda outputs: outputs.phase is Phase.STOPPED, within).run(0.5)
        assert self.phases[-2:] == [Phase.LAND, Phase.STOPPED]
        self.is_down()

    def is_down(self) -> None:
        """It is on the ground in one piece, the motors off."""
        assert self.truth.crashed == ""
        assert self.truth.on_ground
        assert hypot(*self.truth.v_WB) < 0.02
        assert not self.world.autopilot.armed
        assert self.world.autopilot.landed is Landed.ON_GROUND

    # --- what can be seen -------------------------------------------------------------------------------------------

    @property
    def said(self) -> list[str]:
        """Codes of all events since the flight was copied."""
        return [event.code for event in self.events]

    @property
    def truth(self) -> Truth:
        """What is true in the world."""
        return self.world.truth()

    @property
    def from_pipe(self) -> float:
        """How far the gripper is in front of where the crack is believed, m."""
        site, tip = derive(self.config).site, self.truth.tip_W
        return (site.crack[0] - tip[0]) * site.normal[0] + (site.crack[1] - tip[1]) * site.normal[1]

    # --- the link ---------------------------------------------------------------------------------------------------

    def without_link(self, seconds: float) -> Flight:
        """Go on for so long without a word of the commanding station, which is then in reach again."""
        self.reached = False
        self.run(seconds)
        self.reached = True
        return self

    # --- faults of the world ----------------------------------------------------------------------------------------

    def move_pipe(self, x: float) -> None:
        """Move the pipe along x of W, m."""
        self.world.plant.p[at.PIPE_POINT] += x

    def charge(self, left: float) -> None:
        """Set what is left in the battery, 0..1."""
        self.world.plant.x[at.CHARGE] = left


# --- faults of the devices --------------------------------------------------------------------------------------------


def silent(sample: Any) -> None:
    """Nothing is told."""


def frozen() -> Spoil:
    """The same sample again and again."""
    kept: list[Any] = []

    def spoil(sample: Any) -> Any:
        kept.append(sample)
        return kept[0]

    return spoil


def hanging() -> Spoil:
    """The same content again and again, with fresh stamps."""
    kept = frozen()
    return lambda sample: replace(kept(sample), t_ns=sample.t_ns)


def moved(x: float, y: float, z: float) -> Spoil:
    """Positions beside the truth."""
    return lambda sample: replace(sample, p_WB=(sample.p_WB[0] + x, sample.p_WB[1] + y, sample.p_WB[2] + z))


def with_(**fields: Any) -> Spoil:
    """Some fields overwritten."""
    return lambda sample: replace(sample, **fields)


NAN_POSITION = with_(p_WB=(nan, nan, nan))
NAN_ATTITUDE = with_(q_WB=(nan, nan, nan, nan))
NAN_JOINTS = with_(position=(nan, nan, nan, nan, nan))
