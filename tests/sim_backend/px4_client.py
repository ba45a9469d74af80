"""A plain MAVLink client of one stand-in, which it steps itself: no thread, no waiting."""

from __future__ import annotations

from math import nan
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from drivers.frames import px4_from_attitude, px4_from_body, px4_from_world
from drivers.rotation import inverse, rotate
from drivers.samples import FlightMode, Landed, Vec3
from sim_backend.px4_emulator import Px4StandIn

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4
ARM, SET_MODE, TERMINATE, INTERVAL, REQUEST = 400, 176, 185, 511, 512
OFFBOARD, HOLD, LAND = (1.0, 6.0, 0.0), (1.0, 4.0, 3.0), (1.0, 4.0, 6.0)
FORCE = 21196.0
LEVEL_EAST = (0.5**0.5, 0.0, 0.0, 0.5**0.5)  # PX4's quaternion of the identity in W
LEVEL_RATES, LEVEL_ATTITUDE = 128, 7


class Client:
    """A plain MAVLink client of one stand-in.

    While ``sees``, it tells poses at 50 Hz: the truth, moved by ``shift`` (m, W), with ``quality`` and ``counter``.
    """

    sees = False
    beats = True
    shift: Vec3 = (0.0, 0.0, 0.0)
    quality = 100
    counter = 0
    frames = (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    velocity = True

    def __init__(self, stand_in: Px4StandIn) -> None:
        self.stand_in = stand_in
        self.world = stand_in.world
        self.socket = socket(AF_INET, SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self.parser = mavlink.MAVLink(None)
        self.seen: list[Any] = []
        self.beat()

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), ("127.0.0.1", self.stand_in.port))

    def beat(self) -> None:
        """Without a ground station's heartbeat PX4 tells no status texts."""
        self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))

    def run(self, seconds: float, thrust: float | None = None, mask: int = LEVEL_RATES) -> list[Any]:
        """Step the stand-in, with a set-point before each step if a thrust is given; what it said meanwhile."""
        seen: list[Any] = []
        for k in range(round(seconds / self.stand_in.period)):
            if self.beats and k % 50 == 0:
                self.beat()
            if self.sees and k % 5 == 0:
                self.tell_pose()
            if thrust is not None:
                self.send(mavlink.MAVLink_set_attitude_target_message(0, 1, 1, mask, LEVEL_EAST, 0.0, 0.0, 0.0, thrust))
            self.stand_in.step()
            seen += self.receive()
        self.seen += seen
        return seen

    def tell_pose(self) -> None:
        truth = self.world.truth()
        p = px4_from_world(tuple(a + b for a, b in zip(truth.p_WB, self.shift, strict=True)))  # type: ignore[arg-type]
        v = px4_from_body(rotate(inverse(truth.q_WB), truth.v_WB)) if self.velocity else (nan, nan, nan)
        unknown = [nan] * 21
        self.send(
            mavlink.MAVLink_odometry_message(
                0, *self.frames, *p, px4_from_attitude(truth.q_WB), *v, nan, nan, nan, unknown, unknown,
                self.counter, mavlink.MAV_ESTIMATOR_TYPE_VIO, self.quality,
            )
        )  # fmt: skip

    def off(self) -> Vec3:
        """What PX4 believes its position to be, less what it is, m, W."""
        believed, truth = self.stand_in.estimator.p_WB, self.world.truth().p_WB
        return (believed[0] - truth[0], believed[1] - truth[1], believed[2] - truth[2])

    def receive(self) -> list[Any]:
        messages: list[Any] = []
        while True:
            try:
                data = self.socket.recv(4096)
            except BlockingIOError:
                return messages
            except ConnectionRefusedError:  # nobody is there
                continue
            messages += self.parser.parse_buffer(data) or []

    def command(self, command: int, *params: float) -> int:
        """Result of one COMMAND_LONG."""
        padded = (*params, *(nan,) * (7 - len(params)))
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *padded))
        (ack,) = [m for m in self.run(0.004) if m.get_type() == "COMMAND_ACK"]
        assert ack.command == command
        assert (ack.target_system, ack.target_component) == (1, 191)
        return int(ack.result)

    def mode(self) -> FlightMode:
        return self.world.autopilot.mode

    def armed(self) -> bool:
        return self.world.autopilot.armed

    def landed(self) -> Landed:
        return self.world.autopilot.landed

    def texts(self) -> list[str]:
        """Status texts so far, those in pieces joined."""
        joined: list[str] = []
        for m in of(self.seen, "STATUSTEXT"):
            if m.chunk_seq:
                joined[-1] += m.text
            else:
                joined.append(m.text)
        return [text.rstrip() for text in joined]

    def told(self) -> str:
        return "\n".join(self.texts())

    def fly(self) -> None:
        """Arm in offboard and climb off the ground."""
        self.run(0.6, 0.3)
        assert self.command(SET_MODE, *OFFBOARD) == ACCEPTED
        assert self.command(ARM, 1.0) == ACCEPTED
        self.run(1.2, 0.4)
        assert self.world.truth().p_WB[2] > 0.4


def of(messages: list[Any], name: str) -> list[Any]:
    return [m for m in messages if m.get_type() == name]
