"""``pipewright calibrate hover RUN``: the thrust map of the vehicle that flew, from the hover in its log."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from statistics import fmean

import msgspec
from msgspec import Struct

from drivers.hover import HoverFit, HoverPoint, identify
from drivers.thrust import ThrustMap
from drivers.vehicle import Vehicle
from groundstation import calibration, codes
from groundstation.calibration import CalibrationError
from onboard.messages import PARAMS, TICK, LogReader, Phase

Three = tuple[float, float, float]

#: A stretch of flight is hover when the vehicle is nowhere faster in it, m/s.
STILL = 0.15
#: Length of a stretch, s.
STRETCH = 0.5
#: Least hover that a calibration is taken from, s.
LEAST = 5.0
#: The pipe may carry or pull in these.
_NEAR_THE_PIPE = {Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, Phase.RETREAT_HOLD, Phase.RETREAT_LAND}
_FLOWN_BY = ("attitude", "body_rate")


# What is read of the recorded structs: the same names, only the fields that are used here.


class _State(Struct, gc=False):
    armed: bool
    mode: str
    landed: str
    battery_voltage: float


class _Inputs(Struct, gc=False):
    t_ns: int
    autopilot: _State | None


class _Estimate(Struct, gc=False):
    v_WB: Three
    rpy: Three
    payload: bool
    in_contact: bool


class _Command(Struct, gc=False):
    engage: str
    interface: str
    thrust: float


class _Outputs(Struct, gc=False):
    phase: str
    estimate: _Estimate
    autopilot: _Command


class _Tick(Struct, gc=False):
    index: int
    inputs: _Inputs
    outputs: _Outputs


class _Autopilot(Struct):
    kind: str
    thrust: ThrustMap | None = None


class _Devices(Struct):
    autopilot: _Autopilot


class _Config(Struct):
    vehicle: Vehicle
    devices: _Devices


class _Revision(Struct):
    config: _Config


class Flown(Struct, frozen=True):
    """What the log of a flight tells of its hover."""

    before: ThrustMap
    """The map that the set-points were made with."""
    points: tuple[HoverPoint, ...]
    """One for each stretch of ``STRETCH`` s."""


def run(options: argparse.Namespace) -> int:
    """Run ``calibrate hover``; gives the exit code."""
    flown = read(calibration.log_of(options), partial=options.partial)
    fit = identify(flown.points, flown.before)
    found = {name: float(f"{value:.5g}") for name, value in msgspec.to_builtins(fit.thrust).items()}
    calibration.give(options, words_of(flown, fit), {"devices.autopilot.thrust": found})
    return codes.DONE


def read(log: Path, *, partial: bool = False) -> Flown:
    """The hover in a log.

    Raises LogError for one that cannot be read, CalibrationError when it holds no hover to calibrate from.
    """
    config: _Config | None = None
    ticks: list[_Tick] = []
    with LogReader(log, partial=partial) as reader:
        for topic, message in reader.read({TICK: _Tick, PARAMS: _Revision}):
            if topic == TICK:
                ticks.append(message)
            elif config is None:
                config = message.config
    if config is None or not ticks:
        raise CalibrationError(f"{log}: holds no cycle; the run ended before its first tick")
    if config.devices.autopilot.kind == "mock":
        raise CalibrationError(f"{log}: its autopilot was a mock, which takes newtons; fly a real or an emulated one")
    if ticks[0].outputs.autopilot.interface not in _FLOWN_BY:
        raise CalibrationError(f"{log}: was flown with wrenches; want set-points of attitude or body rate")
    before = config.devices.autopilot.thrust or ThrustMap.of(config.vehicle)
    points = tuple(_points(ticks, config.vehicle, before))
    if len(points) * STRETCH < LEAST:
        raise CalibrationError(
            f"{log}: {len(points) * STRETCH:g} s of hover; at least {LEAST:g} s are needed, in the air, in offboard "
            f"mode, away from the pipe and slower than {STILL:g} m/s: have the vehicle hold for a while (request hold)"
        )
    return Flown(before, points)


def _points(ticks: list[_Tick], vehicle: Vehicle, thrust: ThrustMap) -> Iterator[HoverPoint]:
    start = ticks[0].inputs.t_ns
    for _, group in groupby(ticks, lambda tick: (tick.inputs.t_ns - start) // round(1e9 * STRETCH)):
        stretch = list(group)
        first, last = stretch[0], stretch[-1]
        whole = last.index - first.index + 1 == len(stretch)
        if whole and last.inputs.t_ns - first.inputs.t_ns > 0.9e9 * STRETCH and all(map(_hovers, stretch)):
            yield _point(stretch, vehicle, thrust)


def _hovers(tick: _Tick) -> bool:
    state, estimate, command = tick.inputs.autopilot, tick.outputs.estimate, tick.outputs.autopilot
    return (
        state is not None
        and state.armed
        and state.mode == "offboard"
        and state.landed == "in_air"
        and state.battery_voltage > 0.0
        and command.engage == "offboard"
        and not estimate.in_contact
        and tick.outputs.phase not in _NEAR_THE_PIPE
        and math.hypot(*estimate.v_WB) < STILL
    )


def _point(stretch: list[_Tick], vehicle: Vehicle, thrust: ThrustMap) -> HoverPoint:
    """Weight and mean acceleration against mean lift: what the rotors gave along +z of B."""
    estimates = [tick.outputs.estimate for tick in stretch]
    voltages = [tick.inputs.autopilot.battery_voltage for tick in stretch if tick.inputs.autopilot is not None]
    mass = vehicle.base.mass + sum(part.mass for part in vehicle.arm.parts)
    mass += vehicle.arm.sleeve.mass * fmean(estimate.payload for estimate in estimates)
    lasted = (stretch[-1].inputs.t_ns - stretch[0].inputs.t_ns) * 1e-9
    climb = (estimates[-1].v_WB[2] - estimates[0].v_WB[2]) / lasted
    upright = fmean(math.cos(estimate.rpy[0]) * math.cos(estimate.rpy[1]) for estimate in estimates)
    sent = (
        thrust.set_point(tick.outputs.autopilot.thrust, volts) for tick, volts in zip(stretch, voltages, strict=True)
    )
    return HoverPoint(mass * (vehicle.gravity + climb) / upright, fmean(sent), fmean(voltages))


def words_of(flown: Flown, fit: HoverFit) -> Iterator[str]:
    """What was found, line by line, for a person."""
    points, found = flown.points, fit.thrust
    volts = [point.voltage for point in points]
    middle = found.hover_voltage
    was, now = flown.before.full_force(middle), found.full_force(middle)
    yield f"{len(points) * STRETCH:g} s of hover at {min(volts):.2f} to {max(volts):.2f} V"
    yield f"full thrust at {middle:.2f} V: {now:.2f} N, {100 * (now / was - 1):+.1f} % against the map in force"
    yield f"hover at set-point {found.hover_thrust:.4f} for {found.hover_force:.2f} N"
    if fit.slope_taken:
        yield f"thrust goes with voltage to the power of {found.voltage_exponent:.2f} (+- {fit.slope_error:.2f})"
    else:
        yield f"the voltage changed too little to tell its exponent; {found.voltage_exponent:g} is kept"
    left_out = f"; {fit.left_out} of {len(points)} stretches were far off and left out" if fit.left_out else ""
    yield f"the hover lies within {100 * fit.spread:.2f} % (rms) of the new map{left_out}"
