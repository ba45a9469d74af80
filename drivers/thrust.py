"""The thrust map: newtons along +z of B to the 0..1 of PX4's set-points, and back.

A rotor's thrust is a fraction r(u) = f u^2 + (1 - f) u of its full thrust at motor signal u, and full thrust goes with
a power of the battery voltage. PX4 turns a set-point s into the motor signal by s = r_P(u) with its own
THR_MDL_FAC in place of f. One hover at known weight and voltage identifies the full thrust; the curve then gives
every other point (PX4 parameter reference: MPC_THR_HOVER, THR_MDL_FAC).
"""

from __future__ import annotations

from math import sqrt
from typing import Annotated

from msgspec import Meta, Struct

from drivers.vehicle import Vehicle


def _meta(unit: str, doc: str, low: float, high: float) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


class ThrustMap(Struct, frozen=True, forbid_unknown_fields=True):
    """One hover and two curves. ``ThrustMap.of(vehicle)`` gives the map that the vehicle file implies."""

    hover_force: Annotated[float, _meta("N", "weight carried in the identified hover", 0.1, 400.0)]
    hover_thrust: Annotated[float, _meta("1", "set-point at which it hovered", 0.05, 0.95)]
    hover_voltage: Annotated[float, _meta("V", "battery voltage in that hover", 1.0, 60.0)]
    curve: Annotated[float, _meta("1", "f of the motors", 0.0, 1.0)]
    px4_curve: Annotated[float, _meta("1", "THR_MDL_FAC set in PX4", 0.0, 1.0)]
    voltage_exponent: Annotated[
        float, _meta("1", "full thrust goes with voltage^k; 0: PX4 compensates (MC_BAT_SCALE_EN)", 0.0, 3.0)
    ] = 0.0

    @staticmethod
    def of(vehicle: Vehicle) -> ThrustMap:
        """The map that the vehicle's data imply: hovering with the sleeve, PX4's curve set to the motors'.

        Rotors give their full thrust half way between a full and an empty battery, and as the voltage squared.
        """
        mass = vehicle.base.mass + sum(part.mass for part in vehicle.arm.parts) + vehicle.arm.sleeve.mass
        force, curve = mass * vehicle.gravity, vehicle.rotors.curve
        return ThrustMap(
            hover_force=force,
            hover_thrust=force / (4.0 * vehicle.rotors.max_thrust),
            hover_voltage=0.5 * (vehicle.battery.full_voltage + vehicle.battery.empty_voltage),
            curve=curve,
            px4_curve=curve,
            voltage_exponent=2.0,
        )

    def full_force(self, voltage: float) -> float:
        """Thrust at set-point 1, N, at a battery voltage in V (not positive or not finite: unknown, no correction)."""
        full = self.hover_force / thrust_fraction(motor_signal(self.hover_thrust, self.px4_curve), self.curve)
        if self.voltage_exponent and 0.0 < voltage < float("inf"):
            full *= (voltage / self.hover_voltage) ** self.voltage_exponent
        return full

    def set_point(self, force: float, voltage: float) -> float:
        """Set-point 0..1 for ``force`` in N; beyond the ends it saturates."""
        fraction = force / self.full_force(voltage)
        if fraction <= 0.0:
            return 0.0
        if fraction >= 1.0:
            return 1.0
        if self.curve == self.px4_curve:
            return fraction
        return thrust_fraction(motor_signal(fraction, self.curve), self.px4_curve)

    def force(self, set_point: float, voltage: float) -> float:
        """Thrust in N at a set-point 0..1: the inverse of ``set_point``."""
        signal = motor_signal(min(max(set_point, 0.0), 1.0), self.px4_curve)
        return thrust_fraction(signal, self.curve) * self.full_force(voltage)


def thrust_fraction(signal: float, curve: float) -> float:
    """r(u) = f u^2 + (1 - f) u for a motor signal in 0..1."""
    return (curve * signal + 1.0 - curve) * signal


def motor_signal(fraction: float, curve: float) -> float:
    """The u in 0..1 with r(u) = ``fraction``."""
    if curve < 1e-9:
        return fraction
    linear = 1.0 - curve
    return (sqrt(linear * linear + 4.0 * curve * fraction) - linear) / (2.0 * curve)
