"""The emergency stop against loops, recorders and drivers that hang or fail, in real time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

import pytest
from msgspec.structs import replace

from drivers.mailbox import Notices
from drivers.protocols import DeviceError
from drivers.samples import (
    AutopilotCommand,
    AutopilotState,
    Engage,
    FlightMode,
    Interface,
    Landed,
    ServoCommand,
    ServoState,
)
from onboard.clock import WallClock
from onboard.config import load_config
from onboard.core.types import Request, Tick
from onboard.devices import mock_devices, world_of
from onboard.emergency import STUCK_NS, Done, Emergency
from onboard.loop import Loop
from tests.onboard.test_loop import Kept
from tests.waiting import LONG, pause, seconds_until

LEVEL = AutopilotCommand(Engage.OFFBOARD, Interface.WRENCH, 10.0, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3)
FLYING = AutopilotState(
    t_ns=0,
    q_WB=(1.0, 0.0, 0.0, 0.0),
    w_WB_B=(0.0, 0.0, 0.0),
    t_imu_ns=0,
    f_B=(0.0, 0.0, 9.81),
    armed=True,
    mode=FlightMode.OFFBOARD,
    landed=Landed.IN_AIR,
    battery_voltage=16.0,
    battery_remaining=1.0,
)
DOWN = replace(FLYING, armed=False, landed=Landed.ON_GROUND)


class Device:
    """What both devices have, and the emergency stop does not use."""

    async def start(self) -> None: ...

    async def stop(self) -> None: ...

    def notices(self) -> tuple[()]:
        return ()


class Autopilot(Device):
    """Notes what is insisted on; fails so many times first, and obeys if it is told to."""

    def __init__(self, *, fails: int = 0, deaf: bool = False) -> None:
        self.state = FLYING
        self.insisted: list[Engage | None] = []
        self._fails, self._deaf = fails, deaf

    def latest(self) -> AutopilotState | None:
        return self.state

    def command(self, command: AutopilotCommand) -> None: ...

    def insist(self, engage: Engage | None) -> None:
        self.insisted.append(engage)
        if self._fails:
            self._fails -= 1
            raise DeviceError("the cable is out")
        if self._deaf:
            return
        if engage is Engage.KILL:
            self.state = DOWN
        elif engage is Engage.LAND:
            self.state = replace(FLYING, mode=FlightMode.LAND)


class Servos(Device):
    def __init__(self, *, fails: int = 0) -> None:
        self.insisted: list[bool] = []
        self._fails = fails

    def latest(self) -> ServoState | None:
        return None

    def command(self, command: ServoCommand) -> None: ...

    def insist(self, off: bool) -> None:
        self.insisted.append(off)
        if self._fails:
            self._fails -= 1
            raise OSError("the adapter is gone")


class Rig:
    """An emergency stop on devices that note everything, and a loop whose ticks the test makes."""

    def __init__(self, autopilot: Autopilot | None = None, servos: Servos | None = None) -> None:
        self.autopilot, self.servos = autopilot or Autopilot(), servos or Servos()
        self.requests: list[Request] = []
        self.ticked_ns = time.monotonic_ns()
        self.notices = Notices()
        self.emergency = Emergency(self.autopilot, self.servos, self.request, lambda: self.ticked_ns, self.notices)
        self.said: list[str] = []

    def request(self, request: Request, *, done: Done | None = None) -> None:
        self.requests.append(request)

    def tick(self) -> None:
        self.ticked_ns = time.monotonic_ns()

    def says(self, words: str) -> bool:
        self.said += [notice.text for notice in self.notices.take()]
        return any(words in text for text in self.said)

    @contextmanager
    def ticking(self) -> Iterator[None]:
        """A loop at 250 Hz."""
        over = Event()

        def work() -> None:
            while not over.wait(0.004):
                self.tick()

        thread = Thread(target=work)
        thread.start()
        yield
        over.set()
        thread.join()


@pytest.fixture
def begin() -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def make(autopilot: Autopilot | None = None, servos: Servos | None = None) -> Rig:
        rig = Rig(autopilot, servos)
        rig.emergency.start()
        rigs.append(rig)
        return rig

    yield make
    for rig in rigs:
        rig.emergency.close()
        rig.emergency.close()


def test_a_kill_acts_before_it_returns(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.emergency.kill()
    assert rig.autopilot.insisted[0] is Engage.KILL
    assert rig.servos.insisted[0] is True
    assert rig.requests == [Request.KILL]
    assert rig.emergency.killed
    assert rig.says("killed: the motors and the servos' torque are cut")


def test_a_kill_is_said_again_until_the_autopilot_is_disarmed(begin: Callable[..., Rig]) -> None:
    rig = begin(Autopilot(deaf=True))
    rig.emergency.kill()
    seconds_until(lambda: rig.says("does not say that it is disarmed"))
    assert len(rig.autopilot.insisted) > 5
    rig.autopilot.state = DOWN
    seconds_until(lambda: rig.says("the autopilot is disarmed"))
    said = len(rig.autopilot.insisted)
    pause(0.3)
    assert len(rig.autopilot.insisted) == said
    rig.autopilot.state = FLYING  # somebody has armed it again
    seconds_until(lambda: len(rig.autopilot.insisted) > said)


def test_a_kill_twice_is_one(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.emergency.kill()
    rig.emergency.kill()
    assert rig.requests == [Request.KILL, Request.KILL]
    assert rig.says("killed")
    assert sum("killed" in text for text in rig.said) == 1
    rig.tick()
    rig.emergency.release()
    assert not rig.emergency.killed
    assert rig.autopilot.insisted[-1] is None


def test_a_kill_stays_until_it_is_released(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.emergency.kill()
    with rig.ticking():
        pause(0.7)
    assert None not in rig.autopilot.insisted
    assert all(rig.servos.insisted)
    rig.emergency.release()
    assert rig.autopilot.insisted[-1] is None
    assert rig.servos.insisted[-1] is False
    told = len(rig.autopilot.insisted), len(rig.servos.insisted)
    pause(0.2)
    rig.emergency.release()
    assert (len(rig.autopilot.insisted), len(rig.servos.insisted)) == told


def test_a_tick_that_began_before_the_kill_does_not_release_it(begin: Callable[..., Rig]) -> None:
    rig = begin()
    for _ in range(2):
        rig.tick()
        rig.emergency.kill()
        rig.emergency.release()
        assert rig.emergency.killed
    rig.tick()
    rig.emergency.release()
    assert not rig.emergency.killed


def test_a_stop_is_left_to_a_loop_that_ticks(begin: Callable[..., Rig]) -> None:
    rig = begin()
    with rig.ticking():
        rig.emergency.stop()
        rig.emergency.stop()
        pause(0.5)
    assert rig.requests == [Request.STOP, Request.STOP]
    assert rig.autopilot.insisted == []
    pause(0.3)  # nothing is left of a stop that the loop has taken
    assert rig.autopilot.insisted == []
    assert rig.servos.insisted == []


def test_a_stop_lands_at_once_for_a_loop_that_is_stuck(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.ticked_ns -= 2 * STUCK_NS
    rig.emergency.stop()
    assert rig.autopilot.insisted == [Engage.LAND]
    assert rig.requests == [Request.STOP]
    assert rig.says("the loop has made no tick for 0.3")


def test_who_stopped_is_told_of_the_landing(begin: Callable[..., Rig]) -> None:
    told: list[str] = []
    rig = begin()
    rig.ticked_ns -= 2 * STUCK_NS
    rig.emergency.stop(instead=told.append)
    (text,) = told
    assert text.startswith("The loop has made no tick for 0.3")
    assert text.endswith("the autopilot is told to land.")


def test_a_stop_lands_for_a_loop_that_gets_stuck_with_it(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.tick()
    rig.emergency.stop()
    assert rig.autopilot.insisted == []
    took = seconds_until(lambda: Engage.LAND in rig.autopilot.insisted)
    assert took > 0.9 * STUCK_NS * 1e-9


def test_every_stop_that_a_stuck_loop_does_not_take_is_answered(begin: Callable[..., Rig]) -> None:
    rig = begin()
    answers: list[str] = []
    rig.ticked_ns -= 2 * STUCK_NS
    for _ in range(2):
        rig.emergency.stop(instead=answers.append)
    assert len(answers) == 2
    assert "told to land" in answers[0]
    assert "told to land already" in answers[1]


def test_a_landing_is_said_again_until_it_lands(begin: Callable[..., Rig]) -> None:
    rig = begin(Autopilot(deaf=True))
    rig.emergency.stop()
    seconds_until(lambda: len(rig.autopilot.insisted) > 3)
    assert set(rig.autopilot.insisted) == {Engage.LAND}
    assert rig.servos.insisted == []


def test_a_loop_that_ticks_again_gets_the_autopilot_back(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.emergency.stop()
    seconds_until(lambda: Engage.LAND in rig.autopilot.insisted)
    rig.tick()
    seconds_until(lambda: rig.autopilot.insisted[-1] is None)
    assert rig.says("the loop ticks again")


def test_a_kill_while_it_lands(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.emergency.stop()
    seconds_until(lambda: Engage.LAND in rig.autopilot.insisted)
    rig.emergency.kill()
    assert rig.autopilot.insisted[-1] is Engage.KILL
    rig.tick()
    rig.emergency.stop()
    pause(0.3)
    assert rig.autopilot.insisted[-1] is Engage.KILL
    assert rig.emergency.killed


def test_what_stands_is_not_sent_to_land(begin: Callable[..., Rig]) -> None:
    rig = begin()
    rig.autopilot.state = DOWN
    rig.emergency.stop()
    pause(0.4)
    assert rig.autopilot.insisted == []


def test_drivers_that_fail_are_told_and_tried_again(begin: Callable[..., Rig]) -> None:
    rig = begin(Autopilot(fails=3), Servos(fails=5))
    rig.emergency.kill()
    seconds_until(lambda: rig.says("the autopilot is disarmed"))
    assert rig.says("the autopilot failed: DeviceError: the cable is out")
    assert rig.says("the servos failed: OSError: the adapter is gone")
    assert len(rig.servos.insisted) > 5


def test_one_driver_that_hangs_does_not_keep_the_other(begin: Callable[..., Rig]) -> None:
    rig = begin()
    go_on = Event()

    def hang(engage: Engage | None) -> None:
        go_on.wait(LONG)

    rig.autopilot.insist = hang  # type: ignore[method-assign]
    caller = Thread(target=rig.emergency.kill)
    caller.start()
    seconds_until(lambda: True in rig.servos.insisted)
    go_on.set()
    caller.join(LONG)
    assert rig.requests == [Request.KILL]


def test_a_request_that_fails_keeps_nothing(begin: Callable[..., Rig]) -> None:
    def fail(request: Request, *, done: Done | None = None) -> None:
        raise RuntimeError("no loop")

    rig = Rig()
    rig.emergency = Emergency(rig.autopilot, rig.servos, fail, lambda: rig.ticked_ns, rig.notices)
    rig.emergency.kill()
    assert rig.autopilot.insisted == [Engage.KILL]
    assert rig.says("the loop failed: RuntimeError: no loop")


def test_release_against_repetition_ends_released() -> None:
    """A repetition that is under way when the kill is released must not have the last word."""
    rig = Rig()
    inside, go_on = Event(), Event()
    note = rig.autopilot.insist

    def slow(engage: Engage | None) -> None:
        if engage is Engage.KILL and rig.autopilot.insisted:
            inside.set()
            go_on.wait(LONG)
        note(engage)

    rig.autopilot.insist = slow  # type: ignore[method-assign]
    rig.emergency.kill()
    rig.emergency.start()
    assert inside.wait(LONG)
    rig.tick()
    rig.emergency.release()
    go_on.set()
    seconds_until(lambda: rig.autopilot.insisted[-2:] == [Engage.KILL, None])
    rig.emergency.close()


class StuckRecorder(Kept):
    """Hangs in the tick of this number, until it may go on."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.stuck, self.go_on = Event(), Event()
        self._at = at

    def tick(self, tick: Tick) -> None:
        if tick.index == self._at:
            self.stuck.set()
            self.go_on.wait(LONG)
        super().tick(tick)


