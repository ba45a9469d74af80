"""What the PX4 driver makes of each fault of the stand-in: it survives, tells it once, and goes on when it is over."""

from __future__ import annotations

from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path
from time import monotonic_ns

import pytest
import pytest_asyncio
from pymavlink.dialects.v20 import common as mavlink

from drivers.mailbox import Level
from drivers.protocols import DeviceError
from drivers.px4 import Px4
from drivers.samples import Engage, FlightMode, Odometry
from sim_backend.faults import Kind
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.px4_parameters import FILE
from tests.drivers.px4_rig import LEVEL, STILL, command, linked, stand_in, until

pytestmark = pytest.mark.asyncio

Told = list[tuple[Level, str]]


class Rig:
    """A driver on a stand-in, and everything it has told."""

    def __init__(self, px4: Px4, far: Px4StandIn) -> None:
        self.px4 = px4
        self.far = far
        self.told: Told = []

    def listen(self) -> None:
        self.told += [(n.level, n.text) for n in self.px4.notices()]

    def fly(self) -> None:
        self.px4.command(command())
        self.listen()

    def inject(self, kind: Kind, duration: float | None = None, value: float = 0.0, part: str = "") -> None:
        self.far.faults.inject(self.far.world.time, kind, duration, value, part)

    def said(self, words: str) -> int:
        return sum(words in text for _, text in self.told)

    def state(self) -> tuple[bool, FlightMode]:
        latest = self.px4.latest()
        assert latest is not None
        return latest.armed, latest.mode

    def rate(self) -> float:
        return self.px4.counts()["ATTITUDE_QUATERNION"].rate


@pytest_asyncio.fixture
async def rig() -> AsyncIterator[Rig]:
    async with linked(stand_in()) as (px4, far):
        rig = Rig(px4, far)
        await until(lambda: rig.rate() > 200.0, rig.listen)
        yield rig


@pytest.mark.parametrize("kind", [Kind.SILENT, Kind.UNPLUGGED])
async def test_a_link_that_is_lost_comes_back(rig: Rig, kind: Kind) -> None:
    """In flight: PX4 lands meanwhile; the loss and the return are told once, and the rates are as before."""
    rig.far.parameters.set("COM_DISARM_LAND", 9.0)
    await until(lambda: rig.state() == (True, FlightMode.OFFBOARD), rig.fly)
    before = rig.px4.latest()
    rig.inject(kind, 6.0)
    await until(lambda: rig.said("the link to PX4 is lost: nothing comes any more") == 1, rig.fly)
    await until(lambda: rig.far.commander.mode is FlightMode.LAND, rig.fly)
    stale = rig.px4.latest()
    assert before is not None
    assert stale is not None
    await until(lambda: rig.said("the link to PX4 is back") == 1, rig.fly)
    await until(lambda: rig.rate() > 200.0, rig.fly)
    fresh = rig.px4.latest()
    assert fresh is not None
    assert fresh.t_ns > stale.t_ns
    await until(lambda: rig.said("PX4 has left offboard by itself") == 1, rig.fly)
    assert rig.said("is lost") == rig.said("is back") == 1


@pytest.mark.parametrize("duration", [0.2, 3.0])
async def test_a_reboot_is_told_and_asked_anew(rig: Rig, duration: float) -> None:
    """Too short for the link to be missed, or not: the time that begins anew tells it; rates are asked for again."""
    first = rig.far.streams
    rig.inject(Kind.REBOOT, duration)
    await until(lambda: rig.said("PX4 has rebooted: its time began anew") == 1, rig.listen)
    await until(lambda: rig.far.streams is not first and rig.far.streams.intervals[31] < 0.005, rig.listen)
    await until(lambda: rig.rate() > 200.0, rig.listen)
    assert rig.said("has rebooted") == 1
    assert (rig.said("is lost") > 0) is (duration > 1.0)
    # and it can be flown
    await until(lambda: rig.state() == (True, FlightMode.OFFBOARD), rig.fly)


