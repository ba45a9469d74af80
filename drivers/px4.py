"""PX4 over MAVSDK 4: telemetry into mailboxes, one set-point per command, and the wanted state worked towards.

Set-points leave as raw SET_ATTITUDE_TARGET messages, one for each call of ``command``. MAVSDK's offboard plugin is not
used, because it repeats the last set-point by itself, so that a hung process would never trip PX4's offboard-loss
failsafe. Telemetry comes through MAVSDK's own thread straight into mailboxes: its asyncio streams queue without bound
and cost twice as much. (docs/decisions/0005-px4-wire.md)
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from enum import IntEnum
from functools import cache
from math import dist, isfinite, nan
from pathlib import Path
from time import monotonic_ns
from typing import Annotated, Any

import mavsdk
import msgspec
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkMessage
from mavsdk.plugins.param import Param, ParamError
from msgspec import Meta, Struct

from drivers.frames import (
    attitude_from_px4,
    body_from_px4,
    px4_from_attitude,
    px4_from_body,
    px4_from_world,
    world_from_px4,
)
from drivers.mailbox import Level, Mailbox, MailboxCounts, Notice, Notices
from drivers.protocols import DeviceError
from drivers.px4_parameters import INT32, Value, bits_of_float, differences, read_parameter_file
from drivers.px4_watch import LinkWatch
from drivers.rotation import inverse, rotate
from drivers.samples import (
    AutopilotCommand,
    AutopilotState,
    Engage,
    FlightMode,
    Interface,
    Landed,
    Odometry,
    Quat,
    Vec3,
)
from drivers.threads import named
from drivers.thrust import ThrustMap


def _meta(unit: str, doc: str, low: float, high: float) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


def _text(doc: str) -> Meta:
    return Meta(description=doc, extra={"unit": "", "in_flight": False})


class Px4Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """Where PX4 is and what is asked of it."""

    url: Annotated[str, _text("MAVSDK URL: serial:///dev/ttyTHS1:921600, udpin://0.0.0.0:14540, ...")] = ""
    thrust: ThrustMap | None = None
    """The identified map; without one the constructor of ``Px4`` is given the one that the vehicle implies."""
    parameters: Annotated[str, _text("file with the parameters that PX4 must hold (configs/px4); empty: none")] = ""
    may_differ: tuple[Annotated[str, _text("parameter of that file that PX4 need not hold")], ...] = ()
    timeout: Annotated[float, _meta("s", "for each stage of connecting", 0.1, 300.0)] = 10.0
    rate: Annotated[float, _meta("Hz", "asked for attitude and IMU", 10.0, 1000.0)] = 250.0
    stream_time: Annotated[float, _meta("s", "set-points run this long before offboard is asked for", 0.2, 10.0)] = 1.0
    stream_gap: Annotated[float, _meta("s", "a longer pause starts stream_time again", 0.02, 0.5)] = 0.1
    vision_rate: Annotated[float, _meta("Hz", "at most so many poses are handed on to PX4", 1.0, 250.0)] = 40.0


class Motion(Struct, frozen=True, gc=False):
    """PX4's own estimate of the body origin's position (m) and velocity (m/s), W."""

    t_ns: int
    p_WB: Vec3
    v_WB: Vec3


# The fields that are read of each MAVLink message; names are the wire's.


class _AttitudeQuaternion(Struct, gc=False):
    time_boot_ms: int
    q1: float
    q2: float
    q3: float
    q4: float
    rollspeed: float
    pitchspeed: float
    yawspeed: float


class _HighresImu(Struct, gc=False):
    xacc: float
    yacc: float
    zacc: float


class _LocalPosition(Struct, gc=False):
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float


class _Heartbeat(Struct, gc=False):
    base_mode: int
    custom_mode: int


class _ExtendedSysState(Struct, gc=False):
    landed_state: int


class _BatteryStatus(Struct):
    id: int
    voltages: list[int]
    battery_remaining: int


class _SysStatus(Struct, gc=False):
    onboard_control_sensors_health: int


class _StatusText(Struct, gc=False):
    severity: int
    text: str
    id: int = 0
    chunk_seq: int = 0


class _Timesync(Struct, gc=False):
    tc1: int
    ts1: int


class _CommandAck(Struct, gc=False):
    result: int


class _ParamValue(Struct, gc=False):
    param_id: str
    param_type: int
    param_value: float | None
    """None: not finite, as the bits of some whole numbers are."""


class _Text(Struct, frozen=True, gc=False):
    """A status text, as far as it has come."""

    t_ns: int
    number: int
    severity: int
    text: str


class _Attitude(Struct, frozen=True, gc=False):
    t_ns: int
    q_WB: Quat
    w_WB_B: Vec3


class _Imu(Struct, frozen=True, gc=False):
    t_ns: int
    f_B: Vec3


class _Mode(Struct, frozen=True, gc=False):
    armed: bool
    mode: FlightMode


class _Battery(Struct, frozen=True, gc=False):
    voltage: float
    remaining: float


class _Command(IntEnum):
    """MAV_CMD."""

    DO_SET_MODE = 176
    ARM_DISARM = 400
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512


class _Ask(Struct, frozen=True, gc=False):
    """A command that brings the autopilot nearer to the wanted state."""

    words: str
    command: _Command
    params: tuple[float, ...]


_WANTED_URL = "want for example serial:///dev/ttyTHS1:921600, udpin://0.0.0.0:14540 or tcpout://127.0.0.1:5760"
_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
_ONBOARD_COMPUTER = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
_SYSTEM = 1
_ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_PREARM = 0x1000_0000  # MAV_SYS_STATUS_PREARM_CHECK
_FORCE = 21196.0  # the number that makes PX4 disarm in the air
_UNUSED_CELL = 65535
_TEXT_CHUNK = 50
_WARNING = 4  # MAV_SEVERITY
_IGNORE_BODY_RATES, _IGNORE_ATTITUDE = 7, 128  # ATTITUDE_TARGET_TYPEMASK
_LOCAL_FRD, _BODY_FRD, _VIO = 20, 12, 3  # MAV_FRAME, MAV_FRAME, MAV_ESTIMATOR_TYPE

_ACCEPTED = 0
_RESULTS = {1: "temporarily rejected", 2: "denied", 3: "unsupported", 4: "failed", 6: "cancelled"}  # MAV_RESULT

# PX4's custom mode: main mode in bits 16..23, sub mode in bits 24..31.
_MODES = {(6, 0): FlightMode.OFFBOARD, (4, 3): FlightMode.HOLD, (4, 6): FlightMode.LAND}
_LANDED = {1: Landed.ON_GROUND, 2: Landed.IN_AIR, 3: Landed.IN_AIR, 4: Landed.IN_AIR}  # MAV_LANDED_STATE

_OFFBOARD = _Ask("offboard mode", _Command.DO_SET_MODE, (_CUSTOM_MODE, 6.0, 0.0))
_LAND = _Ask("land mode", _Command.DO_SET_MODE, (_CUSTOM_MODE, 4.0, 6.0))
_ARM = _Ask("arming", _Command.ARM_DISARM, (1.0, 0.0))
_DISARM = _Ask("disarming", _Command.ARM_DISARM, (0.0, 0.0))
_KILL = _Ask("cutting the motors", _Command.ARM_DISARM, (0.0, _FORCE))

#: What may be insisted on.
_INSISTED = {Engage.KILL: _KILL, Engage.LAND: _LAND}
_MOST_CONFIRMATIONS = 255

# The heartbeat tells arming and mode. PX4 sends it once a second, whatever interval is asked for; but also on request.
_HEARTBEAT = _Ask("a heartbeat", _Command.REQUEST_MESSAGE, (0.0,))

#: Messages asked for beside attitude and IMU: name, id, Hz.
_SLOW_STREAMS = (
    ("SYS_STATUS", 1, 2.0),
    ("LOCAL_POSITION_NED", 32, 50.0),
    ("TIMESYNC", 111, 50.0),  # PX4 wants 500 answers before it believes our clock
    ("BATTERY_STATUS", 147, 2.0),
    ("EXTENDED_SYS_STATE", 245, 10.0),
)

_PERIOD = 0.05  # of the driver's own task, s
_ASK_AGAIN_NS = 1_000_000_000
_FRESH_NS = 200_000_000
_HEARTBEAT_NS = 1_000_000_000
_TEXT_NS = 500_000_000
#: MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID, MAV_STATE_ACTIVE.
_GROUND_STATION = '{"type":6,"autopilot":8,"base_mode":0,"custom_mode":0,"system_status":4,"mavlink_version":3}'
_JUDGED = ("ATTITUDE_QUATERNION", "HIGHRES_IMU")  # streams whose rate is judged
_TRIP_NS = 100_000_000  # between two questions after the round trip
_KEPT_TRIPS = 50  # so many of them may be unanswered
_REBOOT_MS = 1000  # PX4's time does not go back further than packets can overtake each other
_PARAMETER_ROUNDS = 8  # so many times a parameter is asked for
_PARAMETER_PATIENCE = 0.5  # s without an answer, after which a round ends


class Px4:
    """AutopilotDevice on a PX4, real or emulated.

    ``clock`` gives nanoseconds; samples are stamped with it when they arrive. ``thrust`` is the thrust map where the
    settings hold none; with neither, ValueError. Construct it anywhere; ``start`` must run in the event loop in which
    ``stop`` will run. ``command`` and ``latest`` may be called from any one thread, ``insist`` and ``latest`` from any.
    """

    def __init__(
        self, settings: Px4Settings, clock: Callable[[], int] = monotonic_ns, thrust: ThrustMap | None = None
    ) -> None:
        known = settings.thrust or thrust
        if known is None:
            raise ValueError("autopilot: no thrust map; want thrust in its settings, or ThrustMap.of(vehicle)")
        self._thrust = known
        self._settings = settings
        self._clock = clock
        self._told = Notices()
        fast = settings.rate
        self._streams = (("ATTITUDE_QUATERNION", 31, fast), ("HIGHRES_IMU", 105, fast), *_SLOW_STREAMS)

        self._attitude: Mailbox[_Attitude] = Mailbox()
        self._imu: Mailbox[_Imu] = Mailbox()
        self._motion: Mailbox[Motion] = Mailbox()
        self._mode: Mailbox[_Mode] = Mailbox()
        self._landed: Mailbox[Landed] = Mailbox()
        self._battery: Mailbox[_Battery] = Mailbox()
        self._health: Mailbox[bool] = Mailbox()
        self._boxes: dict[str, Mailbox[Any]] = {
            "ATTITUDE_QUATERNION": self._attitude,
            "HIGHRES_IMU": self._imu,
            "LOCAL_POSITION_NED": self._motion,
            "HEARTBEAT": self._mode,
            "EXTENDED_SYS_STATE": self._landed,
            "BATTERY_STATUS": self._battery,
            "SYS_STATUS": self._health,
        }
        self._text: _Text | None = None

        self._hub: Any = None
        self._param: Any = None
        self._direct: Any = None
        self._task: asyncio.Task[None] | None = None
        self._asking: set[asyncio.Task[None]] = set()
        self._tuning: asyncio.Task[None] | None = None
        self._heard_ns = -(10**18)
        self._watch = LinkWatch(self._tell, settings.rate)
        self._last_attitude: _AttitudeQuaternion | None = None
        self._trips_begun: tuple[int, ...] = ()
        self._trip_due_ns = 0
        self._boot_ms = 0
        self._intervals_due = False

        self._wanted: Engage | None = None
        self._insisted: Engage | None = None
        self._insistence = 0
        self._reached = False
        self._left = False
        self._seen: _Mode | None = None
        self._seen_told = False
        self._commanded_ns = -(10**18)
        self._stream_began_ns = 0
        self._asked: dict[_Ask, int] = {}
        self._refusals: set[str] = set()
        self._sent = 0
        self._vision_due_ns = 0
        self._vision_sent = 0
        self._wanted_parameters: dict[str, Value] = {}
        self._held: dict[str, Value] = {}
        self._whole: set[str] = set()
        self._differences: tuple[str, ...] = ()
        self._parameters_due = False
        self._comparing: asyncio.Task[None] | None = None

    # -- life cycle -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect, subscribe, wait until everything that ``latest`` needs has come once, and compare the parameters.

        Raises DeviceError: bad URL or parameter file, port taken, nobody there, not a PX4, or a message that never
        comes. Parameters that differ are no error (``parameter_differences``).
        """
        try:
            await self._start()
        except BaseException:
            await self.stop()
            raise

    async def _start(self) -> None:
        url, timeout = self._settings.url, self._settings.timeout
        if not url:
            raise DeviceError(f"autopilot: no URL of PX4 in the settings; {_WANTED_URL}")
        if self._settings.parameters:
            try:
                wanted = read_parameter_file(Path(self._settings.parameters))
            except ValueError as error:
                raise DeviceError(f"autopilot: {error}") from error
            may_differ = self._settings.may_differ
            self._wanted_parameters = {name: value for name, value in wanted.items() if name not in may_differ}
        loop = asyncio.get_running_loop()
        _hush()
        # The onboard computer shares the vehicle's system id, as PX4 expects of a companion.
        configuration = mavsdk.Configuration.create_manual(_SYSTEM, _ONBOARD_COMPUTER, True)
        with named("mavsdk"):
            self._hub = mavsdk.Mavsdk(configuration)
        configuration.destroy()
        try:
            await asyncio.to_thread(_connect, self._hub, url)
        except Exception as error:
            raise DeviceError(
                f"autopilot: cannot open {url} ({error}); {_WANTED_URL}, and no other process on that port"
            ) from error

        self._tell(Level.INFO, f"waiting for PX4's heartbeat on {url}")
        found: asyncio.Future[Any] = loop.create_future()

        def settle(system: object) -> None:
            if not found.done():
                found.set_result(system)

        def on_found(system: object) -> None:
            loop.call_soon_threadsafe(settle, system)

        search = self._hub.first_autopilot_async(timeout, on_found)
        try:
            system = await found
        finally:
            self._hub.cancel_first_autopilot(search)
        if system is None:
            raise DeviceError(
                f"autopilot: no heartbeat on {url} within {timeout:g} s; is PX4 powered, is MAVLink enabled on that "
                "port (MAV_1_CONFIG, SER_TEL2_BAUD), and are address and baud rate right?"
            )
        if system.autopilot_type() != mavsdk.Autopilot.PX4:
            raise DeviceError(f"autopilot: {url} answers as {system.autopilot_type().name}; want a PX4")

        self._direct = MavlinkDirect(system)
        self._param = Param(system)
        self._subscribe_all()
        self._keep_texts_coming()
        await self._ask_intervals()
        await self._wait_for_samples()
        await self._compare_parameters()
        self._watch.begin(self._clock())
        self._task = asyncio.create_task(self._work(), name="px4")

    async def _wait_for_samples(self) -> None:
        needed = ("HEARTBEAT", "ATTITUDE_QUATERNION", "HIGHRES_IMU", "EXTENDED_SYS_STATE", "BATTERY_STATUS")
        loop = asyncio.get_running_loop()
        end = loop.time() + self._settings.timeout
        self._tell(Level.INFO, f"waiting for {', '.join(needed)}")
        while missing := [name for name in needed if self._boxes[name].latest() is None]:
            if loop.time() > end:
                raise DeviceError(
                    f"autopilot: {', '.join(missing)} never came from {self._settings.url} within "
                    f"{self._settings.timeout:g} s; is the link fast enough (921600 baud), and is the sensor set up?"
                )
            await asyncio.sleep(0.01)

    async def stop(self) -> None:
        """Close the link. Nothing is sent: landing is the caller's business. Safe to call twice."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        # A question that is out cannot be called back; MAVSDK gives up on it after a second or two.
        await asyncio.gather(*self._asking, return_exceptions=True)
        self._direct = None
        hub, self._hub = self._hub, None
        if hub is not None:
            await asyncio.to_thread(hub.destroy)

    # -- what never waits -----------------------------------------------------------------------------------------

    def latest(self) -> AutopilotState | None:
        """Newest state; its times tell how old it is. None before the first attitude, IMU sample and heartbeat."""
        attitude, imu, mode = self._attitude.latest(), self._imu.latest(), self._mode.latest()
        if attitude is None or imu is None or mode is None:
            return None
        battery = self._battery.latest()
        return AutopilotState(
            t_ns=attitude.t_ns,
            q_WB=attitude.q_WB,
            w_WB_B=attitude.w_WB_B,
            t_imu_ns=imu.t_ns,
            f_B=imu.f_B,
            armed=mode.armed,
            mode=mode.mode,
            landed=self._landed.latest() or Landed.UNKNOWN,
            battery_voltage=battery.voltage if battery else nan,
            battery_remaining=battery.remaining if battery else nan,
        )

    def command(self, command: AutopilotCommand) -> None:
        """Send one set-point (while OFFBOARD is wanted) and note the wanted state.

        A set-point with a number that is not finite is not sent, and told. Raises DeviceError before ``start``, after
        ``stop``, and for Interface.WRENCH, which PX4 does not accept.
        """
        if self._direct is None:
            raise DeviceError("autopilot: command() before start() or after stop()")
        if command.interface is Interface.WRENCH:
            raise DeviceError("autopilot: PX4 accepts no body torques; set the interface to attitude or body_rate")
        if self._insisted is not None and command.engage is not Engage.KILL:
            return
        now = self._clock()
        if command.engage is not self._wanted:
            self._wanted, self._reached, self._left = command.engage, False, False
            self._asked.clear()
            self._refusals.clear()
            if command.engage is Engage.KILL:
                self._kill()
        if command.engage is Engage.OFFBOARD:
            if now - self._commanded_ns > self._settings.stream_gap * 1e9:
                self._stream_began_ns = now
            self._commanded_ns = now
            self._send_set_point(command, now)

    def insist(self, engage: Engage | None) -> None:
        """From any thread: ask for KILL or LAND now, and want nothing else until None is given.

        Nothing repeats it but another call, since the event loop may hang; the message counts these calls, as MAVLink
        wants it. A heartbeat is asked for as well, so that ``latest`` soon tells whether PX4 has done it. ValueError
        for any other state; DeviceError before ``start`` and after ``stop``.
        """
        if engage is not None and engage not in _INSISTED:
            raise ValueError(f"autopilot: insist({engage.value}); want kill, land or None")
        if self._direct is None:
            raise DeviceError("autopilot: insist() before start() or after stop()")
        self._insistence = self._insistence + 1 if engage is self._insisted else 0
        self._insisted = engage
        if engage is not None:
            self._send("COMMAND_LONG", _command_json(_INSISTED[engage], min(self._insistence, _MOST_CONFIRMATIONS)))
            self._send("COMMAND_LONG", _command_json(_HEARTBEAT))

    def odometry(self, sample: Odometry, position: float, attitude: float, velocity: float, quality: int) -> None:
        """Hand a pose to PX4's estimator, with the variances of position (m^2), attitude (rad^2), velocity (m^2/s^2).

        ``quality`` is MAVLink's: 1 to 100 %, -1 failed. Call it with the newest sample at every tick; no sample is sent
        twice, and no more of them than ``vision_rate``. One with a number that is not finite is not sent, and told.
        Raises DeviceError before ``start`` and after ``stop``.
        """
        if self._direct is None:
            raise DeviceError("autopilot: odometry() before start() or after stop()")
        period = round(1e9 / self._settings.vision_rate)
        # A time that lies far before the last one is of a clock that was set, and not of an old sample.
        if self._vision_due_ns - 2 * period < sample.t_ns < self._vision_due_ns:
            return
        # From the last due time, not from now, so that the mean rate is the asked one.
        behind = sample.t_ns - self._vision_due_ns
        self._vision_due_ns = self._vision_due_ns + period if 0 <= behind < period else sample.t_ns + period
        # W's axes are east, north, up, as everywhere on this link; PX4 takes the heading from here, so that north of
        # its own estimate is +y of W too.
        p, q = px4_from_world(sample.p_WB), px4_from_attitude(sample.q_WB)
        v = px4_from_body(rotate(inverse(sample.q_WB), sample.v_WB))
        if not isfinite(sum(p) + sum(q) + sum(v) + position + attitude + velocity):
            self._refuse("a pose that is not finite was not sent")
            return
        self._send(
            "ODOMETRY",
            f'{{"time_usec":{sample.t_ns // 1000},"frame_id":{_LOCAL_FRD},"child_frame_id":{_BODY_FRD},'
            f'"x":{p[0]},"y":{p[1]},"z":{p[2]},"q":[{q[0]},{q[1]},{q[2]},{q[3]}],'
            f'"vx":{v[0]},"vy":{v[1]},"vz":{v[2]},"rollspeed":null,"pitchspeed":null,"yawspeed":null,'
            f'"pose_covariance":{_covariance(position, attitude)},"velocity_covariance":{_covariance(velocity, None)},'
            f'"reset_counter":{sample.reset_counter & 0xFF},"estimator_type":{_VIO},"quality":{quality}}}',
        )
        self._vision_sent += 1

    def motion(self) -> Motion | None:
        """PX4's own position and velocity, or None before the first."""
        return self._motion.latest()

    def ready_to_arm(self) -> bool:
        """PX4's own pre-arm checks pass."""
        return self._health.latest() or False

    def vision_disagreement(self, sample: Odometry) -> float | None:
        """Distance, m, between PX4's own position and this pose; None while PX4 tells no fresh position.

        Both are of the body origin, in W's axes; what the vehicle flew between their times is taken into account.
        """
        motion = self._motion.latest()
        if motion is None or self._clock() - motion.t_ns > _FRESH_NS:
            return None
        ahead = (motion.t_ns - sample.t_ns) * 1e-9
        moved = (sample.p_WB[i] + ahead * motion.v_WB[i] for i in range(3))
        return dist(motion.p_WB, tuple(moved))

    def parameter_differences(self) -> tuple[str, ...]:
        """What PX4 held otherwise than the file of the settings when it was read last; empty: nothing, or no file.

        It is read at the start, after each return of the link, and on ``read_parameters``.
        """
        return self._differences

    def read_parameters(self) -> None:
        """Read PX4's parameters anew, soon. Until then the last comparison stands."""
        self._parameters_due = True

    def notices(self) -> tuple[Notice, ...]:
        """Sentences since the last call: PX4's status texts, refusals, loss and return of the link."""
        return self._told.take()

    def counts(self) -> dict[str, MailboxCounts]:
        """Counters and achieved rate of every message, by MAVLink name."""
        now = self._clock()
        return {name: box.counts(now) for name, box in self._boxes.items()}

    def sent(self) -> int:
        """Set-points sent so far."""
        return self._sent

    def vision_sent(self) -> int:
        """Poses handed on to PX4 so far."""
        return self._vision_sent

    # -- set-points -----------------------------------------------------------------------------------------------

    def _send_set_point(self, command: AutopilotCommand, now: int) -> None:
        battery = self._battery.latest()
        thrust = self._thrust.set_point(command.thrust, battery.voltage if battery else nan)
        if command.interface is Interface.ATTITUDE:
            mask, q, w = _IGNORE_BODY_RATES, px4_from_attitude(command.q_WB), (0.0, 0.0, 0.0)
        else:
            mask, q, w = _IGNORE_ATTITUDE, (1.0, 0.0, 0.0, 0.0), px4_from_body(command.w_WB_B)
        if not isfinite(thrust + sum(q) + sum(w)):
            self._refuse("a set-point that is not finite was not sent")
            return
        self._send(
            "SET_ATTITUDE_TARGET",
            f'{{"time_boot_ms":{now // 1_000_000 & 0xFFFFFFFF},"target_system":{_SYSTEM},'
            f'"target_component":{_AUTOPILOT},"type_mask":{mask},"q":[{q[0]},{q[1]},{q[2]},{q[3]}],'
            f'"body_roll_rate":{w[0]},"body_pitch_rate":{w[1]},"body_yaw_rate":{w[2]},"thrust":{thrust}}}',
        )
        self._sent += 1

    def _send(self, name: str, fields: str) -> None:
        direct = self._direct
        if direct is None:  # stopped meanwhile
            return
        try:
            direct.send_message(MavlinkMessage(message_name=name, fields_json=fields))
        except MavlinkDirectError as error:
            self._refuse(f"{name} was not sent: {error.result.name}")

    def _kill(self) -> None:
        self._send("COMMAND_LONG", _command_json(_KILL))

    # -- the driver's own task ------------------------------------------------------------------------------------

    async def _work(self) -> None:
        while True:
            await asyncio.sleep(_PERIOD)
            self._send("COMMAND_LONG", _command_json(_HEARTBEAT))
            self._keep_texts_coming()
            self._look_at_link()
            if self._wanted is Engage.KILL:
                self._work_towards_kill()
            elif self._insisted is None and (ask := self._next_ask()) is not None:
                self._begin(self._try(ask))
            if self._intervals_due and self._watch.linked and (self._tuning is None or self._tuning.done()):
                self._intervals_due = False
                self._tuning = self._begin(self._ask_intervals())
            if self._parameters_due and self._watch.linked and (self._comparing is None or self._comparing.done()):
                self._parameters_due = False
                self._comparing = self._begin(self._compare_parameters())

    def _keep_texts_coming(self) -> None:
        """PX4 tells status texts only where it hears a ground station. The end of one may be lost: it is let go."""
        now = self._clock()
        if now - self._heard_ns >= _HEARTBEAT_NS:
            self._heard_ns = now
            self._send("HEARTBEAT", _GROUND_STATION)
        text = self._text
        if text is not None and now - text.t_ns > _TEXT_NS:
            self._end_text()

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Do it beside everything else: an answer that is late must not keep the next question back."""
        task = asyncio.create_task(work, name="px4 ask")
        self._asking.add(task)
        task.add_done_callback(self._asking.discard)
        return task

    def _work_towards_kill(self) -> None:
        mode = self._mode.latest()
        if mode is not None and mode.armed:
            self._kill()
        elif not self._reached:
            self._reached = True
            self._tell(Level.WARNING, "PX4 has cut the motors")

    def _next_ask(self) -> _Ask | None:
        """What brings PX4 nearer to the wanted state. A state once reached is not fought for against a pilot."""
        mode, now = self._mode.latest(), self._clock()
        if mode is None or not self._watch.linked:
            return None
        if mode != self._seen:
            self._seen, self._seen_told = mode, False
        ask: _Ask | None = None
        if self._wanted is Engage.OFFBOARD:
            there = mode.armed and mode.mode is FlightMode.OFFBOARD
            if not there and self._reached and not self._left:
                self._left = True
                self._tell(
                    Level.WARNING,
                    f"PX4 has left offboard by itself ({'armed' if mode.armed else 'disarmed'}, mode {mode.mode}); "
                    "it is not taken back before something else has been wanted",
                )
            fresh = now - self._commanded_ns < _FRESH_NS
            streamed = self._commanded_ns - self._stream_began_ns >= self._settings.stream_time * 1e9
            if not there and fresh and streamed:
                ask = _OFFBOARD if mode.mode is not FlightMode.OFFBOARD else _ARM
        elif self._wanted is Engage.LAND:
            there = not mode.armed or mode.mode is FlightMode.LAND
            ask = None if there else _LAND
        elif self._wanted is Engage.IDLE:
            there = not mode.armed
            ask = None if there or self._landed.latest() is not Landed.ON_GROUND else _DISARM
        else:
            return None
        if there and not self._reached:
            self._reached = True
            if not self._seen_told:
                self._seen_told = True
                self._tell(Level.INFO, f"PX4 is {'armed' if mode.armed else 'disarmed'}, mode {mode.mode}")
        if ask is None or self._reached or now - self._asked.get(ask, -_ASK_AGAIN_NS) < _ASK_AGAIN_NS:
            return None
        self._asked[ask] = now
        return ask

    async def _try(self, ask: _Ask) -> None:
        reason = await self._ask(ask)
        if reason and self._watch.linked:  # of a lost link the loss was told
            self._refuse(f"{ask.words}: {reason}")

    async def _ask(self, ask: _Ask) -> str:
        """Send a command and wait for its answer; returns what went wrong, or nothing."""
        message = MavlinkMessage(message_name="COMMAND_LONG", fields_json=_command_json(ask))
        try:
            answer = await asyncio.to_thread(self._direct.send_command, message)
        except MavlinkDirectError as error:
            return "no answer" if error.result.name == "TIMEOUT" else error.result.name.lower()
        result = msgspec.json.decode(answer.fields_json, type=_CommandAck).result
        return "" if result == _ACCEPTED else _RESULTS.get(result, f"MAV_RESULT {result}")

    async def _ask_intervals(self) -> None:
        for name, number, rate in self._streams:
            ask = _Ask(f"{name} at {rate:g} Hz", _Command.SET_MESSAGE_INTERVAL, (float(number), round(1e6 / rate)))
            await self._try(ask)

    async def _compare_parameters(self) -> None:
        """Read the parameters of the file from PX4, and tell in how many they differ."""
        wanted = self._wanted_parameters
        if not wanted:
            return
        self._held.clear()
        self._whole.clear()
        for _ in range(_PARAMETER_ROUNDS):
            missing = [name for name in wanted if name not in self._held and name not in self._whole]
            for name in missing:
                self._send("PARAM_REQUEST_READ", _parameter_json(name))
            quiet, left = 0.0, len(missing)
            while left and quiet < _PARAMETER_PATIENCE and self._direct is not None:
                await asyncio.sleep(_PERIOD)
                now_left = sum(name not in self._held and name not in self._whole for name in missing)
                quiet, left = (quiet + _PERIOD if now_left == left else 0.0), now_left
        for name in self._whole.difference(self._held):
            # JSON has no words for the bits of this whole number; MAVSDK's own reader has.
            try:
                self._held[name] = await asyncio.to_thread(self._param.get_param_int, name)
            except ParamError as error:
                self._tell(Level.WARNING, f"PX4's {name} cannot be read: {error}")
        before, self._differences = self._differences, differences(wanted, self._held)
        if self._differences:
            if self._differences != before:
                self._tell(
                    Level.ERROR,
                    f"PX4 differs from {self._settings.parameters} in {len(self._differences)} of {len(wanted)} "
                    f"parameters: {'; '.join(self._differences)}",
                )
        else:
            self._tell(Level.INFO, f"PX4 holds the {len(wanted)} parameters of {self._settings.parameters}")

    def _look_at_link(self) -> None:
        now, watch = self._clock(), self._watch
        if watch.check(now):
            self._intervals_due = self._parameters_due = True
        # A PX4 that has rebooted sends at its default rates.
        if watch.judge_rates(now, lambda: {name: self._boxes[name].counts(now).rate for name in _JUDGED}):
            self._intervals_due = True
        if now >= self._trip_due_ns:
            self._trip_due_ns = now + _TRIP_NS
            self._trips_begun = (*self._trips_begun[-_KEPT_TRIPS:], now)
            self._send_timesync(0, now)

    # -- what MAVSDK's thread calls -------------------------------------------------------------------------------

    def _subscribe_all(self) -> None:
        self._subscribe("ATTITUDE_QUATERNION", _AttitudeQuaternion, self._on_attitude)
        self._subscribe("HIGHRES_IMU", _HighresImu, self._on_imu)
        self._subscribe("LOCAL_POSITION_NED", _LocalPosition, self._on_motion)
        self._subscribe("HEARTBEAT", _Heartbeat, self._on_heartbeat)
        self._subscribe("EXTENDED_SYS_STATE", _ExtendedSysState, self._on_landed)
        self._subscribe("BATTERY_STATUS", _BatteryStatus, self._on_battery)
        self._subscribe("SYS_STATUS", _SysStatus, self._on_health)
        self._subscribe("STATUSTEXT", _StatusText, self._on_text)
        self._subscribe("TIMESYNC", _Timesync, self._on_timesync)
        self._subscribe("PARAM_VALUE", _ParamValue, self._on_parameter)

    def _subscribe(self, name: str, fields: type[Any], take: Callable[[Any, int], None]) -> None:
        decode = msgspec.json.Decoder(fields).decode
        box = self._boxes.get(name)

        def on_message(message: Any, _: object) -> None:
            now = self._clock()
            if message.component_id != _AUTOPILOT:
                return
            self._watch.heard(now)
            try:
                take(decode(message.fields_json), now)
            except (ValueError, OverflowError, RecursionError):
                # A number that is not finite arrives as null.
                if box is not None:
                    box.reject()
                    self._watch.unusable(now, name)

        self._direct.subscribe_message(name, on_message)

    def _on_attitude(self, m: _AttitudeQuaternion, now: int) -> None:
        if m.time_boot_ms < self._boot_ms - _REBOOT_MS:
            self._intervals_due = self._parameters_due = True
            self._tell(Level.ERROR, "PX4 has rebooted: its time began anew")
        self._boot_ms = m.time_boot_ms
        before, self._last_attitude = self._last_attitude, m
        same = before is not None and _same_attitude(before, m) and self._landed.latest() is Landed.IN_AIR
        self._watch.moves(now, same)
        if same:
            return  # its age must tell
        attitude = attitude_from_px4((m.q1, m.q2, m.q3, m.q4))
        rates = body_from_px4((m.rollspeed, m.pitchspeed, m.yawspeed))
        self._attitude.put(_Attitude(now - self._watch.lateness, attitude, rates), now)

    def _on_imu(self, m: _HighresImu, now: int) -> None:
        self._imu.put(_Imu(now - self._watch.lateness, body_from_px4((m.xacc, m.yacc, m.zacc))), now)

    def _on_motion(self, m: _LocalPosition, now: int) -> None:
        self._motion.put(Motion(now, world_from_px4((m.x, m.y, m.z)), world_from_px4((m.vx, m.vy, m.vz))), now)

    def _on_heartbeat(self, m: _Heartbeat, now: int) -> None:
        mode = _MODES.get((m.custom_mode >> 16 & 0xFF, m.custom_mode >> 24 & 0xFF), FlightMode.OTHER)
        self._mode.put(_Mode(bool(m.base_mode & _ARMED), mode), now)

    def _on_landed(self, m: _ExtendedSysState, now: int) -> None:
        self._landed.put(_LANDED.get(m.landed_state, Landed.UNKNOWN), now)

    def _on_battery(self, m: _BatteryStatus, now: int) -> None:
        cells = [v for v in m.voltages if v != _UNUSED_CELL]
        if m.id != 0 or not cells:
            return
        remaining = m.battery_remaining / 100.0 if m.battery_remaining >= 0 else nan
        self._battery.put(_Battery(sum(cells) / 1000.0, remaining), now)

    def _on_health(self, m: _SysStatus, now: int) -> None:
        self._health.put(bool(m.onboard_control_sensors_health & _PREARM), now)

    def _on_text(self, m: _StatusText, now: int) -> None:
        # A long text comes in pieces of one number. The last is not full, or nothing more comes: there is no empty end.
        piece = m.text.rstrip("\0")
        begun = self._text
        if begun is not None and begun.number == m.id and m.chunk_seq:
            self._text = _Text(now, m.id, m.severity, begun.text + piece)
        else:
            self._end_text()
            self._text = _Text(now, m.id, m.severity, piece)
        if len(piece) < _TEXT_CHUNK:
            self._end_text()

    def _end_text(self) -> None:
        """Tell the text that has come so far."""
        text, self._text = self._text, None
        if text is not None:
            worse = text.severity < _WARNING
            level = Level.ERROR if worse else Level.WARNING if text.severity == _WARNING else Level.INFO
            self._told.tell(text.t_ns, level, f"autopilot: PX4 says: {text.text.rstrip()}")

    def _on_timesync(self, m: _Timesync, now: int) -> None:
        # PX4 asks for the time here, and so learns to read the times of the poses; or it answers such a question.
        if m.tc1 == 0:
            self._send_timesync(now, m.ts1)
        elif m.ts1 in self._trips_begun:
            self._watch.answered(now, m.ts1)

    def _send_timesync(self, tc1: int, ts1: int) -> None:
        self._send("TIMESYNC", f'{{"tc1":{tc1},"ts1":{ts1},"target_system":{_SYSTEM},"target_component":{_AUTOPILOT}}}')

    def _on_parameter(self, m: _ParamValue, now: int) -> None:
        name = m.param_id.rstrip("\0")
        if m.param_type != INT32:
            if m.param_value is not None:
                self._held[name] = m.param_value
        elif m.param_value is None:
            self._whole.add(name)
        else:
            self._held[name] = bits_of_float(m.param_value)

    # -- words ----------------------------------------------------------------------------------------------------

    def _tell(self, level: Level, text: str) -> None:
        self._told.tell(self._clock(), level, f"autopilot: {text}")

    def _refuse(self, text: str) -> None:
        """Tell a refusal once for each wanted state."""
        if text not in self._refusals:
            self._refusals.add(text)
            self._tell(Level.WARNING, text)


def _connect(hub: Any, url: str) -> None:
    """Raises MAVSDK's error when the connection cannot be opened."""
    with named("mavsdk"):
        hub.add_any_connection_with_handle(url)


