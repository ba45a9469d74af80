"""What the screen says: every state in words that read without colours, and within the room there is."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Struct
from msgspec.structs import replace
from rich.color import ColorSystem

from groundstation import watch_words as words
from groundstation.watch_marks import Line, Tone, ago, bar, cut, duration, length, number, plot, wrapped
from groundstation.watch_model import Force, View
from groundstation.watch_orders import Order
from groundstation.watch_widgets import STYLES
from onboard.core.types import Action, Phase, Severity, Tick, Verdict
from onboard.wire import Outcome
from tests.groundstation.watching import KNOWN, START, TICKS, Eye, Puppet, S, first
from tests.synthetic import PIPE

PRESS = first(Phase.PRESS, 350)


def text(lines: Iterable[Line]) -> str:
    return "\n".join("".join(span for span, _ in line) for line in lines)


def tones(lines: Iterable[Line]) -> set[Tone]:
    return {tone for line in lines for span, tone in line if span.strip()}


def everything(view: View, width: int = 80) -> tuple[Line, ...]:
    """All of the vehicle's own values."""
    return (
        *words.verdict(view, width),
        *words.force(view, width),
        *words.trend(view, 30.0, width, 4),
        *words.vehicle(view, 20),
        *words.arm(view),
    )


def change(tick: Tick, **outputs: object) -> Tick:
    return replace(tick, outputs=replace(tick.outputs, **outputs))


def inputs(tick: Tick, name: str, **values: object) -> Tick:
    sample: Struct = getattr(tick.inputs, name)
    return replace(tick, inputs=replace(tick.inputs, **{name: replace(sample, **values)}))


@pytest.fixture
def puppet() -> Puppet:
    return Puppet()


@pytest.fixture
def eye(puppet: Puppet) -> Eye:
    return Eye(puppet)


# --- live, old, lost --------------------------------------------------------------------------------------------------


def test_a_live_tick(puppet: Puppet, eye: Eye) -> None:
    view = eye.after(1.0, PRESS)
    line = words.head(view, "falcon", 80)
    assert length(line) == 80
    assert text([line]).startswith(" falcon  PRESS  1.4 s  pressing the sleeve on  ")
    assert text([line]).endswith("● live, 0.1 s ")
    assert words.alarm(view) == ()
    assert Tone.STALE not in tones(everything(view))
    assert text(words.verdict(view, 80)) == "✓ all is well"
    assert text(words.force(view, 40)).startswith("2.55 N of 2.50 N desired   in contact")


@pytest.mark.parametrize("silent", [0.9, 30.0])
def test_what_is_old_is_grey_and_says_how_old_it_is(puppet: Puppet, eye: Eye, silent: float) -> None:
    eye.after(1.0, PRESS)
    puppet.talks = False
    view = eye.after(silent)
    assert tones(everything(view)) == {Tone.STALE}
    line = words.head(view, "falcon", 80)
    assert "live" not in text([line])
    assert f"○ {ago(silent + 0.04)} " in text([line])
    assert words.alarm(view)


def test_a_lost_link_is_said_loudly(puppet: Puppet, eye: Eye) -> None:
    eye.after(1.0, PRESS)
    puppet.talks = False
    headline, rest = words.alarm(eye.after(3.0))
    assert headline == "LINK LOST  nothing heard for 3.0 s"
    assert "What is shown is old." in rest
    assert "land" in rest
    puppet.present = False
    assert "not connected" in words.alarm(eye.look())[0]
    assert tones(words.link(eye.look())[1:2]) == {Tone.LABEL, Tone.BAD}


def test_a_lost_link_on_the_ground_says_what_to_look_at(puppet: Puppet, eye: Eye) -> None:
    eye.after(1.0, TICKS[0])
    puppet.talks = False
    assert "Is it on" in words.alarm(eye.after(3.0))[1]


