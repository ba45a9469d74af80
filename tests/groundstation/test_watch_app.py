"""The screen itself, as a person sees it: in a terminal of 80 by 24 and others, with keys pressed."""

from __future__ import annotations

import html
import math
import re
import time
from collections.abc import Callable, Iterator
from threading import Event as Flag
from typing import Any

import pytest
from msgspec.structs import replace
from textual.pilot import Pilot

from groundstation.client import Client, StationSettings
from groundstation.watch_app import WatchApp
from onboard.config import dump_config, load_config
from onboard.core.types import Event, Phase, Request, Severity
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.wire import Ack, Ask, Heard, Mission, Outcome, ReleaseLease, ShowEvents, ShowParams, Stop, TakeLease
from tests.groundstation.watching import TICKS, Puppet, first
from tests.waiting import LONG
from tests.zenoh_sessions import free_port

PRESS = first(Phase.PRESS, 350)
SIZES = [(80, 24), (120, 40), (60, 20)]
_CELL = 12.2
"""Width of a character in the picture that Textual makes of its screen."""


def screen(app: WatchApp) -> list[str]:
    """The lines that are to be read on the terminal."""
    lines: dict[int, list[str]] = {}
    text = re.compile(r'<text class="[^"]*" x="([\d.]+)" [^>]*clip-path="url\(#[^"]*line-(\d+)\)">(.*?)</text>')
    for x, line, words in text.findall(app.export_screenshot()):
        row = lines.setdefault(int(line), [" "] * app.size.width)
        start = round(float(x) / _CELL)
        words = html.unescape(words).replace("\xa0", " ")
        row[start : start + len(words)] = words
    return ["".join(lines.get(i, [])).rstrip() for i in range(app.size.height)]


def says(app: WatchApp, *parts: str) -> bool:
    seen = "\n".join(screen(app))
    return all(part in seen for part in parts)


@pytest.fixture
def puppet() -> Puppet:
    puppet = Puppet()
    puppet.tick = PRESS
    for _ in range(20):
        puppet.later(0.1)
    return puppet


def watch(puppet: Puppet, **settings: Any) -> WatchApp:
    return WatchApp(puppet, clock=puppet.clock, **settings)


async def until(pilot: Pilot[None], condition: Callable[[], object], what: str) -> None:
    """Wait for something that another thread brings about."""
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end, what
        await pilot.pause(0.02)


async def passes(pilot: Pilot[None], puppet: Puppet, seconds: float) -> None:
    """Time on the clock of the test, with a look every 0.1 s."""
    app = pilot.app
    assert isinstance(app, WatchApp)
    for _ in range(round(seconds * 10)):
        puppet.later(0.1)
        app.look()
    await pilot.pause()


@pytest.mark.asyncio
@pytest.mark.parametrize("size", SIZES)
async def test_all_is_on_the_screen(puppet: Puppet, size: tuple[int, int]) -> None:
    puppet.commander = "alice"
    puppet.tell("press", "Contact. Pressing with 2.5 N for 12 s.")
    app = watch(puppet)
    async with app.run_test(size=size) as pilot:
        await until(pilot, lambda: says(app, "from the pipe") or size[0] < 80, "the pipe is known")
        await passes(pilot, puppet, 1.0)
        lines = screen(app)
        assert lines[0].startswith(" falcon  PRESS  1.4 s  pressing the sleeve on")
        assert lines[0].endswith("● live, 0.1 s")
        assert lines[1] == " ✓ all is well"
        assert says(app, "2.55 N of 2.50 N desired", "k k KILL", "q quit")
        assert "h hold" in lines[-1]
        if size[0] >= 80:
            assert says(app, "theta 1", "gripper", "30°C", "vision     high", "battery    90 %", "loop       250.0 Hz")
            assert says(app, "commander  you (alice)", "hears us", "Contact. Pressing with 2.5 N for 12 s.")


@pytest.mark.asyncio
async def test_a_narrow_screen_can_be_scrolled_and_grown(puppet: Puppet) -> None:
    app = watch(puppet)
    async with app.run_test(size=(50, 20)) as pilot:
        await passes(pilot, puppet, 0.5)
        assert not says(app, "gripper")
        for _ in range(30):
            await pilot.press("down")
        assert says(app, "gripper")
        await pilot.resize_terminal(110, 30)
        await passes(pilot, puppet, 0.5)
        assert says(app, "gripper", "commander", "vision", "from the pipe")
        await pilot.resize_terminal(20, 5)
        await passes(pilot, puppet, 0.5)
        assert says(app, "PRESS", "● 0.1 s")


