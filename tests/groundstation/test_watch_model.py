"""What the screen shows, as values: ages that hold whatever the clocks and the network do, and nothing old as live."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from groundstation.watch_model import SCALE, STALE, TREND, Link, clearance, gathered
from onboard.core.repair import Pipe
from onboard.core.types import Phase
from tests.groundstation.watching import START, TICKS, Eye, Puppet, S, first


@pytest.fixture
def puppet() -> Puppet:
    return Puppet()


@pytest.fixture
def eye(puppet: Puppet) -> Eye:
    return Eye(puppet)


def test_nothing_is_known_of_a_vehicle_that_has_not_ticked(puppet: Puppet, eye: Eye) -> None:
    view = eye.after(1.0)
    assert view.tick is None
    assert view.age == math.inf
    assert view.stale
    assert not view.flying
    assert view.link is Link.GOOD
    assert view.idle == 0.0


def test_a_tick_is_live_as_long_as_it_is_young(puppet: Puppet, eye: Eye) -> None:
    view = eye.after(2.0, first(Phase.PRESS))
    assert not view.stale
    assert view.flying
    assert view.link is Link.GOOD
    puppet.talks = False
    assert not eye.after(0.6).stale
    assert eye.after(0.3).stale


@pytest.mark.parametrize("delay", [0.001, 0.05, 0.4, 5.0])
def test_the_age_of_a_tick_is_never_told_too_small_and_at_most_a_way_too_large(
    puppet: Puppet, eye: Eye, delay: float
) -> None:
    puppet.delay = delay
    view = eye.after(2.0, first(Phase.APPROACH))
    assert delay <= view.age <= 2 * delay + 0.001
    assert view.stale == (view.age > STALE)
    assert view.link is (Link.SLOW if 2 * delay > 1.0 else Link.GOOD)


def test_a_delay_that_grows_is_seen(puppet: Puppet, eye: Eye) -> None:
    eye.after(2.0, first(Phase.APPROACH))
    puppet.delay = 3.0
    puppet.later(3.5)
    assert eye.look().age >= 3.0
    assert eye.look().stale


def test_a_lost_link_is_noticed_within_a_second_and_its_age_grows(puppet: Puppet, eye: Eye) -> None:
    eye.after(2.0, first(Phase.PRESS))
    puppet.talks = False
    assert eye.after(1.1).link is Link.LOST
    view = eye.after(9.0)
    assert view.silent == pytest.approx(10.1)
    assert view.age == pytest.approx(10.1 + 2 * puppet.delay)
    assert view.stale
    assert view.flying
    puppet.talks = True
    view = eye.after(0.2)
    assert view.link is Link.GOOD
    assert not view.stale


def test_a_vehicle_that_has_gone_is_lost_at_once(puppet: Puppet, eye: Eye) -> None:
    eye.after(2.0, first(Phase.PRESS))
    puppet.present = False
    view = eye.look()
    assert view.link is Link.LOST
    assert view.stale


def test_a_vehicle_that_does_not_hear_us_is_told_apart_and_its_ticks_stay_live(puppet: Puppet, eye: Eye) -> None:
    eye.after(2.0, first(Phase.PRESS))
    puppet.hears = False
    view = eye.after(5.0)
    assert view.link is Link.DEAF
    assert view.unheard == pytest.approx(5.0)
    assert view.contact.age > 5.0
    assert not view.stale


def test_a_loop_that_stands_still_is_told_apart_from_a_lost_link(puppet: Puppet, eye: Eye) -> None:
    eye.after(2.0, first(Phase.PRESS))
    puppet.ticks = False
    view = eye.after(0.7)
    assert view.link is Link.GOOD
    assert view.idle == pytest.approx(0.7)
    assert view.stale


def test_another_machine_under_the_same_name_is_believed_anew(puppet: Puppet, eye: Eye) -> None:
    """After a restart its monotonic clock begins at 0, and old bounds would make its ticks young for ever."""
    eye.after(2.0, first(Phase.PRESS))
    pulse = puppet.contact().pulse
    assert pulse is not None
    other = Eye(puppet)
    now = puppet.now_ns + S
    contact = replace(puppet.contact(), age=0.1, pulse=replace(pulse, sent_ns=7 * S))
    other._model.look(puppet.now_ns, puppet.contact(), puppet.telemetry())
    telemetry = puppet.telemetry()
    assert telemetry is not None
    young = replace(telemetry.tick, index=1, inputs=replace(telemetry.tick.inputs, t_ns=7 * S))
    view = other._model.look(now, contact, replace(telemetry, tick=young))
    assert view.age == pytest.approx(0.1)
    assert view.parameters[0] == 1


def test_the_loop_is_judged_by_what_ticks_say_of_it(puppet: Puppet, eye: Eye) -> None:
    view = eye.after(5.0, first(Phase.APPROACH))
    assert view.punctuality.rate == pytest.approx(250.0, rel=0.01)
    assert view.punctuality.worst == pytest.approx(0.004)
    puppet.dt = 0.031
    eye.after(0.1)
    puppet.dt = 0.004
    assert eye.after(9.0).punctuality.worst == pytest.approx(0.031)
    assert eye.after(2.0).punctuality.worst == pytest.approx(0.004)


def test_a_late_tick_is_seen_though_only_others_came(puppet: Puppet, eye: Eye) -> None:
    eye.after(5.0, first(Phase.APPROACH))
    assert eye.look().punctuality.worst == pytest.approx(0.004)
    puppet.stall(0.028)
    assert eye.after(1.0).punctuality.worst == pytest.approx(0.032)
    assert eye.after(11.0).punctuality.worst == pytest.approx(0.004)


def test_the_trend_goes_back_thirty_seconds(puppet: Puppet, eye: Eye) -> None:
    view = eye.after(40.0, first(Phase.PRESS, 300))
    assert len(view.trend) == pytest.approx(10 * TREND, abs=2)
    assert (view.now_ns - view.trend[0].seen_ns) * 1e-9 == pytest.approx(TREND, abs=0.11)
    assert view.trend[-1].desired == first(Phase.PRESS, 300).outputs.reference.force


def test_the_scale_holds_every_force_of_the_trend(puppet: Puppet, eye: Eye) -> None:
    assert eye.after(1.0, first(Phase.PRESS, 300)).scale == SCALE
    tick = first(Phase.PRESS, 300)
    hard = replace(tick, outputs=replace(tick.outputs, estimate=replace(tick.outputs.estimate, contact_force=7.4)))
    assert eye.after(1.0, hard).scale == 8.0
    nan = replace(tick, outputs=replace(tick.outputs, estimate=replace(tick.outputs.estimate, contact_force=math.nan)))
    assert eye.after(1.0, nan).scale == 8.0


PIPE = Pipe(position=(2.0, 1.0, 1.5), heading_deg=90.0, length=2.0, radius=0.08)


@pytest.mark.parametrize(
    ("tip", "off"),
    [
        ((2.0, 0.92, 1.5), 0.0),
        ((2.0, 0.42, 1.5), 0.5),
        ((2.5, 0.42, 1.5), 0.5),  # along the pipe
        ((2.0, 1.0, 1.68), 0.1),  # above it
        ((2.0, 1.0, 1.5), -0.08),  # on its axis
        ((3.4, 1.0, 1.5), 0.4),  # beyond its end
    ],
)
def test_distance_from_the_pipe(tip: tuple[float, float, float], off: float) -> None:
    assert clearance(tip, PIPE) == pytest.approx(off)


@given(st.tuples(*[st.floats(-5, 5)] * 3), st.floats(-180, 180))
def test_distance_from_the_pipe_changes_no_faster_than_the_tip_moves(
    tip: tuple[float, float, float], heading: float
) -> None:
    pipe = replace(PIPE, heading_deg=heading)
    moved = (tip[0] + 0.006, tip[1] - 0.002, tip[2] + 0.003)
    # At the rim of an end, a point inside comes out by its depth at most.
    assert abs(clearance(moved, pipe) - clearance(tip, pipe)) <= 0.007 + pipe.radius * (clearance(tip, pipe) < 0.01)


def test_events_are_gathered_once_each_in_order(puppet: Puppet) -> None:
    puppet.later(0.1)
    told = []
    for i in range(5):
        puppet.later(1.0)
        told.append(puppet.tell("x", f"event {i}"))
    pulse = puppet.contact().pulse
    assert gathered(told[:4], told[2:], pulse) == tuple(told)
    assert gathered((), told, None) == tuple(told)


def test_events_of_before_a_restart_of_the_machine_are_left_out(puppet: Puppet) -> None:
    told = [puppet.tell("x", "before")]
    puppet.later(0.1)
    pulse = puppet.contact().pulse
    assert pulse is not None
    assert gathered((), told, replace(pulse, sent_ns=30 * S)) == ()


def test_every_tick_of_a_mission_can_be_looked_at(puppet: Puppet, eye: Eye) -> None:
    phases = [eye.after(0.1, tick).tick for tick in TICKS[::25]]
    assert {tick.outputs.phase for tick in phases if tick} == {tick.outputs.phase for tick in TICKS}
    assert puppet.now_ns > START
