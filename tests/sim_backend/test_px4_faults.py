"""Each fault of the stand-in as a plain client meets it, stepped by the test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import isnan

import pytest

from drivers.samples import FlightMode, Landed
from drivers.vehicle import Vehicle
from sim_backend.faults import Fault, Kind
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.world import World, WorldParams
from tests.sim_backend.noisy import NOISY
from tests.sim_backend.px4_client import ACCEPTED, ARM, INTERVAL, OFFBOARD, SET_MODE, Client, of

Make = Callable[..., Client]


@pytest.fixture
def make(vehicle: Vehicle) -> Iterator[Make]:
    clients: list[Client] = []

    def client(*faults: Fault) -> Client:
        world = World(vehicle, WorldParams(sensors=NOISY))
        made = Client(Px4StandIn(world, faults=faults))
        clients.append(made)
        made.run(0.02)
        assert made.command(INTERVAL, 31, 4000.0) == ACCEPTED
        assert made.command(INTERVAL, 105, 4000.0) == ACCEPTED
        return made

    yield client
    for made in clients:
        made.socket.close()
        made.stand_in.stop()


def inject(client: Client, kind: Kind, duration: float | None = None, value: float = 0.0, part: str = "") -> None:
    client.stand_in.faults.inject(client.world.time, kind, duration, value, part)


def test_drop(make: Make) -> None:
    client = make()
    inject(client, Kind.DROP, 2.0, 0.3)
    assert len(of(client.run(2.0), "ATTITUDE_QUATERNION")) == pytest.approx(350, abs=40)
    assert len(of(client.run(1.0), "ATTITUDE_QUATERNION")) == 250


def test_drop_strikes_acknowledgements_too(make: Make) -> None:
    client = make()
    inject(client, Kind.DROP, value=1.0)
    with pytest.raises(ValueError, match="not enough values"):
        client.command(INTERVAL, 31, 4000.0)


def test_delay(make: Make) -> None:
    """Everything comes later, in its order, and nothing is lost when the fault has passed."""
    client = make()
    inject(client, Kind.DELAY, 1.0, 0.2)
    assert not client.run(0.19)
    late = of(client.run(0.5), "ATTITUDE_QUATERNION")[-1]
    now = client.stand_in.streams.now_ns() * 1e-6
    assert now - late.time_boot_ms == pytest.approx(200, abs=6)
    times = [m.time_boot_ms for m in of(client.run(1.5), "ATTITUDE_QUATERNION")]
    assert times == sorted(times)
    assert times[-1] == pytest.approx(client.stand_in.streams.now_ns() * 1e-6, abs=5)


def test_corrupt(make: Make) -> None:
    """What is damaged fails its checksum; the rest is read, and no wrong number gets through."""
    client = make()
    inject(client, Kind.CORRUPT, 2.0, 0.3)
    client.parser.robust_parsing = True
    seen = client.run(2.0)
    good = of(seen, "ATTITUDE_QUATERNION")
    assert 150 < len(good) < 450
    assert of(seen, "BAD_DATA")
    assert all(abs(m.q1 - 0.5**0.5) < 0.02 for m in good)


def test_freeze(make: Make) -> None:
    """The same values with fresh times, while arming and mode are told as they are."""
    client = make()
    client.run(0.1)
    inject(client, Kind.FREEZE, 1.0)
    seen = client.run(0.9)
    for name, value, time in (("ATTITUDE_QUATERNION", "q2", "time_boot_ms"), ("HIGHRES_IMU", "zacc", "time_usec")):
        values = [getattr(m, value) for m in of(seen, name)]
        times = [getattr(m, time) for m in of(seen, name)]
        assert len(set(values)) == 1
        assert len(set(times)) == len(times) > 200
    after = of(client.run(0.5), "HIGHRES_IMU")[-50:]
    assert len({m.zacc for m in after}) == 50


@pytest.mark.parametrize(
    ("part", "attitude", "imu", "position"),
    [("", True, True, False), ("HIGHRES_IMU", False, True, False), ("LOCAL_POSITION_NED", False, False, True)],
)
def test_nan(make: Make, part: str, attitude: bool, imu: bool, position: bool) -> None:
    client = make()
    client.run(0.1)
    inject(client, Kind.NAN, part=part)
    seen = client.run(0.2)
    assert isnan(of(seen, "ATTITUDE_QUATERNION")[-1].q1) is attitude
    assert isnan(of(seen, "HIGHRES_IMU")[-1].zacc) is imu
    assert isnan(of(seen, "LOCAL_POSITION_NED")[-1].x) is position
    assert of(seen, "HIGHRES_IMU")[-1].time_usec > 0


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.UNPLUGGED])
def test_a_dead_link_trips_the_offboard_failsafe(make: Make, kind: Kind) -> None:
    """Dead both ways: nothing is told, set-points do not arrive, and PX4 lands; the client's stream is unbroken."""
    client = make()
    client.sees = True
    client.fly()
    inject(client, kind, 1.0)
    assert not client.run(0.45, 0.45)[3:]
    assert client.mode() is FlightMode.OFFBOARD
    client.run(0.1, 0.45)
    assert client.mode() is FlightMode.LAND
    seen = client.run(0.6, 0.45)
    assert of(seen, "ATTITUDE_QUATERNION")
    assert client.mode() is FlightMode.LAND


