"""How the true vehicle and the true pipe differ from what the vehicle file and the mission say.

The flight core keeps its model; the world gets this. Sizes are declared, the seed says which way each goes: a size of
0.03 is 3 % too much or 3 % too little, never 1 %. So every seed is as hard as declared, and no seed is easier.
"""

from __future__ import annotations

from math import cos, pi, radians, sin
from typing import Annotated

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from sim_backend.knob import knob
from sim_backend.pipe import Pipe

#: Waves that make up the unevenness of a pipe's friction.
WAVES = 4


class DeviationParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How far the truth is from the model. Zero is off; the seed gives the signs and directions."""

    thrust: Annotated[float, knob("1", "thrust against what the thrust map says", 0.0, 0.5)] = 0.0
    mass: Annotated[float, knob("1", "mass of the whole vehicle", 0.0, 0.5)] = 0.0
    centre: Annotated[float, knob("m", "centre of mass of the whole vehicle, in any direction", 0.0, 0.1)] = 0.0
    inertia: Annotated[float, knob("1", "each of the airframe's principal moments", 0.0, 0.9)] = 0.0
    pipe_ahead: Annotated[float, knob("m", "pipe nearer or farther along the heading", 0.0, 0.5)] = 0.0
    pipe_up: Annotated[float, knob("m", "pipe higher or lower", 0.0, 0.5)] = 0.0
    pipe_turn_deg: Annotated[float, knob("deg", "pipe's heading", 0.0, 45.0)] = 0.0


class Deviations(Struct, frozen=True):
    """One truth. The defaults are the model itself."""

    thrust: float = 1.0
    """Factor on the rotors' thrust."""
    mass: float = 1.0
    """Factor on the mass of the whole vehicle; the airframe has the difference."""
    centre: Vec3 = (0.0, 0.0, 0.0)
    """Centre of mass of the whole vehicle less that of the model, m, B; the airframe is what is off."""
    inertia: Vec3 = (1.0, 1.0, 1.0)
    """Factors on the airframe's principal moments."""
    pipe: Vec3 = (0.0, 0.0, 0.0)
    """Ahead along the heading of the mission (m), up (m), turned (rad)."""
    waves: tuple[Vec3, ...] = ((0.0, 0.0, 0.0),) * WAVES
    """Friction along the pipe: direction of each wave's vector (rad), its length in units of 1 / patch, its phase."""

    def vehicle(self, model: Vehicle) -> Vehicle:
        """The true vehicle, its base's centre of mass apart."""
        base, inertia = model.base, self.inertia
        more = (self.mass - 1.0) * mass_of(model)
        a, b, c = base.inertia
        moments = (a * inertia[0], b * inertia[1], c * inertia[2])
        return replace(model, base=replace(base, mass=base.mass + more, inertia=moments))

    def base_centre(self, model: Vehicle) -> Vec3:
        """Where the true base's centre of mass lies, m, B."""
        share = mass_of(model) * self.mass / self.vehicle(model).base.mass
        return (self.centre[0] * share, self.centre[1] * share, self.centre[2] * share)

    def pipe_of(self, model: Pipe) -> Pipe:
        """The pipe where it really is."""
        (ahead, up, turn), (x, y, z), heading = self.pipe, model.position, model.heading
        place = (x + ahead * cos(heading), y + ahead * sin(heading), z + up)
        return replace(model, position=place, heading=heading + turn)


AS_MODELLED = Deviations()


def mass_of(vehicle: Vehicle) -> float:
    """Mass of the whole vehicle with the sleeve, kg."""
    return vehicle.base.mass + sum(part.mass for part in vehicle.arm.parts) + vehicle.arm.sleeve.mass


def deviations(params: DeviationParams, seed: int) -> Deviations:
    """The truth of this seed."""
    random = np.random.default_rng([seed, 3])
    signs = (2 * random.integers(0, 2, 8) - 1).tolist()
    way = random.standard_normal(3)
    way /= np.linalg.norm(way)
    waves = random.random((WAVES, 3)) * (2.0 * pi, 1.5, 2.0 * pi) + (0.0, 0.5, 0.0)
    return Deviations(
        thrust=1.0 + signs[0] * params.thrust,
        mass=1.0 + signs[1] * params.mass,
        centre=_three(params.centre * way),
        inertia=_three(1.0 + params.inertia * np.array(signs[2:5])),
        pipe=(signs[5] * params.pipe_ahead, signs[6] * params.pipe_up, signs[7] * radians(params.pipe_turn_deg)),
        waves=tuple(_three(wave) for wave in waves),
    )


def _three(values: NDArray[np.float64]) -> Vec3:
    return (float(values[0]), float(values[1]), float(values[2]))
