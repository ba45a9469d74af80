"""The loop against a simulated world, and against clocks that are late."""

from __future__ import annotations

import asyncio

import msgspec
import pytest
from msgspec.structs import replace

from drivers.samples import AutopilotCommand, Engage, ServoCommand
from onboard.clock import VirtualClock
from onboard.config import Config, load_config
from onboard.core.params import Params
from onboard.core.plan import InfeasibleError
from onboard.core.step import State, initial_state, step
from onboard.core.types import Inputs, Outputs, Phase, Request, Tick
from onboard.devices import DeviceSet, mock_devices, world_of
from onboard.loop import KEYFRAME_PERIOD_NS, Loop
from onboard.records import Timing
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
from sim_backend.world import World

PERIOD_NS = 4_000_000


class Kept:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.ticks: list[Tick] = []
        self.keyframes: list[tuple[int, int, State]] = []
        self.timings: list[Timing] = []
        self.revisions: list[tuple[int, int, int, Params]] = []

    def tick(self, tick: Tick) -> None:
        self.ticks.append(tick)

    def keyframe(self, index: int, t_ns: int, state: State) -> None:
        self.keyframes.append((index, t_ns, state))

    def timing(self, timing: Timing) -> None:
        self.timings.append(timing)

    def revision(self, index: int, t_ns: int, revision: int, config: Params) -> None:
        self.revisions.append((index, t_ns, revision, config))


class LateClock:
    """A clock that comes back late from the sleeps named in ``late`` (ns, by their number from 0)."""

    def __init__(self, late: dict[int, int]) -> None:
        self._now = 7_000_000_000
        self._late = late
        self._sleeps = 0

    def work(self, duration_ns: int) -> None:
        """Let time pass within a tick."""
        self._now += duration_ns

    def now_ns(self) -> int:
        return self._now

    async def sleep_until(self, t_ns: int) -> None:
        self._now = max(self._now, t_ns) + self._late.get(self._sleeps, 0)
        self._sleeps += 1


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("paper")


def fly(config: Config, seconds: float, requests: dict[float, Request]) -> tuple[Kept, World]:
    """Run the loop on virtual time; ``requests`` by the time at which each is made, s."""
    world, kept = world_of(config), Kept()
    clock = VirtualClock(world.advance)
    loop = Loop(mock_devices(world), clock, config, kept)
    left = sorted(requests.items())

    def on_tick(outputs: Outputs) -> bool:
        while left and clock.now_ns() * 1e-9 >= left[0][0]:
            loop.request(left.pop(0)[1])
        assert loop.outputs is outputs
        return clock.now_ns() < seconds * 1e9

    asyncio.run(loop.run(on_tick))
    return kept, world


@pytest.fixture(scope="module")
def flown(config: Config) -> Kept:
    return fly(config, 4.0, {0.4: Request.START})[0]


def idle(config: Config, clock: LateClock, ticks: int) -> Kept:
    """Run the timed loop on the ground for so many ticks."""
    kept, left = Kept(), [ticks]

    def on_tick(outputs: Outputs) -> bool:
        left[0] -= 1
        return left[0] > 0

    asyncio.run(Loop(mock_devices(world_of(config)), clock, config, kept, timed=True).run(on_tick))
    return kept


def test_two_runs_are_the_same_to_the_bit(config: Config, flown: Kept) -> None:
    again, _ = fly(config, 4.0, {0.4: Request.START})
    assert msgspec.json.encode(again.ticks) == msgspec.json.encode(flown.ticks)
    assert again.keyframes == flown.keyframes
    assert flown.ticks[-1].outputs.phase is Phase.TAKEOFF


def test_the_rhythm(flown: Kept) -> None:
    assert [tick.index for tick in flown.ticks] == list(range(1001))
    assert [tick.inputs.t_ns for tick in flown.ticks] == [PERIOD_NS * i for i in range(1001)]
    assert {tick.inputs.dt for tick in flown.ticks} == {0.004}
    assert {tick.revision for tick in flown.ticks} == {0}
    assert flown.timings == []  # virtual time is never late


