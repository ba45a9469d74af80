"""Mock devices that fail as the emulated ones do, in virtual time: the same faults, and what a driver makes of them.

The tracker is the emulated camera and the driver's own tracking, without librealsense between them. Autopilot and
servo bus are told at the level of samples and commands: a damaged packet is a lost one, a reading that is not finite is
not used, a servo that does not answer is told as such, is found again, and comes back slowly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf
from random import Random

from msgspec.structs import replace

from drivers.dynamixel_settings import DynamixelSettings
from drivers.dynamixel_setup import SHUT_DOWN
from drivers.samples import (
    SERVO_NAMES,
    AutopilotCommand,
    AutopilotState,
    FlightMode,
    JointMode,
    Landed,
    Odometry,
    ServoCommand,
    ServoState,
)
from drivers.tracking import JumpLimits, Mount, Tracking, UnusableError
from drivers.xc330 import HardwareError
from sim_backend import dynamixel_troubles, px4_faults
from sim_backend.faults import Fault, Faults, Kind
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
from sim_backend.tracker import Tracker
from sim_backend.world import World

#: From a servo's reboot until it is at work again, s: it wakes, is found and is told its settings.
_WAKING = 0.3
_SPOILT = ("ATTITUDE_QUATERNION", "HIGHRES_IMU")


class FaultyOdometry(MockOdometry):
    """The tracker behind the driver's tracking; opened again after ``silence`` seconds with nothing usable."""

    def __init__(
        self, world: World, declared: Sequence[Fault], mount: Mount, jump: JumpLimits, silence: float, seed: int
    ) -> None:
        super().__init__(world)
        self._tracker = Tracker(world, mount, declared, seed)
        self.faults = self._tracker.faults
        self._tracking = Tracking(mount, jump, (0.0, 0.0, world.vehicle.base.gear_height), 0.0)
        self._silence = silence
        self._fresh = 0.0
        self._open = True
        self._sample: Odometry | None = None

    def latest(self) -> Odometry | None:
        """Newest pose that was usable."""
        t = self._world.time
        for pose in self._tracker.step(self._open):
            try:
                self._sample, _ = self._tracking.take(pose)
            except UnusableError:
                continue
            self._fresh = t
        if not self._open and not self._tracker.gone:
            self._tracking.restart()
            self._open, self._fresh = True, t
        elif self._open and t - self._fresh >= self._silence:
            self._open = False
        return self._sample


class FaultyAutopilot(MockAutopilot):
    """The autopilot behind a link that fails. REBOOT stops the motors."""

    def __init__(self, world: World, declared: Sequence[Fault], seed: int) -> None:
        super().__init__(world)
        self.faults = Faults(px4_faults.DEVICE, px4_faults.KINDS, declared)
        self._random = Random(seed)
        self._told: AutopilotState | None = None
        self._late: deque[tuple[float, AutopilotState]] = deque()
        self._booting = False

    def latest(self) -> AutopilotState | None:
        """Newest state that has come through."""
        t = self._world.time
        self._reboot(t)
        sample = super().latest()
        if self._cut(t):
            self._late.clear()
            return self._told
        lost = any(self.faults.strike(kind, t, chance=self._random.random()) for kind in (Kind.DROP, Kind.CORRUPT))
        if sample is not None and not lost:
            delay = self.faults.strike(Kind.DELAY, t)
            self._late.append((t + (0.0 if delay is None else delay.value), sample))
        while self._late and self._late[0][0] <= t:
            self._told = self._usable(self._late.popleft()[1], t)
        return self._told

    def command(self, command: AutopilotCommand) -> None:
        """Hand over one fresh set-point, if it gets through."""
        if not self._cut(self._world.time):
            super().command(command)

    def _cut(self, t: float) -> bool:
        """Nothing passes, neither way."""
        return any(self.faults.find(kind, t) for kind in (Kind.SILENT, Kind.UNPLUGGED, Kind.REBOOT))

    def _reboot(self, t: float) -> None:
        booting = self.faults.find(Kind.REBOOT, t) is not None
        autopilot = self._world.autopilot
        if booting and not self._booting:
            autopilot.kill()
        elif self._booting and not booting:
            autopilot.killed, autopilot.mode = False, FlightMode.HOLD
        self._booting = booting

    def _usable(self, sample: AutopilotState, t: float) -> AutopilotState:
        """The sample with what was measured before in place of what the driver does not use."""
        told = self._told
        if told is None:
            return sample
        nan = [self.faults.find(Kind.NAN, t, part) is not None for part in _SPOILT]
        frozen = [self.faults.find(Kind.FREEZE, t, part) is not None for part in _SPOILT]
        if nan[0] or frozen[0]:
            # On the ground the same attitude over and over is no wonder.
            stamp = sample.t_ns if frozen[0] and sample.landed is not Landed.IN_AIR else told.t_ns
            sample = replace(sample, t_ns=stamp, q_WB=told.q_WB, w_WB_B=told.w_WB_B)
        if nan[1] or frozen[1]:
            sample = replace(sample, t_imu_ns=sample.t_imu_ns if frozen[1] else told.t_imu_ns, f_B=told.f_B)
        return sample


