"""Rotors and battery: the X500's layout, thrust lag, and what the battery gives.

The curve from PX4's 0..1 to newtons is ``drivers.thrust``; here thrust is in newtons.
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.vehicle import Battery
from sim_backend import layout as at
from sim_backend.compiled import compiled

Array = NDArray[np.float64]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]


def rated_voltage(battery: Battery) -> float:
    """Voltage at which ``Rotors.max_thrust`` holds, V: half way between full and empty (as ``drivers.thrust``)."""
    return 0.5 * (battery.full_voltage + battery.empty_voltage)


def lag_gain(step: float, time_constant: float) -> float:
    """Share of the way to a constant demand that a first-order lag covers in one step."""
    return 1.0 if time_constant == 0.0 else 1.0 - exp(-step / time_constant)


@compiled()
def rotors(x: Array, p: Array, u: Array) -> tuple[float, float, float, float]:
    """Advance the rotors by one step; returns the total thrust (N, +z of B) and the moment about the origin (3, B).

    PX4 numbering: front right and rear left turn counter-clockwise seen from above, front left and rear right
    clockwise; the reaction on the airframe is opposite.
    """
    gain = p[at.ROTOR_GAIN]
    most = x[at.ROTOR_LIMIT]
    alive = x[at.CRASH] == 0.0
    for i in range(4):
        demand = min(max(u[at.U_ROTOR + i], 0.0), most) if alive else 0.0
        x[at.ROTOR + i] += gain * (demand - x[at.ROTOR + i])
    fr = x[at.ROTOR]
    rl = x[at.ROTOR + 1]
    fl = x[at.ROTOR + 2]
    rr = x[at.ROTOR + 3]
    return (
        fr + rl + fl + rr,
        p[at.ROTOR_Y] * (fl + rl - fr - rr),
        p[at.ROTOR_X] * (rl + rr - fr - fl),
        p[at.ROTOR_YAW] * (fl + rr - fr - rl),
    )


@compiled()
def battery(x: Array, p: Array, step: float) -> None:
    """Discharge the battery over one step at the present thrust; set its voltage and the rotors' limit.

    The current goes with thrust^1.5 (induced power); the open-circuit voltage falls linearly with the charge.
    """
    thrust = x[at.ROTOR] + x[at.ROTOR + 1] + x[at.ROTOR + 2] + x[at.ROTOR + 3]
    share = max(0.0, thrust / p[at.HOVER_THRUST])
    current = p[at.HOVER_CURRENT] * share * sqrt(share)
    x[at.CHARGE] = max(0.0, x[at.CHARGE] - current * step / p[at.BATTERY_CAPACITY])
    open_circuit = p[at.BATTERY_EMPTY] + (p[at.BATTERY_FULL] - p[at.BATTERY_EMPTY]) * x[at.CHARGE]
    x[at.VOLTAGE] = open_circuit - p[at.BATTERY_RESISTANCE] * current
    share = x[at.VOLTAGE] / p[at.RATED_VOLTAGE] if p[at.RATED_VOLTAGE] > 0.0 else 1.0
    x[at.ROTOR_LIMIT] = p[at.ROTOR_MAX] * min(1.0, share * share)
