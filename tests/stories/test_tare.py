"""A tare by hand, in hover: the accelerometer is off by a known amount."""

from __future__ import annotations

from itertools import pairwise

import pytest
from msgspec.structs import replace

from onboard.core.derived import derive
from onboard.core.types import Phase, Request
from tests.stories.conftest import At
from tests.stories.flight import Flight

BIAS = (0.20, -0.12, 0.08)


def biased(sample: object) -> object:
    """An accelerometer that is off by ``BIAS``, m/s^2, B."""
    f = sample.f_B  # type: ignore[attr-defined]
    return replace(sample, f_B=(f[0] + BIAS[0], f[1] + BIAS[1], f[2] + BIAS[2]))  # type: ignore[type-var]


def mean_force(flight: Flight, seconds: float = 1.0) -> tuple[float, ...]:
    """Mean of the estimated external force, N, W."""
    forces = [flight.tick().estimate.force_W for _ in range(round(seconds / 0.004))]
    return tuple(sum(axis) / len(forces) for axis in zip(*forces, strict=True))


def test_the_tare_takes_a_known_force_away_and_tells_it(hover: Flight) -> None:
    mass = derive(hover.config).model.mass(True)
    before = mean_force(hover)
    hover.autopilot.spoil = biased
    hover.run(1.0)
    wrong = mean_force(hover)
    expected = [mass * bias for bias in BIAS]
    assert [b - a for a, b in zip(before, wrong, strict=True)] == pytest.approx(expected, abs=0.03)
    place = hover.truth.p_WB
    hover.tick(Request.TARE)
    began = hover.world.time
    hover.until(lambda outputs: "tared" in hover.said, within=10.0)
    least = hover.config.guidance.tare_settle + hover.config.guidance.tare_time
    assert least - 0.1 < hover.world.time - began < least + 1.0
    assert hover.said == ["tare_by_hand", "tared"]
    told = [float(word) for word in hover.events[-1].text.removeprefix("Tared: ").split(" N ")[0].split(",")]
    assert told == pytest.approx(wrong, abs=0.03)
    assert mean_force(hover) == pytest.approx((0.0, 0.0, 0.0), abs=0.03)
    assert hover.phases == [Phase.HOLD]
    assert hover.truth.p_WB == pytest.approx(place, abs=0.03)
    assert all(a.t_ns <= b.t_ns for a, b in pairwise(hover.events))


def test_a_tare_that_is_broken_off_changes_nothing(hover: Flight) -> None:
    hover.autopilot.spoil = biased
    hover.run(1.0)
    before = hover.state.estimate.forces.tares[0].tare
    hover.tick(Request.TARE)
    hover.run(hover.config.guidance.tare_settle + 1.0)
    assert hover.state.estimate.forces.tares[0].count > 0
    hover.tick(Request.LAND)
    hover.run(0.1)
    assert hover.said == ["tare_by_hand", "tare_broken_off", "land"]
    paper = hover.state.estimate.forces.tares[0]
    assert (paper.tare, paper.count) == (before, 0)


def test_beside_the_pipe_it_is_refused_until_the_vehicle_has_retreated(at: At) -> None:
    flight = at("advance")
    assert flight.tick(Request.TARE).events[-1].code == "refused_hold_first"
    flight.tick(Request.HOLD)
    assert flight.run(2.0).tick(Request.TARE).events[-1].code == "refused_beside"
    flight.tick(Request.RETREAT)
    flight.reach(Phase.RETREAT_HOLD, Phase.HOLD, within=20.0).run(2.0)
    flight.tick(Request.TARE)
    flight.until(lambda outputs: "tared" in flight.said, within=10.0)
    flight.tick(Request.RESUME)
    flight.reach(Phase.TARE, Phase.ADVANCE, within=30.0)
