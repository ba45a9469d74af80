"""Missions in virtual time for whoever flies many of them: in this process, without log and screen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from msgspec import Struct
from msgspec import inspect as mi

from onboard.config import Config, dump_config, law_names, load_config, scenario_layer, scenario_names
from onboard.core.derived import check_mission
from onboard.core.params import Params
from onboard.core.plan import InfeasibleError
from onboard.core.step import State
from onboard.core.types import Outputs, Tick
from onboard.declared import Declared, declared_as, struct_info
from onboard.devices import simulated_devices, world_of
from onboard.layers import ConfigError, Layer, dump_text, inline_text, merge, parse_set, read_yaml
from onboard.param_table import Entry, find
from onboard.params import compose, nearest
from onboard.records import EVENT, PARAMS, TICK, TRUTH, Revision, RunInfo, Timing
from onboard.simulate import fly as fly_mission
from onboard.simulate import run_info
from sim_backend.plant import Truth
from sim_backend.world import World

__all__ = [
    "ConfigError",
    "Entry",
    "InfeasibleError",
    "Mission",
    "Range",
    "TookTooLongError",
    "find",
    "inline_text",
    "law_names",
    "overlay_text",
    "range_of",
    "read_struct",
    "read_yaml",
    "scenario_names",
]
S = TypeVar("S", bound=Struct)
#: Hears every message that a log of the flight would hold: topic, time in ns, message.
Hear = Callable[[str, int, Any], None]


class Range(Struct, frozen=True):
    """What a parameter may be, by its declaration."""

    low: float = -math.inf
    high: float = math.inf
    whole: bool = False
    """Whole numbers only."""
    choices: tuple[bool | str, ...] = ()
    """One of these, and no number."""


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
            self._world: World | None = world_of(self.config)
            simulated_devices(self._world, self.config)
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

    def value(self, name: str) -> Any:
        """The value of a parameter, plain. Raises ConfigError for a name that stands for none."""
        return find(self.config, [name])[0].value

    def fly(self, hear: Hear, longest: float | None = None, wall_s: float | None = None) -> None:
        """Fly it to its end, once; longest: s of simulated time; wall_s: of the wall clock, else TookTooLongError."""
        world, self._world = self._world, None
        assert world is not None, "a world ages: the next flight needs a mission of its own"
        until = None if wall_s is None else time.monotonic() + wall_s

        def watch(outputs: Outputs, t: float) -> None:
            if until is not None and time.monotonic() > until:
                raise TookTooLongError(f"{t:.1f} s flown in {wall_s:g} s of wall clock, in {outputs.phase.value}")

        fly_mission(self.config, world, _Told(hear, self.config), watch, longest)


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


def range_of(name: str) -> Range:
    """What a parameter may be. Raises ConfigError for a name that stands for none, or for more than a single value."""
    declared = Declared(struct_info(Config))
    for key in name.split("."):
        kind = declared.type
        if isinstance(kind, mi.UnionType):
            kind = next((item for item in kind.types if not isinstance(item, mi.NoneType)), kind)
        fields = {field.name: field for field in kind.fields} if isinstance(kind, mi.StructType) else {}
        if key in fields:
            declared = declared_as(fields[key].type)
        elif isinstance(kind, mi.TupleType) and key.isdecimal() and int(key) < len(kind.item_types):
            declared = declared.inner(kind.item_types[int(key)])
        elif isinstance(kind, mi.VarTupleType) and key.isdecimal():
            declared = declared.inner(kind.item_type)
        else:
            near = nearest(Config, tuple(name.split(".")))
            raise ConfigError([f"{name}: no such parameter" + (f"; nearest: {', '.join(near)}" if near else "")])
    match declared.type:
        case mi.FloatType() | mi.IntType() as number:
            low = number.ge if number.ge is not None else number.gt
            high = number.le if number.le is not None else number.lt
            whole = isinstance(number, mi.IntType)
            return Range(-math.inf if low is None else low, math.inf if high is None else high, whole)
        case mi.BoolType():
            return Range(choices=(False, True))
        case mi.EnumType(cls=cls):
            return Range(choices=tuple(member.value for member in cls))
    raise ConfigError([f"{name}: is no single number or choice"])


def overlay_text(scenario: str | None, sets: Sequence[str], values: Mapping[str, Any], law: str | None = None) -> str:
    """YAML text of a scenario with options and values laid over it; of the values alone without a scenario."""
    whole: Any = {} if scenario is None else dict(scenario_layer(scenario).values)
    for text in (*sets, *(f"{name}={inline_text(value)}" for name, value in values.items())):
        whole = merge(whole, parse_set(text).values)
    return dump_text(whole if law is None else {**whole, "law": law})


def read_struct(struct_type: type[S], path: Path) -> S:
    """Read a file of settings that is declared by ``struct_type``. Raises ConfigError with every error."""
    layer: Layer = read_yaml(path)
    return compose(struct_type, [layer])
