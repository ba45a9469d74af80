"""Intel RealSense T265 over pyrealsense2: poses by callback into a mailbox, and a watchdog that opens it again.

librealsense calls back in a thread of its own (a software device: in the thread that feeds it); there the pose becomes
odometry of the body and is stored. All that may block (finding, opening, closing) runs in a thread that is given up
when it hangs: closing a T265 is known to. (docs/decisions/0011-t265.md)
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from math import degrees, radians
from pathlib import Path
from threading import Lock, Thread
from time import monotonic_ns
from typing import Annotated, Any, NamedTuple, TypeVar

from msgspec import Meta, Struct

from drivers.device_clock import DeviceClock
from drivers.frames import attitude_from_tracker, from_tracker
from drivers.mailbox import Level, Mailbox, MailboxCounts, Notice, Notices, Trouble
from drivers.protocols import DeviceError
from drivers.samples import Odometry
from drivers.threads import named
from drivers.tracking import CameraPose, Coordinate, Jump, JumpLimits, Mount, Tracking, UnusableError

T = TypeVar("T")


def _meta(unit: str, doc: str, low: float, high: float) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


def _text(doc: str) -> Meta:
    return Meta(description=doc, extra={"unit": "", "in_flight": False})


class Trust(NamedTuple):
    """How far a pose can be trusted, in the order of ``Px4.odometry``."""

    position: float
    """Variance along each axis, m^2."""
    attitude: float
    """Variance about each axis, rad^2."""
    velocity: float
    """Variance along each axis, (m/s)^2."""
    quality: int
    """Percent as MAVLink's ODOMETRY means it: 1 worst to 100 best, -1 failed (there, 0 would be: not known)."""


class Variances(Struct, frozen=True, forbid_unknown_fields=True):
    """Variances at the highest confidence; each step of confidence less is taken as ten times the variance."""

    position: Annotated[float, _meta("m^2", "along each axis", 1e-8, 1.0)] = 1e-3
    attitude: Annotated[float, _meta("rad^2", "about each axis", 1e-8, 1.0)] = 1e-3
    velocity: Annotated[float, _meta("m^2/s^2", "along each axis", 1e-8, 1.0)] = 1e-3

    def trust(self, confidence: int) -> Trust:
        """Of a pose with this confidence (0..3)."""
        factor = 10.0 ** (3 - confidence)
        return Trust(factor * self.position, factor * self.attitude, factor * self.velocity, _QUALITY[confidence])


class T265Settings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the camera sits, where it begins, and what is asked of it."""

    start: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """p_WB at the first pose; None: standing on the ground at the origin, as the vehicle's data imply."""
    start_heading_deg: Annotated[float, _meta("deg", "yaw of the body in W at the first pose", -180.0, 180.0)] = 0.0
    mount: Mount = Mount()
    jump: JumpLimits = JumpLimits()
    variances: Variances = Variances()
    serial: Annotated[str, _text("serial number of the camera; empty: any T265")] = ""
    timeout: Annotated[float, _meta("s", "for opening, and for the first pose", 0.1, 60.0)] = 10.0
    silence: Annotated[float, _meta("s", "without a usable pose, after which it is opened again", 0.05, 10.0)] = 0.5
    retry: Annotated[float, _meta("s", "between two attempts to open it again", 0.1, 60.0)] = 3.0
    latency: Annotated[float, _meta("s", "shortest way from motion to arrival, which no clock shows", 0.0, 0.1)] = 0.0
    drift: Annotated[float, _meta("s/s", "of the camera's clock that is told", 1e-6, 0.1)] = 5e-4
    record: Annotated[str, _text("file (.bag) to record the poses to; empty: none")] = ""
    replay: Annotated[str, _text("file (.bag) to take the poses from, at their own pace; empty: the camera")] = ""


_QUALITY = (-1, 33, 66, 100)
_PERIOD = 0.05  # of the watchdog, s
_RATE = 200.0  # of the poses, Hz
_ENOUGH = 0.8
_RATE_PERIOD_NS = 1_000_000_000
_OFF = {"enable_relocalization": "relocalisation", "enable_pose_jumping": "pose jumping"}


