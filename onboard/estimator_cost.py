"""What a tick of each force estimator costs on this machine, measured beside the flight and never in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter_ns

import msgspec

from drivers.samples import ServoState
from onboard.core import body_observer, kalman_observer, momentum_observer, observer
from onboard.core.derived import derive
from onboard.core.estimators import Command, Sight, State, tell
from onboard.core.params import Params
from onboard.core.types import Estimator

#: In a run's folder, beside its log: equal runs have equal logs, and times are never equal.
NAME = "costs.json"
_TIMES = 500


def measure(params: Params) -> dict[str, float]:
    """Median cost of a tick, us, by the name of the estimator; in hover, each ``_TIMES`` times."""
    derived = derive(params)
    mass, g = derived.model.mass(True), params.vehicle.gravity
    five = (0.0,) * 5
    servos = ServoState(0, (-0.9, 0.6, 0.0, 0.0, 0.0), five, five, five, five, (0,) * 5, True)
    sight = Sight(
        (0.0, 0.0, g), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, True, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        (0.0, 0.0, 1.5), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), servos, 0.0, True, (0.0, 0.0, 0.0), True, False,
    )  # fmt: skip
    start, dt = State(), 0.004
    told, _ = tell(start, sight, Command(mass * g), derived, params, dt)
    begun = momentum_observer.step(start.momentum, told, derived.model, params.estimators.momentum, dt)
    axis = (0.0, 0.0, 1.0)
    steps: dict[Estimator, Callable[[], object]] = {
        Estimator.PAPER: lambda: observer.step(
            start.paper, told.a_W, told.desired, told.sent, axis, mass, g, params.observer, dt
        ),
        Estimator.BODY: lambda: body_observer.step(start.body, told, params.estimators.body, dt),
        Estimator.MOMENTUM: lambda: momentum_observer.step(begun, told, derived.model, params.estimators.momentum, dt),
        Estimator.KALMAN: lambda: kalman_observer.step(start.kalman, told, params.estimators.kalman, dt),
    }
    return {name.value: time_of(step) for name, step in steps.items()}


def time_of(step: Callable[[], object], times: int = _TIMES) -> float:
    """Median time of a call, us."""
    spent = []
    for _ in range(times):
        begun = perf_counter_ns()
        step()
        spent.append(perf_counter_ns() - begun)
    return 1e-3 * median(spent)


def write(params: Params, log: Path) -> None:
    """Measure, and write it beside a log."""
    log.with_name(NAME).write_bytes(msgspec.json.encode(measure(params)) + b"\n")
