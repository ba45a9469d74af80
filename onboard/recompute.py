"""The force estimators over a recorded log again: with other parameters, and beside one too slow to fly.

The core is replayed with the parameters of the flight, so that phases, references and commands are those of the
flight; beside it the estimators run on the same inputs with the parameters that are asked for. What they would have
made of the flight had they been in its loop is another question: fly it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from onboard import estimator_cost
from onboard.config import Config
from onboard.core import estimate
from onboard.core.derived import Derived
from onboard.core.step import State, initial_state, step
from onboard.core.types import Estimate, Phase, Tick
from onboard.layers import ConfigError, Layer, parse_set
from onboard.logfile import LogError, LogReader
from onboard.params import compose
from onboard.records import PARAMS, TICK, Revision
from onboard.ukf import Ukf

#: Where the slow ones run: before, in and after the contact.
_CONTACT = (Phase.TARE, Phase.ADVANCE, Phase.PRESS, Phase.RELEASE)


class Recomputed(Struct, frozen=True):
    """Compressions by each estimator, N, one a tick of the log (None where it did not run); costs of a tick, us."""

    forces: dict[str, list[float | None]]
    triggered: list[bool]
    alarm: list[bool]
    selected: str
    costs: dict[str, float]


def recompute(
    path: Path,
    sets: Sequence[str] = (),
    *,
    ukf: bool = False,
    partial: bool = False,
    on_second: Callable[[float, float], None] | None = None,
) -> Recomputed:
    """Run the estimators over the log at ``path``. ``on_second``: time and length of the log, once a second of it.

    Raises:
        LogError: the log cannot be read, or does not begin with the flight.
        ConfigError: ``sets`` are wrong.
    """
    forces: dict[str, list[float | None]] = {name: [] for name in ("paper", "body", "momentum", "kalman", "felt")}
    triggered: list[bool] = []
    alarm: list[bool] = []
    slow: Ukf | None = None
    spent: list[int] = []
    if ukf:
        forces["ukf"] = []
    with LogReader(path, partial=partial) as log:
        recorded: Config | None = None
        asked: Config | None = None
        derived: Derived | None = None
        state: State | None = None
        seen = estimate.State()
        first = second = 0
        kinds: dict[str, Any] = {PARAMS: Revision[Config], TICK: Tick}
        for topic, message in log.read(kinds):
            if topic == PARAMS:
                recorded = message.config
                asked = changed(message.config, sets)
                derived = Derived(asked)
                continue
            tick: Tick = message
            if recorded is None or asked is None or derived is None:
                raise LogError(f"{path}: holds no parameters before its first tick")
            if state is None:
                if tick.index != 0:
                    raise LogError(f"{path}: begins with tick {tick.index}; the estimators want the whole flight")
                state, first = initial_state(recorded), tick.inputs.t_ns
            before = state
            state, outputs = step(state, tick.inputs, recorded, tick.inputs.dt)
            dt = min(asked.dt_max, max(asked.dt_min, tick.inputs.dt))
            seen, told = estimate.step(
                seen, tick.inputs, before.mission.phase, before.progress, before.reference, before.command, derived,
                asked, dt,
            )  # fmt: skip
            read = told.forces
            for name in ("paper", "body", "momentum", "kalman"):
                forces[name].append(getattr(read, name).contact)
            forces["felt"].append(read.felt)
            triggered.append(told.in_contact)
            alarm.append(read.alarm)
            if ukf:
                value = None
                if outputs.phase in _CONTACT and told.valid:
                    slow = slow or Ukf(derived.model.mass(told.payload), asked.vehicle.gravity, told.v_WB, told.rpy)
                    begun = perf_counter_ns()
                    value = _slowly(slow, told, seen, derived, dt)
                    spent.append(perf_counter_ns() - begun)
                    if before.progress.taring:
                        slow.tare(done=before.progress.tared)
                forces["ukf"].append(value)
            t = (tick.inputs.t_ns - first) * 1e-9
            if on_second is not None and t >= second:
                on_second(t, log.duration)
                second = int(t) + 1
    if asked is None:
        raise LogError(f"{path}: holds no tick")
    costs = estimator_cost.measure(asked)
    if spent:
        costs["ukf"] = 1e-3 * float(np.median(spent))
    return Recomputed(forces, triggered, alarm, asked.estimators.selected.value, costs)


def changed(config: Config, sets: Sequence[str]) -> Config:
    """The configuration with options ``key=value`` laid over it. Raises ConfigError with every error."""
    for text in sets:
        if not text.startswith(("estimators.", "observer.", "contact.", "vehicle.")):
            raise ConfigError(
                [f"--set {text}: does not change the estimators; give one of estimators, observer, contact, vehicle"]
            )
    return compose(Config, [Layer("the log", msgspec.to_builtins(config)), *(parse_set(text) for text in sets)])


def _slowly(slow: Ukf, told: Estimate, seen: estimate.State, derived: Derived, dt: float) -> float:
    autopilot = seen.autopilot
    assert autopilot is not None
    thrust = seen.forces.thrust
    force = slow.step(thrust.scale * thrust.lagged, autopilot.f_B, autopilot.w_WB_B, told.rpy, told.v_WB, told.R_WB, dt)
    n = derived.site.normal
    return -(force[0] * n[0] + force[1] * n[1])
