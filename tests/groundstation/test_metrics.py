from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from groundstation.metrics import compute, outcome, plane, state_errors, windows, write
from groundstation.run import Run, euler, read_run
from onboard.core.types import Phase, Tick
from onboard.messages import LogError, Truth
from onboard.recorder import Recorder
from onboard.records import RunInfo, Timing
from tests import synthetic
from tests.synthetic import PIPE, REPAIR, ConfigStub, change_outputs, mission, record

CYCLES = list(mission())
Cycles = list[tuple[Tick, Truth]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(record(tmp_path_factory.mktemp("run") / "log.mcap"))


@pytest.fixture(scope="module")
def metrics(run: Run) -> dict[str, Any]:
    return compute(run, wall_s=3.5)


def first(phase: Phase) -> int:
    return next(i for i, (tick, _) in enumerate(CYCLES) if tick.outputs.phase is phase)


def changed(tmp_path: Path, cycles: Cycles, **options: Any) -> dict[str, Any]:
    return compute(read_run(record(tmp_path / "log.mcap", cycles, **options)))


def test_keys_and_identity(metrics: dict[str, Any]) -> None:
    assert {"outcome", "phases", "force_rmse", "state_rmse", "contact", "limits", "adhesive", "paper"} < set(metrics)
    assert (metrics["seed"], metrics["law"], metrics["version"]) == (7, "tuned", "0.1.0")
    assert metrics["outcome"] == "completed"
    assert metrics["wall_s"] == 3.5
    assert metrics["sim_s"] == pytest.approx((len(CYCLES) - 1) * 0.004)
    assert metrics["state_rmse"]["flight"].keys() == metrics["paper"]["state_rmse"].keys()
    assert metrics["force_rmse"].keys() == metrics["paper"]["force_rmse"].keys()


def test_phases_follow_each_other_without_gap(metrics: dict[str, Any]) -> None:
    phases = metrics["phases"]
    assert [phase["name"] for phase in phases] == [phase for phase, _ in synthetic.PHASES]
    assert all(a["end"] == b["start"] for a, b in itertools.pairwise(phases))
    assert [p["end"] - p["start"] for p in phases[:-1]] == pytest.approx(
        [length for _, length in synthetic.PHASES[:-1]]
    )


def test_force_errors_are_those_put_in(metrics: dict[str, Any]) -> None:
    errors = metrics["force_rmse"]
    assert errors["meas_des"] == pytest.approx(synthetic.MEASURED_ERROR)
    assert errors["est_meas"] == pytest.approx(synthetic.ESTIMATED_ERROR)
    assert errors["est_des"] == pytest.approx(synthetic.MEASURED_ERROR + synthetic.ESTIMATED_ERROR)


@pytest.mark.parametrize("window", ["flight", "contact"])
def test_state_errors_are_those_put_in(metrics: dict[str, Any], window: str) -> None:
    expected = dict.fromkeys(metrics["paper"]["state_rmse"], 0.0)
    expected |= {
        "x": synthetic.X_ERROR,
        "theta": math.degrees(synthetic.PITCH_ERROR),
        "theta_3": math.degrees(synthetic.JOINT_ERROR),
    }
    assert metrics["state_rmse"][window] == pytest.approx(expected, abs=1e-12)


def test_windows(run: Run) -> None:
    window = windows(run)
    assert (window.flight.start, window.flight.stop) == (first(Phase.APPROACH), first(Phase.LAND))
    assert (window.contact.start, window.contact.stop) == (first(Phase.PRESS), first(Phase.RELEASE))


def test_contact_figures(metrics: dict[str, Any]) -> None:
    contact = metrics["contact"]
    assert contact["peak"] == pytest.approx(REPAIR.force + synthetic.MEASURED_ERROR + 0.1)
    assert contact["overshoot"] == pytest.approx(synthetic.MEASURED_ERROR + 0.1)
    assert contact["touchdown_peak"] == pytest.approx(0.3 + synthetic.MEASURED_ERROR + 0.1, abs=0.03)
    assert contact["hold_mean"] == pytest.approx(REPAIR.force + synthetic.MEASURED_ERROR, abs=1e-3)
    assert contact["hold_std"] < 1e-3
    assert 0.4 < contact["time_to_95"] < 0.8
    assert contact["tip_slip"] == pytest.approx(0.001)
    assert contact["bounces"] == 0


@pytest.mark.parametrize(("gap", "bounces"), [(2, 0), (3, 1), (50, 1)])
def test_bounces_are_gaps_longer_than_ten_milliseconds(tmp_path: Path, gap: int, bounces: int) -> None:
    cycles = list(CYCLES)
    for i in range(first(Phase.PRESS) + 100, first(Phase.PRESS) + 100 + gap):
        cycles[i] = (cycles[i][0], replace(cycles[i][1], contact_force=0.0))
    contact = changed(tmp_path, cycles)["contact"]
    assert contact["bounces"] == bounces
    expected = pytest.approx(gap * 0.004 if bounces else 0.0)
    assert contact["time_without_contact"] == contact["longest_gap"] == contact["press_gap"] == expected


def test_bounce_before_the_trigger_counts(tmp_path: Path) -> None:
    cycles = list(CYCLES)
    touch = first(Phase.PRESS) - 10
    cycles[touch] = (cycles[touch][0], replace(cycles[touch][1], contact_force=0.5, contact_peak=3.5))
    contact = changed(tmp_path, cycles)["contact"]
    assert contact["bounces"] == 1
    assert (contact["longest_gap"], contact["press_gap"]) == (pytest.approx(0.036), 0.0), "not lost once it was found"
    assert contact["peak"] == contact["touchdown_peak"] == 3.5


def test_limits(metrics: dict[str, Any]) -> None:
    limits = metrics["limits"]
    assert limits["thrust_max"] == max(limits["thrust_by_rotor"]) == pytest.approx(6.8, abs=1e-3)
    assert limits["torque_by_joint"] == pytest.approx([0.2, 0.4, 0.1], abs=1e-3)
    assert (limits["thrust_limit"], limits["torque_limit"]) == (13.0, 0.93)


def test_adhesive_arc(metrics: dict[str, Any]) -> None:
    assert metrics["adhesive"]["arc_deg"] == pytest.approx(math.degrees(2.0), rel=0.02)
    assert metrics["adhesive"]["path_error_rms"] == pytest.approx(synthetic.NEEDLE_ERROR)


def test_plane_of_the_pipe(run: Run) -> None:
    psi = math.radians(PIPE.heading_deg)
    x, y, z = PIPE.position
    point = [[x + 0.3 * math.cos(psi) - 0.1 * math.sin(psi), y + 0.3 * math.sin(psi) + 0.1 * math.cos(psi), z - 0.2]]
    assert [float(v[0]) for v in plane(run, np.array(point))] == pytest.approx([0.3, -0.2, 0.1])


def test_euler_is_zyx_with_nose_down_positive() -> None:
    half = 0.5 * 0.2
    q = np.array([[math.cos(half), 0.0, math.sin(half), 0.0]])
    assert euler(q)[0] == pytest.approx([0.0, 0.2, 0.0])


def test_yaw_error_wraps(run: Run, tmp_path: Path) -> None:
    cycles = [
        (change_outputs(tick, control=replace(tick.outputs.control, attitude=(0.0, 0.0, 0.3 + 2 * math.pi))), truth)
        for tick, truth in CYCLES
    ]
    other = read_run(record(tmp_path / "log.mcap", cycles))
    assert np.allclose(state_errors(other)["psi"], state_errors(run)["psi"], atol=1e-9)


def test_without_truth_only_the_estimate_is_judged(tmp_path: Path) -> None:
    metrics = changed(tmp_path, CYCLES, truth=False)
    assert metrics["force_rmse"]["meas_des"] is None
    assert metrics["force_rmse"]["est_des"] == pytest.approx(0.05)
    assert metrics["contact"]["source"] == "estimate"
    assert metrics["limits"]["thrust_max"] is None
    assert metrics["adhesive"]["arc_deg"] is None
    assert metrics["outcome"] == "completed"


def test_crash_is_lost(tmp_path: Path) -> None:
    cycles = [*CYCLES[:600], (CYCLES[600][0], replace(CYCLES[600][1], crashed="hit the ground at 3.2 m/s"))]
    assert changed(tmp_path, cycles)["outcome"] == "lost"


def test_motors_cut_in_the_air_are_lost(tmp_path: Path) -> None:
    tick, truth = CYCLES[600]
    assert changed(tmp_path, [*CYCLES[:600], (change_outputs(tick, phase=Phase.STOPPED), truth)])["outcome"] == "lost"


def test_early_landing_is_safe(tmp_path: Path) -> None:
    cycles = CYCLES[: first(Phase.ADVANCE)] + CYCLES[first(Phase.LAND) :]
    cycles = [(tick, replace(truth, sleeve_on_pipe=False)) for tick, truth in cycles]
    metrics = changed(tmp_path, cycles)
    assert metrics["outcome"] == "safe"
    assert metrics["contact"]["peak"] is metrics["contact"]["hold_mean"] is metrics["contact"]["bounces"] is None
    assert metrics["force_rmse"]["est_des"] is None
    assert metrics["state_rmse"]["contact"]["x"] is None


def test_retreat_and_land_is_safe(tmp_path: Path) -> None:
    cycles = [
        (change_outputs(tick, phase=Phase.RETREAT_LAND), truth)
        if tick.outputs.phase is Phase.RETREAT
        else (tick, truth)
        for tick, truth in CYCLES
    ]
    assert changed(tmp_path, cycles)["outcome"] == "safe"


def test_cut_off_log_is_unfinished(tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(LogError, match="--partial"):
        read_run(path)
    assert outcome(read_run(path, partial=True)) == "unfinished"


def test_log_without_ticks(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no cycle"):
        read_run(record(tmp_path / "log.mcap", []))


def test_timing_of_a_wall_clock_run(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    info = RunInfo(version="0.1.0", scenario="paper", law="tuned", seed=7, realtime=True)
    with Recorder(path, info, ConfigStub(), "") as recorder:
        for tick, _ in CYCLES[:501:2]:
            recorder.tick(tick)
            recorder.timing(
                Timing(tick.index, tick.inputs.t_ns, late=0.001 + 1e-6 * tick.index, busy=0.0005, sent=0.0003)
            )
    timing = compute(read_run(path))["timing"]
    assert timing["rates"] == pytest.approx({"tick": 125, "odometry": 125, "autopilot": 125, "servos": 125})
    assert timing["late"]["max"] == pytest.approx(0.0015)
    assert timing["late"]["median"] == pytest.approx(0.00125)
    assert timing["busy"]["p99"] == pytest.approx(0.0005)
    assert timing["missing_ticks"] == 250


def test_written_file_is_plain_json(metrics: dict[str, Any], tmp_path: Path) -> None:
    write(metrics, tmp_path / "metrics.json")
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