class T265:
    """OdometryDevice on a T265, a recording of one, or a software device.

    ``find`` gives the device to open, now and after each loss, and raises DeviceError when there is none; without it
    the settings say which. ``clock`` gives nanoseconds; poses are stamped with it. ``start`` must run in the event
    loop in which ``stop`` will run.
    """

    def __init__(
        self,
        settings: T265Settings,
        find: Callable[[], Any] | None = None,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._settings = settings
        self._find = find or (lambda: _recorded(settings.replay) if settings.replay else _camera(settings.serial))
        self._clock = clock
        self._told = Notices()
        self._poses: Mailbox[Odometry] = Mailbox()
        self._stream: _Stream | None = None
        self._streams = 0
        self._recordings = 0
        self._lock = Lock()
        self._watching: asyncio.Task[None] | None = None
        self._fresh_ns = 0
        self._ended = False
        self._begin()

    def _begin(self) -> None:
        settings = self._settings
        start = settings.start or (0.0, 0.0, 0.0)
        self._tracking = Tracking(settings.mount, settings.jump, start, radians(settings.start_heading_deg))
        self._device_clock = DeviceClock()
        self._unusable = Trouble(self._tell, "its poses are usable again; {count} were not")
        self._jumps = Trouble(self._tell, "no more jumps; there were {count}")
        self._drifts = Trouble(self._tell, "its clock keeps time again")
        self._slow = Trouble(self._tell, f"its poses come at {_RATE:.0f} Hz again")
        self._slow_seconds = 0
        self._rate_due_ns = 0

    # -- life cycle -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Open the camera and wait for its first usable pose.

        Raises DeviceError: no pyrealsense2, no camera, it cannot be opened, it hangs, or no usable pose comes.
        """
        try:
            await self._start()
        except BaseException:
            await self.stop()
            raise

    async def _start(self) -> None:
        timeout = self._settings.timeout
        self._begin()
        self._ended = False
        before = self._poses.counts(0).received
        opening = _in_thread(self._open)
        if not await _done(opening, timeout):
            raise DeviceError(f"tracker: opening it has hung for {timeout:g} s; unplug it and plug it in again")
        opening.result()
        loop = asyncio.get_running_loop()
        end = loop.time() + timeout
        while self._poses.counts(0).received == before:
            if loop.time() > end:
                rejected = self._poses.counts(0).rejected
                raise DeviceError(
                    f"tracker: no usable pose within {timeout:g} s ({rejected} unusable ones); let it see light and "
                    "texture, hold it still, or unplug it and plug it in again"
                )
            await asyncio.sleep(0.01)
        self._watching = asyncio.create_task(self._watch(), name="t265")

    async def stop(self) -> None:
        """Close the camera. Safe to call twice; a camera whose closing hangs is left behind, and told."""
        task, self._watching = self._watching, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        with self._lock:
            self._streams += 1  # whatever still comes is of the past
        closing = _in_thread(self._close)
        if not await _done(closing, self._settings.timeout):
            self._tell(Level.ERROR, "closing it hangs; before the next use, unplug it and plug it in again")

    # -- what never waits -----------------------------------------------------------------------------------------

    def latest(self) -> Odometry | None:
        """Newest usable pose of the body; its time tells how old it is. None before the first."""
        return self._poses.latest()

    def trust(self, confidence: int) -> Trust:
        """Variances and quality of a pose with this confidence."""
        return self._settings.variances.trust(confidence)

    def notices(self) -> tuple[Notice, ...]:
        """Sentences since the last call: loss and return, unusable poses, jumps, the clock."""
        return self._told.take()

    def counts(self) -> dict[str, MailboxCounts]:
        """Counters and achieved rate of the poses."""
        return {"POSE": self._poses.counts(self._clock())}

    @property
    def ended(self) -> bool:
        """The recording that is replayed has come to its end."""
        return self._ended

    # -- opening and closing, in a thread of its own --------------------------------------------------------------

    def _open(self) -> None:
        self._streams += 1
        number = self._streams

        def on_frame(frame: Any) -> None:
            now = self._clock()
            if number != self._streams:
                return
            try:
                self._take(frame, now)
            except UnusableError as why:
                self._reject(now, str(why))
            except Exception as error:  # librealsense's thread must not see it
                self._reject(now, f"{type(error).__name__}: {error}")

        def on_end() -> None:
            if number == self._streams:
                self._ended = True
                self._tell(Level.INFO, "the recording has ended")

        device = self._find()
        record = self._settings.record
        if record:
            self._recordings += 1
            record = _numbered(record, self._recordings)
        stream = _Stream(device, record, on_frame, on_end)
        if stream.stubborn:
            what = " and ".join(stream.stubborn)
            self._tell(Level.WARNING, f"{what} cannot be switched off: its poses may jump when it knows a place again")
        with self._lock:
            if number == self._streams:
                self._stream = stream
                return
        stream.close()  # given up meanwhile

    def _close(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def _reopen(self) -> None:
        self._streams += 1
        self._close()
        # The map of the clock stays: if the new stream is late from its first pose on, only the old one can tell.
        self._tracking.restart()
        self._open()

    # -- what librealsense's thread calls -------------------------------------------------------------------------

    def _take(self, frame: Any, now: int) -> None:
        pose = frame.as_pose_frame().get_pose_data()
        clock, steps = self._device_clock, self._device_clock.steps
        t_ns = clock.map(round(frame.get_timestamp() * 1e6), now) - round(self._settings.latency * 1e9)
        if clock.steps != steps:
            self._tell(Level.WARNING, "its clock was set; the times of its poses are mapped anew")
        p, v, w, q = pose.translation, pose.velocity, pose.angular_velocity, pose.rotation
        odometry, jump = self._tracking.take(
            CameraPose(
                t_ns=t_ns,
                p_VC=from_tracker((p.x, p.y, p.z)),
                q_VC=attitude_from_tracker((q.w, q.x, q.y, q.z)),
                v_VC=from_tracker((v.x, v.y, v.z)),
                w_VC=from_tracker((w.x, w.y, w.z)),
                confidence=min(max(pose.tracker_confidence, 0), 3),
            )
        )
        self._poses.put(odometry, now)
        self._fresh_ns = now
        if jump is not None:
            self._jumps.happened(now, _words(jump, odometry))

    def _reject(self, now: int, why: str) -> None:
        self._poses.reject()
        self._unusable.happened(now, f"a pose is not used: {why}")

    # -- the watchdog ---------------------------------------------------------------------------------------------

    async def _watch(self) -> None:
        silence, retry = round(self._settings.silence * 1e9), round(self._settings.retry * 1e9)
        lost_ns = tried_ns = 0
        reason = ""
        while True:
            await asyncio.sleep(_PERIOD)
            now = self._clock()
            self._check(now)
            if self._ended:
                continue
            if now - self._fresh_ns < silence:
                if lost_ns:
                    gone = (self._fresh_ns - lost_ns) * 1e-9
                    self._tell(Level.WARNING, f"it is back after {gone:.1f} s; its frame begins where it was lost")
                lost_ns, reason = 0, ""
                continue
            if not lost_ns:
                lost_ns = self._fresh_ns
                self._tell(Level.ERROR, f"no usable pose for {self._settings.silence:g} s; opening it again")
            elif now - tried_ns < retry:
                continue
            why = await self._try_again()
            tried_ns = self._clock()
            if why != reason:
                reason = why
                if why:
                    self._tell(Level.WARNING, f"cannot open it again: {why}")

    async def _try_again(self) -> str:
        """Close and open; what went wrong, or nothing. While that hangs it is waited for, however long it takes."""
        work = _in_thread(self._reopen)
        timeout = self._settings.timeout
        if not await _done(work, timeout):
            self._tell(
                Level.ERROR,
                f"opening it again has hung for {timeout:g} s; land, unplug it, and start this process anew",
            )
            await asyncio.wait({work})
        error = work.exception()
        return "" if error is None else str(error).removeprefix("tracker: ")

    def _check(self, now: int) -> None:
        drift = self._device_clock.drift()
        if abs(drift) > self._settings.drift:
            way = "slow" if drift > 0.0 else "fast"
            self._drifts.happened(now, f"its clock is {way} by {abs(drift) * 1e6:.0f} ppm")
        for trouble in (self._unusable, self._jumps, self._drifts):
            trouble.check(now)
        if now >= self._rate_due_ns:
            self._rate_due_ns = now + _RATE_PERIOD_NS
            self._judge_rate(now)

    def _judge_rate(self, now: int) -> None:
        """Once a second: a camera that is slow in two of them on end, and not silent or of no use, loses poses."""
        rate = self._poses.counts(now).rate
        calm = self._settings.replay == "" and not self._unusable.active
        self._slow_seconds = self._slow_seconds + 1 if calm and rate < _ENOUGH * _RATE else 0
        if now - self._fresh_ns > self._settings.silence * 1e9:
            self._slow_seconds = 0
        if self._slow_seconds > 1:
            self._slow.happened(now, f"its poses come at {rate:.0f} Hz, want {_RATE:.0f} Hz: check USB 3 and the load")
        self._slow.check(now)

    def _tell(self, level: Level, text: str) -> None:
        self._told.tell(self._clock(), level, f"tracker: {text}")


class _Stream:
    """An open pose stream. Everything here may block."""

    stubborn: tuple[str, ...] = ()
    """What the camera does not let itself be told to leave off."""

    def __init__(self, device: Any, record: str, on_frame: Callable[[Any], None], on_end: Callable[[], None]) -> None:
        rs = library()
        try:
            if record:
                device = rs.recorder(record, device)
            sensor, profile = _pose_sensor(rs, device)
            if not device.is_playback():
                self.stubborn = tuple(words for name, words in _OFF.items() if not _switched_off(rs, sensor, name))
            if device.is_playback():
                device.as_playback().set_status_changed_callback(
                    lambda status: on_end() if status == rs.playback_status.stopped else None
                )
            sensor.open(profile)
            sensor.start(on_frame)
        except RuntimeError as error:
            raise DeviceError(f"tracker: cannot open it ({error}); no other process may use it") from error
        self._device: Any = device
        self._sensor: Any = sensor

    def close(self) -> None:
        """Stop and let go; a recording is complete after that."""
        sensor, self._sensor, self._device = self._sensor, None, None
        try:
            sensor.stop()
            sensor.close()
        except RuntimeError:
            pass  # it is gone already


def library() -> Any:
    """pyrealsense2; raises DeviceError with the remedy where it cannot be imported."""
    try:
        import pyrealsense2
    except ImportError as error:
        raise DeviceError(
            f"tracker: pyrealsense2 cannot be imported ({error}); on x86-64: pip install 'pipewright[vision]' and the "
            "system's libusb-1.0; on the Jetson: build librealsense 2.53.1 with its Python binding"
        ) from error
    return pyrealsense2


def _camera(serial: str) -> Any:
    rs = library()
    found = [
        (device.get_info(rs.camera_info.name), device.get_info(rs.camera_info.serial_number), device)
        for device in rs.context().query_devices()
    ]
    for name, number, device in found:
        if "T265" in name and serial in ("", number):
            return device
    seen = ", ".join(f"{name} {number}" for name, number, _ in found) or "nothing"
    raise DeviceError(
        f"tracker: no T265{f' {serial}' if serial else ''} found (seen: {seen}); unplug it and plug it in again, "
        "use USB 3, and librealsense 2.53.1, the last one that knows it"
    )


def _recorded(path: str) -> Any:
    rs = library()
    try:
        return rs.context().load_device(path)
    except RuntimeError as error:
        raise DeviceError(f"tracker: cannot replay {path} ({error}); want a .bag recorded by librealsense") from error


def _pose_sensor(rs: Any, device: Any) -> tuple[Any, Any]:
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() == rs.stream.pose:
                return sensor, profile
    raise DeviceError("tracker: the device has no pose stream; want a T265, or a recording of its poses")


def _switched_off(rs: Any, sensor: Any, name: str) -> bool:
    """It is off when it is read back."""
    option = getattr(rs.option, name)
    if not sensor.supports(option):
        return False
    if not sensor.is_option_read_only(option):
        sensor.set_option(option, 0.0)
    return bool(sensor.get_option(option) == 0.0)


def _numbered(path: str, number: int) -> str:
    """The file of the first stream, and beside it one for each after."""
    if not path or number == 1:
        return path
    first = Path(path)
    return str(first.with_stem(f"{first.stem}-{number}"))


def _words(jump: Jump, odometry: Odometry) -> str:
    return (
        f"its pose has jumped by {jump.position:.2f} m and {degrees(jump.angle):.0f} deg; "
        f"resets so far: {odometry.reset_counter}"
    )


def _in_thread(work: Callable[[], T]) -> asyncio.Future[T]:
    """Run in a thread that the process does not wait for at its end, unlike those of the loop's executor."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()
    future.add_done_callback(lambda done: done.cancelled() or done.exception())  # one that was given up ends unseen

    def settle(result: T | None, error: Exception | None) -> None:
        if future.cancelled():
            return
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result, error = None, None
        with named("realsense"):
            try:
                result = work()
            except Exception as raised:
                error = raised
        if not loop.is_closed():
            loop.call_soon_threadsafe(settle, result, error)

    Thread(target=run, name="t265 open", daemon=True).start()
    return future


async def _done(work: asyncio.Future[Any], within: float) -> bool:
    """It has ended within the time, well or not."""
    return bool((await asyncio.wait({work}, timeout=within))[0])
