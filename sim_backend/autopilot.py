"""What an autopilot does around its inner loops: arming, modes, offboard loss, landing, and the delay of commands."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import hypot, inf, isfinite
from typing import Annotated

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from drivers.samples import FlightMode, Interface, Landed, Quat, Vec3
from sim_backend import inner_loops as loops
from sim_backend import layout as at
from sim_backend.knob import knob

Array = NDArray[np.float64]


class AutopilotParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Timing of the simulated autopilot."""

    command_delay: Annotated[float, knob("s", "set-point to inner loop, attitude and body rate", 0.0, 0.2)] = 0.012
    command_jitter: Annotated[
        float, knob("s", "mean of the exponential rest of that delay; order is kept", 0.0, 0.1)
    ] = 0.0
    command_loss: Annotated[float, knob("1", "share of the set-points that never arrive", 0.0, 0.9)] = 0.0
    wrench_delay: Annotated[float, knob("s", "set-point to mixer, wrench", 0.0, 0.2)] = 0.0
    arm_delay: Annotated[float, knob("s", "stream of set-points needed before arming and offboard", 0.0, 5.0)] = 0.5
    offboard_timeout: Annotated[float, knob("s", "COM_OF_LOSS_T: silence after which it lands", 0.1, 5.0)] = 0.5
    descent_speed: Annotated[float, knob("m/s", "MPC_LAND_SPEED: speed of its own landing", 0.1, 2.0)] = 0.6
    landed_time: Annotated[float, knob("s", "rest on the skids for this long counts as landed", 0.05, 5.0)] = 0.3
    landed_speed: Annotated[float, knob("m/s", "slower than this counts as rest", 0.01, 1.0)] = 0.1
    disarm_delay: Annotated[float, knob("s", "COM_DISARM_LAND: from landed to disarmed in mode LAND", 0.0, 10.0)] = 1.0


class SetPoint(Struct, frozen=True, gc=False):
    """One set-point; only the fields of its interface count."""

    interface: Interface
    thrust: float
    """N."""
    torque_B: Vec3 = (0.0, 0.0, 0.0)
    q_WB: Quat = (1.0, 0.0, 0.0, 0.0)
    w_WB_B: Vec3 = (0.0, 0.0, 0.0)


class Descent(Struct, frozen=True, gc=False):
    """The autopilot flies by itself: no horizontal velocity, heading kept, down at ``speed`` m/s (0: hover)."""

    speed: float
    blind: bool = False
    """It does not know its horizontal velocity and keeps level instead."""
    error: Vec3 = (0.0, 0.0, 0.0)
    """Of the velocity it believes in, m/s, W."""


class Rotors(Struct, frozen=True, gc=False):
    """What an autopilot outside this world has its motors do."""

    armed: bool
    thrust: tuple[float, float, float, float]
    """N, in PX4's numbering."""


STOPPED = Rotors(False, (0.0, 0.0, 0.0, 0.0))

_KINDS = {Interface.WRENCH: loops.WRENCH, Interface.ATTITUDE: loops.ATTITUDE, Interface.BODY_RATE: loops.BODY_RATE}


def _drive(u: Array, demand: SetPoint | Descent | Rotors | None) -> None:
    """Write into ``u`` what the inner loops shall follow; None stops the motors."""
    if demand is None:
        u[at.U_SETPOINT] = loops.NONE
    elif isinstance(demand, Rotors):
        u[at.U_SETPOINT] = loops.ROTORS
        u[at.U_ROTOR : at.U_ROTOR + 4] = demand.thrust
    elif isinstance(demand, Descent):
        u[at.U_SETPOINT] = loops.DESCENT if demand.blind else loops.VELOCITY
        u[at.U_THRUST] = demand.speed
        u[at.U_VELOCITY_ERROR : at.U_VELOCITY_ERROR + 3] = demand.error
    else:
        u[at.U_SETPOINT] = _KINDS[demand.interface]
        u[at.U_THRUST] = demand.thrust
        u[at.U_BODY_TORQUE : at.U_BODY_TORQUE + 3] = demand.torque_B
        u[at.U_ATTITUDE : at.U_ATTITUDE + 4] = demand.q_WB
        u[at.U_BODY_RATE : at.U_BODY_RATE + 3] = demand.w_WB_B


