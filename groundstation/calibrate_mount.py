"""``pipewright calibrate mount RUN``: how the camera sits on the vehicle, from the log of a motion."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from math import degrees
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec import Struct

from drivers.mounting import OFFSET_ERROR, WINDOW, MotionError, MountFit, Recorded, angle_between, identify
from drivers.tracking import Mount
from groundstation import calibration, codes
from groundstation.calibration import CalibrationError
from onboard.messages import PARAMS, TICK, LogReader

Three = tuple[float, float, float]
Four = tuple[float, float, float, float]

#: Poses of less confidence are not used.
_CONFIDENCE: Final = 2


# What is read of the recorded structs: the same names, only the fields that are used here.


class _Odometry(Struct, gc=False):
    t_ns: int
    q_WB: Four
    v_WB: Three
    confidence: int
    reset_counter: int


class _State(Struct, gc=False):
    t_ns: int
    q_WB: Four
    w_WB_B: Three
    t_imu_ns: int
    f_B: Three


class _Inputs(Struct, gc=False):
    odometry: _Odometry | None
    autopilot: _State | None


class _Tick(Struct, gc=False):
    inputs: _Inputs


class _Tracker(Struct):
    kind: str
    mount: Mount = Mount()


class _Devices(Struct):
    odometry: _Tracker


class _Vehicle(Struct):
    gravity: float


class _Config(Struct):
    vehicle: _Vehicle
    devices: _Devices


class _Revision(Struct):
    config: _Config


class Moved(Struct, frozen=True):
    """What the log of a motion tells."""

    recorded: Recorded
    before: Mount
    """With which the poses were made."""
    gravity: float


def run(options: argparse.Namespace) -> int:
    """Run ``calibrate mount``; gives the exit code."""
    log = calibration.log_of(options)
    moved = read(log, partial=options.partial)
    try:
        fit = identify(moved.recorded, moved.before, moved.gravity)
    except MotionError as error:
        raise CalibrationError(f"{log}: {error}") from None
    found: dict[str, Any] = {}
    if fit.offset_taken:
        found["devices.odometry.mount.offset"] = [round(x, 4) for x in fit.mount.offset]
    found["devices.odometry.mount.rotation_deg"] = [round(x, 2) for x in fit.mount.rotation_deg]
    calibration.give(options, words_of(moved, fit), found)
    return codes.DONE


def read(log: Path, *, partial: bool = False) -> Moved:
    """The motion in a log.

    Raises LogError for one that cannot be read, CalibrationError when camera or autopilot were not there.
    """
    config: _Config | None = None
    poses: dict[int, _Odometry] = {}
    attitudes: dict[int, _State] = {}
    with LogReader(log, partial=partial) as reader:
        for topic, message in reader.read({TICK: _Tick, PARAMS: _Revision}):
            if topic == PARAMS:
                config = config or message.config
                continue
            odometry, autopilot = message.inputs.odometry, message.inputs.autopilot
            if odometry is not None and odometry.confidence >= _CONFIDENCE:
                poses.setdefault(odometry.t_ns, odometry)
            if autopilot is not None:
                attitudes.setdefault(autopilot.t_ns, autopilot)
    if config is None or not poses or not attitudes:
        raise CalibrationError(f"{log}: holds no pose of the camera with an attitude of the autopilot beside it")
    if config.devices.odometry.kind == "mock":
        raise CalibrationError(f"{log}: its tracker was a mock, which has no mount; use a real or an emulated one")
    forces = {state.t_imu_ns: state.f_B for state in attitudes.values()}
    start = min(poses)
    in_order = [poses[t] for t in sorted(poses)]
    states = [attitudes[t] for t in sorted(attitudes)]

    def seconds(stamps: list[int]) -> Any:
        return (np.array(stamps, dtype=np.int64) - start) * 1e-9

    return Moved(
        Recorded(
            t=seconds(sorted(poses)),
            q_WB=np.array([pose.q_WB for pose in in_order]),
            v_WB=np.array([pose.v_WB for pose in in_order]),
            piece=np.array([pose.reset_counter for pose in in_order], dtype=np.int64),
            t_attitude=seconds(sorted(attitudes)),
            attitude=np.array([state.q_WB for state in states]),
            rate_B=np.array([state.w_WB_B for state in states]),
            t_imu=seconds(sorted(forces)),
            f_B=np.array([forces[t] for t in sorted(forces)]),
        ),
        config.devices.odometry.mount,
        config.vehicle.gravity,
    )


def words_of(moved: Moved, fit: MountFit) -> Iterator[str]:
    """What was found, line by line, for a person."""
    before, mount = moved.before, fit.mount
    turned = degrees(angle_between(before, mount))
    yield f"{fit.windows * WINDOW:g} s of motion; poses are stamped {1e3 * fit.lag:.1f} ms later than attitudes"
    yield (
        f"turned by {turned:.2f} deg against the mount in force, known to +- {degrees(fit.rotation_error):.2f} deg; a "
        f"turn within {WINDOW:g} s fits within {degrees(fit.rotation_residual):.2f} deg (rms)"
    )
    if fit.offset_taken:
        away = 1e3 * float(np.linalg.norm(np.subtract(mount.offset, before.offset)))
        yield (
            f"{away:.0f} mm from where it was thought to be, known to +- {1e3 * fit.offset_error:.0f} mm; a change of "
            f"velocity fits within {1e3 * fit.offset_residual:.0f} mm/s (rms)"
        )
    else:
        how = f"+- {1e3 * fit.offset_error:.0f} mm" if np.isfinite(fit.offset_error) else "nothing told it"
        yield (
            f"the turns were too slow to tell where it sits ({how}; {1e3 * OFFSET_ERROR:g} mm are wanted): its offset "
            "is kept; turn the vehicle quicker, or measure it with a ruler"
        )
