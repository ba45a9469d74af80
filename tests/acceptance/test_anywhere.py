"""The repair at any heading, radius, force and height."""

from __future__ import annotations

import pytest

from tests.acceptance.flights import FORCE_ROWS, SHORT, Hangar, completed, contact_kept, in_limits, within

#: Some of these pipes are a long way round: fly there at a brisk pace.
BRISK = ("plan.speed=0.8", "plan.acceleration=0.7", "plan.jerk=1.5")
#: Heading (deg), radius (m), force (N), height (m): all corners of the last three, the headings all around.
CASES = [
    (-180.0, 0.04, 1.0, 1.0),
    (-135.0, 0.12, 3.5, 1.0),
    (-90.0, 0.04, 3.5, 3.0),
    (-20.0, 0.12, 1.0, 3.0),
    (45.0, 0.04, 3.5, 1.0),
    (90.0, 0.12, 1.0, 1.0),
    (150.0, 0.04, 1.0, 3.0),
    (180.0, 0.12, 3.5, 3.0),
]


@pytest.mark.parametrize(("heading", "radius", "force", "height"), CASES)
def test_the_repair_succeeds(fly: Hangar, heading: float, radius: float, force: float, height: float) -> None:
    flown = fly(
        *SHORT,
        *BRISK,
        f"pipe.heading_deg={heading}",
        f"pipe.radius={radius}",
        f"repair.force={force}",
        f"pipe.position=[2,0,{height}]",
    )
    assert completed(flown)
    assert within(flown.metrics["force_rmse"], FORCE_ROWS, factor=2.0)
    assert contact_kept(flown)
    assert in_limits(flown)
    assert flown.metrics["contact"]["tip_slip"] <= 0.005