def test_other_troubles_of_the_link_and_the_loop(puppet: Puppet, eye: Eye) -> None:
    eye.after(1.0, PRESS)
    puppet.hears = False
    assert words.alarm(eye.after(3.0))[0] == "THE VEHICLE DOES NOT HEAR US for 3.0 s"
    puppet.hears, puppet.ticks = True, False
    assert words.alarm(eye.after(2.0))[0] == "THE VEHICLE'S LOOP STANDS STILL  no tick for 2.0 s"
    puppet.ticks = True
    eye.after(1.0)
    puppet.delay = 0.6
    assert words.alarm(eye.after(40.0))[0].startswith("SLOW LINK  what is shown may be 1.2 s old")


def test_a_tick_that_does_not_come_though_the_link_is_there(puppet: Puppet, eye: Eye) -> None:
    """Telemetry is sent after all else, so it starves first."""
    eye.after(1.0, PRESS)
    old = puppet.telemetry()
    puppet.later(2.0)
    view = eye._model.look(puppet.now_ns, puppet.contact(), old)
    assert words.alarm(view) == ("OLD PICTURE  what is shown may be 2.0 s old",)
    assert tones(words.force(view, 40)) == {Tone.STALE}


def test_before_the_first_tick(puppet: Puppet, eye: Eye) -> None:
    view = eye.after(1.0)
    assert "no tick yet" in text([words.head(view, "falcon", 80)])
    assert "waits for its devices" in text(words.verdict(view, 80))
    assert text(everything(view))
    assert "live" not in text([words.head(view, "falcon", 80)])


# --- safety -----------------------------------------------------------------------------------------------------------


def test_the_verdict_in_the_words_of_the_vehicle(puppet: Puppet, eye: Eye) -> None:
    sentence = "Odometry is 0.21 s old: the tracker is silent, late, or repeats itself. Check cable and load."
    puppet.tell("odometry_late", sentence, Severity.ERROR)
    verdict = Verdict(Action.HOLD, ("odometry_late", "servo_warm"))
    lines = words.verdict(eye.after(0.5, change(PRESS, verdict=verdict)), 60)
    assert tones(lines) == {Tone.BAD}
    assert len(lines) == 2
    assert text(lines).startswith("▲ HOLD  Odometry is 0.21 s old")
    long = text(words.verdict(eye.look(), 200))
    assert sentence in long
    assert "Also: servo warm." in long


def test_a_condition_that_was_not_told_goes_by_its_name(puppet: Puppet, eye: Eye) -> None:
    lines = words.verdict(eye.after(0.5, change(PRESS, verdict=Verdict(Action.WARN, ("odometry_late",)))), 80)
    assert text(lines) == "▲ WARN  odometry late."
    assert tones(lines) == {Tone.WARN}


# --- values -----------------------------------------------------------------------------------------------------------


def test_a_device_that_is_silent_has_old_values(puppet: Puppet, eye: Eye) -> None:
    estimate = replace(PRESS.outputs.estimate, age_odometry=0.8, age_servos=1.2)
    view = eye.after(0.5, change(PRESS, estimate=estimate))
    vehicle = {line[0][0].strip(): line[1:] for line in words.vehicle(view, 20)}
    assert "0.8 s ago" in text([vehicle["vision"]])
    assert tones([vehicle["tip"]]) == tones([vehicle["place"]]) == {Tone.STALE}
    assert Tone.STALE not in tones([vehicle["battery"]])
    title, *joints = words.arm(view)
    assert text([title]).startswith("1.2 s ago")
    assert tones([line[1:] for line in joints]) == {Tone.STALE}


@pytest.mark.parametrize(
    ("left", "volts", "word", "tone"),
    [(0.9, 15.9, "", Tone.PLAIN), (0.2, 15.0, "low", Tone.WARN), (0.5, 13.0, "critical", Tone.BAD)],
)
def test_the_battery(puppet: Puppet, eye: Eye, left: float, volts: float, word: str, tone: Tone) -> None:
    view = eye.after(0.5, inputs(PRESS, "autopilot", battery_remaining=left, battery_voltage=volts))
    line = next(line for line in words.vehicle(view, 20) if line[0][0].startswith("battery"))
    assert text([line]).rstrip() == f"battery    {100 * left:.0f} %   {volts:.2f} V   {word}".rstrip()
    assert tones([line[1:]]) == {tone}


