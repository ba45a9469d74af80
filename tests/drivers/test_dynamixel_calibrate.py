"""Zeros and signs that are found are those with which the emulated arm was put together."""

from __future__ import annotations

from collections.abc import Iterator
from math import radians

import pytest

from drivers import dynamixel_calibrate as calibration
from drivers import xc330
from drivers.dynamixel_calibrate import FiveServos, calibrate, read_counts, with_signs, with_zeros
from drivers.dynamixel_settings import DynamixelSettings, ServoSettings
from drivers.protocols import DeviceError
from drivers.samples import Five
from sim_backend.dynamixel_emulator import DynamixelEmulator, emulate
from sim_backend.dynamixel_mechanics import Drive, FreeServos, Motion
from sim_backend.faults import Kind

MOUNTING: FiveServos = (
    ServoSettings(id=3, zero=1500),
    ServoSettings(id=7, zero=2600, sign=-1),
    ServoSettings(id=4, zero=2048),
    ServoSettings(id=9, zero=100, sign=-1),
    ServoSettings(id=12, zero=3000),
)
FIRST: Five = (10.0, -20.0, 0.0, 90.0, 5.0)
SECOND: Five = (40.0, 20.0, -30.0, -45.0, -40.0)


@pytest.fixture
def emulator() -> Iterator[DynamixelEmulator]:
    made = emulate(MOUNTING, wire=False)
    made.start()
    yield made
    made.stop()


def stand(emulator: DynamixelEmulator, angles: Five) -> None:
    """Deg; the encoders of servos that were turned further than one turn begin anew when they are switched on."""
    free = emulator.bus._mechanics
    assert isinstance(free, FreeServos)
    for k, (mount, angle) in enumerate(zip(MOUNTING, angles, strict=True)):
        free.position[k] = mount.zero * xc330.RAD_PER_COUNT + mount.sign * radians(angle)


def settings(emulator: DynamixelEmulator, signed: bool = True) -> DynamixelSettings:
    servos: FiveServos = tuple(  # type: ignore[assignment]
        ServoSettings(id=mount.id, sign=mount.sign if signed else 1, torque_constant=0.4) for mount in MOUNTING
    )
    return DynamixelSettings(emulator.path, servos)


def test_zeros_of_one_pose(emulator: DynamixelEmulator) -> None:
    stand(emulator, FIRST)
    angles: Five = tuple(map(radians, FIRST))  # type: ignore[assignment]
    found = calibrate(settings(emulator), angles)
    assert [servo.zero for servo in found] == pytest.approx([mount.zero for mount in MOUNTING], abs=1)
    assert {servo.torque_constant for servo in found} == {0.4}


def test_nothing_is_written(emulator: DynamixelEmulator) -> None:
    read_counts(settings(emulator))
    assert set(emulator.bus.received) == {"READ"}


def test_an_offset_in_the_servo_does_not_matter(emulator: DynamixelEmulator) -> None:
    """The driver takes it out."""
    stand(emulator, FIRST)
    before = read_counts(settings(emulator))
    emulator.bus.servos[1].write(xc330.HOMING_OFFSET.address, xc330.HOMING_OFFSET.encode(500))
    assert read_counts(settings(emulator)) == before


def test_signs_and_zeros_of_two_poses(emulator: DynamixelEmulator) -> None:
    counts: list[calibration.Counts] = []
    angles: list[Five] = []
    for pose in (FIRST, SECOND):
        stand(emulator, pose)
        counts.append(read_counts(settings(emulator, signed=False)))
        angles.append(tuple(map(radians, pose)))  # type: ignore[arg-type]
    found = with_zeros(with_signs(settings(emulator, signed=False).servos, counts, angles), counts[0], angles[0])
    assert [servo.sign for servo in found] == [mount.sign for mount in MOUNTING]
    assert [servo.zero for servo in found] == pytest.approx([mount.zero for mount in MOUNTING], abs=1)


def test_with_torque_on(emulator: DynamixelEmulator) -> None:
    emulator.bus.servos[2].write(xc330.TORQUE_ENABLE.address, b"\x01")
    with pytest.raises(DeviceError, match=r"theta_3 \(id 4\) has torque; stop what drives it"):
        read_counts(settings(emulator))


def test_one_that_counts_backwards(emulator: DynamixelEmulator) -> None:
    emulator.bus.servos[0].write(xc330.DRIVE_MODE.address, b"\x01")
    with pytest.raises(DeviceError, match=r"theta_1 \(id 3\) counts backwards"):
        read_counts(settings(emulator))


def test_one_that_moves(emulator: DynamixelEmulator) -> None:
    mechanics = emulator.bus._mechanics
    assert isinstance(mechanics, FreeServos)
    exchange = mechanics.exchange

    def shaking(now: float, drives: list[Drive]) -> list[Motion]:
        mechanics.position[4] += 0.005
        return exchange(now, drives)

    mechanics.exchange = shaking  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"gripper \(id 12\) moves \(from \d+ to \d+ counts\); hold it still"):
        read_counts(settings(emulator))


def test_one_that_is_missing(emulator: DynamixelEmulator) -> None:
    emulator.inject(Kind.SILENT, part="pump")
    with pytest.raises(DeviceError, match=r"no answer from pump \(id 9\)"):
        read_counts(settings(emulator))