def test_unplugged_closes_the_port(make: Make) -> None:
    client = make()
    port = client.stand_in.port
    inject(client, Kind.UNPLUGGED, 0.1)
    client.run(0.02)
    client.socket.connect(("127.0.0.1", port))
    client.socket.send(b"x")
    with pytest.raises(ConnectionRefusedError):  # the answer to the one before
        client.socket.send(b"x")
    client.run(0.2)
    assert client.stand_in.port == port


def test_reboot_in_flight_loses_the_vehicle(make: Make) -> None:
    """Motors stop; when it is back it is disarmed, tells its default streams, and its time has begun anew."""
    client = make()
    client.fly()
    client.stand_in.parameters.set("EKF2_EV_CTRL", 7)
    inject(client, Kind.REBOOT, 1.5)
    assert not client.run(1.4, 0.45)[3:]
    truth = client.world.truth()
    assert sum(truth.rotor_thrust) < 0.1
    client.run(0.2)
    seen = client.run(2.0, 0.3)
    assert 95 <= len(of(seen, "ATTITUDE_QUATERNION")) <= 101
    assert of(seen, "ATTITUDE_QUATERNION")[-1].time_boot_ms == pytest.approx(2100, abs=60)
    assert not client.armed()
    assert client.mode() is FlightMode.HOLD
    assert client.landed() is Landed.ON_GROUND
    assert client.stand_in.parameters["EKF2_EV_CTRL"] == 7
    assert not client.stand_in.estimator.horizontal_valid(client.world.time)


def test_reboot_on_the_ground_is_survived(make: Make) -> None:
    client = make()
    inject(client, Kind.REBOOT, 1.0)
    client.run(1.1)
    client.fly()
    assert client.command(SET_MODE, *OFFBOARD) == ACCEPTED
    assert client.command(ARM, 1.0) == ACCEPTED


def test_declared_by_phase(make: Make) -> None:
    client = make(Fault("autopilot", Kind.SILENT, start=0.5, duration=0.5, phase="press"))
    assert client.run(1.0)
    client.stand_in.enter("press")
    assert len(of(client.run(0.5), "ATTITUDE_QUATERNION")) >= 124
    assert not client.run(0.49)[3:]
    client.stand_in.enter("press")
    assert len(of(client.run(0.5), "ATTITUDE_QUATERNION")) >= 100


def test_a_fault_it_cannot_show(vehicle: Vehicle) -> None:
    with pytest.raises(ValueError, match=r"fault jump of autopilot: autopilot can show corrupt, delay, drop, freeze"):
        Px4StandIn(World(vehicle), faults=[Fault("autopilot", Kind.JUMP)])
