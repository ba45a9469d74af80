"""The world's end of the link to processes that fly in it: a face that tells everybody who has said hello lately."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from socket import AF_INET, SOCK_DGRAM, socket

import msgspec

from drivers.protocols import DeviceError
from sim_backend.mock_devices import Clock, MockAutopilot, MockOdometry, MockServos
from sim_backend.tracker import Tracker
from sim_backend.world import World
from sim_backend.world_messages import FOREIGN, LARGEST, Address, Bye, Camera, Hello, Look, encode, to_world

#: Who has said nothing for so long is gone, s.
PATIENCE = 2.0


class WorldServer:
    """The world's end: a face (see ``pace.Face``), and a second one, ``camera``, at the camera's own rate.

    ``clock`` maps world time to the machine's monotonic clock. ``received`` and ``slipped`` are asked at each look.
    ``on_phase`` hears the mission's phase and the world's time, s, whenever a client says hello.
    """

    period = 0.004

    def __init__(
        self,
        world: World,
        clock: Clock,
        tracker: Tracker | None = None,
        received: Callable[[], Mapping[str, int]] = dict,
        slipped: Callable[[], float] = float,
        on_phase: Sequence[Callable[[str, float], None]] = (),
        bind: Address = ("127.0.0.1", 0),
    ) -> None:
        self.camera = _CameraFace(self, tracker)
        self._world = world
        self._clock = clock
        self._received = received
        self._slipped = slipped
        self._on_phase = on_phase
        self._mocks = (MockAutopilot(world, clock), MockOdometry(world, clock), MockServos(world, clock))
        self._peers: dict[Address, tuple[Hello, float]] = {}
        self._phase = ""
        self._socket = socket(AF_INET, SOCK_DGRAM)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            raise DeviceError(f"world link: cannot listen on UDP {bind[0]}:{bind[1]} ({error.strerror})") from error
        self._socket.setblocking(False)

    @property
    def address(self) -> str:
        """Where clients find it: ``host:port``."""
        host, port = self._socket.getsockname()
        return f"{host}:{port}"

    @property
    def flown_in(self) -> bool:
        """Somebody flies in this world."""
        return any(hello.phase for hello, _ in self._peers.values())

    @property
    def streaming(self) -> bool:
        """Somebody has opened the camera's stream."""
        return any(hello.streaming for hello, _ in self._peers.values())

    def receive(self) -> None:
        """Take what clients have said; forget those that say nothing any more."""
        now = time.monotonic()
        while True:
            try:
                data, address = self._socket.recvfrom(LARGEST)
            except BlockingIOError:
                break
            except ConnectionRefusedError:  # of an earlier send to a client that is gone
                continue
            try:
                message = to_world(data)
            except FOREIGN:
                continue  # not ours
            if isinstance(message, Hello):
                self._peers[address] = (message, now)
                self._insist(message)
                if message.phase:
                    self._phase = message.phase
                    for enter in self._on_phase:
                        enter(message.phase, self._world.time)
            elif isinstance(message, Bye):
                self._peers.pop(address, None)
            else:
                autopilot, _, servos = self._mocks
                if message.autopilot is not None:
                    autopilot.command(message.autopilot)
                if message.servos is not None:
                    servos.command(message.servos)
        self._peers = {peer: entry for peer, entry in self._peers.items() if now - entry[1] < PATIENCE}

    def _insist(self, hello: Hello) -> None:
        """What the one who has the mock devices insists on."""
        autopilot, _, servos = self._mocks
        if "autopilot" in hello.mocks:
            autopilot.insist(hello.insisted)
        if "servos" in hello.mocks:
            servos.insist(hello.off)

    def publish(self) -> None:
        """Tell everybody how the world looks."""
        if not self._peers:
            return
        snapshot = self._world.snapshot
        plain = Look(
            self._clock(snapshot.t_ns),
            self._world.truth(),
            snapshot.armed,
            snapshot.mode,
            snapshot.torque_on,
            dict(self._received()),
            self._slipped(),
            self._phase,
        )
        packets: dict[tuple[str, ...], bytes] = {}
        for peer, (hello, _) in self._peers.items():
            if hello.mocks not in packets:
                packets[hello.mocks] = encode(self._with_samples(plain, hello.mocks))
            self.send(packets[hello.mocks], peer)

    def _with_samples(self, look: Look, wanted: tuple[str, ...]) -> Look:
        autopilot, odometry, servos = self._mocks
        return msgspec.structs.replace(
            look,
            autopilot=autopilot.latest() if "autopilot" in wanted else None,
            odometry=odometry.latest() if "odometry" in wanted else None,
            servos=servos.latest() if "servos" in wanted else None,
        )

    def see(self, camera: Camera) -> None:
        """Tell those with an open stream what the camera sees; the others, whether it is there."""
        poses = tuple(msgspec.structs.replace(pose, t_ns=self._clock(pose.t_ns)) for pose in camera.poses)
        full, bare = encode(Camera(camera.gone, poses)), encode(Camera(camera.gone, ()))
        for peer, (hello, _) in self._peers.items():
            self.send(full if hello.streaming else bare, peer)

    def send(self, packet: bytes, peer: Address) -> None:
        """One datagram; a full buffer drops it, as a wire would."""
        with suppress(OSError):
            self._socket.sendto(packet, peer)

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()


class _CameraFace:
    """The camera of the world, at its own rate."""

    period = 0.005

    def __init__(self, server: WorldServer, tracker: Tracker | None) -> None:
        self._server = server
        self._tracker = tracker

    def receive(self) -> None:
        """Nothing: the server has the socket."""

    def publish(self) -> None:
        """Send the poses that are due."""
        if self._tracker is not None:
            poses = self._tracker.step(self._server.streaming)
            self._server.see(Camera(self._tracker.gone, poses))
