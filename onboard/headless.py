"""Missions in virtual time for whoever flies many of them: in this process, without log and screen."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from msgspec import Struct

from onboard.config import Config, dump_config, law_names, load_config, scenario_names
from onboard.core.derived import check_mission
from onboard.core.params import Params
from onboard.core.plan import InfeasibleError
from onboard.core.step import State
from onboard.core.types import Outputs, Tick
from onboard.devices import simulated_devices, world_of
from onboard.layers import ConfigError, Layer, inline_text, read_yaml
from onboard.param_table import Entry, find
from onboard.params import compose
from onboard.records import EVENT, PARAMS, TICK, TRUTH, Revision, RunInfo, Timing
from onboard.simulate import fly as fly_mission
from onboard.simulate import run_info
from sim_backend.plant import Truth

__all__ = [
    "ConfigError",
    "Entry",
    "InfeasibleError",
    "Mission",
    "TookTooLongError",
    "find",
    "inline_text",
    "law_names",
    "read_struct",
    "read_yaml",
    "scenario_names",
]
S = TypeVar("S", bound=Struct)
#: Hears every message that a log of the flight would hold: topic, time in ns, message.
Hear = Callable[[str, int, Any], None]


class TookTooLongError(Exception):
    """A flight took longer on the wall clock than it may."""


class Mission:
    """One mission, as ``pipewright sim`` is told what to fly.

    Raises ConfigError, with all errors at once, for what cannot be read, and InfeasibleError for what cannot be flown.
    """

    complete = True
    config_yaml = ""

    def __init__(self, scenario: str, law: str | None, sets: tuple[str, ...], seed: int) -> None:
        self.config: Config = load_config(scenario, law, sets, seed)
        check_mission(self.config)
        try:
            simulated_devices(world_of(self.config), self.config)
        except ValueError as error:  # parameters of the world that do not go together
            raise ConfigError([f"world: {error}"]) from error

    @property
    def info(self) -> RunInfo:
        """What the run is."""
        return run_info(self.config)

    @property
    def yaml(self) -> str:
        """Everything that is in force."""
        return dump_config(self.config)

    def fly(self, hear: Hear, longest: float | None = None, wall_s: float | None = None) -> None:
        """Fly it to its end; longest: s of simulated time; wall_s: of the wall clock, else TookTooLongError."""
        until = None if wall_s is None else time.monotonic() + wall_s

        def watch(outputs: Outputs, t: float) -> None:
            if until is not None and time.monotonic() > until:
                raise TookTooLongError(f"{t:.1f} s flown in {wall_s:g} s of wall clock, in {outputs.phase.value}")

        fly_mission(self.config, world_of(self.config), _Told(hear, self.config), watch, longest)


class _Told:
    """Hands on what a recorder would write."""

    def __init__(self, hear: Hear, config: Config) -> None:
        self._hear = hear
        self.revision(0, 0, 0, config)

    def tick(self, tick: Tick, truth: Truth | None = None) -> None:
        t_ns = tick.inputs.t_ns
        self._hear(TICK, t_ns, tick)
        if truth is not None:
            self._hear(TRUTH, t_ns, truth)
        for event in tick.outputs.events:
            self._hear(EVENT, event.t_ns, event)

    def keyframe(self, index: int, t_ns: int, state: State) -> None:
        """Nobody resumes from it."""

    def timing(self, timing: Timing) -> None:
        """Virtual time is punctual."""

    def revision(self, index: int, t_ns: int, revision: int, config: Params) -> None:
        self._hear(PARAMS, t_ns, Revision(index, t_ns, revision, config))


def read_struct(struct_type: type[S], path: Path) -> S:
    """Read a file of settings that is declared by ``struct_type``. Raises ConfigError with every error."""
    layer: Layer = read_yaml(path)
    return compose(struct_type, [layer])