@pytest.mark.asyncio
@pytest.mark.parametrize("size", SIZES)
async def test_a_lost_link_cannot_be_overlooked(puppet: Puppet, size: tuple[int, int]) -> None:
    app = watch(puppet)
    async with app.run_test(size=size) as pilot:
        await passes(pilot, puppet, 1.0)
        assert not says(app, "LINK LOST")
        puppet.talks = False
        await passes(pilot, puppet, 3.0)
        lines = screen(app)
        assert lines[1].startswith(" LINK LOST  nothing heard for 3.0 s")
        assert "live" not in lines[0]
        assert "3.1 s ago" in lines[0]
        assert app.query_one("#alarm").styles.background.rgb == (192, 28, 40)
        if size == (80, 24):
            assert says(app, "gripper", "commander", "h hold")  # and nothing else had to go
        puppet.talks = True
        await passes(pilot, puppet, 0.5)
        assert not says(app, "LINK LOST")
        assert says(app, "● live")


@pytest.mark.asyncio
async def test_keys_ask_and_the_answer_is_shown(puppet: Puppet) -> None:
    def answer(ask: Ask) -> Ack:
        if ask == Mission(Request.HOLD):
            return Ack("a", Outcome.REFUSED, "Nobody commands: take the lease first.")
        return Ack("a", Outcome.DONE, "Holding.")

    puppet.answer = answer
    app = watch(puppet)
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press("h")
        await until(pilot, lambda: says(app, "✗ hold refused", "Nobody commands: take the lease first"), "refused")
        await pilot.press("space")
        await until(pilot, lambda: says(app, "✓ stop done", "Holding"), "done")
        await pilot.press("r", "l", "u", "x")
        await until(pilot, lambda: len(puppet.asked) == 5, "all are asked")
    asked = [Mission(request) for request in (Request.HOLD, Request.RETREAT, Request.LAND, Request.RESUME)]
    assert {repr(ask) for ask in puppet.asked} == {repr(ask) for ask in (*asked, Stop())}


@pytest.mark.asyncio
async def test_kill_is_asked_about_and_then_given(puppet: Puppet) -> None:
    app = watch(puppet)
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press("k")
        assert says(app, "KILL?  k again within 2.0 s", "FALLS")
        puppet.now_ns += 2_500_000_000
        app.look()
        await pilot.pause()
        assert not says(app, "KILL?")
        await pilot.press("k", "k")
        await until(pilot, lambda: puppet.asked == [Mission(Request.KILL)], "kill is asked")
        await until(pilot, lambda: says(app, "✓ kill done"), "and answered")


@pytest.mark.asyncio
async def test_an_order_without_an_answer_blocks_nothing(puppet: Puppet) -> None:
    free = Flag()

    def answer(ask: Ask) -> Ack:
        if ask == Mission(Request.HOLD):
            free.wait(LONG)
        return Ack("a", Outcome.DONE, "So be it.")

    puppet.answer = answer
    app = watch(puppet)
    async with app.run_test(size=(80, 24)) as pilot:
        try:
            await pilot.press("h")
            await until(pilot, lambda: says(app, "… hold asked"), "it is asked")
            await pilot.press("s")
            await until(pilot, lambda: says(app, "✓ stop done", "… hold asked"), "a stop overtakes it")
            await passes(pilot, puppet, 0.5)
            assert says(app, "● live")
        finally:
            free.set()
        await until(pilot, lambda: says(app, "✓ hold done"), "its answer comes")


@pytest.mark.asyncio
@pytest.mark.parametrize("key", ["q", "ctrl+c", "ctrl+q"])
async def test_quit_asks_while_it_flies_by_our_command(puppet: Puppet, key: str) -> None:
    puppet.commander = "alice"
    puppet.later(0.1)
    app = watch(puppet)
    async with app.run_test(size=(80, 24)) as pilot:
        await pilot.press(key)
        assert says(app, "QUIT?", "y quit")
        await pilot.press("n")
        assert not says(app, "QUIT?")
        assert app.is_running
        await pilot.press(key, "y")
        await until(pilot, lambda: not app.is_running, "it ends")


@pytest.mark.asyncio
@pytest.mark.parametrize(("commander", "tick"), [("bob", PRESS), ("", PRESS), ("alice", TICKS[0])])
async def test_quit_is_not_asked_about_otherwise(puppet: Puppet, commander: str, tick: Any) -> None:
    puppet.commander = commander
    puppet.later(0.1, tick)
    app = watch(puppet)
    async with app.run_test() as pilot:
        await pilot.press("q")
        await until(pilot, lambda: not app.is_running, "it ends")