async def test_a_reboot_in_flight(rig: Rig) -> None:
    """It comes back disarmed: told, and not armed again by itself."""
    await until(lambda: rig.state() == (True, FlightMode.OFFBOARD), rig.fly)
    rig.inject(Kind.REBOOT, 1.0)
    await until(lambda: rig.said("has rebooted") == 1, rig.fly)
    await until(lambda: rig.said("PX4 has left offboard by itself (disarmed, mode hold)") == 1, rig.fly)
    sent = rig.px4.sent()
    await until(lambda: rig.px4.sent() > sent + 500, rig.fly)
    assert not rig.far.commander.armed
    rig.px4.command(command(Engage.IDLE))
    await until(lambda: rig.state() == (True, FlightMode.OFFBOARD), rig.fly)


async def test_dropped_packets(rig: Rig) -> None:
    """Fewer samples, told as a rate that has fallen; commands get through by asking again."""
    rig.inject(Kind.DROP, value=0.4)
    await until(lambda: rig.said("ATTITUDE_QUATERNION comes at") == 1, rig.listen)
    await until(lambda: rig.state() == (True, FlightMode.OFFBOARD), rig.fly)


async def test_damaged_packets(rig: Rig) -> None:
    """No wrong number gets through the checksum."""
    rig.inject(Kind.CORRUPT, value=0.3)
    seen = 0

    def look() -> None:
        nonlocal seen
        latest = rig.px4.latest()
        assert latest is not None
        assert latest.q_WB == pytest.approx(LEVEL, abs=1e-3)
        assert latest.f_B == pytest.approx((0.0, 0.0, 9.80665), abs=0.05)
        seen += 1

    await until(lambda: seen > 500 and rig.rate() < 230.0, look)


async def test_late_packets(rig: Rig) -> None:
    """What they say is as old as the delay, and so are the samples; told once, as is the end."""
    rig.inject(Kind.DELAY, value=0.3)
    await until(lambda: rig.said("PX4's answers take 3") == 1, rig.fly)
    await until(lambda: rig.state() == (True, FlightMode.OFFBOARD), rig.fly)
    latest = rig.px4.latest()
    assert latest is not None
    assert monotonic_ns() - latest.t_ns > 0.25e9
    assert rig.said("is lost") == 0
    rig.far.faults.clear()
    await until(lambda: rig.said("PX4 answers in time again") == 1, rig.fly)
    assert rig.said("answers take") == 1


@pytest.mark.parametrize("part", ["ATTITUDE_QUATERNION", "HIGHRES_IMU", "LOCAL_POSITION_NED"])
async def test_numbers_that_are_not_finite_are_counted_and_left_out(rig: Rig, part: str) -> None:
    await until(lambda: rig.px4.motion() is not None)
    rig.inject(Kind.NAN, 1.0, part=part)
    await until(lambda: rig.px4.counts()[part].rejected > 10, rig.listen)
    await until(lambda: rig.said(f"{part} holds numbers that are not finite and is not used") == 1, rig.listen)
    latest, motion = rig.px4.latest(), rig.px4.motion()
    assert latest is not None
    assert motion is not None
    assert latest.q_WB == pytest.approx(LEVEL, abs=1e-3)
    assert latest.f_B[2] == pytest.approx(9.8, abs=0.1)
    assert motion.p_WB == pytest.approx(STILL, abs=0.01)
    rejected = rig.px4.counts()[part].rejected
    await until(lambda: rig.far.faults.find(Kind.NAN, rig.far.world.time) is None)
    received = rig.px4.counts()[part].received
    await until(lambda: rig.px4.counts()[part].received > received + 10)
    assert rig.px4.counts()[part].rejected < rejected + 300
    await until(lambda: rig.said("what PX4 measures is usable again") == 1, rig.listen)
    assert rig.said("not finite") == 1


async def test_an_attitude_that_freezes_in_the_air_grows_old(rig: Rig) -> None:
    rig.far.streams.makers[245] = lambda: mavlink.MAVLink_extended_sys_state_message(0, 2)  # in the air
    states = []

    def look() -> None:
        rig.listen()
        states.append(rig.px4.latest())

    rig.inject(Kind.FREEZE, 2.0)
    await until(lambda: rig.said("PX4 tells the same attitude over and over") == 1, look)
    await until(lambda: rig.said("PX4's attitude moves again") == 1, look)
    assert rig.said("over and over") == 1
    times = [state.t_ns for state in states if state is not None]
    assert max(b - a for a, b in pairwise(times)) > 1e9


