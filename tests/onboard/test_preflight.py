"""A vehicle that is well has ticks only; each thing that is wrong makes its own cross, with its remedy."""

from __future__ import annotations

import re
from math import nan
from typing import Any

import pytest
from msgspec.structs import replace

from drivers.samples import Landed, Quat
from onboard import preflight
from onboard.agreement import Agreement
from onboard.config import Config, load_config
from onboard.core.derived import check_mission
from onboard.core.types import Action, LinkState, Phase, Tick, Verdict
from onboard.device_config import Kind
from onboard.devices import FlightDevices
from onboard.preflight import Known, Late, Lateness, checks
from onboard.wire import Check
from tests.synthetic import change_outputs, mission

ENDPOINTS = ["devices.world=127.0.0.1:1", "devices.autopilot.url=udp://:1", "devices.servos.port=x"]
CONFIG = load_config("desk", sets=ENDPOINTS)
TICK = next(tick for tick, _ in mission())
STATISTICS = {
    "autopilot.ATTITUDE_QUATERNION.rate": 251.0,
    "autopilot.HIGHRES_IMU.rate": 249.0,
    "odometry.POSE.rate": 200.0,
    "servos.rate": 248.0,
}


def known(**changes: Any) -> Known:
    told = {
        "config": CONFIG,
        "t_ns": TICK.inputs.t_ns + 20_000_000,
        "tick": TICK,
        "statistics": STATISTICS,
        "late": Late(0.001, 0.004),
        "link": LinkState("ann", TICK.inputs.t_ns - 100_000_000, True),
        "free": 20_000_000_000,
    }
    return Known(**{**told, **changes})


def with_inputs(**changes: Any) -> Tick:
    return replace(TICK, inputs=replace(TICK.inputs, **changes))


def with_sample(device: str, **changes: Any) -> Tick:
    return with_inputs(**{device: replace(getattr(TICK.inputs, device), **changes)})


def with_config(*sets: str) -> Config:
    return load_config("desk", sets=["devices.world=127.0.0.1:1", *sets])


def crosses(of: Known) -> dict[str, Check]:
    return {row.name: row for row in checks(of) if not row.ok}


def test_a_vehicle_that_is_well() -> None:
    rows = checks(known())
    assert [row for row in rows if not row.ok] == []
    assert not any(row.remedy for row in rows)
    assert [row.name for row in rows] == [
        "autopilot", "odometry", "servos", "rates", "PX4 parameters", "vision", "battery", "servo supply",
        "servo health", "loop", "disk", "recorder", "link", "geofence", "mission", "on the ground", "arming", "safety",
    ]  # fmt: skip
    told = {row.name: row.text for row in rows}
    assert told["rates"] == "attitude 251 of 250 Hz, IMU 249 of 250 Hz, poses 200 of 200 Hz, servos 248 of 250 Hz"
    assert told["link"] == "ann commands, heard 0.1 s ago"
    assert told["geofence"].startswith("the vehicle and 6 places")


def test_before_the_first_tick_nothing_passes_unseen() -> None:
    names = [row.name for row in checks(known())]
    before = known(tick=None, late=None, statistics={})
    assert [row.name for row in checks(before)] == names
    assert {row.name for row in checks(before) if row.ok} == {
        "PX4 parameters", "disk", "recorder", "link", "mission", "arming"
    }  # fmt: skip


LEANING: Quat = (0.995, 0.0998, 0.0, 0.0)
TURNED: Quat = (0.9239, 0.0, 0.0, 0.3827)


