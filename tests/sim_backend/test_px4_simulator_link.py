"""The simulator of a real PX4, with a small client that speaks PX4's side of the link."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from math import inf, nan
from pathlib import Path
from socket import create_connection, socket
from threading import Thread
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import common as mavlink

from drivers.mailbox import Level
from drivers.protocols import DeviceError
from drivers.samples import FlightMode, Interface
from drivers.thrust import motor_signal, thrust_fraction
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.autopilot import SetPoint
from sim_backend.motors import rated_voltage
from sim_backend.px4_sensors import Px4SensorParams, Px4Sensors, pressure_at
from sim_backend.px4_simulator_link import LinkParams, Px4SimulatorLink, main
from sim_backend.sensors import SensorParams
from sim_backend.world import World, WorldParams
from tests.sim_backend.flying import mass_of
from tests.sim_backend.noisy import NOISY

ANY_PORT = "tcp://127.0.0.1:0"
ARMED, LOCKSTEP = 128, 1
LONG = 20.0  # s of real time, for what comes at once on an idle machine
PARAMS = LinkParams(patience=LONG)
IDLE = (0.0, 0.0, 0.0, 0.0)
Four = tuple[float, float, float, float]


class Client:
    """PX4's side: what it was sent, and answers. ``read`` and ``write`` are a socket's or a terminal's."""

    def __init__(self, read: Callable[[int], bytes], write: Callable[[bytes], Any]) -> None:
        self._read = read
        self.write = write
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parser = mavlink.MAVLink(None)
        self._unread: list[Any] = []
        self.sensors: list[Any] = []

    def next(self) -> Any:
        """The next HIL_SENSOR; it has been sent already."""
        while not self._unread:
            data = self._read(4096)
            if not data:
                raise EOFError
            self._unread += [m for m in self._parser.parse_buffer(data) or () if m.get_type() == "HIL_SENSOR"]
        self.sensors.append(self._unread.pop(0))
        return self.sensors[-1]

    def tell(self, controls: Four, armed: bool = True, time_us: int = 0, flags: int = LOCKSTEP) -> None:
        padded = [*controls, *(0.0,) * 12]
        mode = 1 | (ARMED if armed else 0)
        self.write(mavlink.MAVLink_hil_actuator_controls_message(time_us, padded, mode, flags).pack(self._mav))

    def answer(self, controls: Four = IDLE, armed: bool = True) -> Any:
        """Answer the next HIL_SENSOR, and give it back."""
        sensor = self.next()
        self.tell(controls, armed, sensor.time_usec)
        return sensor

    def keep_answering(self, controls: Four) -> None:
        """Until the other end is closed."""
        try:
            while True:
                self.answer(controls)
        except (OSError, EOFError):
            return


class Rig:
    """A world, its link, and a client on TCP."""

    def __init__(self, vehicle: Vehicle, params: LinkParams = PARAMS, url: str = ANY_PORT) -> None:
        self.world = World(vehicle)
        self.link = Px4SimulatorLink(self.world, url, params)
        self.told: list[tuple[Level, str]] = []
        self.sockets: list[socket] = []

    def connect(self) -> Client:
        port = int(self.link.where.rsplit(":", 1)[1])
        connection = create_connection(("127.0.0.1", port), timeout=LONG)
        self.sockets.append(connection)
        self.link.expect(LONG)
        return Client(connection.recv, connection.sendall)

    def turn(self) -> None:
        """What the pace does once a period."""
        self.link.receive()
        self.world.advance(self.link.period)
        self.link.publish()

    def take(self, heard: Callable[[], bool]) -> None:
        """Receive until what has been written has come through the kernel."""
        for _ in range(100_000):
            self.link.receive()
            if heard():
                return
        raise AssertionError("it never came")

    def texts(self) -> list[str]:
        self.told += [(notice.level, notice.text) for notice in self.link.notices()]
        return [text for _, text in self.told]

    def full(self) -> float:
        """Full thrust of a rotor at this voltage, N."""
        vehicle = self.world.vehicle
        return vehicle.rotors.max_thrust * (self.world.snapshot.x[at.VOLTAGE] / rated_voltage(vehicle.battery)) ** 2

    def hover(self, times: float = 1.0) -> float:
        """The control at which all motors carry so many times the weight."""
        vehicle = self.world.vehicle
        share = times * mass_of(vehicle) * vehicle.gravity / (4.0 * self.full())
        return motor_signal(share, vehicle.rotors.curve)

    def armed(self) -> bool:
        return self.world.snapshot.armed

    def close(self) -> None:
        self.link.close()
        for connection in self.sockets:
            connection.close()


