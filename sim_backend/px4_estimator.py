"""PX4's own position and velocity as its EKF2 would have them, with external vision as the only horizontal aid.

The filter is a complementary one, in place of EKF2's Kalman filter: acceleration of the IMU carries position and
velocity on, each pose that is fused pulls them along with fixed gains. What it shares with EKF2 are the rules: which
poses are taken (frames, EKF2_EV_QMIN, EKF2_EV_CTRL, age against EKF2_DELAY_MAX, an innovation gate), what a new
reset_counter does, for how long dead reckoning counts (EKF2_NOAID_TOUT), and that the barometer takes the height over
when vision does not give it. The barometer here is exact; attitude is no matter of this filter (sim_backend/sensors).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import dist, exp, inf, isfinite

from drivers.rotation import rotate
from drivers.samples import Odometry, Quat, Vec3

_POSITION_TIME, _VELOCITY_TIME = 0.25, 0.15  # time constants of the pull towards vision, s
_GATE = 0.5  # m; EKF2 gates at five standard deviations, of about 0.1 m
_PATIENCE = 5.0  # s of poses outside of the gate, after which EKF2 gives in and resets to them
_GAP = 1.0  # s without a pose, after which fusion starts anew with a reset
_HORIZONTAL, _VERTICAL, _VELOCITY = 1, 2, 4  # bits of EKF2_EV_CTRL


class PositionEstimator:
    """Position and velocity of the body origin in the axes of W. Times are seconds of the world.

    ``parameter`` gives PX4's parameters by name; ``gravity`` in m/s^2.
    """

    def __init__(self, parameter: Callable[[str], float], gravity: float) -> None:
        self._parameter = parameter
        self._gravity = gravity
        self.p_WB: Vec3 = (0.0, 0.0, 0.0)
        self.v_WB: Vec3 = (0.0, 0.0, 0.0)
        #: Resets to vision so far.
        self.resets = 0
        #: Newest pose that was fused.
        self.vision: Odometry | None = None
        self._past: deque[tuple[float, Vec3]] = deque()
        self._fused = {_HORIZONTAL: -inf, _VERTICAL: -inf}
        self._newest = -inf
        self._refused_since: float | None = None
        self._counter: int | None = None
        self._ground: float | None = None

    def horizontal_valid(self, t: float) -> bool:
        """The horizontal position is good for Hold and Land. Height always is: there is a barometer."""
        return t - self._fused[_HORIZONTAL] <= self._parameter("EKF2_NOAID_TOUT") * 1e-6

    def predict(self, t: float, dt: float, f_B: Vec3, q_WB: Quat, height: float, climb: float, resting: bool) -> None:
        """Advance by ``dt`` s to ``t`` with specific force (m/s^2, B) and attitude.

        ``height`` (m) and ``climb`` (m/s) are the barometer's; ``resting``: disarmed on the ground, where EKF2 knows
        that it does not move.
        """
        f_W = rotate(q_WB, f_B)
        v = self.v_WB
        if resting:
            v = (0.0, 0.0, 0.0)
        elif isfinite(sum(f_W)):
            v = (v[0] + dt * f_W[0], v[1] + dt * f_W[1], v[2] + dt * (f_W[2] - self._gravity))
        p = self.p_WB
        p = (p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2])
        if self._ground is None:
            self._ground = height - p[2]
        if t - self._fused[_VERTICAL] > _GAP:
            p, v = (p[0], p[1], height - self._ground), (v[0], v[1], climb)
        else:
            self._ground = height - p[2]  # so that the barometer can take over without a step
        self.p_WB, self.v_WB = p, v
        self._past.append((t, p))
        while self._past[0][0] < t - 1.0:
            self._past.popleft()

    def fuse(self, t: float, sample: Odometry, quality: int) -> None:
        """Take a pose with its MAVLink quality at ``t``; its time is the world's."""
        control = int(self._parameter("EKF2_EV_CTRL"))
        taken = sample.t_ns * 1e-9 - self._parameter("EKF2_EV_DELAY") * 1e-3
        if quality < self._parameter("EKF2_EV_QMIN") or not isfinite(sum(sample.p_WB)) or not self._past:
            return
        # EKF2 fuses at its delayed horizon: what is older than that, or not newer than the last one, is dropped.
        if taken <= self._newest or t - taken > self._parameter("EKF2_DELAY_MAX") * 1e-3:
            return
        gap, self._newest = taken - self._newest, taken
        error = _minus(sample.p_WB, self._past_position(taken))
        jumped = self._counter is not None and sample.reset_counter != self._counter
        self._counter = sample.reset_counter
        if gap > _GAP or jumped:
            self._reset(t, control, sample, error)
        elif dist(error, (0.0, 0.0, 0.0)) > _GATE:
            self._refused_since = t if self._refused_since is None else self._refused_since
            if t - self._refused_since > _PATIENCE:
                self._reset(t, control, sample, error)
            return
        else:
            self._pull(min(gap, 0.1), control, sample, error)
        self._refused_since = None
        for axis in (_HORIZONTAL, _VERTICAL):
            if control & axis:
                self._fused[axis] = t
        if control & (_HORIZONTAL | _VERTICAL):
            self.vision = sample

    def _reset(self, t: float, control: int, sample: Odometry, error: Vec3) -> None:
        """Move to the pose at once; that moves the past too."""
        step = _chosen(control, error)
        self.p_WB = _plus(self.p_WB, step)
        self._past = deque((at, _plus(p, step)) for at, p in self._past)
        if control & _VELOCITY and isfinite(sum(sample.v_WB)):
            self.v_WB = sample.v_WB
        self._refused_since = None
        self.resets += 1

    def _pull(self, gap: float, control: int, sample: Odometry, error: Vec3) -> None:
        share = 1.0 - exp(-gap / _POSITION_TIME)
        error = _chosen(control, error)
        self.p_WB = _plus(self.p_WB, error, share)
        self._past = deque((at, _plus(p, error, share)) for at, p in self._past)
        if control & _VELOCITY and isfinite(sum(sample.v_WB)):
            correction = _minus(sample.v_WB, self.v_WB)
            self.v_WB = _plus(self.v_WB, correction, 1.0 - exp(-gap / _VELOCITY_TIME))
        else:
            # without a measured velocity it is learnt from the position, critically damped
            self.v_WB = _plus(self.v_WB, error, 0.25 * share * share / gap)

    def _past_position(self, t: float) -> Vec3:
        """Where it was believed to be at ``t``."""
        for at, p in reversed(self._past):
            if at <= t:
                return p
        return self._past[0][1]


def _chosen(control: int, v: Vec3) -> Vec3:
    """The components of which EKF2_EV_CTRL says that vision gives them."""
    horizontal, vertical = bool(control & _HORIZONTAL), bool(control & _VERTICAL)
    return (v[0] * horizontal, v[1] * horizontal, v[2] * vertical)


def _minus(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _plus(a: Vec3, b: Vec3, scale: float = 1.0) -> Vec3:
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])
