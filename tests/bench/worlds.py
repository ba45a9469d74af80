"""Physics steps per second: the rigid-body world, and rotorpy's multirotor beside it, by turns in the same run."""

from __future__ import annotations

import importlib
import logging
from importlib.metadata import PackageNotFoundError, version
from time import perf_counter
from typing import Any

import numpy as np
from msgspec import Struct

from onboard.config import Config
from onboard.devices import world_of
from sim_backend.world import World

DISTRIBUTION = "rotorpy"
_ROUNDS = 3
_TICK, _TICKS = 0.004, 250
_THEIR_STEPS = 200


class Worlds(Struct, frozen=True):
    """Of one core."""

    package: str
    """Name and version of the other, or why it is not there."""
    step: float
    """Length of our step, s."""
    ours: float
    """Steps per second: base, three joints, contact, motors, servos and the autopilot's loops."""
    theirs_same: float | None = None
    """Steps per second, of the same length: a base with four rotors and drag, no arm, no contact, no autopilot."""
    theirs_own: float | None = None
    """Of the length that its simulator takes, 10 ms."""

    @property
    def ratio(self) -> float | None:
        """Ours by theirs, steps of the same length."""
        return None if self.theirs_same is None else self.ours / self.theirs_same


def measure(config: Config) -> Worlds:
    """Time both, in turns; the best of a few rounds each."""
    world, step = world_of(config), config.world.plant.physics_step
    other = _Other.made()
    ours, same, own = 0.0, 0.0, 0.0
    for _ in range(_ROUNDS):
        ours = max(ours, _ours(world, step))
        if other is not None:
            same, own = max(same, other.steps(step)), max(own, other.steps(0.010))
    if other is None:
        return Worlds(f"skipped: {DISTRIBUTION} is not installed", step, ours)
    return Worlds(f"{DISTRIBUTION} {version(DISTRIBUTION)}", step, ours, same, own)


def _ours(world: World, step: float) -> float:
    begun = perf_counter()
    for _ in range(_TICKS):
        world.advance(_TICK)
    return _TICKS * _TICK / step / (perf_counter() - begun)


class _Other:
    """rotorpy's quadrotor, hovering."""

    def __init__(self, multirotor: Any, params: dict[str, Any]) -> None:
        hover = float(np.sqrt(params["mass"] * 9.81 / (4.0 * params["k_eta"])))
        self._speeds = np.full(4, hover)
        self._state: dict[str, Any] = {
            "x": np.zeros(3), "v": np.zeros(3), "q": np.array([0.0, 0.0, 0.0, 1.0]), "w": np.zeros(3),
            "wind": np.zeros(3), "rotor_speeds": self._speeds.copy(),
        }  # fmt: skip
        self._vehicle = multirotor(params, self._state)

    @staticmethod
    def made() -> _Other | None:
        """None where it is not installed."""
        try:
            version(DISTRIBUTION)
        except PackageNotFoundError:
            return None
        logging.getLogger(DISTRIBUTION).setLevel(logging.ERROR)
        multirotor = importlib.import_module("rotorpy.vehicles.multirotor")
        params = importlib.import_module("rotorpy.vehicles.hummingbird_params")
        return _Other(multirotor.Multirotor, params.quad_params)

    def steps(self, length: float) -> float:
        """Steps of this length per second."""
        state, control = self._state, {"cmd_motor_speeds": self._speeds}
        begun = perf_counter()
        for _ in range(_THEIR_STEPS):
            state = self._vehicle.step(state, control, length)
        return _THEIR_STEPS / (perf_counter() - begun)
