"""What is set about the servo bus: the port, the five servos and their calibration, and how faults are met."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct


def _meta(unit: str, doc: str, low: float, high: float) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


Gain = Annotated[int, _meta("1", "of the position loop, in the control table's scale", 0, 16_383)]


class ServoSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """One servo: where it is on the bus, how it is mounted, what it may do."""

    id: Annotated[int, _meta("1", "on the bus", 0, 252)]
    zero: Annotated[int, _meta("counts", "encoder reading at angle 0", -1_000_000, 1_000_000)] = 2048
    sign: Annotated[Literal[1, -1], Meta(description="1: the angle grows with the encoder's counts")] = 1
    center: Annotated[float, _meta("rad", "when switched on, the angle is within half a turn of this", -6.3, 6.3)] = 0.0
    torque_constant: Annotated[
        float, _meta("N m/A", "torque at the output per supply current; stall 0.93 N m at 1.80 A", 0.05, 5.0)
    ] = 0.93 / 1.80
    current_limit: Annotated[
        float, _meta("A", "no goal exceeds it; below what trips the overload shutdown", 0, 2.352)
    ] = 1.6
    profile_velocity: Annotated[float, _meta("rad/s", "in position mode; 0: no profile", 0.0, 49.0)] = 0.0
    profile_acceleration: Annotated[float, _meta("rad/s^2", "in position mode; 0: no profile", 0.0, 12_000.0)] = 0.0
    gains: tuple[Gain, Gain, Gain] | None = None
    """P, I, D of the position loop; None leaves those of the firmware."""


class DynamixelSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The bus, its servos in the order of ``SERVO_NAMES``, and how faults are met."""

    port: Annotated[str, Meta(description="serial port: /dev/servos, /dev/ttyUSB0, ...")]
    servos: tuple[ServoSettings, ServoSettings, ServoSettings, ServoSettings, ServoSettings] = (
        ServoSettings(1),
        ServoSettings(2),
        ServoSettings(3),
        ServoSettings(4),
        ServoSettings(5),
    )
    baud: Annotated[
        Literal[9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000],
        Meta(description="as set in the servos", extra={"unit": "bit/s", "in_flight": False}),
    ] = 1_000_000
    period: Annotated[float, _meta("s", "between cycles while nothing is commanded", 0.001, 0.1)] = 0.004
    patience: Annotated[float, _meta("s", "without a command the bus is left silent after this", 0.005, 1.0)] = 0.030
    watchdog: Annotated[float, _meta("s", "silence that makes the servos stop; steps of 0.02", 0.02, 2.54)] = 0.10
    reply_margin: Annotated[float, _meta("s", "answers may be late by this", 0.0005, 0.05)] = 0.010
    silent_after: Annotated[float, _meta("s", "without an answer until a servo counts as silent", 0.01, 1.0)] = 0.05
    retry: Annotated[float, _meta("s", "between attempts to find a lost servo or adapter", 0.05, 10.0)] = 0.25
    health: Annotated[float, _meta("s", "between looks at one servo's voltage and temperature", 0.01, 5.0)] = 0.05
    temperature_limit: Annotated[int, _meta("degC", "the servo shuts down above it", 0, 100)] = 70
    reboot_delay: Annotated[float, _meta("s", "from an overload shutdown to the reboot", 0.1, 60.0)] = 1.0
    reboots: Annotated[int, _meta("1", "after overload, for each servo and start", 0, 100)] = 3
    homing_speed: Annotated[float, _meta("rad/s", "back to the goal after an interruption", 0.01, 5.0)] = 0.5
    homing_time: Annotated[float, _meta("s", "torque grows back in this time after an interruption", 0.01, 10.0)] = 1.0