def test_samples_are_those_of_the_tick(flown: Kept) -> None:
    for tick in flown.ticks:
        inputs = tick.inputs
        assert inputs.odometry is not None
        assert inputs.autopilot is not None
        assert inputs.servos is not None
        assert inputs.odometry.t_ns == inputs.autopilot.t_ns == inputs.servos.t_ns == inputs.t_ns


def test_keyframes_every_second_and_the_run_can_be_taken_up_from_each(config: Config, flown: Kept) -> None:
    period = KEYFRAME_PERIOD_NS // PERIOD_NS
    assert [(index, t_ns) for index, t_ns, _ in flown.keyframes] == [
        (i * period, i * KEYFRAME_PERIOD_NS) for i in range(5)
    ]
    for index, _, state in flown.keyframes:
        for tick in flown.ticks[index : index + 20]:
            state, outputs = step(state, tick.inputs, config, tick.inputs.dt)
            assert outputs == tick.outputs


def test_requests_are_taken_one_a_tick_in_order(config: Config) -> None:
    world, kept = world_of(config), Kept()
    loop = Loop(mock_devices(world), VirtualClock(world.advance), config, kept)
    asked = [Request.RESUME, Request.LAND, Request.RESUME, Request.HOLD]
    for request in asked:
        loop.request(request)
    asyncio.run(loop.run(lambda outputs: len(kept.ticks) < 6))
    assert [tick.inputs.request for tick in kept.ticks] == [*asked, None, None]
    refused = [event.text.split(" ")[0] for tick in kept.ticks for event in tick.outputs.events]
    assert refused == ["resume", "land", "resume", "hold"]


@pytest.mark.parametrize("urgent", [Request.KILL, Request.STOP])
def test_what_is_urgent_waits_for_no_other_request(config: Config, urgent: Request) -> None:
    world, kept = world_of(config), Kept()
    loop = Loop(mock_devices(world), VirtualClock(world.advance), config, kept)
    for request in (Request.LAND, Request.HOLD, urgent):
        loop.request(request)
    asyncio.run(loop.run(lambda outputs: len(kept.ticks) < 3))
    assert [tick.inputs.request for tick in kept.ticks] == [urgent, Request.LAND, Request.HOLD]


class Logged:
    """A device that notes what is done with it."""

    def __init__(self, name: str, log: list[str], sample: object) -> None:
        self._name, self._log, self._sample = name, log, sample

    def latest(self) -> object:
        self._log.append(f"read {self._name}")
        return self._sample

    def command(self, command: AutopilotCommand | ServoCommand) -> None:
        self._log.append(f"command {self._name}")


class LoggedSet(DeviceSet):
    """Three logged devices, whose set notes what is done with it too."""

    def __init__(self, log: list[str]) -> None:
        autopilot, odometry, servos = (Logged(name, log, None) for name in ("autopilot", "odometry", "servos"))
        super().__init__(autopilot, odometry, servos)  # type: ignore[arg-type]
        self._log = log

    def relay(self) -> None:
        self._log.append("relay")


class Forbidden(DeviceSet):
    """The devices of a world, with something amiss until ``seconds`` of it have passed."""

    def __init__(self, world: World, seconds: float) -> None:
        given = mock_devices(world)
        super().__init__(given.autopilot, given.odometry, given.servos)
        self._world, self._seconds = world, seconds

    def obstacles(self) -> tuple[str, ...]:
        return ("A cable is loose.",) if self._world.truth().t < self._seconds else ()


def test_all_is_read_before_and_all_commanded_after_each_step(config: Config) -> None:
    log: list[str] = []

    def on_tick(outputs: Outputs) -> bool:
        log.append("told")
        return log.count("told") < 2

    asyncio.run(Loop(LoggedSet(log), VirtualClock(lambda duration: None), config, Kept()).run(on_tick))
    reads = [f"read {name}" for name in ("odometry", "autopilot", "servos")]
    tick = [*reads, "command autopilot", "command servos", "relay", "told"]
    assert log == tick * 2


def test_without_any_sample_nothing_moves(config: Config) -> None:
    log: list[str] = []
    kept = Kept()
    loop = Loop(LoggedSet(log), VirtualClock(lambda duration: None), config, kept)
    loop.request(Request.START)
    asyncio.run(loop.run(lambda outputs: len(kept.ticks) < 50))
    assert {tick.outputs.phase for tick in kept.ticks} == {Phase.PREFLIGHT}
    assert {tick.outputs.autopilot.engage for tick in kept.ticks} == {Engage.IDLE}


