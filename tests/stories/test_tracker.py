"""Each fault of the emulated T265, in flight, through the real driver: it survives, tells, and safety acts."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator

import pytest

from drivers.samples import Odometry
from drivers.t265 import T265, T265Settings
from drivers.tracking import Mount
from onboard.core.types import Action, Phase
from sim_backend.faults import Kind
from sim_backend.t265_emulator import T265Emulator
from tests.stories.conftest import At
from tests.stories.flight import Flight

pytest.importorskip("pyrealsense2", reason="pyrealsense2 cannot be imported here", exc_type=ImportError)

MOUNT = Mount(offset=(0.12, 0.0, 0.05), rotation_deg=(0.0, 30.0, 0.0))


class Tracker:
    """Driver and emulated camera on the world of a flight, in its time, begun where the flight is."""

    def __init__(self, flight: Flight) -> None:
        self.flight = flight
        world = flight.world
        self.emulator = T265Emulator(world, MOUNT)
        settings = T265Settings(start=world.truth().p_WB, mount=MOUNT, silence=0.2, retry=0.5)
        self.driver = T265(settings, self.emulator.find, lambda: world.snapshot.t_ns)
        self.told: list[str] = []
        self._loop = asyncio.new_event_loop()
        starting = self._loop.create_task(self.driver.start())
        while not starting.done():
            self.emulator.tracker._seen = (
                None  # the world stands still meanwhile: measure it again until somebody listens
            )
            self.latest()
        starting.result()

    def latest(self) -> Odometry | None:
        """The camera sends what is due, whoever waits gets a turn, and the newest sample is there."""
        self.emulator.step()
        self._loop.call_soon(self._loop.stop)
        self._loop.run_forever()
        self.told += [notice.text.removeprefix("tracker: ") for notice in self.driver.notices()]
        return self.driver.latest()

    def fault(self, kind: Kind, duration: float | None = None, value: float = 0.0) -> None:
        """One that begins now."""
        self.emulator.faults.inject(self.flight.world.time, kind, duration, value)

    def count(self, text: str) -> int:
        """How often this was told."""
        return sum(text in told for told in self.told)

    def close(self) -> None:
        """Stop the driver and its loop."""
        self._loop.run_until_complete(self.driver.stop())
        self._loop.close()


Fly = Callable[[str], tuple[Flight, Tracker]]


@pytest.fixture
def fly(at: At) -> Iterator[Fly]:
    """``fly(moment)``: a flight from that moment on, with the T265 as its tracker."""
    trackers: list[Tracker] = []

    def begin(moment: str) -> tuple[Flight, Tracker]:
        flight = at(moment)
        tracker = Tracker(flight)
        trackers.append(tracker)
        flight.odometry = tracker  # type: ignore[assignment]
        return flight, tracker

    yield begin
    for tracker in trackers:
        tracker.close()


def test_healthy_the_mission_goes_on_to_its_end(fly: Fly) -> None:
    flight, tracker = fly("press")
    flight.until(lambda outputs: outputs.phase is Phase.STOPPED, 120.0)
    assert tracker.told == []
    assert flight.truth.sleeve_on_pipe


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.UNPLUGGED, Kind.REBOOT, Kind.NAN, Kind.FREEZE])
@pytest.mark.parametrize(("moment", "action"), [("approach", Action.HOLD), ("press", Action.RETREAT)])
def test_no_usable_pose_any_more(fly: Fly, kind: Kind, moment: str, action: Action) -> None:
    """Held or taken back at once, landed by the autopilot after; the driver has told it once."""
    flight, tracker = fly(moment)
    tracker.fault(kind)
    limits = flight.config.safety
    flight.meets("odometry_late", action, limits.odometry_late + 0.02)
    flight.meets("odometry_lost", Action.LAND, limits.odometry_lost)
    flight.stands()
    if kind is not Kind.FREEZE:  # a frozen pose looks healthy to the driver: the core knows it by its bits
        assert tracker.count("no usable pose for 0.2 s; opening it again") == 1
        assert tracker.count("a pose is not used") == (kind is Kind.NAN)
        # the opening takes real time, in which a flight in simulated time may well be over
        assert tracker.count("cannot open it again") <= (kind in (Kind.UNPLUGGED, Kind.REBOOT))
        assert tracker.count("it is back") == 0


def test_late_poses_are_seen_to_be_late(fly: Fly) -> None:
    """So late that the driver opens the camera again: what comes then is known to be old all the same."""
    flight, tracker = fly("approach")
    tracker.fault(Kind.DELAY, value=0.3)
    flight.meets("odometry_late", Action.HOLD, flight.config.safety.odometry_late + 0.02)
    flight.run(1.0)
    latest = tracker.latest()
    assert latest is not None
    assert (flight.world.snapshot.t_ns - latest.t_ns) * 1e-9 == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(("moment", "action"), [("approach", Action.HOLD), ("press", Action.RETREAT)])
def test_a_jump_is_a_reset(fly: Fly, moment: str, action: Action) -> None:
    flight, tracker = fly(moment)
    tracker.fault(Kind.JUMP, value=0.3)
    flight.meets("odometry_reset", action, 0.02)
    flight.reach(Phase.HOLD if action is Action.HOLD else Phase.RETREAT_HOLD, within=20.0)
    flight.until(lambda outputs: outputs.phase is Phase.HOLD, 20.0)
    flight.hovers()
    assert tracker.count("its pose has jumped by 0.30 m") == 1


@pytest.mark.parametrize(
    ("confidence", "code", "action"), [(1, "odometry_unsure", Action.RETREAT), (0, "odometry_failed", Action.LAND)]
)
def test_low_confidence_in_press(fly: Fly, confidence: int, code: str, action: Action) -> None:
    flight, tracker = fly("press")
    tracker.fault(Kind.CONFIDENCE, value=confidence)
    flight.meets(code, action, 0.6)


@pytest.mark.parametrize(
    ("kind", "duration", "value"), [(Kind.NAN, 0.05, 0.0), (Kind.SILENT, 0.1, 0.0), (Kind.DROP, None, 0.3)]
)
def test_small_troubles_change_nothing(fly: Fly, kind: Kind, duration: float | None, value: float) -> None:
    flight, tracker = fly("approach")
    tracker.fault(kind, duration, value)
    flight.run(2.0)
    assert set(flight.phases) == {Phase.APPROACH}
    assert flight.said == []
    assert tracker.count("a pose is not used: it is not finite") == (kind is Kind.NAN)


def test_a_creeping_frame_takes_the_vehicle_with_it(fly: Fly) -> None:
    """Nothing on board can tell slow drift from motion; it is bounded by what the mission's contact tells."""
    flight, tracker = fly("approach")
    tracker.fault(Kind.DRIFT, 1.0, 0.02)
    flight.run(1.5)
    assert flight.said == []
    latest = tracker.latest()
    assert latest is not None
    assert latest.p_WB[0] - flight.truth.p_WB[0] == pytest.approx(0.02, abs=1e-3)
    assert latest.reset_counter == 0
