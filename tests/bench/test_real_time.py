"""The benches in real time, on a few cycles: no figure is judged, only that they belong together."""

from __future__ import annotations

import pytest

from onboard.config import load_config
from onboard.core.types import Tick
from onboard.recorder import Recorder
from tests.bench import desk, flight, lateness, setpoints
from tests.bench.desk import Desk
from tests.bench.table import WIDTH, desk_rows


@pytest.fixture(scope="module")
def ticks() -> list[Tick]:
    return flight.fly(load_config(), longest=1.0)[1]


def test_the_loop_runs_on_what_the_mission_had(ticks: list[Tick], monkeypatch: pytest.MonkeyPatch) -> None:
    requests: list[tuple[int, object]] = []
    phases = []
    record = Recorder.tick

    def tick(self: Recorder, tick: Tick) -> None:
        requests.extend([(tick.index, tick.inputs.request)] if tick.inputs.request is not None else [])
        phases.append(tick.outputs.phase)
        record(self, tick)

    monkeypatch.setattr(Recorder, "tick", tick)
    found = lateness.measure(ticks, load_config(), turns=1)
    flown = [(t.index, t.inputs.request) for t in ticks if t.inputs.request is not None and t.index < 250]
    assert requests == flown != []
    assert phases == [tick.outputs.phase for tick in ticks[:250]]
    assert found.loop.count == found.bare.count == 250
    assert found.ratio == found.loop.median / found.bare.median


def test_every_set_point_arrives_after_its_call() -> None:
    found = setpoints.measure(50)
    assert found.ours.count == found.call.count == found.bare.count == 50
    assert found.bare.median > 0.0
    assert found.ours.median > 0.0
    assert found.ratio == found.ours.median / found.bare.median


def test_a_flight_that_cannot_be_had_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(desk, "_COMMAND", "import sys; sys.exit('no such device')")
    with pytest.raises(desk.FlightError, match="no such device"):
        desk.measure()


def test_the_flight_process_s_parts_fill_the_table() -> None:
    parts = {"loop": 0.3, "dynamixel": 0.1, "mavsdk": 1.4}
    lines = desk_rows(Desk(12.0, parts, 300.0, 1500.0, 2100.0, 0.0004))
    assert [line.split()[1] for line in lines if line.startswith("processor: ")] == [
        "mavsdk",
        "loop",
        "dynamixel",
        "all",
    ]
    assert "180.0 %" in lines[-1]
    assert max(map(len, lines)) <= WIDTH