@pytest.fixture
def rig(vehicle: Vehicle) -> Iterator[Rig]:
    rig = Rig(vehicle)
    yield rig
    rig.close()


def controls_heard(rig: Rig, count: int) -> Callable[[], bool]:
    return lambda: rig.link.received["HIL_ACTUATOR_CONTROLS"] >= count


# -- lockstep -------------------------------------------------------------------------------------------------------


def test_each_sensor_sample_is_answered_before_the_world_moves_on(rig: Rig) -> None:
    client = rig.connect()
    up = rig.hover(1.3)
    thread = Thread(target=client.keep_answering, args=((up, up, up, up),))
    thread.start()
    rig.turn()
    rig.take(lambda: rig.link.in_step)
    for step in range(250):
        rig.turn()
        # The world stands 4 ms after the answer that moved it, and has asked for the next.
        assert rig.link.received["HIL_ACTUATOR_CONTROLS"] == step + 1
    rig.link.close()
    thread.join(LONG)
    assert not thread.is_alive()
    assert rig.link.unanswered == 0
    assert [m.time_usec for m in client.sensors][:250] == [4000 * (k + 1) for k in range(250)]
    assert rig.armed()
    assert rig.world.snapshot.mode is FlightMode.OTHER
    assert rig.world.truth().p_WB[2] > rig.world.vehicle.base.gear_height + 0.2


def test_the_world_does_not_wait_before_the_first_answer(rig: Rig) -> None:
    """PX4 needs some simulated time until its controllers run."""
    client = rig.connect()
    for _ in range(50):
        rig.turn()
    assert not rig.link.in_step
    assert rig.world.time == pytest.approx(0.2)
    assert client.next().time_usec == 4000


def test_a_late_answer_is_waited_for_once_and_told(vehicle: Vehicle) -> None:
    rig = Rig(vehicle, LinkParams(patience=0.02))
    client = rig.connect()
    rig.turn()
    client.answer()
    rig.take(lambda: rig.link.in_step)
    for _ in range(5):
        rig.turn()
    assert rig.link.unanswered == 1
    assert not rig.link.in_step
    assert sum("has not answered" in text for text in rig.texts()) == 1
    # The answers to older samples do not bring the step back; that to the newest does.
    for count in range(2, 6):
        client.answer()
        rig.take(controls_heard(rig, count))
        assert not rig.link.in_step
    client.answer()
    rig.take(lambda: rig.link.in_step)
    rig.close()


def test_a_px4_without_lockstep_is_not_waited_for(rig: Rig) -> None:
    client = rig.connect()
    rig.turn()
    client.tell(IDLE, time_us=client.next().time_usec, flags=0)
    rig.take(controls_heard(rig, 1))
    for _ in range(10):
        rig.turn()
    assert rig.link.unanswered == 0


# -- what comes in --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("motor", "roll", "pitch", "yaw"),
    [(0, -1, -1, -1), (1, 1, 1, -1), (2, 1, -1, 1), (3, -1, 1, 1)],
    ids=["front right", "rear left", "front left", "rear right"],
)
def test_each_motor_turns_the_vehicle_its_way(rig: Rig, motor: int, roll: int, pitch: int, yaw: int) -> None:
    """In B: a left-hand motor rolls to the right, a rear one pitches the nose down; a clockwise rotor yaws left."""
    client, hover = rig.connect(), rig.hover()

    def rates_after(controls: list[float]) -> list[float]:
        client.tell((controls[0], controls[1], controls[2], controls[3]))
        rig.take(controls_heard(rig, rig.link.received["HIL_ACTUATOR_CONTROLS"] + 1))
        x = rig.world.plant.x
        x[at.POSITION + 2] = 20.0
        x[at.ATTITUDE : at.ATTITUDE + 4] = (1.0, 0.0, 0.0, 0.0)
        x[at.RATE : at.RATE + 3] = 0.0
        rig.world.advance(0.1)
        return rig.world.snapshot.x[at.RATE : at.RATE + 3]

    even = [hover] * 4
    rates_after(even)  # the rotors come up to speed
    rates_after(even)
    before = rates_after(even)
    after = rates_after([control + (0.05 if number == motor else 0.0) for number, control in enumerate(even)])
    change = [a - b for a, b in zip(after, before, strict=True)]
    assert [1 if c > 0 else -1 for c in change] == [roll, pitch, yaw]


