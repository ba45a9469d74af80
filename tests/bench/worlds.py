"""The same mission in the other world, and steps of another package's quadrotor beside the steps of both."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from time import perf_counter_ns
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from onboard.config import Config
from sim_backend.array_plant import PlantKind
from tests.bench import flight
from tests.bench.flight import Flight
from tests.bench.measure import Stat, stat

#: Steps of the other package that are timed.
STEPS = 1000


class Quadrotor(Struct, frozen=True):
    """The steps of another package."""

    package: str
    """Name and version, or why there is no comparison."""
    step_s: float
    """Simulated time of one."""
    time: Stat | None = None
    """Each step, us."""


class Worlds(Struct, frozen=True):
    """What a mission takes in PyBullet, and rotorpy's quadrotor at the step of each of our worlds and at its own."""

    bullet: Flight | None
    missing: str
    """Why there is no flight."""
    quadrotor: tuple[Quadrotor, ...]


def measure(config: Config, longest: float | None) -> Worlds:
    """Fly the mission in PyBullet, broken off after ``longest`` simulated seconds, and time the other package."""
    plant = config.world.plant
    other = replace(config, world=replace(config.world, plant=replace(plant, kind=PlantKind.PYBULLET)))
    bullet, missing = None, ""
    try:
        version("pybullet")
    except PackageNotFoundError:
        missing = "skipped: pybullet is not installed"
    else:
        bullet, _ = flight.fly(other, longest)
    return Worlds(bullet, missing, tuple(_rotorpy(step) for step in (plant.step, plant.bullet.step, 0.01)))


def _rotorpy(step: float) -> Quadrotor:
    """Its rigid body with four rotors (no arm, no contact), hovering; as it comes, integrated by SciPy's RK45."""
    try:
        package = f"rotorpy {version('rotorpy')}"
    except PackageNotFoundError:
        return Quadrotor("skipped: rotorpy is not installed", step)
    from rotorpy.vehicles.hummingbird_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    speed = np.sqrt(quad_params["mass"] * 9.81 / 4.0 / quad_params["k_eta"])
    vehicle = Multirotor(quad_params)
    state: dict[str, Any] = {
        "x": np.zeros(3),
        "v": np.zeros(3),
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": np.full(4, speed),
    }
    control = {"cmd_motor_speeds": np.full(4, speed)}
    spans = []
    for _ in range(STEPS):
        start = perf_counter_ns()
        state = vehicle.step(state, control, step)
        spans.append(perf_counter_ns() - start)
    return Quadrotor(package, step, stat(spans))