def test_servos_that_are_hot_or_have_an_error_or_no_torque(puppet: Puppet, eye: Eye) -> None:
    tick = inputs(
        PRESS, "servos", temperature=(30.0, 64.0, 71.0, 30.0, math.nan), error=(0x20, 0, 0, 0, 0), torque_on=False
    )
    title, *lines = (text([line]) for line in words.arm(eye.after(0.5, tick)))
    assert title.startswith("no torque")
    assert lines[0].endswith("✗0x20")
    assert lines[1].endswith("64°C warm")
    assert lines[2].endswith("71°C hot")
    assert "--" in lines[4]
    assert all(len(line) <= 41 for line in (title, *lines))


@pytest.mark.parametrize(("ahead", "said"), [(0.0004, "0.4 mm"), (0.05, "50.0 mm"), (0.72, "0.72 m")])
def test_where_the_tip_is(puppet: Puppet, ahead: float, said: str) -> None:
    x, y, z = PIPE.position
    off, heading = PIPE.radius + ahead, math.radians(PIPE.heading_deg)
    tip = (x - off * math.cos(heading), y - off * math.sin(heading), z)
    tick = change(PRESS, estimate=replace(PRESS.outputs.estimate, tip_W=tip))
    for known, words_of_it in ((KNOWN, f"{said} from the pipe"), (None, "pipe not known yet")):
        view = Eye(puppet, known).after(0.2, tick)
        assert (
            text(line for line in words.vehicle(view, 6) if line[0][0] == "tip        ") == f"tip        {words_of_it}"
        )


def test_who_commands_and_who_is_there(puppet: Puppet, eye: Eye) -> None:
    for commander, words_of_it, tone in (
        ("", "nobody", Tone.WARN),
        ("alice", "you (alice)", Tone.GOOD),
        ("bob", "bob, not you", Tone.PLAIN),
    ):
        puppet.commander = commander
        line = words.link(eye.after(0.5, PRESS))[0]
        assert text([line]) == f"commander  {words_of_it}"
        assert line[-1][1] is tone
    told = text(words.link(eye.look()))
    assert "hears us   0.1 s ago" in told
    assert "alice, bob" in told
    assert "none lost" in told
    puppet.missed = 3
    assert "3 lost" in text(words.link(eye.after(0.1)))


def test_a_late_loop(puppet: Puppet, eye: Eye) -> None:
    puppet.dt = 0.031
    line = next(line for line in words.vehicle(eye.after(1.0, PRESS), 20) if line[0][0].startswith("loop"))
    assert text([line]).endswith("31.0 ms")
    assert line[-1][1] is Tone.WARN


# --- events and answers -----------------------------------------------------------------------------------------------


def test_the_newest_events_that_fit(puppet: Puppet, eye: Eye) -> None:
    puppet.tell("a", "The first, which is too old.")
    puppet.tell("b", "A sentence that does not fit into one line of forty columns.", Severity.WARNING)
    puppet.tell("c", "The last.", Severity.ERROR)
    lines = words.events(eye.after(0.1, PRESS), 40, 3)
    assert len(lines) == 3
    assert all(length(line) <= 40 for line in lines)
    assert "▲ A sentence" in text(lines[:1])
    assert text(lines[2:]).endswith("✗ The last.")
    assert [line[-1][1] for line in lines] == [Tone.WARN, Tone.WARN, Tone.BAD]
    assert words.events(eye.look(), 40, 0) == ()


def test_what_became_of_orders() -> None:
    orders = [
        Order("hold", START, Outcome.REFUSED, "Nobody commands: take the lease first."),
        Order("resume", START, Outcome.REFUSED, "resume refused. Nothing was interrupted."),
        Order("stop", START, Outcome.DONE, "Holding."),
        Order("retreat", START),
        Order("land", START, None, "falcon has gone: no answer within 5 s"),
    ]
    lines = [text(words.answers([order], START + 2 * S, 100, 2)) for order in orders]
    assert lines == [
        "✗ hold refused, 2.0 s ago: Nobody commands: take the lease first",
        "✗ resume refused, 2.0 s ago: Nothing was interrupted",
        "✓ stop done, 2.0 s ago: Holding",
        "… retreat asked 2.0 s ago",
        "? land asked 2.0 s ago: falcon has gone: no answer within 5 s",
    ]
    assert len(words.answers(orders, START, 100, 2)) == 2


