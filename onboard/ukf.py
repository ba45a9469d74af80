"""The literature's baseline: an unscented Kalman filter of attitude, velocity and external force, by filterpy.

State: velocity (3, W), ZYX Euler angles (3), external force (3, W), a random walk. Driven by thrust and gyroscope;
measured are velocity, attitude and specific force. As in McKinnon and Schoellig (IROS 2016), with the attitude as Euler
angles. In Python a tick takes some hundred times what one of the core may, so it runs on logs only.
"""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Vec3
from onboard.core import math3
from onboard.core.types import Mat3

if TYPE_CHECKING:
    from filterpy.kalman import UnscentedKalmanFilter

Array = NDArray[np.float64]

#: Standard deviations: random walks per s^0.5 of velocity (m/s), angles (rad) and force (N); then of each measured
#: velocity (m/s), angle (rad) and specific force (m/s^2).
_WALK = (0.10, 0.01, 1.2)
_NOISE = (0.05, 0.003, 0.25)


class Ukf:
    """One filter, begun where the vehicle is. Needs the package filterpy (extra ``sim``)."""

    def __init__(self, mass: float, gravity: float, v_W: Vec3, rpy: Vec3) -> None:
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        self._mass, self._gravity = mass, gravity
        points = MerweScaledSigmaPoints(9, alpha=1.0, beta=2.0, kappa=0.0)
        self._filter: UnscentedKalmanFilter = UnscentedKalmanFilter(9, 9, 0.004, self._measured, self._moved, points)
        self._filter.x = np.array([*v_W, *rpy, 0.0, 0.0, 0.0])
        self._filter.P = np.diag([0.01] * 3 + [1e-4] * 3 + [1.0] * 3)
        self._filter.R = np.diag(np.repeat(_NOISE, 3) ** 2)
        self._drive: tuple[float, Vec3] = (0.0, (0.0, 0.0, 0.0))
        self._tare: Vec3 = (0.0, 0.0, 0.0)
        self._sum, self._count = np.zeros(3), 0
        self._R: Mat3 = math3.matrix_from_euler(rpy)

    def step(self, thrust: float, f_B: Vec3, w_WB_B: Vec3, rpy: Vec3, v_W: Vec3, R_WB: Mat3, dt: float) -> Vec3:
        """One tick: thrust (N) and gyroscope (rad/s) drive; the rest is measured. Gives the tared force, N, W."""
        own = self._filter
        self._drive, self._R = (thrust, w_WB_B), R_WB
        own.Q = np.diag(np.repeat(_WALK, 3) ** 2 * dt)
        own.predict(dt=dt)
        yaw = own.x[5] + math3.wrap_angle(rpy[2] - own.x[5])  # the measured angle nearest to the predicted
        own.update(np.array([*v_W, rpy[0], rpy[1], yaw, *f_B]))
        force = (float(own.x[6]), float(own.x[7]), float(own.x[8]))
        return math3.subtract(force, math3.rotate(R_WB, self._tare))

    def tare(self, *, done: bool) -> None:
        """Take the present force for no force; the mean of all of these counts once it is ``done``."""
        x = self._filter.x
        self._sum = self._sum + np.array(math3.rotate_transposed(self._R, (float(x[6]), float(x[7]), float(x[8]))))
        self._count += 1
        if done:
            a, b, c = (self._sum / self._count).tolist()
            self._tare, self._sum, self._count = (a, b, c), np.zeros(3), 0

    def _moved(self, x: Array, dt: float) -> Array:
        thrust, (p, q, r) = self._drive
        phi, theta, psi = x[3:6]
        cf, sf, ct, st, cp, sp = cos(phi), sin(phi), cos(theta), sin(theta), cos(psi), sin(psi)
        lift = thrust / self._mass
        across = sf * q + cf * r
        rates = np.array(
            [
                lift * (cp * st * cf + sp * sf) + x[6] / self._mass,
                lift * (sp * st * cf - cp * sf) + x[7] / self._mass,
                lift * ct * cf + x[8] / self._mass - self._gravity,
                p + across * st / ct,
                cf * q - sf * r,
                across / ct,
                0.0,
                0.0,
                0.0,
            ]
        )
        return np.asarray(x + dt * rates)

    def _measured(self, x: Array) -> Array:
        thrust, _ = self._drive
        R = math3.matrix_from_euler((float(x[3]), float(x[4]), float(x[5])))
        a, b, c = math3.rotate_transposed(R, (float(x[6]), float(x[7]), float(x[8])))
        m = self._mass
        return np.array([*x[:6], a / m, b / m, (c + thrust) / m])
