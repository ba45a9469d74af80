"""The flying process's end of the link to a world elsewhere, and the mock devices of that world."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from socket import AF_INET, SOCK_DGRAM, socket
from threading import Event, Lock, Thread

from drivers.mailbox import Mailbox
from drivers.protocols import DeviceError
from drivers.samples import AutopilotCommand, AutopilotState, Engage, Odometry, ServoCommand, ServoState
from sim_backend.world_messages import FOREIGN, HELLO, LARGEST, Bye, Camera, Command, Hello, Look, encode, from_world

#: How often the camera's stream is looked at, s.
_GLANCE = 0.02


class WorldClient:
    """The other end, with a thread that listens.

    ``on_look`` and ``on_camera`` are called in that thread. ``streaming`` is asked whether the camera's stream is open.
    """

    def __init__(
        self,
        address: str,
        mocks: tuple[str, ...] = (),
        on_look: Callable[[Look], None] = lambda look: None,
        on_camera: Callable[[Camera], None] = lambda camera: None,
        streaming: Callable[[], bool] = bool,
    ) -> None:
        """Raises DeviceError for an address that is none."""
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise DeviceError(f"world link: {address!r} is no address; want host:port of a world process")
        self.address = address
        self._peer = (host, int(port))
        self._mocks = mocks
        self._on_look, self._on_camera, self._streaming = on_look, on_camera, streaming
        self._phase = ""
        self._insisted: Engage | None = None
        self._off = False
        self._one_hello = Lock()
        """So that of two hellos the newer one leaves last."""
        self._looks: Mailbox[Look] = Mailbox()
        self._first = Event()
        self._socket = socket(AF_INET, SOCK_DGRAM)
        self._socket.settimeout(HELLO)
        self._stopping = False
        self._thread: Thread | None = None

    def start(self, timeout: float) -> None:
        """Listen, and wait for the first look. Raises DeviceError when no world answers within ``timeout`` s."""
        self._thread = Thread(target=self._run, name="world link", daemon=True)
        self._thread.start()
        if not self._first.wait(timeout):
            self.stop()
            raise DeviceError(
                f"world link: no world answers at {self.address} within {timeout:g} s; start one (pipewright world), "
                "or let pipewright desk start it"
            )

    def stop(self) -> None:
        """End the thread. Safe to call twice."""
        self._stopping = True
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()
            self._send(encode(Bye()))
        self._socket.close()

    def latest(self) -> Look | None:
        """The newest look, or None before the first."""
        return self._looks.latest()

    def tell_phase(self, phase: str) -> None:
        """The mission's phase; told at once when it has changed."""
        if phase != self._phase:
            self._phase = phase
            self._hello()

    def command(self, command: Command) -> None:
        """Command the mock devices."""
        self._send(encode(command))

    def insist(self, engage: Engage | None) -> None:
        """What the mock autopilot is to do whatever is commanded; told at once, and with each hello."""
        self._insisted = engage
        self._hello()

    def insist_off(self, off: bool) -> None:
        """Whether the mock servos have no torque whatever is commanded; told at once, and with each hello."""
        self._off = off
        self._hello()

    def _hello(self) -> None:
        with self._one_hello:
            self._send(encode(Hello(self._streaming(), self._phase, self._mocks, self._insisted, self._off)))

    def _send(self, packet: bytes) -> None:
        with suppress(OSError):  # as on a wire: what does not arrive is missing, and its age will tell
            self._socket.sendto(packet, self._peer)

    def _run(self) -> None:
        told = looked = -HELLO
        was_open = False
        while not self._stopping:
            now = time.monotonic()
            if now - looked >= _GLANCE:
                looked, is_open = now, self._streaming()
                if is_open is not was_open or now - told >= HELLO:
                    told, was_open = now, is_open
                    self._hello()
            try:
                message = from_world(self._socket.recv(LARGEST))
            except (OSError, *FOREIGN):
                continue
            if isinstance(message, Look):
                self._looks.put(message, message.t_ns)
                self._first.set()
                self._on_look(message)
            else:
                self._on_camera(message)


class _Linked:
    """What the devices of a world elsewhere share: the link, and a life cycle with nothing to connect to."""

    def __init__(self, client: WorldClient) -> None:
        self._client = client

    async def start(self) -> None:
        """Nothing to connect to: the link was there before."""

    async def stop(self) -> None:
        """Nothing to release."""

    def notices(self) -> tuple[()]:
        """Nothing to tell."""
        return ()


class LinkedAutopilot(_Linked):
    """The mock autopilot of a world in another process."""

    def latest(self) -> AutopilotState | None:
        """Newest attitude, inertial data and status."""
        look = self._client.latest()
        return None if look is None else look.autopilot

    def command(self, command: AutopilotCommand) -> None:
        """Hand over one fresh set-point."""
        self._client.command(Command(autopilot=command))

    def insist(self, engage: Engage | None) -> None:
        """KILL or LAND now, and nothing else but a commanded KILL until None is given."""
        self._client.insist(engage)


class LinkedOdometry(_Linked):
    """The mock tracker of a world in another process."""

    def latest(self) -> Odometry | None:
        """Newest pose and velocity of the body origin."""
        look = self._client.latest()
        return None if look is None else look.odometry


class LinkedServos(_Linked):
    """The mock servo bus of a world in another process."""

    def latest(self) -> ServoState | None:
        """Newest cycle."""
        look = self._client.latest()
        return None if look is None else look.servos

    def command(self, command: ServoCommand) -> None:
        """Hand over the goals for the next cycle."""
        self._client.command(Command(servos=command))

    def insist(self, off: bool) -> None:
        """Torque off, and off whatever is commanded, until False is given."""
        self._client.insist_off(off)
