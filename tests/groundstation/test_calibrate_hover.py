"""The thrust map from the log of a flight whose true map is known."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import yaml
from msgspec.structs import replace

from drivers.samples import AutopilotCommand, AutopilotState, FlightMode, Interface
from drivers.thrust import ThrustMap
from groundstation import calibrate
from groundstation.calibrate_hover import read
from groundstation.calibration import CalibrationError
from onboard.config import Config, load_config
from onboard.core.types import Phase, Tick
from onboard.messages import LogError
from onboard.recorder import Recorder
from onboard.records import RunInfo
from tests.synthetic import mission, record

CONFIG = load_config("desk")
BEFORE = ThrustMap.of(CONFIG.vehicle)
#: Motors that give a sixth less than the vehicle file says.
TRUE = replace(BEFORE, hover_thrust=BEFORE.hover_thrust * 1.2, voltage_exponent=1.5)
MASS = CONFIG.vehicle.base.mass + sum(part.mass for part in CONFIG.vehicle.arm.parts) + CONFIG.vehicle.arm.sleeve.mass
FLYING = next(tick for tick, _ in mission() if tick.outputs.phase is Phase.APPROACH)
Change = Callable[[Tick, float], Tick]


def hovering(seconds: float, change: Change | None = None) -> Iterator[Tick]:
    """Ticks of a vehicle that stands in the air, tilted a little, while its battery empties."""
    assert FLYING.inputs.autopilot is not None
    for index in range(round(250 * seconds)):
        t = 0.004 * index
        volts = 16.4 - 0.05 * t
        force = MASS * CONFIG.vehicle.gravity / 0.9950041652780258  # upright by cos 0.1
        wanted = BEFORE.force(TRUE.set_point(force, volts), volts)
        estimate = replace(FLYING.outputs.estimate, rpy=(0.0, 0.1, 0.3), v_WB=(0.02, 0.0, 0.0), payload=True)
        command = replace(FLYING.outputs.autopilot, interface=Interface.ATTITUDE, thrust=wanted)
        inputs = replace(
            FLYING.inputs,
            t_ns=10**12 + 4_000_000 * index,
            autopilot=replace(FLYING.inputs.autopilot, battery_voltage=volts),
        )
        outputs = replace(FLYING.outputs, phase=Phase.HOLD, estimate=estimate, autopilot=command)
        tick = replace(FLYING, index=index, inputs=inputs, outputs=outputs)
        yield change(tick, t) if change is not None else tick


def log_of(path: Path, ticks: Iterator[Tick], config: Config = CONFIG) -> Path:
    info = RunInfo(version="0.1.0", scenario="desk", law="tuned", seed=0, realtime=True)
    with Recorder(path / "log.mcap", info, config, "") as recorder:
        for tick in ticks:
            recorder.tick(tick)
    return path / "log.mcap"


def with_state(**fields: object) -> Callable[[Tick], Tick]:
    def change(tick: Tick) -> Tick:
        state = tick.inputs.autopilot
        assert isinstance(state, AutopilotState)
        return replace(tick, inputs=replace(tick.inputs, autopilot=replace(state, **fields)))

    return change


def with_outputs(**fields: object) -> Callable[[Tick], Tick]:
    return lambda tick: replace(tick, outputs=replace(tick.outputs, **fields))


def run(log: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, str, str]:
    parser = argparse.ArgumentParser()
    calibrate.add_parser(parser.add_subparsers())
    options = parser.parse_args(["calibrate", "hover", str(log), *more])
    code = options.run(options)
    told = capsys.readouterr()
    return code, told.out, told.err


def test_the_true_map_is_found_and_fits_into_the_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = log_of(tmp_path, hovering(20.0))
    code, out, _ = run(tmp_path, capsys)
    assert code == 0
    assert "20 s of hover at 15.4" in out
    assert "to the power of 1.50" in out
    told = yaml.safe_load(out)
    found = msgspec.convert(told["devices"]["autopilot"]["thrust"], ThrustMap)
    for volts in (15.0, 16.5):
        assert found.full_force(volts) == pytest.approx(TRUE.full_force(volts), rel=1e-3)
    ratio = TRUE.full_force(found.hover_voltage) / BEFORE.full_force(found.hover_voltage)
    assert f"{100 * (ratio - 1):+.1f} % against the map in force" in out
    out_file = tmp_path / "calibrated.yaml"
    out_file.write_text((Path(__file__).parents[2] / "configs" / "desk.yaml").read_text().split("devices:")[0] + out)
    assert load_config(str(out_file)).devices.autopilot.thrust == found
    assert run(log, capsys)[1] == out


def test_the_map_is_written_into_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, mine = log_of(tmp_path, hovering(20.0)), tmp_path / "mine.yaml"
    text = (Path(__file__).parents[2] / "configs" / "desk.yaml").read_text()
    mine.write_text(text)
    code, out, _ = run(log, capsys, "--config", str(mine))
    assert code == 0
    assert out.splitlines()[-1] == f"{mine}: written"
    printed = yaml.safe_load(run(log, capsys)[1])["devices"]["autopilot"]["thrust"]
    assert load_config(str(mine)).devices.autopilot.thrust == msgspec.convert(printed, ThrustMap)
    assert [line for line in text.splitlines() if "#" in line] == [
        line for line in mine.read_text().splitlines() if "#" in line
    ]
    assert run(log, capsys, "--config", str(mine))[1].endswith("holds this already\n")
    code, _, err = run(log, capsys, "--config", "desk")
    assert code == 2
    assert "belongs to the program" in err


def test_the_map_that_was_in_force_is_taken_from_the_log(tmp_path: Path) -> None:
    mine = replace(BEFORE, hover_thrust=BEFORE.hover_thrust * 0.9)
    config = replace(CONFIG, devices=replace(CONFIG.devices, autopilot=replace(CONFIG.devices.autopilot, thrust=mine)))
    flown = read(log_of(tmp_path, hovering(6.0), config))
    assert flown.before == mine
    assert flown.points[0].set_point == pytest.approx(
        mine.set_point(BEFORE.force(TRUE.set_point(MASS * 9.80665 / 0.995, 16.39), 16.39), 16.39), rel=1e-3
    )


def test_climbing_and_the_sleeve_count(tmp_path: Path) -> None:
    def change(tick: Tick, t: float) -> Tick:
        estimate = replace(tick.outputs.estimate, v_WB=(0.0, 0.0, 0.2 * (t % 0.5)), payload=False)
        return with_outputs(estimate=estimate)(tick)

    flown = read(log_of(tmp_path, hovering(6.0, change)))
    mass = MASS - CONFIG.vehicle.arm.sleeve.mass
    assert [p.force for p in flown.points] == pytest.approx(
        [mass * (CONFIG.vehicle.gravity + 0.2) / 0.9950041652780258] * len(flown.points), rel=1e-9
    )


@pytest.mark.parametrize(
    "change",
    [
        with_outputs(phase=Phase.PRESS),
        with_outputs(estimate=replace(FLYING.outputs.estimate, v_WB=(0.1, 0.1, 0.1))),
        with_outputs(estimate=replace(FLYING.outputs.estimate, v_WB=(0.0, 0.0, 0.0), in_contact=True)),
        with_state(mode=FlightMode.HOLD),
        with_state(landed="on_ground"),
        with_state(landed="unknown"),
        with_state(armed=False),
        with_state(battery_voltage=float("nan")),
        lambda tick: replace(tick, inputs=replace(tick.inputs, autopilot=None)),
    ],
)
def test_what_is_not_hover_does_not_count(tmp_path: Path, change: Callable[[Tick], Tick]) -> None:
    ticks = list(hovering(12.0))
    # seven seconds of hover, and a single moment of something else in each of the other stretches
    ticks = [change(tick) if tick.index >= 1750 and tick.index % 125 == 60 else tick for tick in ticks]
    assert len(read(log_of(tmp_path, iter(ticks))).points) == 14
    short = [change(tick) if tick.index >= 1000 else tick for tick in ticks]
    with pytest.raises(CalibrationError, match=r"4 s of hover; at least 5 s are needed.*request hold"):
        read(log_of(tmp_path, iter(short)))


def test_ticks_that_the_log_lacks_do_not_count(tmp_path: Path) -> None:
    ticks = [tick for tick in hovering(8.0) if not 130 <= tick.index < 200]
    assert len(read(log_of(tmp_path, iter(ticks))).points) == 15


def with_interface(tick: Tick, interface: Interface) -> Tick:
    command: AutopilotCommand = replace(tick.outputs.autopilot, interface=interface)
    return with_outputs(autopilot=command)(tick)


def test_flights_that_cannot_tell_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrench = log_of(tmp_path, (with_interface(tick, Interface.WRENCH) for tick in hovering(6.0)))
    code, out, err = run(wrench, capsys)
    assert (code, out) == (2, "")
    assert "was flown with wrenches" in err
    mock = log_of(tmp_path, hovering(6.0), load_config("paper"))
    assert "its autopilot was a mock" in run(mock, capsys)[2]
    assert "no cycle" in run(log_of(tmp_path, iter(())), capsys)[2]
    assert "no such log" in run(tmp_path / "nothing.mcap", capsys)[2]
    with pytest.raises(LogError, match="does not fit"):
        read(record(tmp_path / "other.mcap"))
