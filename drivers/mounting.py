"""Mount calibration: how the camera sits on the vehicle, from a motion that both camera and autopilot have seen.

Rotation: the turn of the vehicle within a short window, as the autopilot tells it in B, is the turn that the camera
tells in C, seen through the rotation from C to B (hand-eye: A X = X B, Park and Martin 1994). It needs turns about two
axes at least. Both clocks are compared on the way: the lag of the poses is found with it.

Offset: what the camera is faster than the body is the angular velocity times the offset. The body's change of velocity
within a window is its specific force and gravity, summed up; nothing is differentiated. It needs quick turns. The
accelerometer's bias is found with it.

Worlds and headings need not agree, only verticals: the attitude is the camera's, through the rotation found.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.rotation import inverse, multiply
from drivers.samples import Quat, Vec3
from drivers.tracking import Mount

Array = NDArray[np.float64]

#: Standard errors with which rotation (rad) and offset (m) are taken, about or along the worst axis.
ROTATION_ERROR: Final = radians(0.5)
OFFSET_ERROR: Final = 0.01
#: Length of a window (s), and how many there must be.
WINDOW, LEAST = 0.25, 20
#: A longer pause between two poses is a gap, s.
_GAP: Final = 0.05
#: No residual is trusted to be smaller: turn of a window (rad), change of velocity (m/s).
_TURN_FLOOR, _SPEED_FLOOR = 0.002, 0.01
#: Standard deviations beyond which a window does not belong to the others.
_FAR: Final = 4.0
_ROUNDS, _STEP = 6, 0.002
_AXES = ("x (roll)", "y (pitch)", "z (yaw)")


@dataclass(frozen=True)
class Recorded:
    """What was recorded of a motion. Times in s on one clock, ascending; quaternions (w, x, y, z)."""

    t: Array
    """Of the poses, (n,)."""
    q_WB: Array
    v_WB: Array
    """Attitude (n, 4) and velocity (n, 3) of the body, as they were made with the mount before."""
    piece: NDArray[np.int64]
    """Changes where the tracker has jumped, (n,)."""
    t_attitude: Array
    attitude: Array
    rate_B: Array
    """Of the autopilot: q_WB (m, 4) and angular velocity (m, 3) at its own times (m,)."""
    t_imu: Array
    f_B: Array
    """Specific force of the body origin (k, 3) at its own times (k,)."""


@dataclass(frozen=True)
class MountFit:
    """What a motion tells."""

    mount: Mount
    lag: float
    """By which poses are stamped later than attitudes, s."""
    windows: int
    rotation_residual: float
    """Root mean square of a turn's difference, rad."""
    rotation_error: float
    """Standard error about the worst axis, rad."""
    offset_residual: float
    """Root mean square of a change of velocity, m/s."""
    offset_error: float
    """Standard error along the worst axis, m; infinite where nothing told it."""
    offset_taken: bool
    """The offset is the motion's; else that of the mount before."""


class MotionError(ValueError):
    """A motion that tells no mount; the text says what lacks."""


def identify(recorded: Recorded, before: Mount, gravity: float) -> MountFit:
    """Fit the mount. ``before``: with which the poses were made. Raises MotionError."""
    begins, ends = _windows(recorded)
    if len(begins) < LEAST:
        raise MotionError(
            f"{len(begins) * WINDOW:g} s in which both camera and autopilot told how it moves; at least "
            f"{LEAST * WINDOW:g} s are needed"
        )
    R_WB_before = _matrices(recorded.q_WB)
    R_WC = R_WB_before @ _matrix(before.q_BC())
    rotation = _fit_rotation(recorded, R_WC, begins, ends)
    offset = _fit_offset(recorded, R_WC, R_WB_before, np.array(before.offset), rotation, gravity, begins, ends)
    taken = offset.error <= OFFSET_ERROR and bool(np.all(np.abs(offset.value) <= 1.0))
    x, y, z = (offset.value if taken else np.array(before.offset)).tolist()
    return MountFit(
        mount=Mount((x, y, z), _euler_deg(rotation.value)),
        lag=rotation.lag,
        windows=len(begins),
        rotation_residual=rotation.residual,
        rotation_error=rotation.error,
        offset_residual=offset.residual,
        offset_error=offset.error,
        offset_taken=taken,
    )


@dataclass(frozen=True)
class _Rotation:
    value: Array
    """R_BC."""
    lag: float
    residual: float
    error: float