def test_a_loop_that_hangs_in_its_recorder() -> None:
    """The real loop on a simulated vehicle that flies: stop lands, kill cuts, and neither waits for the loop."""
    config = load_config()
    world = world_of(config)
    devices = mock_devices(world)
    while not (world.autopilot.armed and world.truth().p_WB[2] > 0.6):
        devices.autopilot.command(replace(LEVEL, thrust=1.2 * 9.81 * 3.0))
        world.advance(0.004)
    sink = StuckRecorder(20)
    loop = Loop(devices, WallClock(), config, sink, timed=True)
    ticked = [0]
    over = Event()

    def on_tick(outputs: object) -> bool:
        ticked[0] = time.monotonic_ns()
        return not over.is_set()

    notices = Notices()
    emergency = Emergency(
        devices.autopilot,
        devices.servos,
        lambda request, *, done=None: loop.request(request),
        lambda: ticked[0],
        notices,
    )
    emergency.start()
    thread = Thread(target=lambda: asyncio.run(loop.run(on_tick)))
    thread.start()
    try:
        assert sink.stuck.wait(LONG)
        emergency.stop()
        assert seconds_until(lambda: world.autopilot.mode is FlightMode.LAND) < 5.0
        emergency.kill()
        assert world.autopilot.killed
        world.advance(0.004)
        assert not world.snapshot.torque_on
    finally:
        over.set()
        sink.go_on.set()
        thread.join()
        emergency.close()
    assert [notice.text for notice in notices.take() if "has made no tick" in notice.text]
