"""Zeros and signs of the servos, from the arm stood in known poses by hand.

Nothing is written to the servos and nothing moves: torque must be off, so that the arm can be stood as it should be.
One pose gives the zeros; a second one, in which every servo stands elsewhere, gives the signs as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import degrees, radians
from statistics import median

from msgspec.structs import replace

from drivers import xc330
from drivers.dynamixel_bus import Bus, BusError, Port
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.dynamixel_setup import Servo, SetUp
from drivers.protocols import DeviceError
from drivers.samples import SERVO_NAMES, Five

FiveServos = tuple[ServoSettings, ServoSettings, ServoSettings, ServoSettings, ServoSettings]
Counts = tuple[int, int, int, int, int]

_READINGS = 20
_STILL = 10  # counts: more is no standing still
_ATTEMPTS, _PATIENCE = 3, 0.05
_LEAST = radians(5.0)  # less tells no sign
_FAR = radians(10.0)  # so far from where it should have gone, a servo was not where it was said to be


class PoseError(Exception):
    """Two poses do not tell the signs; the text says of which servos."""


def calibrate(settings: DynamixelSettings, angles: Five) -> FiveServos:
    """The servos' settings with the zeros that make the arm, as it stands now, stand at ``angles`` (rad).

    Signs stay as they are in ``settings``. Raises DeviceError: no port, servos that do not answer, torque on, moving.
    """
    return with_zeros(settings.servos, read_counts(settings), angles)


def read_counts(settings: DynamixelSettings) -> Counts:
    """Encoder counts of the five servos as the driver will see them, standing still; nothing is written.

    Raises DeviceError as ``calibrate`` does.
    """
    with _open(settings) as bus:
        a, b, c, d, e = (_counts(bus, servo) for servo in _found(settings, bus))
        return a, b, c, d, e


def with_zeros(servos: FiveServos, counts: Counts, angles: Five) -> FiveServos:
    """These servos with the zeros at which ``counts`` are ``angles`` (rad)."""
    a, b, c, d, e = (
        replace(servo, zero=(seen - round(servo.sign * angle / xc330.RAD_PER_COUNT)) % xc330.COUNTS)
        for servo, seen, angle in zip(servos, counts, angles, strict=True)
    )
    return a, b, c, d, e


def with_signs(servos: FiveServos, counts: Sequence[Counts], angles: Sequence[Five]) -> FiveServos:
    """These servos with the signs at which two poses' ``counts`` change as their ``angles`` (rad) do.

    Raises PoseError for servos that were turned too little, or not by what was said.
    """
    found, wrong = [], []
    for k, servo in enumerate(servos):
        said = angles[1][k] - angles[0][k]
        half = xc330.COUNTS // 2
        turned = ((counts[1][k] - counts[0][k] + half) % xc330.COUNTS - half) * xc330.RAD_PER_COUNT
        if abs(said) < _LEAST:
            wrong.append(f"{SERVO_NAMES[k]}: the poses are {degrees(said):.0f} deg apart, want 5 or more")
        elif abs(abs(turned) - abs(said)) > _FAR:
            wrong.append(f"{SERVO_NAMES[k]}: turned by {degrees(turned):.0f} deg, but {degrees(said):.0f} were said")
        found.append(replace(servo, sign=1 if turned * said > 0.0 else -1))
    if wrong:
        raise PoseError("; ".join(wrong))
    a, b, c, d, e = found
    return a, b, c, d, e


@contextmanager
def _open(settings: DynamixelSettings) -> Iterator[Bus]:
    bus = Bus(Port(settings.port, settings.baud, settings.reply_margin))
    bus.patient(_ATTEMPTS, _PATIENCE)
    try:
        yield bus
    except (BusError, OSError) as error:
        name = f" servo {error.servo}" if isinstance(error, BusError) else ""
        raise DeviceError(f"servo calibration:{name} {error}") from error
    finally:
        bus.close()


def _found(settings: DynamixelSettings, bus: Bus) -> Sequence[Servo]:
    servos = [Servo(index, servo) for index, servo in enumerate(settings.servos)]
    SetUp(settings, servos, lambda level, text: None).find(bus)
    return servos


def _counts(bus: Bus, servo: Servo) -> int:
    name = servo.settings.id
    if bus.read(name, xc330.TORQUE_ENABLE):
        raise DeviceError(f"servo calibration: {servo.name} has torque; stop what drives it, then stand the arm")
    if bus.read(name, xc330.DRIVE_MODE) & 1:
        raise DeviceError(f"servo calibration: {servo.name} counts backwards (drive mode 1); set its drive mode to 0")
    readings = [bus.read(name, xc330.PRESENT_POSITION) for _ in range(_READINGS)]
    if max(readings) - min(readings) > _STILL:
        raise DeviceError(
            f"servo calibration: {servo.name} moves (from {min(readings)} to {max(readings)} counts); hold it still"
        )
    # The driver sets the homing offset to 0.
    return round(median(readings)) - bus.read(name, xc330.HOMING_OFFSET)