@pytest.mark.parametrize(
    ("changes", "row", "text", "remedy"),
    [
        ({"tick": with_sample("autopilot", t_ns=-400_000_000)}, "autopilot", "400 ms old", "baud rate"),
        ({"tick": with_sample("servos", t_ns=10**9)}, "servos", "-1000 ms old", "adapter"),
        ({"statistics": STATISTICS | {"servos.rate": 60.0}}, "rates", "servos 60 of 250 Hz", "slow: servos. .*latency"),
        ({"statistics": {}}, "rates", "attitude 0 of 250 Hz", "MAV_1_RATE"),
        ({"tick": with_sample("odometry", confidence=1)}, "vision", "confidence 1 of 3", "texture"),
        ({"tick": with_sample("odometry", q_WB=LEANING)}, "vision", "vertical is 1[0-9]", "calibrate mount"),
        ({"tick": with_sample("odometry", q_WB=TURNED)}, "vision", r"heading 2\d\.\d deg off", "EKF2_EV_CTRL"),
        ({"tick": with_sample("autopilot", battery_voltage=13.9)}, "battery", "13.9 V", "14 V and 25%"),
        ({"tick": with_sample("autopilot", battery_remaining=nan)}, "battery", "nan%", "charge it"),
        ({"tick": with_sample("servos", voltage=(5.0, 5.0, 5.0, 3.9, 5.0))}, "servo supply", "3.9 to 5.0", "converter"),
        ({"tick": with_sample("servos", error=(0, 32, 0, 0, 0))}, "servo health", "theta_2: overload", "off and on"),
        ({"tick": with_sample("servos", error=(0, 0, 0, 128, 0))}, "servo health", "pump: no answer", "cause"),
        ({"tick": with_sample("servos", temperature=(30.0, 66.0, 0.0, 0.0, 0.0))}, "servo health", "66 degC", "cool"),
        ({"tick": with_sample("servos", current=(0.0, 0.0, -1.5, 0.0, 0.0))}, "servo health", "theta_3: 1.50", "free"),
        ({"late": Late(0.012, 0.3)}, "loop", "12.0 ms late, the worst 300", "top -H"),
        ({"free": 400_000_000}, "disk", "0.4 GB free", "log fetch"),
        ({"free": None}, "disk", "does not tell", "folder of the runs"),
        ({"log_error": "No space left on device"}, "recorder", "No space left", "Make room"),
        ({"log_dropped": 12}, "recorder", "12 records", "faster"),
        ({"link": LinkState("ann", 0, False)}, "link", "ann commands, has gone", "--seize"),
        (
            {"tick": change_outputs(TICK, estimate=replace(TICK.outputs.estimate, p_WB=(11.0, 0.0, 0.24)))},
            "geofence", r"the vehicle at \(11.0, 0.0, 0.2\) m is outside", "widen",
        ),
        (
            {"tick": change_outputs(TICK, estimate=replace(TICK.outputs.estimate, p_WB=(0.0, 0.0, 5.5)))},
            "geofence", r"takeoff at \(0.0, 0.0, 6.5\) m is outside", "Place the vehicle nearer",
        ),
        (
            {"tick": change_outputs(TICK, estimate=replace(TICK.outputs.estimate, p_WB=(1.4, 0.1, 0.24)))},
            "mission", "0.60 m beside the pipe", "0.85 m",
        ),
        ({"tick": change_outputs(TICK, phase=Phase.STOPPED)}, "on the ground", "phase stopped", "pipewright reset"),
        ({"tick": change_outputs(TICK, phase=Phase.HOLD)}, "on the ground", "phase hold", "Land first"),
        ({"tick": with_sample("autopilot", armed=True)}, "on the ground", "armed", "Disarm"),
        ({"tick": with_sample("autopilot", landed=Landed.IN_AIR)}, "on the ground", "in air", "still"),
        ({"tick": with_inputs(obstacles=("The autopilot is real, but servos is mock.",))}, "arming", "servos", "Bring"),
        (
            {"tick": change_outputs(TICK, verdict=Verdict(Action.WARN, ("servo_hot", "tick_late")))},
            "safety", r"servo_hot \(hottest servo above 68 degC\); tick_late", "events. Then: pipewright reset",
        ),
    ],
)  # fmt: skip
def test_each_trouble_has_its_cross(changes: dict[str, Any], row: str, text: str, remedy: str) -> None:
    found = crosses(known(**changes))
    assert list(found) == [row]
    assert re.search(text, found[row].text)
    assert re.search(remedy, found[row].remedy)