@dataclass(frozen=True)
class _Offset:
    value: Array
    residual: float
    error: float


def _windows(recorded: Recorded) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last pose of each stretch of ``WINDOW`` s without gap or jump, within what the autopilot told."""
    t = recorded.t
    begins, ends = [], []
    if len(t) and len(recorded.t_attitude) > 1 and len(recorded.t_imu) > 1:
        low = max(recorded.t_attitude[0], recorded.t_imu[0]) + _GAP
        high = min(recorded.t_attitude[-1], recorded.t_imu[-1]) - _GAP
        whole = (np.diff(t) <= _GAP) & (np.diff(recorded.piece) == 0) & (t[:-1] >= low) & (t[1:] <= high)
        begin = 0
        for k, joined in enumerate(whole.tolist()):
            if not joined:
                begin = k + 1
            elif t[k + 1] - t[begin] >= WINDOW:
                begins.append(begin)
                ends.append(k + 1)
                begin = k + 1
    return np.array(begins, dtype=np.int64), np.array(ends, dtype=np.int64)


def _fit_rotation(recorded: Recorded, R_WC: Array, begins: NDArray[np.int64], ends: NDArray[np.int64]) -> _Rotation:
    a = _turns(R_WC[begins], R_WC[ends])
    start, end = recorded.t[begins], recorded.t[ends]

    def seen(lag: float) -> Array:
        return _turns(_attitude_at(recorded, start - lag), _attitude_at(recorded, end - lag))

    chosen = np.ones(len(begins), dtype=np.bool_)
    R, lag = _aligned(a, seen(0.0)), 0.0
    information = np.zeros((4, 4))
    for _ in range(_ROUNDS):
        b = seen(lag)
        drift = (seen(lag + _STEP) - seen(lag - _STEP)) / (2.0 * _STEP)
        turned = a @ R.T
        e = b - turned
        size = np.linalg.norm(e, axis=1)
        chosen = size <= max(_FAR * 1.4826 * float(np.median(size)), _TURN_FLOOR)
        J = np.concatenate((_crosses(turned), drift[:, :, None]), axis=2)[chosen].reshape(-1, 4)
        information = J.T @ J
        step = np.linalg.lstsq(J, -e[chosen].reshape(-1), rcond=None)[0]
        R, lag = _turn(step[:3]) @ R, lag + float(step[3])
    residual = float(np.sqrt(np.mean(np.sum((seen(lag) - a @ R.T)[chosen] ** 2, axis=1))))
    spread = max(residual / np.sqrt(3.0), _TURN_FLOOR)
    error, axis = _worst(information, spread)
    if not error <= ROTATION_ERROR:
        raise MotionError(
            f"how the camera is turned about {_AXES[axis]} of the vehicle cannot be seen (+- {_degrees(error)}; "
            f"{degrees(ROTATION_ERROR):g} deg are wanted): turn the vehicle about its other two axes, back and forth, "
            "by 30 deg and more"
        )
    return _Rotation(R, lag, residual, error)


def _fit_offset(
    recorded: Recorded,
    R_WC: Array,
    R_WB_before: Array,
    offset_before: Array,
    rotation: _Rotation,
    gravity: float,
    begins: NDArray[np.int64],
    ends: NDArray[np.int64],
) -> _Offset:
    t = recorded.t
    R_WB = R_WC @ rotation.value.T
    w_B = _at(recorded.t_attitude, recorded.rate_B, t - rotation.lag)
    f_W = np.einsum("nij,nj->ni", R_WB, _at(recorded.t_imu, recorded.f_B, t - rotation.lag))
    # the velocity of the camera, which the mount before was taken out of
    w_W = np.einsum("nij,nj->ni", R_WB, w_B)
    v_WC = recorded.v_WB + np.cross(w_W, R_WB_before @ offset_before)
    steps = np.diff(t)[:, None]
    gained = _summed(0.5 * steps * (f_W[1:] + f_W[:-1]))
    attitudes = _summed((0.5 * steps[:, :, None] * (R_WB[1:] + R_WB[:-1])).reshape(-1, 9)).reshape(-1, 3, 3)
    arms = R_WB @ _crosses(w_B)
    change = v_WC[ends] - v_WC[begins] - (gained[ends] - gained[begins])
    change[:, 2] += gravity * (t[ends] - t[begins])
    J = np.concatenate((arms[ends] - arms[begins], -(attitudes[ends] - attitudes[begins])), axis=2)
    chosen = np.ones(len(begins), dtype=np.bool_)
    for _ in range(2):
        found = np.linalg.lstsq(J[chosen].reshape(-1, 6), change[chosen].reshape(-1), rcond=None)[0]
        size = np.linalg.norm(change - J @ found, axis=1)
        chosen = size <= max(_FAR * 1.4826 * float(np.median(size)), _SPEED_FLOOR)
    rows = J[chosen].reshape(-1, 6)
    found = np.linalg.lstsq(rows, change[chosen].reshape(-1), rcond=None)[0]
    residual = float(np.sqrt(np.mean(np.sum((change - J @ found)[chosen] ** 2, axis=1))))
    error, _ = _worst(rows.T @ rows, max(residual / np.sqrt(3.0), _SPEED_FLOOR))
    return _Offset(np.asarray(found[:3], dtype=np.float64), residual, error)


def _worst(information: Array, spread: float) -> tuple[float, int]:
    """Largest standard error of the first three unknowns, and of which; infinite where nothing tells it."""
    values, vectors = np.linalg.eigh(information)
    known = values > 1e-9 * max(values[-1], 1e-9)
    variances = np.sum(vectors[:3, known] ** 2 / values[known], axis=1) if known.any() else np.zeros(3)
    variances[np.sum(vectors[:3, ~known] ** 2, axis=1) > 1e-6] = np.inf
    return float(spread * np.sqrt(variances.max())), int(np.argmax(variances))


def _aligned(a: Array, b: Array) -> Array:
    """The rotation that takes the vectors a to b best (Kabsch)."""
    u, _, vt = np.linalg.svd(b.T @ a)
    return np.asarray(u @ np.diag((1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt))) @ vt)


def _attitude_at(recorded: Recorded, t: Array) -> Array:
    """Attitudes of the autopilot at other times, (n, 3, 3)."""
    q = recorded.attitude.copy()
    flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0))
    q[1:] *= flips[:, None]
    return _matrices(_at(recorded.t_attitude, q, t))


def _at(t: Array, values: Array, when: Array) -> Array:
    return np.stack([np.interp(when, t, column) for column in values.T], axis=1)


def _summed(parts: Array) -> Array:
    """Sums up to each row, beginning with zero."""
    return np.concatenate((np.zeros((1, parts.shape[1])), np.cumsum(parts, axis=0)))


def _turns(first: Array, last: Array) -> Array:
    """Rotation vectors (n, 3) of the turns from one attitude (n, 3, 3) to the other, each in its own frame."""
    R = np.swapaxes(first, 1, 2) @ last
    axis = 0.5 * np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), axis=1)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    return np.asarray(axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None])


def _turn(vector: Array) -> Array:
    """The rotation of a rotation vector (3,)."""
    angle = float(np.linalg.norm(vector))
    K = _crosses((vector / max(angle, 1e-12))[None])[0]
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


def _crosses(v: Array) -> Array:
    """The matrices that make a cross product with each vector, (n, 3) to (n, 3, 3)."""
    K = np.zeros((len(v), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return K - np.swapaxes(K, 1, 2)


def _matrices(q: Array) -> Array:
    """Rotation matrices of quaternions, which need not be of unit length, (n, 4) to (n, 3, 3)."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1)[:, None]).T
    return np.stack(
        (
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ),
        axis=1,
    ).reshape(-1, 3, 3)  # fmt: skip


def _matrix(q: Quat) -> Array:
    return np.asarray(_matrices(np.array([q]))[0])


def _euler_deg(R: Array) -> Vec3:
    """Roll, pitch, yaw (ZYX), deg."""
    pitch = np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))
    if abs(R[2, 0]) > 1.0 - 1e-9:  # roll and yaw turn about the same axis: all of it is told as yaw
        return (0.0, float(np.degrees(pitch)), float(np.degrees(np.arctan2(-R[0, 1], R[1, 1]))))
    roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    return (float(np.degrees(roll)), float(np.degrees(pitch)), float(np.degrees(yaw)))


def angle_between(one: Mount, other: Mount) -> float:
    """The turn from one mount's rotation to the other's, rad."""
    w, x, y, z = multiply(inverse(one.q_BC()), other.q_BC())
    return float(2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), abs(w)))


def _degrees(angle: float) -> str:
    return f"{degrees(angle):.1f} deg" if np.isfinite(angle) else "anything"
