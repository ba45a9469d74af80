"""PX4's position as the stand-in tells it: by vision, dead reckoned without, and which poses count."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot

import pytest
from pymavlink.dialects.v20 import common as mavlink

from drivers.samples import FlightMode, Vec3
from drivers.vehicle import Vehicle
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.world import World, WorldParams
from tests.sim_backend.noisy import NOISY
from tests.sim_backend.px4_client import ACCEPTED, LAND, SET_MODE, Client, of


@pytest.fixture
def client(vehicle: Vehicle) -> Iterator[Client]:
    """A vehicle whose IMU has noise and bias."""
    stand_in = Px4StandIn(World(vehicle, WorldParams(sensors=NOISY)))
    client = Client(stand_in)
    client.sees = True
    yield client
    client.socket.close()
    stand_in.stop()


def valid(client: Client) -> bool:
    return client.stand_in.estimator.horizontal_valid(client.world.time)


def test_follows_vision_in_flight(client: Client) -> None:
    client.fly()
    for _ in range(20):
        client.run(0.1, 0.45)
        assert hypot(*client.off()) < 0.05
    told = of(client.seen, "LOCAL_POSITION_NED")[-1]
    truth = client.world.truth()
    assert (told.y, told.x, -told.z) == pytest.approx(truth.p_WB, abs=0.1)
    assert (told.vy, told.vx, -told.vz) == pytest.approx(truth.v_WB, abs=0.15)


def test_velocity_is_learnt_from_positions_where_it_is_not_told(client: Client) -> None:
    client.velocity = False
    client.fly()
    client.run(2.0, 0.45)
    assert hypot(*client.off()) < 0.1


def test_dead_reckons_and_then_gives_up(client: Client) -> None:
    """Without vision the error grows, the position counts for EKF2_NOAID_TOUT, and height stays the barometer's."""
    client.fly()
    client.run(1.0, 0.45)
    client.sees = False
    client.run(4.8, 0.445)
    assert valid(client)
    drift = client.off()
    assert 0.01 < hypot(drift[0], drift[1]) < 5.0
    assert abs(drift[2]) < 0.15
    client.run(0.4, 0.445)
    assert not valid(client)
    assert client.command(SET_MODE, *LAND) == ACCEPTED  # always; what is flown is Descend
    client.run(0.1)
    assert client.texts()[-1] == "Failsafe activated"


def test_vision_that_comes_back_is_a_reset(client: Client) -> None:
    client.fly()
    client.sees = False
    client.run(2.0, 0.445)
    resets = client.stand_in.estimator.resets
    client.sees = True
    client.run(0.1, 0.445)
    assert client.stand_in.estimator.resets == resets + 1
    assert hypot(*client.off()) < 0.05


def test_a_new_reset_counter_is_taken_as_a_reset(client: Client) -> None:
    client.run(0.5)
    client.shift, client.counter = (2.0, 0.0, 0.3), 1
    client.run(0.1)
    assert client.off() == pytest.approx((2.0, 0.0, 0.3), abs=0.02)


def test_a_jump_without_one_is_refused_for_a_while(client: Client) -> None:
    client.run(0.5)
    client.shift = (2.0, 0.0, 0.0)
    client.run(4.5)
    assert hypot(*client.off()) < 0.1
    client.run(0.8)
    assert client.off() == pytest.approx((2.0, 0.0, 0.0), abs=0.02)


@pytest.mark.parametrize(
    ("control", "off"),
    [(15, (0.3, 0.0, 0.2)), (1, (0.3, 0.0, 0.0)), (2, (0.0, 0.0, 0.2)), (0, (0.0, 0.0, 0.0))],
)
def test_ev_ctrl_says_what_vision_gives(vehicle: Vehicle, control: int, off: Vec3) -> None:
    stand_in = Px4StandIn(World(vehicle), parameters={"EKF2_EV_CTRL": control})
    client = Client(stand_in)
    client.sees = True
    height = vehicle.base.gear_height
    client.shift = (0.3, 0.0, 0.2)
    try:
        client.run(1.0)
        believed = stand_in.estimator.p_WB
        assert believed[0] == pytest.approx(off[0], abs=0.01)
        assert believed[2] == pytest.approx(off[2] + height if control & 2 else 0.0, abs=0.02)
        assert valid(client) is bool(control & 1)
    finally:
        client.socket.close()
        stand_in.stop()


@pytest.mark.parametrize(
    ("quality", "frames"),
    [
        (0, Client.frames),
        (-1, Client.frames),
        (100, (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)),
        (100, (mavlink.MAV_FRAME_LOCAL_ENU, mavlink.MAV_FRAME_BODY_FRD)),
        (100, (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_LOCAL_FRD)),
    ],
)
def test_poor_poses_and_odd_frames_are_ignored(client: Client, quality: int, frames: tuple[int, int]) -> None:
    client.quality, client.frames = quality, frames
    client.run(0.5)
    assert client.stand_in.received["ODOMETRY"] > 10
    assert not valid(client)
    assert client.stand_in.vision is None


def test_its_own_landing_follows_its_estimate(vehicle: Vehicle) -> None:
    """Poses that creep away carry the vehicle along: PX4 holds still in the tracker's world, not in ours."""
    stand_in = Px4StandIn(World(vehicle))
    client = Client(stand_in)
    client.sees = True
    try:
        client.fly()
        client.run(1.0, 0.45)
        assert client.command(SET_MODE, *LAND) == ACCEPTED
        before = client.world.truth().p_WB
        for k in range(50):
            client.shift = (-0.01 * k, 0.0, 0.0)
            client.velocity = False
            client.run(0.02)
        assert client.mode() is FlightMode.LAND
        assert client.world.truth().p_WB[0] - before[0] > 0.1
    finally:
        client.socket.close()
        stand_in.stop()