def _same_attitude(a: _AttitudeQuaternion, b: _AttitudeQuaternion) -> bool:
    """To the bit; their times may differ."""
    return (a.q1, a.q2, a.q3, a.q4, a.rollspeed, a.pitchspeed, a.yawspeed) == (
        b.q1, b.q2, b.q3, b.q4, b.rollspeed, b.pitchspeed, b.yawspeed
    )  # fmt: skip


@cache
def _hush() -> None:
    """Keep MAVSDK from printing, once for the process; what matters of it is told in notices."""
    mavsdk.log_subscribe(lambda level, text, file, line: True)


def _covariance(linear: float, angular: float | None) -> str:
    """The upper right triangle, row by row, of a diagonal 6x6 matrix; None is not known (NaN on the wire)."""
    a, b = f"{linear}", "null" if angular is None else f"{angular}"
    return f"[{a},0,0,0,0,0,{a},0,0,0,0,{a},0,0,0,{b},0,0,{b},0,{b}]"


def _parameter_json(name: str) -> str:
    return f'{{"target_system":{_SYSTEM},"target_component":{_AUTOPILOT},"param_id":"{name}","param_index":-1}}'


def _command_json(ask: _Ask, confirmation: int = 0) -> str:
    fields: dict[str, float | int] = {
        "target_system": _SYSTEM,
        "target_component": _AUTOPILOT,
        "command": int(ask.command),
        "confirmation": confirmation,
    }
    padded = (*ask.params, *(0.0,) * (7 - len(ask.params)))
    fields.update({f"param{i}": value for i, value in enumerate(padded, start=1)})
    return msgspec.json.encode(fields).decode()