class Autopilot:
    """Arming, modes and failsafe. Times are simulated seconds. Starts disarmed, landed, in mode HOLD."""

    def __init__(self, params: AutopilotParams, seed: int = 0) -> None:
        self.params = params
        self._random = np.random.default_rng([seed, 14540])
        self.armed = False
        self.mode = FlightMode.HOLD
        self.landed = Landed.ON_GROUND
        self.killed = False
        self._rotors: Rotors | None = None
        self._pending: deque[tuple[float, SetPoint]] = deque()
        self._last_due = -inf
        self._setpoint: SetPoint | None = None
        self._stream_start = 0.0
        self._stream_last = -inf
        self._rest_since: float | None = 0.0
        self._landed_at = 0.0

    def hand_over(self, rotors: Rotors) -> None:
        """From now on an autopilot outside this world flies, and this is what its motors do.

        What is left here is the land detector. Its mode is not known: FlightMode.OTHER.
        """
        self._rotors = rotors
        self.armed = rotors.armed
        self.mode = FlightMode.OTHER

    def offer(self, t: float, setpoint: SetPoint) -> None:
        """Take one set-point, received at ``t``; it reaches the loops after the interface's delay.

        One that holds a number that is not finite is ignored, as PX4 does; some are lost on the way.
        """
        s, params = setpoint, self.params
        if not isfinite(s.thrust + sum(s.torque_B) + sum(s.q_WB) + sum(s.w_WB_B)):
            return
        lost, more = self._random.random(), float(self._random.standard_exponential())
        if lost < params.command_loss:
            return
        if t - self._stream_last > params.offboard_timeout:
            self._stream_start = t
        self._stream_last = t
        delay = params.wrench_delay if s.interface is Interface.WRENCH else params.command_delay
        delay += params.command_jitter * more
        self._last_due = max(self._last_due, t + delay)
        self._pending.append((self._last_due, s))

    def streaming(self, t: float) -> bool:
        """Set-points have come for long enough, and still come: arming and offboard are accepted."""
        fresh = t - self._stream_last <= self.params.offboard_timeout
        return fresh and t - self._stream_start >= self.params.arm_delay

    def arm(self) -> bool:
        """Arm; refused after a kill, until ``disarm`` on the ground has cleared it."""
        self.armed = not self.killed
        return self.armed

    def disarm(self) -> bool:
        """Disarm, and clear a kill; refused in the air."""
        if self.landed is not Landed.ON_GROUND:
            return False
        self._stop()
        self.killed = False
        self.mode = FlightMode.HOLD
        return True

    def switch(self, mode: FlightMode, t: float) -> bool:
        """Change the mode; OFFBOARD is refused without a stream of set-points."""
        if mode is FlightMode.OTHER or (mode is FlightMode.OFFBOARD and not self.streaming(t)):
            return False
        self.mode = mode
        return True

    def kill(self) -> None:
        """Cut the motors at once, wherever the vehicle is."""
        self._stop()
        self.killed = True

    def _stop(self) -> None:
        self.armed = False
        self._setpoint = None
        self._pending.clear()
        self._stream_last = -inf

    def next_change(self) -> float:
        """Time at which the next pending set-point falls due, s; infinity when none is pending."""
        return self._pending[0][0] if self._pending else inf

    def update(self, t: float, x: Sequence[float], u: Array) -> None:
        """Land detector, failsafe, disarming after landing, and the set-point that is due at ``t``.

        ``x`` is the world's state now; of ``u``, the demand of the loops, it sets what they shall follow.
        """
        self._detect_land(t, x, u)
        if self._rotors is not None:
            _drive(u, self._rotors)
            return
        self._fail_safe(t)
        self._disarm_landed(t)
        while self._pending and self._pending[0][0] <= t + 1e-9:
            self._setpoint = self._pending.popleft()[1]
        if not self.armed:
            _drive(u, None)
        elif self.mode is FlightMode.OFFBOARD:
            _drive(u, self._setpoint)
        else:
            _drive(u, self._own_flight(t))

    def _fail_safe(self, t: float) -> None:
        if self.armed and self.mode is FlightMode.OFFBOARD and t - self._stream_last > self.params.offboard_timeout:
            self.mode = FlightMode.LAND

    def _disarm_landed(self, t: float) -> None:
        landed = self.landed is Landed.ON_GROUND
        if self.armed and self.mode is FlightMode.LAND and landed and t - self._landed_at >= self.params.disarm_delay:
            self._stop()

    def _own_flight(self, t: float) -> Descent:
        """How it flies in its own modes."""
        return Descent(self.params.descent_speed if self.mode is FlightMode.LAND else 0.0)

    def _detect_land(self, t: float, x: Sequence[float], u: Array) -> None:
        on_ground = x[at.ON_GROUND] != 0.0
        if not on_ground:
            self.landed = Landed.IN_AIR
        if not on_ground or speed_of(x) > self.params.landed_speed:
            self._rest_since = None
            return
        if self._rest_since is None:
            self._rest_since = t
        if self.landed is not Landed.ON_GROUND and t - self._rest_since >= self.params.landed_time:
            self.landed = Landed.ON_GROUND
            self._landed_at = t


def speed_of(x: Sequence[float]) -> float:
    """Speed of the body origin, m/s."""
    return hypot(x[at.VELOCITY], x[at.VELOCITY + 1], x[at.VELOCITY + 2])