class _Servo:
    """What one servo and the driver's care for it are in. Times in s of the world; angles in rad."""

    def __init__(self) -> None:
        self.error = HardwareError(0)
        self.reboots = 0
        self.reboot_at = inf
        self.away_until = -inf
        """Found again, and told what it needs, then."""
        self.deaf_since: float | None = None
        self.off = False
        """It gives no torque until it is rebooted."""
        self.forgot = False
        """Since it went away it was rebooted."""
        self.position = 0.0
        self.goal = 0.0
        self.torque = 0.0
        self.homing: float | None = None
        self.ramp_from: float | None = None


class FaultyServos(MockServos):
    """The servo bus with spoilt answers, and servos that fail."""

    def __init__(self, world: World, declared: Sequence[Fault], settings: DynamixelSettings, seed: int) -> None:
        super().__init__(world)
        self.faults = Faults(dynamixel_troubles.DEVICE, dynamixel_troubles.KINDS, declared, SERVO_NAMES)
        self._settings = settings
        self._random = Random(seed)
        self._servos = [_Servo() for _ in SERVO_NAMES]
        self._told: ServoState | None = None
        self._commanded: ServoCommand | None = None
        self._t = 0.0

    def latest(self) -> ServoState | None:
        """Newest cycle in which somebody has answered."""
        t = self._world.time
        self._befall(t)
        sample = super().latest()
        lost = self._lost(t)
        away = [self._away(servo, t) for servo in self._servos]
        if sample is not None and not lost and not all(away):
            self._told = self._heard(sample, away)
        return self._told

    def command(self, command: ServoCommand) -> None:
        """Hand the goals to the servos that hear them."""
        t = self._world.time
        dt, self._t = min(t - self._t, 0.1), t
        heard = [not self._away(servo, t) for servo in self._servos]
        if any(heard):
            self._commanded = command
        if self._commanded is None:
            return
        for k, (servo, hears) in enumerate(zip(self._servos, heard, strict=True)):
            if hears:
                self._obey(servo, command, k, t, dt)
        goals = [servo.goal for servo in self._servos]
        torque = [servo.torque for servo in self._servos]
        limp = [self._limp(servo, t) for servo in self._servos]
        self._world.command_servos(
            replace(
                self._commanded,
                position=(goals[0], goals[1], goals[2], goals[3], goals[4]),
                torque=(torque[0], torque[1], torque[2]),
            ),
            (limp[0], limp[1], limp[2], limp[3], limp[4]),
        )

    def _lost(self, t: float) -> bool:
        """The answers of this cycle are of no use."""
        kinds = (Kind.DROP, Kind.CORRUPT, Kind.TRUNCATE, Kind.WRONG_ID)
        struck = any(self.faults.strike(kind, t, chance=self._random.random()) for kind in kinds)
        delay = self.faults.strike(Kind.DELAY, t)
        return struck or (delay is not None and delay.value > self._settings.reply_margin)

    def _befall(self, t: float) -> None:
        """Let what is in force befall the servos."""
        unplugged = self.faults.find(Kind.UNPLUGGED, t) is not None
        rebooted = self.faults.begun(Kind.REBOOT, t)
        failed = [*self.faults.begun(Kind.ERROR_BIT, t), *self.faults.active(t)]
        for name, servo in zip(SERVO_NAMES, self._servos, strict=True):
            mine = [fault for fault in failed if fault.part in ("", name)]
            deaf = unplugged or any(fault.kind in (Kind.SILENT, Kind.REBOOT) for fault in mine)
            if any(fault.part in ("", name) for fault in rebooted) or t >= servo.reboot_at:
                self._restart(servo, t)
            for fault in mine:
                if fault.kind is Kind.ERROR_BIT and not self._away(servo, t):
                    self._fail(servo, HardwareError(round(fault.value)), t)
            if deaf and servo.deaf_since is None:
                servo.deaf_since = t
            elif not deaf and servo.deaf_since is not None:
                servo.deaf_since = None
                servo.away_until = max(servo.away_until, t + self._settings.retry)

    def _restart(self, servo: _Servo, t: float) -> None:
        servo.reboot_at, servo.away_until = inf, t + _WAKING
        servo.error, servo.off, servo.forgot = HardwareError(0), False, True

    def _fail(self, servo: _Servo, error: HardwareError, t: float) -> None:
        new = error & ~servo.error
        servo.error |= error
        servo.off = servo.off or bool(error & SHUT_DOWN)
        if new & HardwareError.OVERLOAD and servo.reboots < self._settings.reboots:
            servo.reboots += 1
            servo.reboot_at = t + self._settings.reboot_delay

    def _away(self, servo: _Servo, t: float) -> bool:
        """It does not answer, or is not yet found again; on its return it is brought back slowly."""
        if servo.deaf_since is not None or t < servo.away_until:
            return True
        if servo.away_until > -inf:
            servo.away_until, servo.forgot = -inf, False
            servo.homing, servo.ramp_from = servo.position, t
        return False

    def _heard(self, sample: ServoState, away: Sequence[bool]) -> ServoState:
        position, velocity, current = list(sample.position), list(sample.velocity), list(sample.current)
        error = [0] * len(SERVO_NAMES)
        for k, servo in enumerate(self._servos):
            error[k] = int(servo.error | (HardwareError.SILENT if away[k] else 0))
            if away[k]:
                position[k], velocity[k], current[k] = servo.position, 0.0, 0.0
            servo.position = position[k]
        return replace(
            sample,
            position=(position[0], position[1], position[2], position[3], position[4]),
            velocity=(velocity[0], velocity[1], velocity[2], velocity[3], velocity[4]),
            current=(current[0], current[1], current[2], current[3], current[4]),
            error=(error[0], error[1], error[2], error[3], error[4]),
            torque_on=sample.torque_on and not any(away) and not any(servo.off for servo in self._servos),
        )

    def _obey(self, servo: _Servo, command: ServoCommand, k: int, t: float, dt: float) -> None:
        """Set its goals; after it was away, its place at a walk and its torque growing, as the driver does."""
        servo.goal = command.position[k]
        if servo.homing is not None:
            most = self._settings.homing_speed * dt
            servo.homing += min(max(servo.goal - servo.homing, -most), most)
            done = servo.homing == servo.goal
            servo.goal, servo.homing = servo.homing, None if done else servo.homing
        if k < len(command.torque):
            servo.torque = command.torque[k]
        if servo.ramp_from is not None:
            share = (t - servo.ramp_from) / self._settings.homing_time
            servo.torque *= min(1.0, share)
            servo.ramp_from = None if share >= 1.0 else servo.ramp_from

    def _limp(self, servo: _Servo, t: float) -> bool:
        """It is off, or its watchdog has stopped it, which holds a place in position mode and gives no torque else."""
        command = self._commanded
        stopped = servo.deaf_since is not None and t - servo.deaf_since > self._settings.watchdog
        by_torque = command is not None and command.mode is JointMode.TORQUE
        return servo.off or servo.forgot or (by_torque and (stopped or t < servo.away_until))
