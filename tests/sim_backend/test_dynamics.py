"""The lumped equations of motion against each part taken by itself, and the laws of conservation."""

from __future__ import annotations

from math import cos, sin
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.vehicle import Carrier, Part, Vehicle
from sim_backend import layout as at
from sim_backend.dynamics import accelerations, lump

Array = NDArray[np.float64]
CARRIERS = (Carrier.LINK_1, Carrier.LINK_2, Carrier.TOOL)


def direct_residual(
    vehicle: Vehicle, parts: tuple[Part, ...], joints: Array, rate: Array, rates: Array, solution: Array, load: Array
) -> Array:
    """Newton and Euler for every part by itself, projected on the nine directions; zero when ``solution`` is right."""
    f, turn, bend = solution[:3], solution[3:6], solution[6:]
    y = np.array([0.0, 1.0, 0.0])
    u = np.array([[cos(a), 0.0, sin(a)] for a in joints])
    du = np.array([[-sin(a), 0.0, cos(a)] for a in joints])
    out = load.copy()
    out[6:] -= vehicle.servo.rotor_inertia * bend
    base = np.array(vehicle.base.inertia)
    out[:3] -= vehicle.base.mass * f
    out[3:6] -= base * turn + np.cross(rate, base * rate)
    for part in parts:
        along = np.array(part.along)
        c = np.array(vehicle.arm.mount) + (part.offset[0], 0.0, part.offset[1]) + along @ u
        speed = (along * rates) @ du
        a = (
            f
            + np.cross(turn, c)
            + (along * bend) @ du
            + np.cross(rate, np.cross(rate, c))
            + 2.0 * np.cross(rate, speed)
            - (along * rates**2) @ u
        )
        k = None if part.turns_with is Carrier.BASE else CARRIERS.index(part.turns_with)
        axes = np.eye(3) if k is None else np.column_stack((u[k], y, du[k]))
        inertia = axes @ np.diag(np.array(part.inertia)) @ axes.T
        w = rate if k is None else rate - y * rates[k]
        dw = turn if k is None else turn - y * bend[k] - np.cross(rate, y) * rates[k]
        moment = inertia @ dw + np.cross(w, inertia @ w)
        out[:3] -= part.mass * a
        out[3:6] -= part.mass * np.cross(c, a) + moment
        out[6:] -= part.mass * along * (du @ a)
        if k is not None:
            out[6 + k] += y @ moment
    return out


@pytest.mark.parametrize("payload", [False, True])
@pytest.mark.parametrize("mount_y", [0.0, 0.03])
def test_equations_hold_for_each_part(vehicle: Vehicle, payload: bool, mount_y: float) -> None:
    arm = msgspec.structs.replace(vehicle.arm, mount=(vehicle.arm.mount[0], mount_y, vehicle.arm.mount[2]))
    vehicle = msgspec.structs.replace(vehicle, arm=arm)
    parts = (*arm.parts, arm.sleeve) if payload else arm.parts
    p = np.zeros(at.CONSTANTS_SIZE)
    p[at.LUMPED : at.LUMPED + at.LUMPED_SIZE] = lump(vehicle, parts, vehicle.servo.rotor_inertia)
    random = np.random.default_rng(1)
    for _ in range(50):
        joints, rate, rates = random.uniform(-3, 3, 3), random.uniform(-4, 4, 3), random.uniform(-6, 6, 3)
        load = random.uniform(-10, 10, 9)
        arguments = (*(g(a) for a in joints for g in (cos, sin)), *rate, *rates, *map(tuple, load.reshape(3, 3)))
        solution = np.array(cast(Any, accelerations)(p, at.LUMPED, *arguments))
        residual = direct_residual(vehicle, parts, joints, rate, rates, solution, load)
        assert np.abs(residual).max() < 1e-10