def test_controls_become_thrust_by_curve_and_voltage(rig: Rig) -> None:
    client = rig.connect()
    client.tell((0.5, 2.0, -1.0, nan))
    rig.take(controls_heard(rig, 1))
    full = rig.full()
    rig.world.advance(0.001)
    thrust = rig.world.plant.u[at.U_ROTOR : at.U_ROTOR + 4].tolist()
    assert thrust == pytest.approx([full * thrust_fraction(0.5, rig.world.vehicle.rotors.curve), full, 0.0, 0.0])


def test_disarmed_motors_stand(rig: Rig) -> None:
    client = rig.connect()
    client.tell((0.5, 0.5, 0.5, 0.5), armed=False)
    rig.take(controls_heard(rig, 1))
    rig.world.advance(0.5)
    assert rig.world.plant.u[at.U_ROTOR : at.U_ROTOR + 4].tolist() == [0.0] * 4
    assert not rig.armed()


def test_the_newest_of_several_controls_counts(rig: Rig) -> None:
    client, full = rig.connect(), rig.full()
    for control in (0.1, 0.2, 0.3):
        client.tell((control, control, control, control))
    rig.take(controls_heard(rig, 3))
    rig.world.advance(0.001)
    want = full * thrust_fraction(0.3, rig.world.vehicle.rotors.curve)
    assert rig.world.plant.u[at.U_ROTOR] == pytest.approx(want, rel=1e-3)


def test_the_worlds_own_autopilot_is_not_in_charge(rig: Rig) -> None:
    autopilot = rig.world.autopilot
    autopilot.offer(rig.world.time, SetPoint(Interface.ATTITUDE, 50.0))
    rig.world.advance(1.0)
    assert not rig.armed()
    assert rig.world.plant.u[at.U_ROTOR : at.U_ROTOR + 4].tolist() == [0.0] * 4


# -- what goes wrong ------------------------------------------------------------------------------------------------


def test_silence_stops_the_motors_and_is_told_once(vehicle: Vehicle) -> None:
    rig = Rig(vehicle, LinkParams(patience=0.01, silence=0.2))
    client = rig.connect()
    rig.turn()
    client.tell((0.3, 0.3, 0.3, 0.3))
    rig.take(controls_heard(rig, 1))
    for _ in range(100):
        rig.turn()
    assert not rig.armed()
    assert rig.world.plant.u[at.U_ROTOR] == 0.0
    rig.texts()
    assert [level for level, text in rig.told if "no motor controls from PX4 for 0.2 s" in text] == [Level.ERROR]
    client.tell((0.3, 0.3, 0.3, 0.3))
    rig.take(controls_heard(rig, 2))
    rig.turn()
    assert rig.armed()
    assert sum("again" in text for text in rig.texts()) == 1
    rig.close()


def test_px4_may_go_and_come_back(rig: Rig) -> None:
    client = rig.connect()
    rig.turn()
    client.answer((0.3, 0.3, 0.3, 0.3))
    rig.take(lambda: rig.link.in_step)
    rig.sockets[0].close()
    rig.take(lambda: not rig.link.connected)
    assert not rig.link.in_step
    rig.turn()
    assert rig.world.plant.u[at.U_ROTOR] == 0.0
    assert not rig.armed()
    again = rig.connect()
    rig.turn()
    assert again.next().time_usec == rig.world.snapshot.t_ns // 1000
    again.tell((0.3, 0.3, 0.3, 0.3), time_us=again.sensors[-1].time_usec)
    rig.take(lambda: rig.link.in_step)
    texts = rig.texts()
    assert [sum(word in text for text in texts) for word in ("has come", "is gone", "flies")] == [2, 1, 2]


def test_a_px4_that_does_not_read_is_given_up(rig: Rig) -> None:
    """Its buffers fill, and the world must not stand still for it."""
    rig.connect()
    rig.turn()
    while rig.link.sent["HIL_SENSOR"] < 1_000_000 and not any("does not read" in text for text in rig.texts()):
        rig.link.publish()
    assert any("does not read" in text for text in rig.texts())


def test_nonsense_is_told_once_and_read_over(rig: Rig) -> None:
    client = rig.connect()
    client.write(random.Random(1).randbytes(2000).replace(b"\xfd", b"\x00").replace(b"\xfe", b"\x00"))
    client.tell((0.2, 0.2, 0.2, 0.2))
    rig.take(controls_heard(rig, 1))
    rig.texts()
    told = [(level, text) for level, text in rig.told if "no MAVLink" in text]
    assert [level for level, _ in told] == [Level.ERROR]
    assert "baud rate" in told[0][1]


