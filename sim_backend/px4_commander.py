"""What PX4's commander and land detector decide: modes, arming checks, failsafes, landing, battery.

The rules are those of PX4's main branch of May 2025, towards v1.16 (modules commander and land_detector), for a
multicopter without a pilot's sticks and without satellites, as far as an offboard flight meets them:

- Disarmed, any mode may be chosen; armed, only one that can run, and Land always. Hold wants a local and a global
  position, the latter not to be had from vision alone; Land wants a local position; offboard attitude wants nothing but
  its signal. After disarming, the mode is again the one chosen last in which one may arm.
- Why a mode cannot run, PX4 tells in events only; in status texts it says no more than that arming is denied.
- What cannot run falls back: Hold, Return (wants home), Land, Descend (level, down at MPC_LAND_SPEED), termination.
- While disarmed, PX4's land detector says landed. In offboard attitude it takes thrust under MPC_MANTHR_MIN and a
  hundredth, without motion, for a landing; so any thrust above is a takeoff. In PX4's own modes its velocity controller
  takes the thrust away where the vehicle does not sink; here, standing still on the ground stands for that, or on
  whatever else holds the vehicle up (an arm that hangs below the skids) for a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from math import hypot, radians

from drivers.samples import FlightMode, Landed, Vec3
from drivers.thrust import motor_signal, thrust_fraction
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.autopilot import Array, Autopilot, AutopilotParams, Descent, speed_of
from sim_backend.motors import rated_voltage
from sim_backend.px4_estimator import PositionEstimator


class Severity(IntEnum):
    """MAV_SEVERITY, as far as it is used."""

    EMERGENCY = 0
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    INFO = 6


class Action(IntEnum):
    """What PX4 may do about a failure, in the order in which one falls back to the next."""

    HOLD = 0
    RETURN = 1
    LAND = 2
    DESCEND = 3
    TERMINATE = 4
    DISARM = 5


#: COM_OBL_RC_ACT; Position, Altitude and Stabilized want sticks, without which NAV_RCL_ACT decides.
_OFFBOARD_LOSS = {3: Action.RETURN, 4: Action.LAND, 5: Action.HOLD, 6: Action.TERMINATE, 7: Action.DISARM}
_CONTROL_LOSS = {1: Action.HOLD, 2: Action.RETURN, 3: Action.LAND, 5: Action.TERMINATE, 6: Action.DISARM}
_STAGE = 1.0 / 3.0  # s that each of ground contact, maybe landed and landed lasts before it is believed
_UNWINDING = 2.0  # s until PX4's velocity controller has taken the thrust away from a vehicle that does not sink
_LOW, _CRITICAL, _EMERGENCY = 1, 2, 3
_BATTERY = {_LOW: "Low battery", _CRITICAL: "Critical battery", _EMERGENCY: "Emergency battery level"}


class _Held:
    """True once a condition has held for a while (s); false at once."""

    def __init__(self, state: bool, duration: float = _STAGE) -> None:
        self.state = state
        self._duration = duration
        self._since: float | None = None

    def update(self, t: float, condition: bool) -> bool:
        if not condition:
            self._since, self.state = None, False
        elif not self.state:
            self._since = t if self._since is None else self._since
            self.state = t - self._since >= self._duration - 1e-9
        return self.state


class Commander(Autopilot):
    """PX4 in the place of the world's plain autopilot.

    ``parameter`` gives PX4's parameters by name, ``say`` takes status texts. ``velocity_error`` (m/s, W) is the
    estimator's, to be kept up to date by the owner.
    """

    def __init__(
        self,
        params: AutopilotParams,
        vehicle: Vehicle,
        parameter: Callable[[str], float],
        estimator: PositionEstimator,
        say: Callable[[Severity, str], None],
    ) -> None:
        super().__init__(params)
        self._vehicle = vehicle
        self._parameter = parameter
        self._estimator = estimator
        self._say = say
        self.velocity_error: Vec3 = (0.0, 0.0, 0.0)
        #: Somebody has told PX4 where on earth it is.
        self.global_origin = False
        self.terminated = False
        #: A failsafe has taken over.
        self.failsafe = False
        self._blind = False
        self._after_disarming = FlightMode.HOLD
        self._now = 0.0
        self._contact, self._maybe, self._down = _Held(True), _Held(True), _Held(True)
        self._unwound = _Held(False, _UNWINDING)
        self._took_off = False
        self._since_armed = 0.0
        self._down_since: float | None = None
        self._charge = 1.0
        self._warned = 0
        self._warned_at_arming = 0

    # -- what is asked of it --------------------------------------------------------------------------------------

    def streaming(self, t: float) -> bool:
        """Set-points come."""
        return t - self._stream_last <= self.params.offboard_timeout

    def can_run(self, mode: FlightMode, t: float) -> bool:
        """The mode has what it needs."""
        if mode is FlightMode.OFFBOARD:
            return self.streaming(t)
        located = self._estimator.horizontal_valid(t)
        return located and (self.global_origin or mode is not FlightMode.HOLD)

    def can_arm(self, t: float) -> bool:
        """The pre-arm checks of the present mode pass."""
        charged = self._charge > self._parameter("BAT_CRIT_THR")
        may_arm = self.mode is not FlightMode.LAND and not self.terminated
        return charged and may_arm and self.can_run(self.mode, t)

    def switch(self, mode: FlightMode, t: float) -> bool:
        """Change the mode, as the pilot's or the computer's command; False when it cannot be."""
        allowed = not self.armed or mode is FlightMode.LAND or self.can_run(mode, t)
        if self.terminated or mode is FlightMode.OTHER or not allowed:
            return False
        self.mode = mode
        self.failsafe = self._blind = False
        if mode is not FlightMode.LAND:
            self._after_disarming = mode
        return True

    def try_arm(self, t: float, force: bool) -> bool:
        """Arm on command; refused in words. Without checks if forced, but never after a termination."""
        if self.armed:
            return True
        if self.terminated or not (force or self.can_arm(t)):
            self._watch_battery()
            self._say(Severity.CRITICAL, "Arming denied: Resolve system health failures first")
            return False
        self.killed = False
        self.armed = True
        self._since_armed = t
        self._took_off = False
        self._warned_at_arming = self._warned
        self._say(Severity.INFO, "Armed by external command")
        return True

    def try_disarm(self, force: bool) -> bool:
        """Disarm on command; refused in the air, in words, unless forced."""
        if not self.armed:
            return True
        if not force and not (self._down.state or self._maybe.state):
            self._say(Severity.CRITICAL, "Disarming denied: not landed")
            return False
        self._disarm("external command")
        return True

    def terminate(self) -> None:
        """Motors off until the next boot."""
        if not self.terminated:
            self.terminated = self.failsafe = True
            self._stop()
            self._say(Severity.CRITICAL, "Failsafe activated")

    def _disarm(self, reason: str) -> None:
        self._stop()
        self.mode = self._after_disarming
        self.failsafe = False
        self._say(Severity.INFO, f"Disarmed by {reason}")

    # -- what it does by itself -----------------------------------------------------------------------------------

    def _fail_safe(self, t: float) -> None:
        if not self.armed:
            return
        worse = self._watch_battery()
        # 2: Land at critical; 3: Return at critical, which is Land without a home
        if worse >= _CRITICAL and self._parameter("COM_LOW_BAT_ACT") >= 2 and worse > self._warned_at_arming:
            self._take(Action.LAND, t)
        if self.mode is FlightMode.OFFBOARD and not self.streaming(t):
            action = _OFFBOARD_LOSS.get(int(self._parameter("COM_OBL_RC_ACT")))
            if action is None:
                action = _CONTROL_LOSS.get(int(self._parameter("NAV_RCL_ACT")), Action.RETURN)
            self._take(action, t)
        elif self.mode is FlightMode.HOLD and self._down.state is False and not self.can_run(FlightMode.HOLD, t):
            self._take(Action.RETURN, t)
        elif self.mode is FlightMode.LAND:
            blind = not self.can_run(FlightMode.LAND, t)
            if blind and not self._blind:
                self._take(Action.DESCEND, t)
            self._blind = blind

    def _take(self, action: Action, t: float) -> None:
        """Enter a failsafe: the wanted action, or what it falls back to."""
        if action is Action.HOLD and not self.can_run(FlightMode.HOLD, t):
            action = Action.RETURN
        if action is Action.RETURN:  # wants a home position, which is a global one
            action = Action.LAND
        if action is Action.LAND and not self.can_run(FlightMode.LAND, t):
            action = Action.DESCEND
        self.failsafe = True
        if action is Action.DISARM:
            self._disarm("failsafe")
            return
        if action is Action.TERMINATE:
            self.terminate()
            return
        self.mode = FlightMode.HOLD if action is Action.HOLD else FlightMode.LAND
        self._blind = action is Action.DESCEND
        self._say(Severity.CRITICAL, "Failsafe activated")

    def _watch_battery(self) -> int:
        """Tell each worse level of the battery once; the level if it is news, else 0."""
        thresholds = ("BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR")
        level = sum(self._charge <= self._parameter(name) for name in thresholds)
        if level <= self._warned:
            return 0
        self._warned = level
        self._say(Severity.EMERGENCY, _BATTERY[level])
        return level

    def _disarm_landed(self, t: float) -> None:
        if not self.armed:
            return
        landed_for, before_takeoff = self.params.disarm_delay, self._parameter("COM_DISARM_PRFLT")
        if self._took_off:
            if landed_for > 0.0 and self._down_since is not None and t - self._down_since >= landed_for:
                self._disarm("landing")
        elif before_takeoff > 0.0 and t - self._since_armed >= before_takeoff:
            self._disarm("auto preflight disarming")

    def _own_flight(self, t: float) -> Descent:
        speed = self.params.descent_speed if self.mode is FlightMode.LAND else 0.0
        return Descent(speed, self.mode is FlightMode.LAND and self._blind, self.velocity_error)

    # -- land detector --------------------------------------------------------------------------------------------

    def _detect_land(self, t: float, x: Sequence[float], u: Array) -> None:
        self._now, self._charge = t, x[at.CHARGE]
        contact, minimum = self._ground_contact(x, u)
        contact = self._contact.update(t, not self.armed or contact)
        turning = hypot(x[at.RATE], x[at.RATE + 1]) > self._widened(radians(self._parameter("LNDMC_ROT_MAX")))
        maybe = self._maybe.update(t, not self.armed or (minimum and contact and not turning))
        before = self._down.state
        down = self._down.update(t, not self.armed or maybe)
        if down and not before:
            self._down_since = t
            self._say(Severity.INFO, "Landing detected")
        elif before and not down:
            self._down_since, self._took_off = None, True
            self._say(Severity.INFO, "Takeoff detected")
        self.landed = Landed.ON_GROUND if down else Landed.IN_AIR

    def _ground_contact(self, x: Sequence[float], u: Array) -> tuple[bool, bool]:
        """Whether the ground is touched, and whether the thrust is as little as on the ground."""
        if self.mode is not FlightMode.OFFBOARD:
            # Own modes: contact counts once going down, and after it the position controller takes the thrust away.
            going_down = self.mode is FlightMode.LAND or self._maybe.state
            still = going_down and speed_of(x) < self._parameter("LNDMC_Z_VEL_MAX")
            resting = self._unwound.update(self._now, still) or (still and x[at.ON_GROUND] != 0.0)
            return resting, resting
        v_z = x[at.VELOCITY + 2] + self.velocity_error[2]
        rising_or_falling = abs(v_z) >= self._widened(self._parameter("LNDMC_Z_VEL_MAX"))
        drift = hypot(x[at.VELOCITY] + self.velocity_error[0], x[at.VELOCITY + 1] + self.velocity_error[1])
        moving = rising_or_falling or drift > self._parameter("LNDMC_XY_VEL_MAX")
        least, hover = self._parameter("MPC_THR_MIN"), self._parameter("MPC_THR_HOVER")
        thrust = self._set_point(x, u)
        return thrust <= least + 0.6 * (hover - least) and not moving, thrust <= self._parameter(
            "MPC_MANTHR_MIN"
        ) + 0.01

    def _widened(self, threshold: float) -> float:
        """Once landed, more motion is needed to be in the air again."""
        return 2.5 * threshold if self._down.state else threshold

    def _set_point(self, x: Sequence[float], u: Array) -> float:
        """PX4's thrust set-point 0..1 behind the present demand of the rotors."""
        rotors = self._vehicle.rotors
        full = 4.0 * rotors.max_thrust * (x[at.VOLTAGE] / rated_voltage(self._vehicle.battery)) ** 2
        fraction = min(max(float(sum(u[at.U_ROTOR : at.U_ROTOR + 4])) / full, 0.0), 1.0)
        return thrust_fraction(motor_signal(fraction, rotors.curve), self._parameter("THR_MDL_FAC"))