def test_a_device_that_has_told_nothing() -> None:
    found = crosses(known(tick=with_inputs(odometry=None)))
    assert set(found) == {"odometry", "vision"}
    assert found["odometry"].text == "emulated: has told nothing yet"
    assert "USB cable" in found["odometry"].remedy


def test_a_loop_that_hangs() -> None:
    found = crosses(known(t_ns=TICK.inputs.t_ns + 3 * 10**9, link=None))
    assert found == {
        "loop": Check("loop", False, "has made no tick for 3.0 s", "It hangs. Restart the flight process.")
    }


def test_a_commander_that_is_silent_and_nobody_who_commands() -> None:
    silent = known(link=LinkState("ann", TICK.inputs.t_ns - 5 * 10**9, True))
    assert crosses(silent)["link"].text == "ann commands, heard 5.0 s ago"
    assert not crosses(known(link=LinkState()))
    assert not crosses(known(link=None))


def test_what_the_devices_say_against_arming_has_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """The very sentences of the devices: nothing of them may land in a row that says something else."""
    devices = FlightDevices(load_config("jetson"))
    px4 = devices._px4
    assert px4 is not None
    monkeypatch.setattr(px4, "parameter_differences", lambda: ("EKF2_EV_CTRL is 0, wants 15",))
    apart = Agreement(0.3)
    apart.judge(0, 0.5)
    assert apart.judge(1_000_000_000, 0.5) is not None
    monkeypatch.setattr(devices, "_agreement", apart)
    found = crosses(known(tick=with_inputs(obstacles=devices.obstacles())))
    assert set(found) == {"PX4 parameters", "vision"}
    assert "EKF2_EV_CTRL is 0, wants 15" in found["PX4 parameters"].text
    assert "x500.params" in found["PX4 parameters"].remedy
    assert "0.50 m" in found["vision"].text


def test_a_real_autopilot_that_is_compared_with_nothing() -> None:
    config = load_config("jetson", sets=["devices.autopilot.parameters=''"])
    assert crosses(known(config=config))["PX4 parameters"].remedy.endswith("x500.params")


def test_mock_devices_have_no_rates() -> None:
    kinds = [f"devices.{name}.kind=mock" for name in CONFIG.devices.kinds()]
    config = with_config(*kinds)
    assert set(config.devices.kinds().values()) == {Kind.MOCK}
    assert not crosses(known(config=config, statistics={}))


@pytest.mark.parametrize(
    ("key", "text"),
    [("pipe.position=[30, 0, 1.5]", "outside of the fence"), ("pipe.position=[2, 0, 0.3]", "no room")],
)
def test_a_mission_that_cannot_be_flown(key: str, text: str) -> None:
    found = crosses(known(config=with_config(key)))
    assert list(found) == ["mission"]
    assert text in found["mission"].text
    assert "params set" in found["mission"].remedy


def test_the_mission_is_surveyed_once_for_a_set(monkeypatch: pytest.MonkeyPatch) -> None:
    surveys: list[Config] = []

    def counted(config: Config) -> Any:
        surveys.append(config)
        return check_mission(config)

    monkeypatch.setattr(preflight, "check_mission", counted)
    one, other = with_config(), with_config("repair.force=3")
    for config in (one, one, other, other):
        assert not crosses(known(config=config))
    assert surveys == [one, other]


def test_the_newest_lateness_counts() -> None:
    lateness = Lateness(100)
    assert lateness.newest() is None
    for late in (0.5, *(1e-3 * k for k in range(100))):
        lateness.add(late)
    newest = lateness.newest()
    assert newest is not None
    assert (newest.p99, newest.max) == pytest.approx((0.098, 0.099))