@pytest.mark.asyncio
async def test_a_lease_that_another_terminal_keeps_is_not_given_up(puppet: Puppet) -> None:
    puppet.others = (Heard("alice", "a2", 1, 0, True),)
    puppet.later(0.1)
    app = watch(puppet, lease=True)
    async with app.run_test() as pilot:
        await until(pilot, lambda: puppet.asked == [TakeLease()], "the lease is asked for")
        puppet.commander = "alice"
        await passes(pilot, puppet, 0.5)
        await pilot.press("q")
        await until(pilot, lambda: not app.is_running, "it ends")
    assert app.release() is None


@pytest.mark.asyncio
async def test_with_lease_it_commands_from_the_start(puppet: Puppet) -> None:
    app = watch(puppet, lease=True)
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: puppet.asked == [TakeLease()], "the lease is asked for")
        puppet.commander = "alice"
        await passes(pilot, puppet, 0.5)
        assert says(app, "✓ lease done", "you (alice)")
    assert app.release() == ReleaseLease()


@pytest.mark.asyncio
async def test_without_lease_it_only_watches(puppet: Puppet) -> None:
    app = watch(puppet)
    async with app.run_test() as pilot:
        await passes(pilot, puppet, 3.0)
    assert puppet.asked == []
    assert app.release() is None


@pytest.mark.asyncio
async def test_what_happened_before_is_there(puppet: Puppet) -> None:
    puppet.remembered = (puppet.tell("start", "The mission has begun."),)
    puppet.events.clear()
    app = watch(puppet)
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: says(app, "The mission has begun."), "the vehicle remembers")


@pytest.mark.asyncio
async def test_values_that_are_not_finite_are_shown_as_such(puppet: Puppet) -> None:
    nan3 = (math.nan, math.nan, math.nan)
    estimate = replace(PRESS.outputs.estimate, contact_force=math.nan, rpy=nan3, p_WB=nan3, tip_W=nan3, v_WB=nan3)
    puppet.tick = replace(PRESS, outputs=replace(PRESS.outputs, estimate=estimate))
    app = watch(puppet)
    async with app.run_test(size=(120, 40)) as pilot:
        await passes(pilot, puppet, 1.0)
        assert says(app, "-- N of 2.50 N", "--°")


# --- with a real link -------------------------------------------------------------------------------------------------


@pytest.fixture
def told() -> list[Asked]:
    return []


@pytest.fixture
def link(told: list[Asked]) -> Iterator[Link]:
    def answer(asked: Asked) -> Ack:
        told.append(asked)
        match asked.ask:
            case ShowParams():
                return asked.done("", dump_config(load_config("paper")).encode())
            case ShowEvents():
                return asked.done("", b"[]")
        return asked.done("Holding.")

    link = Link(LinkSettings(vehicle="falcon", listen=(f"tcp/127.0.0.1:{free_port()}",), plain=True), answer)
    link.start()
    yield link
    link.stop()


@pytest.mark.asyncio
async def test_a_flight_over_a_real_link(link: Link, told: list[Asked]) -> None:
    settings = StationSettings("falcon", link._settings.listen, "alice", plain=True)
    with Client(settings, timeout=LONG) as client:
        app = WatchApp(client, lease=True)
        async with app.run_test(size=(80, 24)) as pilot:
            began = time.monotonic_ns()
            for tick in TICKS[::20]:
                now = time.monotonic_ns()
                index = (now - began) // 4_000_000 + 1
                link.tick(replace(tick, index=index, inputs=replace(tick.inputs, t_ns=now)))
                await pilot.pause(0.01)
                if tick.outputs.phase is Phase.PRESS:
                    break
            link.event(Event(time.monotonic_ns(), "press", Severity.INFO, "Contact."))

            def flies() -> bool:
                now = time.monotonic_ns()
                index = (now - began) // 4_000_000 + 1
                link.tick(replace(PRESS, index=index, inputs=replace(PRESS.inputs, t_ns=now)))
                return says(app, "PRESS", "● live", "from the pipe", "you (alice)", "Contact.")

            await until(pilot, flies, "the flight is on the screen")
            await pilot.press("h")
            await until(pilot, lambda: flies() and says(app, "✓ hold done", "Holding"), "the order is answered")
            assert [asked.ask for asked in told if asked.ask == Mission(Request.HOLD)]
            link.stop()
            await until(pilot, lambda: says(app, "LINK LOST", "not connected"), "the link is lost")
            assert not says(app, "● live")