async def test_frozen_values_on_the_ground_look_fresh(rig: Rig) -> None:
    """There, a vehicle may well stand still to the bit."""
    rig.inject(Kind.FREEZE)
    states = []

    def look() -> None:
        states.append(rig.px4.latest())

    await until(lambda: len({state.t_ns for state in states[100:] if state is not None}) > 20, look)
    assert len({state.q_WB for state in states[100:] if state is not None}) == 1


# -- parameters ---------------------------------------------------------------------------------------------------


async def test_the_parameters_agree() -> None:
    async with linked(stand_in(), parameters=str(FILE)) as (px4, _):
        assert px4.parameter_differences() == ()
        assert any("PX4 holds the 66 parameters of" in n.text for n in px4.notices())


async def test_differences_are_told_and_read_again() -> None:
    far = stand_in(parameters={"EKF2_EV_CTRL": 0, "COM_OBL_RC_ACT": -1, "THR_MDL_FAC": 0.0})
    far.parameters.drop("MPC_USE_HTE")
    want = {
        "EKF2_EV_CTRL is 0, wants 15",
        "COM_OBL_RC_ACT is -1, wants 4",
        "THR_MDL_FAC is 0, wants 0.3",
        "MPC_USE_HTE: PX4 does not tell it, wants 0; is there such a parameter in its version?",
    }
    async with linked(far, parameters=str(FILE)) as (px4, _):
        assert set(px4.parameter_differences()) == want
        errors = [n.text for n in px4.notices() if n.level is Level.ERROR]
        assert len(errors) == 1
        assert "x500.params in 4 of 66 parameters: " in errors[0]
        assert all(words in errors[0] for words in want)
        far.parameters.set("EKF2_EV_CTRL", 15)
        px4.read_parameters()
        await until(lambda: set(px4.parameter_differences()) == want - {"EKF2_EV_CTRL is 0, wants 15"})


async def test_parameters_are_read_through_a_bad_link() -> None:
    far = stand_in()
    far.faults.inject(0.0, Kind.DROP, value=0.3)
    async with linked(far, parameters=str(FILE)) as (px4, _):
        assert px4.parameter_differences() == ()


async def test_parameters_are_read_again_after_a_reboot() -> None:
    async with linked(stand_in(), parameters=str(FILE)) as (px4, far):
        rig = Rig(px4, far)
        await until(lambda: rig.rate() > 200.0)
        far.parameters.set("EKF2_HGT_REF", 1)
        rig.inject(Kind.REBOOT, 1.0)
        await until(lambda: px4.parameter_differences() == ("EKF2_HGT_REF is 1, wants 3",))


async def test_a_parameter_file_with_errors(tmp_path: Path) -> None:
    bad = tmp_path / "bad.params"
    bad.write_text("1\t1\tEKF2_EV_CTRL\tmany\t6\n1\t1\tCOM_OF_LOSS_T\n")
    with pytest.raises(DeviceError, match=r"bad\.params: line 1: .*\n.*bad\.params: line 2: 3 columns"):
        async with linked(stand_in(), parameters=str(bad)):
            pass


# -- PX4's own position -------------------------------------------------------------------------------------------


async def test_vision_disagreement(rig: Rig) -> None:
    """The stand-in on the ground believes in its origin until it has seen a pose."""

    def pose(x: float) -> Odometry:
        motion = rig.px4.motion()
        assert motion is not None
        return Odometry(motion.t_ns, (x, 0.0, 0.0), LEVEL, STILL, 3)

    await until(lambda: rig.px4.motion() is not None)
    assert rig.px4.vision_disagreement(pose(0.0)) == pytest.approx(0.0, abs=0.01)
    assert rig.px4.vision_disagreement(pose(0.3)) == pytest.approx(0.3, abs=0.01)
    old = pose(0.0)
    rig.inject(Kind.SILENT, 1.0)
    await until(lambda: rig.px4.vision_disagreement(old) is None)
    await until(lambda: rig.px4.vision_disagreement(old) is not None)