def test_other_messages_and_strange_times_do_no_harm(rig: Rig) -> None:
    client = rig.connect()
    rig.turn()
    client.write(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(client._mav))
    client.tell(IDLE, time_us=2**63)
    rig.take(controls_heard(rig, 1))
    assert rig.link.received["HEARTBEAT"] == 1
    assert not rig.link.in_step


def test_a_taken_port_is_told(rig: Rig) -> None:
    port = int(rig.link.where.rsplit(":", 1)[1])
    with pytest.raises(DeviceError, match=rf"cannot listen on TCP 127\.0\.0\.1:{port} .*another simulator"):
        Px4SimulatorLink(World(rig.world.vehicle), f"tcp://127.0.0.1:{port}")


@pytest.mark.parametrize("url", ["", "tcp://127.0.0.1", "udp://127.0.0.1:4560", "serial:///dev/ttyACM0", "4560"])
def test_a_wrong_url_is_told_with_a_right_one(vehicle: Vehicle, url: str) -> None:
    with pytest.raises(DeviceError, match=r"tcp://127\.0\.0\.1:4560.*serial:///dev/ttyACM0:921600"):
        Px4SimulatorLink(World(vehicle), url)


def test_a_missing_serial_port_is_told(vehicle: Vehicle, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"cannot open .*none at 921600 baud"):
        Px4SimulatorLink(World(vehicle), f"serial://{tmp_path}/none:921600")


def test_no_px4_is_told(vehicle: Vehicle, rig: Rig) -> None:
    with pytest.raises(DeviceError, match="no PX4 has come to TCP"):
        rig.link.expect(0.02)


# -- sensors --------------------------------------------------------------------------------------------------------


#: Thrust of one rotor in hover, N.
HOVER = 5.9


def settled(vehicle: Vehicle, seed: int = 0, ideal: bool = True) -> World:
    world = World(vehicle, WorldParams(sensors=SensorParams() if ideal else NOISY), seed=seed)
    world.advance(0.1)
    return world


def test_sensors_of_a_vehicle_at_rest(vehicle: Vehicle) -> None:
    """It stands level and looks east, so that north is on its left. Compass and barometer are never without noise."""
    world = settled(vehicle)
    (m,) = Px4Sensors(SensorParams(), HOVER).measure(world.snapshot)
    assert (m.xacc, m.yacc, m.zacc) == pytest.approx((0.0, 0.0, -vehicle.gravity), abs=0.02)
    assert (m.xgyro, m.ygyro, m.zgyro) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert (m.xmag, m.ymag, m.zmag) == pytest.approx((0.0, -0.215, 0.427), abs=0.01)
    assert m.abs_pressure == pytest.approx(pressure_at(488.0 + world.truth().p_WB[2]), abs=0.1)
    assert m.time_usec == 100_000
    assert m.id == 0


def test_pressure_is_the_standard_atmospheres() -> None:
    assert pressure_at(0.0) == pytest.approx(1013.25)
    assert pressure_at(1000.0) == pytest.approx(898.76, abs=0.05)
    assert pressure_at(0.0) - pressure_at(1.0) == pytest.approx(0.12, abs=0.001)


def test_fields_come_at_their_own_rates(vehicle: Vehicle) -> None:
    world, sensors = settled(vehicle), Px4Sensors(SensorParams(), HOVER, gps=True)
    seen = [sensors.measure(world.snapshot) for _ in range(150)]
    fields = [batch[0].fields_updated for batch in seen]
    assert all(field & 0x3F == 0x3F for field in fields)
    assert [sum(field & bits == bits for field in fields) for bits in (0x1C0, 0x1A00)] == [50, 30]
    assert sum(len(batch) == 2 for batch in seen) == 3


def test_noise_is_that_of_the_world_and_follows_the_seed(vehicle: Vehicle) -> None:
    world = settled(vehicle, ideal=False)
    inertial = world.params.sensors

    def series(seed: int) -> list[float]:
        sensors = Px4Sensors(inertial, HOVER, seed=seed)
        return [sensors.measure(world.snapshot)[0].yacc for _ in range(1000)]

    first = series(3)
    assert first == series(3)
    assert first != series(4)
    mean = sum(first) / 1000
    spread = (sum((value - mean) ** 2 for value in first) / 1000) ** 0.5
    assert spread == pytest.approx(inertial.autopilot.accelerometer_noise, rel=0.1)