def test_the_keys_fit_eighty_columns() -> None:
    line = text([words.keys(80)])
    assert line == " h hold  r retreat  s stop  k k KILL  l land  u resume  q quit"
    assert "…" in text([words.keys(30)])


# --- marks ------------------------------------------------------------------------------------------------------------


def test_the_bar_is_as_long_as_the_force() -> None:
    assert text([bar(2.0, 1.0, 4.0, 44)]) == "█" * 10 + "·" * 10 + "┃" + "·" * 19 + " 4 N"
    assert text([bar(0.0, 9.0, 4.0, 44)]) == "█" * 40 + " 4 N"
    assert text([bar(0.0, math.nan, 4.0, 44)]) == "·" * 40 + " 4 N"


def test_the_trend_has_holes_where_nothing_came() -> None:
    forces = [Force(START + i * S, 0.0, 2.0) for i in (0, 1, 2, 6, 7)]
    lines = plot(forces, 4.0, START + 7 * S, 10.0, 10, 2)
    assert text(lines) == "          \n  ███   ██"


def test_the_trend_shows_both_forces() -> None:
    lines = plot([Force(START, 3.0, 1.0)], 4.0, START, 1.0, 1, 4)
    assert text(lines) == "━\n \n \n█"


@given(st.text(max_size=40), st.integers(1, 50))
def test_cut_never_is_too_long(words_: str, width: int) -> None:
    assert length(cut(((words_, Tone.PLAIN), (words_, Tone.BAD)), width)) <= max(width, 1)


@given(st.text(alphabet="ab .", max_size=200), st.integers(10, 60), st.integers(1, 4))
def test_wrapped_keeps_its_room(words_: str, width: int, rows: int) -> None:
    lines = wrapped(words_, width, rows)
    assert 1 <= len(lines) <= rows
    assert all(len(line) <= width for line in lines)


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.0, "0 ms"),
        (0.0994, "99 ms"),
        (0.0999, "0.1 s"),
        (9.94, "9.9 s"),
        (9.96, "10 s"),
        (300, "5 min"),
        (math.inf, "never"),
    ],
)
def test_durations(seconds: float, said: str) -> None:
    assert duration(seconds) == said


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.0, "0.1 s ago"),
        (0.1, "0.1 s ago"),
        (0.11, "0.2 s ago"),
        (3.0, "3.0 s ago"),
        (12.3, "12 s ago"),
        (math.inf, "never"),
    ],
)
def test_ages_are_bounds(seconds: float, said: str) -> None:
    assert ago(seconds) == said


def test_what_is_no_number() -> None:
    assert number(-0.001, "z.2f") == "0.00"
    assert number(math.nan, ".1f") == "--"


@pytest.mark.parametrize("system", [ColorSystem.EIGHT_BIT, ColorSystem.STANDARD])
def test_with_few_colours_what_is_old_still_differs_from_what_is_live(system: ColorSystem) -> None:
    def shown(tone: Tone) -> object:
        color = STYLES[tone].color
        assert color is not None
        return color.downgrade(system).number

    live = {shown(tone) for tone in Tone if tone not in (Tone.STALE, Tone.LABEL, Tone.LOUD)}
    assert shown(Tone.STALE) not in live
    assert len({shown(tone) for tone in (Tone.GOOD, Tone.WARN, Tone.BAD, Tone.STALE)}) == 4


@pytest.mark.parametrize("width", [1, 20, 42, 78])
def test_every_tick_of_a_mission_can_be_said_in_any_room(puppet: Puppet, eye: Eye, width: int) -> None:
    for tick in TICKS[::50]:
        view = eye.after(0.1, tick)
        assert everything(view, width)
        assert words.events(view, width, 3) == ()
        assert len(words.vehicle(view, 6)) == 6
