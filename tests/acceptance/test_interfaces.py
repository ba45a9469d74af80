"""What a vehicle accepts: attitude or body rate with thrust, joints by position; autopilot loops as PX4's."""

from __future__ import annotations

import numpy as np
import pytest

from groundstation.metrics import PAPER
from onboard.core.types import Phase
from tests.acceptance.flights import SHORT, Flown, Hangar, completed, in_limits


def rate_loop(bandwidth: float) -> tuple[str, ...]:
    """The autopilot's attitude loop as PX4's, its rate loop of this bandwidth (rad/s), 12 ms of command delay."""
    return (
        "world.loops.attitude_gain=6.5",
        f"world.loops.bandwidth={bandwidth}",
        "world.autopilot.command_delay=0.012",
    )


def struck(flown: Flown) -> float:
    """With what the tip strikes the sleeve that it has let go, N."""
    run = flown.run
    assert run.truth is not None
    leaving = np.isin(run.phase, [Phase.RELEASE, Phase.RETREAT])
    gone = run.t[leaving & ~run.payload][0]
    return float(run.truth.force[leaving & (run.t > gone + 0.2)].max())


@pytest.mark.parametrize(
    ("interface", "bandwidth"),
    [("attitude", 25.0), ("attitude", 40.0), ("body_rate", 25.0), ("body_rate", 30.0), ("body_rate", 40.0)],
)
def test_tuned_law(fly: Hangar, interface: str, bandwidth: float) -> None:
    flown = fly(*SHORT, f"interface={interface}", *rate_loop(bandwidth))
    assert completed(flown)
    # the joints of these interfaces are soft: at the first touch the tip springs off for a moment, and never again
    assert flown.metrics["contact"]["time_without_contact"] <= 0.03
    assert struck(flown) <= 0.5
    assert flown.metrics["force_rmse"]["meas_des"] <= 0.15
    assert in_limits(flown)


@pytest.mark.parametrize("interface", ["wrench", "attitude"])
def test_joints_by_position(fly: Hangar, interface: str) -> None:
    flown = fly(*SHORT, f"interface={interface}", "joints=position")
    assert completed(flown)
    assert flown.metrics["force_rmse"]["meas_des"] <= 0.15
    assert in_limits(flown)


@pytest.mark.parametrize("interface", ["attitude", "body_rate"])
def test_printed_law(fly: Hangar, interface: str) -> None:
    flown = fly(*SHORT, "force_profile.ramp=10", f"interface={interface}", *rate_loop(30.0), law="paper")
    assert completed(flown)
    assert flown.metrics["force_rmse"]["est_meas"] <= PAPER["force_rmse"]["est_meas"]
    assert in_limits(flown)