def test_an_obstacle_keeps_the_vehicle_on_the_ground_until_it_is_gone(config: Config) -> None:
    world, kept = world_of(config), Kept()
    clock = VirtualClock(world.advance)
    loop = Loop(Forbidden(world, 0.5), clock, config, kept)
    asks = [0.4, 2.0]

    def on_tick(outputs: Outputs) -> bool:
        if asks and clock.now_ns() * 1e-9 >= asks[0]:
            asks.pop(0)
            loop.request(Request.START)
        return clock.now_ns() < 2_100_000_000

    asyncio.run(loop.run(on_tick))
    codes = [event.code for tick in kept.ticks for event in tick.outputs.events]
    assert codes == ["must_not_arm", "refused_not_ready", "must_not_arm_cleared", "start"]
    assert "A cable is loose." in kept.ticks[0].outputs.events[0].text


def test_an_infeasible_mission_is_refused_before_the_first_tick(config: Config) -> None:
    low = replace(config, pipe=replace(config.pipe, position=(2.0, 0.0, 0.3)))
    devices = mock_devices(world_of(config))
    with pytest.raises(InfeasibleError, match=r"pipe\.position"):
        Loop(devices, LateClock({}), low, Kept())


@pytest.mark.parametrize(("late", "warned"), [(1_000_000, False), (17_000_000, True)])
def test_a_late_tick_is_told(config: Config, late: int, warned: bool) -> None:
    kept = idle(config, LateClock({4: late}), 12)
    tick = kept.ticks[5]
    assert tick.inputs.dt == pytest.approx(0.004 + late * 1e-9)
    assert ("tick_late" in tick.outputs.verdict.reasons) is warned
    assert kept.timings[5].late == pytest.approx(late * 1e-9)
    assert [timing.late for timing in kept.timings[:5]] == [0.0] * 5


def test_the_way_of_the_set_point_is_timed(config: Config) -> None:
    clock = LateClock({})

    class Slow(MockAutopilot):
        def command(self, command: AutopilotCommand) -> None:
            clock.work(300_000)
            super().command(command)

    class Relaying(DeviceSet):
        def relay(self) -> None:
            clock.work(200_000)

    world, kept = world_of(config), Kept()
    devices = Relaying(Slow(world), MockOdometry(world), MockServos(world))
    asyncio.run(Loop(devices, clock, config, kept, timed=True).run(lambda outputs: len(kept.ticks) < 3))
    assert [timing.sent for timing in kept.timings] == pytest.approx([0.0003] * 3)
    assert [timing.busy for timing in kept.timings] == pytest.approx([0.0005] * 3)


def test_a_little_late_the_loop_catches_up(config: Config) -> None:
    kept = idle(config, LateClock({4: 10_000_000}), 20)
    late = [timing.late for timing in kept.timings]
    assert late[5:8] == pytest.approx([0.010, 0.006, 0.002])
    assert late[8:] == [0.0] * 12
    first, last = kept.ticks[0].inputs.t_ns, kept.ticks[-1].inputs.t_ns
    assert last - first == 19 * PERIOD_NS


def test_after_a_long_stall_there_is_no_burst(config: Config) -> None:
    kept = idle(config, LateClock({4: 1_000_000_000}), 20)
    gaps = [b.inputs.t_ns - a.inputs.t_ns for a, b in zip(kept.ticks[5:], kept.ticks[6:], strict=False)]
    assert gaps[0] <= PERIOD_NS
    assert gaps[1:] == [PERIOD_NS] * len(gaps[1:])
    assert kept.timings[5].late == pytest.approx(1.0)
    assert max(timing.late for timing in kept.timings[6:]) <= PERIOD_NS * 1e-9


def test_the_core_s_step_is_all_that_the_loop_adds(config: Config, flown: Kept) -> None:
    state = initial_state(config)
    for tick in flown.ticks:
        inputs: Inputs = tick.inputs
        state, outputs = step(state, inputs, config, inputs.dt)
        assert outputs == tick.outputs
