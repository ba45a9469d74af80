"""New parameters between two ticks: what is refused, what is told, and that a flight and its replay go through."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from onboard.clock import VirtualClock
from onboard.config import Config, dump_config, load_config
from onboard.core.derived import Derived, check_mission, derive
from onboard.core.plan import InfeasibleError
from onboard.core.types import Event, Outputs, Phase, Request, Severity, Tick
from onboard.devices import mock_devices, world_of
from onboard.errand import Errand
from onboard.layers import ConfigError
from onboard.logfile import LogReader
from onboard.loop import Loop
from onboard.params import diff
from onboard.recorder import Recorder
from onboard.records import PARAMS, Revision
from onboard.reload import BUILT_FROM, Reloader, needs_restart
from onboard.replay import replay
from onboard.simulate import TruthSink, run_info
from tests.onboard.test_loop import Kept


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("paper", sets=["repair.hold=2.0"])


def tuned(config: Config) -> Config:
    """Gains, bounds and speeds that may change in flight."""
    return replace(
        config,
        backstepping=replace(config.backstepping, alpha=1.4, gamma=1.8),
        observer=replace(config.observer, cutoff=25.0),
        admittance=replace(config.admittance, damping=1.1 * config.admittance.damping),
        safety=replace(config.safety, tilt=0.5),
        plan=replace(config.plan, near_speed=0.1),
    )


def stiffer(config: Config) -> Config:
    return replace(tuned(config), backstepping=replace(config.backstepping, gamma=2.0, contact_damping=1.3))


def moved(config: Config) -> Config:
    """The pipe somewhere else: not in flight."""
    return replace(config, pipe=replace(config.pipe, position=(2.2, 0.1, 1.5)))


# --- in the loop ------------------------------------------------------------------------------------------------------


class Answers:
    """What the loop has answered."""

    def __init__(self) -> None:
        self.revisions: list[int | None] = []

    def __call__(self, revision: int | None) -> None:
        self.revisions.append(revision)


def test_a_set_is_in_force_from_the_next_tick_on_and_recorded_before_it(config: Config) -> None:
    world, kept, answers = world_of(config), Kept(), Answers()
    loop = Loop(mock_devices(world), VirtualClock(world.advance), config, kept)
    new = check_mission(moved(config))

    def on_tick(outputs: Outputs) -> bool:
        if len(kept.ticks) == 5:
            loop.reload(new, grounded=True, done=answers)
        return len(kept.ticks) < 10

    asyncio.run(loop.run(on_tick))
    assert [tick.revision for tick in kept.ticks] == [0] * 5 + [1] * 5
    assert kept.revisions == [(5, kept.ticks[5].inputs.t_ns, 1, new.params)]
    assert answers.revisions == [1]
    assert loop.params is new.params
    assert derive(new.params) is new, "what was made beforehand is what the ticks used"


def test_a_check_touches_nothing_that_is_in_force(config: Config) -> None:
    in_force = derive(config)
    check_mission(moved(config))
    assert derive(config) is in_force


def test_what_may_not_change_in_flight_is_refused_there_and_not_on_the_ground(config: Config) -> None:
    world, kept, answers = world_of(config), Kept(), Answers()
    clock = VirtualClock(world.advance)
    loop = Loop(mock_devices(world), clock, config, kept)
    asked: list[Phase] = []

    def on_tick(outputs: Outputs) -> bool:
        if outputs.phase not in asked:
            asked.append(outputs.phase)
            loop.reload(check_mission(moved(config)), grounded=True, done=answers)
        if clock.now_ns() == 600_000_000:
            loop.request(Request.TAKEOFF)
        if outputs.phase is Phase.HOLD:
            loop.request(Request.LAND)
        return outputs.phase is not Phase.STOPPED or len(asked) > len(answers.revisions)

    asyncio.run(loop.run(on_tick))
    assert asked == [Phase.PREFLIGHT, Phase.TAKEOFF, Phase.HOLD, Phase.LAND, Phase.STOPPED]
    assert answers.revisions == [1, None, None, None, 2]
    assert {revision for _, _, revision, _ in kept.revisions} == {1, 2}


# --- a whole flight, and its replay -----------------------------------------------------------------------------------


class Flown:
    """A mission whose parameters were reloaded, in the phases of ``reloads``, a second after each began."""

    def __init__(self, config: Config, log: Path, reloads: dict[Phase, Config]) -> None:
        world = world_of(config)
        clock = VirtualClock(world.advance)
        left, self.answers, self.phases = dict(reloads), Answers(), [Phase.PREFLIGHT]
        self.force: list[float] = []
        """True contact force from the reload in PRESS to its end, N."""
        with Recorder(log, run_info(config), config, dump_config(config)) as recorder:
            loop = Loop(mock_devices(world), clock, config, TruthSink(recorder, world))
            errand = Errand(loop.request, 400.0)

            def on_tick(outputs: Outputs) -> bool:
                if outputs.phase is not self.phases[-1]:
                    self.phases.append(outputs.phase)
                if outputs.phase in left and outputs.phase_time > 1.0:
                    loop.reload(check_mission(left.pop(outputs.phase)), grounded=False, done=self.answers)
                if outputs.phase is Phase.PRESS and Phase.PRESS not in left:
                    self.force.append(world.truth().contact_force)
                return errand.goes_on(outputs, clock.now_ns() * 1e-9) and not world.truth().crashed

            asyncio.run(loop.run(on_tick))


@pytest.fixture(scope="module")
def log(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reload") / "log.mcap"


@pytest.fixture(scope="module")
def flown(config: Config, log: Path) -> Flown:
    return Flown(config, log, {Phase.TARE: tuned(config), Phase.PRESS: stiffer(config)})


def test_a_mission_goes_through_reloads_in_hover_and_in_press(flown: Flown, config: Config) -> None:
    assert flown.answers.revisions == [1, 2]
    assert flown.phases[-4:] == [Phase.RETREAT, Phase.RETURN, Phase.LAND, Phase.STOPPED]
    assert flown.phases.count(Phase.PRESS) == 1, "contact was kept"
    assert min(flown.force) > 0.0
    assert max(flown.force) == pytest.approx(config.repair.force, rel=0.2)


def test_its_log_holds_the_sets_and_its_replay_is_the_same_to_the_bit(flown: Flown, config: Config, log: Path) -> None:
    with LogReader(log) as reader:
        sets = list(reader.one(PARAMS, Revision[Config]))
        revisions = [tick.revision for tick in reader.ticks()]
    assert [entry.config for entry in sets] == [config, tuned(config), stiffer(config)]
    assert [revisions.index(entry.revision) for entry in sets] == [entry.index for entry in sets]
    whole, later = replay(log), replay(log, (sets[2].index + 300) * 0.004)
    assert whole.same, str(whole)
    assert later.same, str(later)
    assert (whole.ticks, whole.missing, later.missing) == (len(revisions), 0, 0)


# --- the reloader -----------------------------------------------------------------------------------------------------


class Swapped:
    """A loop that answers at once. ``grounded``: the vehicle is on the ground."""

    def __init__(self, params: Config, grounded: bool = False) -> None:
        self.params: Any = params
        self.revision = 0
        self._grounded = grounded

    def reload(self, derived: Derived, *, grounded: bool, done: Callable[[int | None], None]) -> None:
        if grounded and not self._grounded:
            done(None)
            return
        self.params = derived.params
        self.revision += 1
        done(self.revision)


def reload(loop: Swapped, *loads: Config | Exception) -> list[Event]:
    """Ask once for each of ``loads``; everything that was told."""
    given = iter(loads)

    def load() -> Config:
        item = next(given)
        if isinstance(item, Exception):
            raise item
        return item

    reloader = Reloader(load, loop)  # type: ignore[arg-type]
    for _ in loads:
        reloader.ask()
    reloader.close()
    reloader.join(30.0)
    return list(reloader.events(17))


def test_every_change_is_told_with_old_and_new(config: Config) -> None:
    loop = Swapped(config)
    events = reload(loop, tuned(config))
    assert loop.params == tuned(config)
    assert {(event.t_ns, event.code, event.severity) for event in events} == {(17, "reloaded", Severity.INFO)}
    assert len(events) == 6
    assert "Parameters, revision 1: safety.tilt = 0.6 -> 0.5." in [event.text for event in events]


def test_nothing_new_is_told_too_and_bumps_nothing(config: Config) -> None:
    loop = Swapped(config)
    (event,) = reload(loop, replace(config, plan=replace(config.plan)))
    assert (event.code, event.severity, loop.revision) == ("reload_unchanged", Severity.INFO, 0)


@pytest.mark.parametrize(
    ("error", "texts"),
    [
        (ConfigError(["a.yaml: x = 5: must be 1", "a.yaml: y: no such"]), ["x = 5", "y: no such"]),
        (InfeasibleError("pipe.position: too low"), ["pipe.position: too low"]),
        (PermissionError(13, "Permission denied"), ["Permission denied"]),
    ],
)
def test_every_error_is_told_and_the_next_order_is_still_heard(
    config: Config, error: Exception, texts: list[str]
) -> None:
    loop = Swapped(config)
    events = reload(loop, error, tuned(config))
    refused = [event for event in events if event.code == "reload_refused"]
    assert all(event.severity is Severity.ERROR for event in refused)
    assert len(refused) == len(texts)
    for event, text in zip(refused, texts, strict=True):
        assert text in event.text
    assert loop.revision == 1


def test_a_mission_that_cannot_be_flown_is_refused(config: Config) -> None:
    loop = Swapped(config, grounded=True)
    low = replace(config, pipe=replace(config.pipe, position=(2.0, 0.0, 0.3)))
    narrow = replace(config, safety=replace(config.safety, fence_high=(1.0, 1.0, 1.0)))
    first, second = reload(loop, low, narrow)
    assert loop.params is config
    assert "pipe.position" in first.text
    assert "safety.fence_low" in second.text


def test_in_flight_one_change_too_many_refuses_all(config: Config) -> None:
    loop = Swapped(config)
    (event,) = reload(loop, replace(tuned(config), repair=replace(config.repair, force=3.0)))
    assert loop.params is config
    assert event.severity is Severity.ERROR
    assert "repair.force = 2.5 -> 3.0: may change on the ground only" in event.text
    on_ground = Swapped(config, grounded=True)
    assert len(reload(on_ground, replace(tuned(config), repair=replace(config.repair, force=3.0)))) == 7
    assert on_ground.revision == 1


def test_what_something_was_built_from_takes_a_restart(config: Config) -> None:
    loop = Swapped(config, grounded=True)
    heavier = replace(config.vehicle, base=replace(config.vehicle.base, mass=2.5))
    events = reload(loop, replace(tuned(config), vehicle=heavier, seed=5))
    assert [event.code for event in events] == ["reload_refused"] * 2
    assert "vehicle.base.mass = 2.05 -> 2.5" in events[0].text
    assert all("restart" in event.text for event in events)
    assert loop.params is config


def test_all_but_the_core_s_own_takes_a_restart(config: Config) -> None:
    fixed = {
        change.path.partition(".")[0]
        for change in diff(config, load_config("paper", "paper", ["world.plant.contact.stiffness=40000.0"], seed=5))
        if needs_restart(change)
    }
    assert fixed == {"law", "seed", "world"}
    assert set(Config.__struct_fields__) >= BUILT_FROM


def test_geometry_and_what_the_contact_was_begun_with_stay_in_flight(config: Config) -> None:
    """A leg under way, a profile under way and the offset of the trigger were made with these."""
    other = replace(
        config,
        plan=replace(config.plan, needle_reach=0.27, standoff=1.1, fold=(0.0, -0.15)),
        force_profile=replace(config.force_profile, ramp=5.0),
        backstepping=replace(config.backstepping, contact_stiffness=0.4),
        guidance=replace(config.guidance, gripper_closed=0.1),
        interface="attitude",
    )
    assert not any(change.in_flight for change in diff(config, other))


def test_requests_and_ticks_go_on_while_a_file_is_read(config: Config) -> None:
    """The reader waits for the loop, and never the other way round."""
    world, kept = world_of(config), Kept()
    clock = VirtualClock(world.advance)
    loop = Loop(mock_devices(world), clock, config, kept)
    reading, told = asyncio.Event(), list[Event]()

    async def fly() -> None:
        here = asyncio.get_running_loop()

        def load() -> Config:
            here.call_soon_threadsafe(reading.set)
            return tuned(config)

        reloader = Reloader(load, loop)

        def on_tick(outputs: Outputs) -> bool:
            if len(kept.ticks) == 50:
                reloader.ask()
            told.extend(reloader.events(clock.now_ns()))
            return not told

        await loop.run(on_tick)
        reloader.close()
        reloader.join(30.0)

    asyncio.run(fly())
    assert {event.code for event in told} == {"reloaded"}
    last: Tick = kept.ticks[-1]
    assert last.revision == 1
    assert kept.revisions[0][0] > 49