def test_gps_tells_north_as_plus_y(vehicle: Vehicle) -> None:
    world = settled(vehicle)
    place = Px4SensorParams(gps_noise=0.0, gps_velocity_noise=0.0)
    snapshot = world.snapshot
    moved = list(snapshot.x)
    moved[at.POSITION : at.POSITION + 3] = (30.0, 100.0, 7.0)
    moved[at.VELOCITY : at.VELOCITY + 3] = (1.0, 2.0, 3.0)
    m = Px4Sensors(SensorParams(), HOVER, place, gps=True).measure(snapshot._replace(x=moved))[1]
    assert m.lat / 1e7 - place.latitude == pytest.approx(100.0 / 111_319.5, rel=1e-3)
    assert m.lon / 1e7 - place.longitude == pytest.approx(30.0 / 75_360.0, rel=1e-2)
    assert m.alt == 495_000
    assert (m.vn, m.ve, m.vd) == (200, 100, -300)
    assert m.fix_type == 3


# -- serial ---------------------------------------------------------------------------------------------------------


class Board:
    """A board on a pseudo-terminal, at ``path``."""

    def __init__(self, path: Path) -> None:
        self._master, self._slave = os.openpty()
        os.set_blocking(self._master, True)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._slave))
        self.client = Client(lambda size: os.read(self._master, size), lambda data: os.write(self._master, data))

    def unplug(self) -> None:
        os.close(self._slave)
        os.close(self._master)


def test_a_board_on_a_serial_port(vehicle: Vehicle, tmp_path: Path) -> None:
    path = tmp_path / "board"
    board = Board(path)
    rig = Rig(vehicle, url=f"serial://{path}:921600")
    rig.turn()
    assert board.client.next().time_usec == 4000
    full = rig.full()
    for control in (0.1, 0.4):
        board.client.tell((control,) * 4, flags=0)
    rig.take(controls_heard(rig, 2))
    for _ in range(20):
        rig.turn()  # nobody is waited for
    assert rig.link.unanswered == 0
    want = full * thrust_fraction(0.4, vehicle.rotors.curve)
    assert rig.world.plant.u[at.U_ROTOR] == pytest.approx(want, rel=1e-2)

    board.unplug()
    rig.take(lambda: not rig.link.connected)
    rig.world.advance(0.004)
    assert rig.world.plant.u[at.U_ROTOR] == 0.0
    again = Board(path)
    rig.link.expect(LONG)
    again.client.tell((0.4,) * 4, flags=0)
    rig.take(controls_heard(rig, 3))
    texts = rig.texts()
    assert [sum(word in text for text in texts) for word in ("is gone", "has come", "flies")] == [1, 1, 2]
    rig.close()
    again.unplug()


def test_a_silent_board_is_told_with_the_reason(vehicle: Vehicle, tmp_path: Path) -> None:
    board = Board(tmp_path / "board")
    rig = Rig(vehicle, LinkParams(start_patience=1.0), url=f"serial://{tmp_path}/board:921600")
    rig.link._awaited = -inf  # long ago
    rig.turn()
    rig.turn()
    assert sum("SYS_HITL = 1" in text for text in rig.texts()) == 1
    rig.close()
    board.unplug()


# -- alone ----------------------------------------------------------------------------------------------------------


def test_alone_without_px4(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--url", ANY_PORT, "--wait", "0.02"]) == 2
    out, err = capsys.readouterr()
    assert out.startswith("TCP 127.0.0.1:")
    assert "no PX4 has come" in err


@pytest.mark.parametrize(
    ("arguments", "word"), [(["--url", "nowhere"], "tcp://"), (["--vehicle", "/none.yaml"], "not a vehicle file")]
)
def test_alone_with_a_wrong_argument(capsys: pytest.CaptureFixture[str], arguments: list[str], word: str) -> None:
    assert main(arguments) == 2
    assert word in capsys.readouterr().err


def test_alone_until_interrupted() -> None:
    command = [sys.executable, "-m", "sim_backend.px4_simulator_link", "--url", ANY_PORT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline().rsplit(":", 1)[1])
        with create_connection(("127.0.0.1", port), timeout=60.0) as connection:
            client = Client(connection.recv, connection.sendall)
            for _ in range(100):
                client.answer(armed=False)
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60.0)
    assert process.returncode == 0
    assert "PX4 flies in this world" in err


def test_bounds_of_the_parameters() -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"patience": 0.0}, LinkParams)
