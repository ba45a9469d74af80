"""``pipewright calibrate servos``: zeros and signs of the servos, from the arm stood in known poses by hand."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from math import radians
from typing import Any

import msgspec

from drivers.dynamixel_calibrate import FiveServos, PoseError, read_counts, with_signs, with_zeros
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.samples import SERVO_NAMES, Five
from groundstation import calibration, codes
from groundstation.calibration import CalibrationError
from onboard.param_file import ParameterFile


def run(options: argparse.Namespace) -> int:
    """Run ``calibrate servos``; gives the exit code."""
    settings = _settings(options)
    angles, counts, servos = _five(options.angles), read_counts(settings), settings.servos
    try:
        if options.then is not None:
            input("stand the arm in the second pose, then press return: ")
            servos = with_signs(servos, (counts, read_counts(settings)), (angles, _five(options.then)))
    except EOFError:
        raise CalibrationError(
            "a second pose wants a person at the terminal; without --then there is one pose"
        ) from None
    except PoseError as error:
        raise CalibrationError(str(error)) from None
    servos = with_zeros(servos, counts, angles)
    found = {
        f"devices.servos.servos.{k}.{name}": getattr(servo, name)
        for k, servo in enumerate(servos)
        for name in ("id", "zero", "sign")
    }
    calibration.give(options, _words(settings.servos, servos), found, {"devices.servos.servos": _plain(servos)})
    return codes.DONE


def _settings(options: argparse.Namespace) -> DynamixelSettings:
    """The bus as the configuration says, or the options. Raises ConfigError and CalibrationError."""
    settings: DynamixelSettings = DynamixelSettings("")
    if options.config is not None:
        file = ParameterFile(options.config)
        file.path()  # told before anybody stands the arm, should it not be a file
        settings = file.load().devices.servos
    plain = [msgspec.to_builtins(servo) for servo in settings.servos]
    for key, given in (("id", options.ids), ("sign", options.signs)):
        for servo, value in zip(plain, given or (), strict=given is not None):
            servo[key] = value
    port, baud = options.port or settings.port, options.baud or settings.baud
    if not port:
        raise CalibrationError("--port: missing; want for example /dev/servos, or a --config that names it")
    try:
        return DynamixelSettings(port, msgspec.convert(plain, FiveServos), baud)
    except msgspec.ValidationError as error:
        raise CalibrationError(f"--ids, --signs: {error}") from None


def _words(before: FiveServos, servos: FiveServos) -> Iterator[str]:
    for name, was, now in zip(SERVO_NAMES, before, servos, strict=True):
        turned = "" if now.sign == was.sign else ", turns the other way round than was thought"
        yield f"{name} (id {now.id}): zero at {now.zero} counts, was {was.zero}{turned}"


def _plain(servos: FiveServos) -> list[dict[str, Any]]:
    """The servos as they are written in a configuration."""
    plain = []
    for servo in servos:
        default, given = msgspec.to_builtins(ServoSettings(servo.id)), msgspec.to_builtins(servo)
        plain.append({key: given[key] for key in given if key in ("id", "zero", "sign") or given[key] != default[key]})
    return plain


def _five(values: Sequence[float]) -> Five:
    a, b, c, d, e = (radians(value) for value in values)
    return a, b, c, d, e
