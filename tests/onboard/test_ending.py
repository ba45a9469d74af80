"""The end of a run: as a state machine by hand, by signals, and of a simulated flight."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from threading import Thread

import pytest
from msgspec.structs import replace

from drivers.samples import AutopilotCommand, Engage, FlightMode, Interface
from onboard.clock import VirtualClock
from onboard.config import Config, load_config
from onboard.core.types import Outputs, Phase, Request, Severity
from onboard.devices import mock_devices, world_of
from onboard.ending import Ending, hand_over, signals
from onboard.loop import Loop
from sim_backend.mock_devices import MockAutopilot
from tests.onboard.test_loop import Kept
from tests.synthetic import mission

OUTPUTS = next(iter(mission()))[0].outputs


class Run:
    """An ``Ending`` that is shown ticks by hand."""

    def __init__(self, patience: float = 60.0) -> None:
        self.requests: list[Request] = []
        self.ending = Ending(self.requests.append, patience)
        self.t = 0.0

    def tick(self, phase: Phase, engage: Engage = Engage.OFFBOARD, dt: float = 0.004) -> bool:
        self.t += dt
        command = replace(OUTPUTS.autopilot, engage=engage)
        return self.ending.goes_on(replace(OUTPUTS, phase=phase, autopilot=command), self.t)

    def said(self) -> list[tuple[str, Severity]]:
        return [(event.code, event.severity) for event in self.ending.events(5)]


@pytest.mark.parametrize("phase", Phase)
def test_unasked_it_goes_on(phase: Phase) -> None:
    run = Run()
    assert all(run.tick(phase) for _ in range(1000))
    assert run.requests == []
    assert run.said() == []


@pytest.mark.parametrize("phase", [Phase.PREFLIGHT, Phase.STOPPED])
@pytest.mark.parametrize("asks", [1, 2])
def test_on_the_ground_it_ends_at_once(phase: Phase, asks: int) -> None:
    run = Run()
    assert run.tick(phase, Engage.IDLE)
    for _ in range(asks):
        run.ending.ask("SIGTERM")
    assert not run.tick(phase, Engage.IDLE)
    assert run.requests == []
    assert run.ending.handed_over is None
    assert run.said() == [("ended", Severity.INFO)]


def test_a_flying_vehicle_is_landed_first() -> None:
    run = Run()
    run.tick(Phase.APPROACH)
    run.ending.ask("SIGTERM")
    assert run.tick(Phase.APPROACH)
    assert run.requests == [Request.LAND]
    (event,) = run.ending.events(17)
    assert (event.t_ns, event.code) == (17, "ending")
    assert "SIGTERM" in event.text
    for _ in range(1000):
        assert run.tick(Phase.LAND)
    assert run.requests == [Request.LAND]
    assert not run.tick(Phase.STOPPED, Engage.IDLE)
    assert run.ending.handed_over is None
    assert run.said() == [("ended", Severity.INFO)]


@pytest.mark.parametrize("phase", [Phase.LAND, Phase.RETREAT_LAND])
def test_a_landing_under_way_is_only_waited_for(phase: Phase) -> None:
    run = Run()
    run.tick(phase)
    run.ending.ask("SIGTERM")
    assert run.tick(phase)
    assert run.requests == []


def test_a_landing_that_somebody_breaks_off_is_asked_for_again_though_not_in_every_tick() -> None:
    run = Run()
    run.ending.ask("SIGTERM")
    for _ in range(500):
        run.tick(Phase.HOLD)
    assert run.requests == [Request.LAND] * 2


@pytest.mark.parametrize("engage", [Engage.OFFBOARD, Engage.LAND])
def test_asked_twice_it_leaves_and_the_autopilot_is_to_land(engage: Engage) -> None:
    run = Run()
    run.ending.ask("SIGINT")
    assert run.tick(Phase.PRESS)
    run.ending.ask("SIGINT")
    assert not run.tick(Phase.RETREAT_LAND, engage)
    assert run.ending.handed_over is not None
    assert run.ending.handed_over.engage is Engage.LAND
    assert run.ending.handed_over.thrust == 0.0
    assert run.said() == [("ending", Severity.WARNING), ("left", Severity.ERROR)]


def test_asked_twice_between_two_ticks_it_leaves_too() -> None:
    run = Run()
    run.tick(Phase.HOLD)
    run.ending.ask("SIGINT")
    run.ending.ask("SIGINT")
    assert not run.tick(Phase.HOLD)
    assert run.ending.handed_over is not None


def test_what_a_pilot_has_taken_is_left_to_him() -> None:
    run = Run()
    run.ending.ask("SIGINT")
    assert run.tick(Phase.LAND, Engage.IDLE)
    run.ending.ask("SIGINT")
    assert not run.tick(Phase.LAND, Engage.IDLE)
    assert run.ending.handed_over is None
    assert run.said()[-1] == ("left", Severity.ERROR)


def test_a_landing_that_takes_too_long_is_given_up() -> None:
    run = Run(patience=10.0)
    run.ending.ask("SIGTERM")
    ticks = 0
    while run.tick(Phase.LAND):
        ticks += 1
    assert ticks == pytest.approx(2500, abs=2)
    assert run.ending.handed_over is not None
    assert run.said() == [("ending", Severity.WARNING), ("left", Severity.ERROR)]


# --- a simulated flight -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("paper")


def test_a_hovering_vehicle_comes_down_before_the_loop_ends(config: Config) -> None:
    world, kept = world_of(config), Kept()
    clock = VirtualClock(world.advance)
    loop = Loop(mock_devices(world), clock, config, kept)
    ending = Ending(loop.request)

    def on_tick(outputs: Outputs) -> bool:
        if clock.now_ns() == 600_000_000:
            loop.request(Request.TAKEOFF)
        if outputs.phase is Phase.HOLD and outputs.phase_time == 0.0:
            ending.ask("SIGTERM")
        return ending.goes_on(outputs, clock.now_ns() * 1e-9)

    asyncio.run(loop.run(on_tick))
    assert list(dict.fromkeys(tick.outputs.phase for tick in kept.ticks)) == [
        Phase.PREFLIGHT, Phase.TAKEOFF, Phase.HOLD, Phase.LAND, Phase.STOPPED,
    ]  # fmt: skip
    assert world.truth().on_ground
    assert not world.autopilot.armed
    assert ending.handed_over is None


def test_the_autopilot_is_told_until_it_lands(config: Config) -> None:
    world, kept = world_of(config), Kept()
    clock = VirtualClock(world.advance)
    devices = mock_devices(world)
    loop = Loop(devices, clock, config, kept)
    ending = Ending(loop.request)

    def on_tick(outputs: Outputs) -> bool:
        if clock.now_ns() == 600_000_000:
            loop.request(Request.TAKEOFF)
        if outputs.phase is Phase.HOLD:
            ending.ask("SIGINT")
            ending.ask("SIGINT")
        return ending.goes_on(outputs, clock.now_ns() * 1e-9)

    asyncio.run(loop.run(on_tick))
    assert ending.handed_over is not None
    said = asyncio.run(hand_over(devices.autopilot, ending.handed_over, clock))
    assert said == "The autopilot lands by itself."
    assert world.autopilot.mode is FlightMode.LAND
    world.advance(15.0)
    assert world.truth().on_ground
    assert world.truth().crashed == ""


def test_an_autopilot_that_does_not_obey_is_told(config: Config) -> None:
    world = world_of(config)
    clock = VirtualClock(world.advance)
    world.autopilot.arm()

    class Deaf(MockAutopilot):
        commands: list[AutopilotCommand] = []  # noqa: RUF012

        def command(self, command: AutopilotCommand) -> None:
            self.commands.append(command)

    deaf = Deaf(world)
    command = AutopilotCommand(Engage.LAND, Interface.ATTITUDE, 0.0, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3)
    assert "has not said that it lands" in asyncio.run(hand_over(deaf, command, clock))
    assert deaf.commands == [command] * 100


# --- signals ----------------------------------------------------------------------------------------------------------


def test_signals_reach_the_ending_and_the_reload() -> None:
    run, reloads = Run(), list[int]()

    async def flight() -> None:
        with signals(run.ending, lambda: reloads.append(1)):
            assert run.tick(Phase.HOLD)
            for number in (signal.SIGHUP, signal.SIGTERM):
                signal.raise_signal(number)
            while not (reloads and run.requests):
                await asyncio.sleep(0.001)
                assert run.tick(Phase.HOLD)
            signal.raise_signal(signal.SIGINT)
            goes_on = True
            while goes_on:
                await asyncio.sleep(0.001)
                goes_on = run.tick(Phase.LAND)

    before = [signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGTERM)]
    asyncio.run(flight())
    assert [signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGTERM)] == before
    assert (reloads, run.requests[0]) == ([1], Request.LAND)
    assert run.ending.handed_over is not None


def test_before_the_first_tick_connecting_is_broken_off_and_the_devices_released() -> None:
    run, released = Run(), list[str]()

    async def flight() -> str:
        with signals(run.ending, lambda: None):
            try:
                signal.raise_signal(signal.SIGTERM)
                await asyncio.sleep(3600.0)
            finally:
                signal.raise_signal(signal.SIGTERM)  # an impatient second one does not break off the release
                await asyncio.sleep(0.01)
                released.append("devices")
        return "ended in order"

    assert asyncio.run(flight()) == "ended in order"
    assert released == ["devices"]


def test_another_thread_asks_for_the_end_in_the_same_way() -> None:
    run, ends = Run(), list[Callable[[str], None]]()

    async def flight() -> str:
        with signals(run.ending, lambda: None) as end:
            ends.append(end)
            Thread(target=end, args=("standard input has closed",)).start()
            await asyncio.sleep(3600.0)
        return "ended in order"

    assert asyncio.run(flight()) == "ended in order"
    ends[0]("too late to matter")


def test_after_the_last_tick_the_release_is_not_broken_off() -> None:
    run = Run()

    async def flight() -> str:
        with signals(run.ending, lambda: None):
            run.tick(Phase.STOPPED)
            run.ending.ask("SIGTERM")
            assert not run.tick(Phase.STOPPED)
            signal.raise_signal(signal.SIGTERM)
            await asyncio.sleep(0.01)
            return "released"

    assert asyncio.run(flight()) == "released"


def test_a_cancellation_by_others_goes_through() -> None:
    run = Run()

    async def flight() -> None:
        with signals(run.ending, lambda: None):
            await asyncio.sleep(3600.0)

    async def outer() -> None:
        task = asyncio.create_task(flight())
        await asyncio.sleep(0)
        task.cancel()
        await task

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(outer())
