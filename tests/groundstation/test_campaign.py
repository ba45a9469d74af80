"""A campaign: what its file makes, that no run is lost or doubled, and what is told of them all."""

from __future__ import annotations

import io
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from scipy.stats import binomtest

from groundstation import (
    campaign,
    campaign_figures,
    campaign_pool,
    campaign_report,
    campaign_run,
    campaign_summary,
    cli,
    codes,
    metrics,
)
from groundstation.campaign_file import (
    SHIPPED,
    Campaign,
    Design,
    FaultCase,
    Job,
    Limit,
    Moment,
    Plan,
    Spread,
    Varied,
    read_campaign,
)
from groundstation.campaign_pool import Pool
from groundstation.campaign_run import ENDS, NAMES, flown
from groundstation.campaign_store import Store, StoreError
from groundstation.run import read_run
from onboard import main as onboard
from onboard.config import scenario_names
from onboard.headless import ConfigError, Mission
from tests.waiting import seconds_until

#: A run that costs next to nothing: it is broken off while it waits for preflight.
BRIEF = Job(0, "paper", None, ("repair.hold=2.0",), 3, 0.6, None)
FALLING = "faults=[{device: odometry, kind: silent, phase: takeoff, start: 2.5, duration: 2.0}]"


def written(folder: Path, text: str, name: str = "mine.yaml") -> str:
    path = folder / name
    path.write_text(text)
    return str(path)


@cache
def read(given: str) -> Plan:
    return read_campaign(given, NAMES, tuple(ENDS))


# --- the file ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED.names())
def test_what_is_shipped_can_be_flown(name: str) -> None:
    plan = read(name)
    assert len(plan) == {"realistic": 100, "robustness": 500, "gusts": 6}.get(name, len(plan))
    assert plan.campaign.scenario in scenario_names()


def test_faults_are_all_kinds_at_all_phases() -> None:
    from sim_backend import dynamixel_troubles, px4_faults, tracker

    campaign = read("faults").campaign
    flown = {(case.device, case.kind) for case in campaign.faults}
    for kinds, device in (
        (px4_faults.KINDS, "autopilot"),
        (tracker.KINDS, "odometry"),
        (dynamixel_troubles.KINDS, "servos"),
    ):
        assert {(device, kind.value) for kind in kinds} <= flown
    order = onboard.CHAIN
    assert {phase.value for phase in order if phase != "stopped"} == {moment.phase for moment in campaign.moments}
    assert all(case.ends for case in campaign.faults)


def test_every_error_of_a_file_at_once(tmp_path: Path) -> None:
    file = written(
        tmp_path,
        """
        scenaro: paper
        runs: 0
        parameters:
          - {name: repair.force, low: 3.0, high: 2.0}
          - {name: repair.force, spread: normal}
          - {name: repair.force}
        limits: [{metric: meas_des}]
        """,
    )
    with pytest.raises(ConfigError) as told:
        read(file)
    words = "\n".join(told.value.errors)
    assert len(told.value.errors) == 6
    assert f"{file}:2: scenaro: no such parameter; nearest: scenario" in words
    assert f"{file}:3: runs = 0: must be" in words
    assert f"{file}:5: parameters.0: low 3 must be below high 2" in words
    assert "parameters.1: a normal distribution has mean and sigma" in words
    assert "parameters.2: missing low or high, or values to choose from" in words
    assert "limits.0.high: missing" in words


def test_names_and_values_are_tried_before_anything_flies(tmp_path: Path) -> None:
    wrong = """
        metric: mess_des
        limits: [{metric: peek, high: 3}]
        moments: [{name: press, phase: pres}]
        faults: [{label: odd, device: servos, kind: silent, moments: [pess], ends: [complete]}]
        """
    with pytest.raises(ConfigError) as told:
        read(written(tmp_path, wrong))
    words = "\n".join(told.value.errors)
    for hint in ("nearest: meas_des", "nearest: peak", "nearest: press", "nearest: completed"):
        assert hint in words
    assert len(told.value.errors) == 5
    wrong = """
        parameters: [{name: repair.forse, low: 1, high: 2}]
        """
    with pytest.raises(ConfigError, match=r"repair\.forse: no such parameter; nearest: repair\.force"):
        read(written(tmp_path, wrong))
    wrong = """
        moments: [{name: press, phase: press}]
        parameters: [{name: repair.force, low: -5, high: 2}]
        faults: [{label: odd, device: servos, kind: jump}]
        """
    with pytest.raises(ConfigError) as told:
        read(written(tmp_path, wrong))
    assert "repair.force=-5.0" in told.value.errors[0]
    assert "faults: odd: faults: fault jump of servos: servos can show" in told.value.errors[1]


def test_the_command_tells_wrong_input_and_makes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for given, words in (
        (["robust"], "no campaign of that name; there are: robustness"),
        (["gone.yaml"], "gone.yaml: cannot be read"),
        (["robustness", "--workers", "0"], "--workers 0: must be from 1"),
    ):
        assert cli.main(["campaign", *given]) == codes.WRONG_INPUT
        assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_changed_scenario_makes_other_runs(tmp_path: Path) -> None:
    scenario, file = tmp_path / "here.yaml", written(tmp_path, f"scenario: {tmp_path / 'here.yaml'}")
    scenario.write_text("repair: {hold: 2.0}")
    before = read_campaign(file, NAMES, tuple(ENDS)).digest()
    assert read_campaign(file, NAMES, tuple(ENDS)).digest() == before
    scenario.write_text("repair: {hold: 2.5}")
    assert read_campaign(file, NAMES, tuple(ENDS)).digest() != before


# --- the design -------------------------------------------------------------------------------------------------------


def test_a_latin_hypercube_fills_every_range_evenly() -> None:
    varied = (
        Varied("repair.force", low=1.0, high=3.0),
        Varied("world.plant.motor_lag", spread=Spread.LOG_UNIFORM, low=0.01, high=0.1),
        Varied("pipe.heading_deg", spread=Spread.NORMAL, mean=10.0, sigma=2.0),
        Varied("interface", values=("attitude", "body_rate")),
    )
    plan = Plan("x", Campaign(runs=40, seeds=2, first_seed=5, parameters=varied))
    jobs = list(plan.jobs())
    assert len(jobs) == len(plan) == 80
    assert [job.run for job in jobs] == list(range(80))
    assert [job.seed for job in jobs] == list(range(5, 85))
    points = [job.values for job in jobs[::2]]
    assert [job.values for job in jobs[1::2]] == points
    force = np.array([point["repair.force"] for point in points], dtype=float)
    assert sorted(np.floor((force - 1.0) / 2.0 * 40).astype(int)) == list(range(40))
    lag = np.array([point["world.plant.motor_lag"] for point in points], dtype=float)
    assert sorted(np.floor(np.log10(lag / 0.01) * 40 - 1e-9).astype(int).clip(0)) == list(range(40))
    heading = np.array([point["pipe.heading_deg"] for point in points], dtype=float)
    assert abs(np.median(heading) - 10.0) < 0.2
    assert 4.0 < heading.min() < heading.max() < 16.0
    assert [point["interface"] for point in points].count("attitude") == 20
    assert list(plan.jobs()) == jobs, "always the same"


def test_a_grid_has_every_combination_with_the_same_seeds() -> None:
    varied = (Varied("repair.force", low=1.0, high=3.0, steps=3), Varied("repair.hold", values=(2, 4)))
    plan = Plan("x", Campaign(design=Design.GRID, seeds=2, parameters=varied))
    jobs = list(plan.jobs())
    assert len(jobs) == len(plan) == 12
    assert [job.seed for job in jobs] == [0, 1] * 6
    assert [tuple(job.values.values()) for job in jobs[::2]] == [
        (1.0, 2),
        (1.0, 4),
        (2.0, 2),
        (2.0, 4),
        (3.0, 2),
        (3.0, 4),
    ]


def test_faults_by_moments() -> None:
    campaign = Campaign(
        moments=(Moment("a", "press", 2.0), Moment("b", "land")),
        faults=(
            FaultCase("odd", "servos", "silent", duration=1.0),
            FaultCase("jump", "odometry", "jump", ("b",), value=0.3),
        ),
    )
    jobs = list(Plan("x", campaign).jobs())
    assert [(job.fault, job.moment) for job in jobs] == [("odd", "a"), ("odd", "b"), ("jump", "b")]
    assert jobs[2].sets == ("faults=[{device: odometry, kind: jump, phase: land, start: 0.5, value: 0.3}]",)


# --- one run ----------------------------------------------------------------------------------------------------------


def test_the_command_of_a_run_repeats_it_exactly(tmp_path: Path) -> None:
    job = msgspec.structs.replace(
        BRIEF, sets=(*BRIEF.sets, FALLING, "world.sensors.odometry.position_noise=0.001"), longest=12.0
    )
    row = flown(job)
    assert (row["end"], row["error"], row["ok"]) == ("autolanded", "", True)
    words = shlex.split(row["command"])
    assert words[:2] == ["pipewright", "sim"]
    cli._parser().parse_args(words[1:])
    assert onboard.main(["sim", "--out", str(tmp_path), "--no-progress", *words[2:]]) == 0
    again = metrics.compute(read_run(tmp_path / "log.mcap"))
    assert again["sim_s"] == row["sim_s"]
    assert again["limits"]["thrust_max"] == row["thrust_max"]
    assert again["limits"]["torque_max"] == row["torque_max"]
    assert again["outcome"] == row["outcome"]


def test_what_goes_wrong_in_a_run_is_told_and_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    row = flown(msgspec.structs.replace(BRIEF, sets=("repair.forse=2",)))
    assert (row["end"], row["ok"]) == ("error", False)
    assert "repair.forse: no such parameter" in row["error"]
    row = flown(msgspec.structs.replace(BRIEF, sets=("pipe.position=[2, 0, 0.2]",)))
    assert row["end"] == "error"
    assert row["error"]
    row = flown(msgspec.structs.replace(BRIEF, wall_s=0.0))
    assert "TookTooLongError" in row["error"]

    def broken(self: Mission, *more: Any) -> None:
        raise ZeroDivisionError("in the middle")

    monkeypatch.setattr(Mission, "fly", broken)
    row = flown(BRIEF)
    assert "ZeroDivisionError: in the middle" in row["error"]
    assert "campaign_run.py" in row["error"], "with its trace"
    assert row["command"].startswith("pipewright sim --scenario paper --seed 3")


# --- the folder -------------------------------------------------------------------------------------------------------


def plan_of(runs: int, **more: Any) -> Plan:
    return Plan("mine", Campaign(runs=runs, parameters=(Varied("repair.force", low=1.0, high=3.0),), **more))


def rows_of(plan: Plan, **more: Any) -> list[dict[str, Any]]:
    rows = []
    for job in plan.jobs():
        row = campaign_run.failed(job, "")
        rows.append(
            {**row, "end": "completed", "ok": True, "meas_des": 0.1 * float(job.values["repair.force"]), **more}
        )
    return rows


def test_rows_are_there_once_whatever_was_killed_when(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_of(6)
    rows = rows_of(plan)
    store = Store(tmp_path / "here", plan)
    with store.opened(resume=False):
        for row in rows[:3]:
            store.put(row)
        (tmp_path / "here" / "parts" / "0000003.tmp").write_bytes(b"half a row")
    store = Store(tmp_path / "here", plan)
    with store.opened(resume=True):
        assert store.done() == {0, 1, 2}
        assert not list((tmp_path / "here" / "parts").glob("*.tmp"))
        with monkeypatch.context() as killed:  # between the whole file and the end of its parts
            killed.setattr(Path, "unlink", lambda self, **_: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                store.compact()
        assert store.done() == {0, 1, 2}
        assert store.table()["run"].to_pylist() == [0, 1, 2]
        for row in reversed(rows[3:]):
            store.put(row)
        store.compact()
    table = store.table()
    assert table["run"].to_pylist() == list(range(6))
    assert table["meas_des"].to_pylist() == [row["meas_des"] for row in rows]
    assert table["repair.force"].to_pylist() == [row["values"]["repair.force"] for row in rows]
    assert not (tmp_path / "here" / "parts").exists()


def opened(store: Store, *, resume: bool) -> None:
    with store.opened(resume=resume):
        pass


def test_a_folder_is_of_one_campaign_and_of_one_process(tmp_path: Path) -> None:
    store = Store(tmp_path, plan_of(3))
    opened(store, resume=False)
    with pytest.raises(StoreError, match="--resume goes on with it"):
        opened(store, resume=False)
    with pytest.raises(StoreError, match="something has been changed since"):
        opened(Store(tmp_path, plan_of(4)), resume=True)
    with store.opened(resume=True), pytest.raises(StoreError, match="another process is at work"):
        opened(Store(tmp_path, plan_of(3)), resume=True)
    other = tmp_path / "other"
    other.mkdir()
    (other / "letter").write_text("")
    with pytest.raises(StoreError, match="holds other files"):
        opened(Store(other, plan_of(3)), resume=True)
    assert [path.name for path in other.iterdir()] == ["letter"]


# --- all together -----------------------------------------------------------------------------------------------------


def test_the_summary_counts_measures_and_finds_the_worst(tmp_path: Path) -> None:
    plan = plan_of(40, limits=(Limit("meas_des", 0.25, 0.5), Limit("meas_des", 0.2, 1.0)))
    rows = rows_of(plan, touchdown_peak=2.0, sim_s=100.0, wall_s=10.0)
    rows[7] |= {"end": "lost", "ok": False, "crash": "hit the ground", "meas_des": None}
    rows[9] |= {"end": "landed"}
    store = Store(tmp_path, plan)
    opened(store, resume=False)
    for row in rows:
        store.put(row)
    summary = campaign_summary.summarize(plan, store.table())
    assert summary.ends == {"completed": 38, "landed": 1, "lost": 1}
    wilson = binomtest(38, 40).proportion_ci(0.95, "wilson")
    assert (summary.success.low, summary.success.high) == (wilson.low, wilson.high)
    known = [row["meas_des"] for row in rows if row["meas_des"] is not None]
    assert summary.figures["meas_des"].median == pytest.approx(np.median(known))
    assert [verdict.met for verdict in summary.verdicts] == [True, False]
    (felt,) = [item for item in summary.sensitivities if item.figure == "meas_des"]
    assert felt.parameter == "repair.force"
    assert felt.strength == pytest.approx(1.0)
    assert [worst.run for worst in summary.worst[:2]] == [7, 9]
    assert summary.worst[0].why == "hit the ground"
    assert len(summary.worst) == 10
    assert summary.worst[2].value == max(
        value for k, row in enumerate(rows) if k not in (7, 9) for value in [row["meas_des"]]
    )
    assert summary.speed == pytest.approx(10.0)
    assert not summary.good

    page = tmp_path / "report.html"
    campaign_report.write(summary, store.table(), page)
    html = page.read_text()
    assert "95.0 %" in html
    assert html.count("<code>pipewright sim") == 10
    assert re.search(r'<svg class="chart".*measured less desired force', html)
    campaign_figures.distributions(summary, store.table(), tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_the_estimators_are_told_side_by_side(tmp_path: Path) -> None:
    plan = plan_of(9)
    rows = rows_of(plan, watched_s=100.0, false_contacts=0.0)
    for k, row in enumerate(rows):
        row |= {"paper_rmse": 0.2 + 0.01 * k, "kalman_rmse": 0.1, "kalman_bias": -0.02, "kalman_delay": 0.05}
        row |= {"kalman_watched_rms": 0.03 + 0.01 * (k % 2), "kalman_pulls": float(k == 3), "paper_pulls": 4.0}
    rows[8] |= {"kalman_rmse": None, "kalman_bias": None, "kalman_delay": None, "watched_s": 0.0, "false_contacts": 1.0}
    store = Store(tmp_path, plan)
    opened(store, resume=False)
    for row in rows:
        store.put(row)
    summary = campaign_summary.summarize(plan, store.table())
    assert (summary.watched_s, summary.false_contacts) == (800.0, 1)
    paper, kalman = summary.estimators
    assert (paper.name, paper.runs, paper.ratio, paper.watched_rms) == ("paper", 9, 1.0, None)
    assert (kalman.name, kalman.runs, kalman.rmse, kalman.bias, kalman.delay) == ("kalman", 8, 0.1, -0.02, 0.05)
    assert kalman.ratio == pytest.approx(2.35)
    assert [kalman.ratio_low, kalman.ratio_high] == pytest.approx([2.0, 2.7]), "of eight: all of them"
    assert kalman.watched_rms == pytest.approx(np.sqrt(0.5 * (0.03**2 + 0.04**2)))
    assert kalman.pulls == 1
    page = tmp_path / "report.html"
    campaign_report.write(summary, store.table(), page)
    for words in (
        "2.35 (2.00 to 2.70)",
        "watched for 800 s with nothing touching, false contacts: 1;",
        "Kalman, wind apart",
    ):
        assert words in page.read_text()
    printed = io.StringIO()
    Console(width=80, file=printed).print(campaign.side_by_side(summary))
    one_line = r"Kalman, wind apart +8 0\.100 -0\.020 +50 2\.35 \(2\.00 to 2\.70\) +0\.035 +1 *$"
    assert re.search(one_line, printed.getvalue(), re.MULTILINE)
    assert campaign_summary.summarize(plan_of(3), store.table().slice(0, 3)).estimators[1].ratio_low is None


def test_the_interval_of_a_median_holds_it_as_often_as_it_says() -> None:
    random = np.random.default_rng(7)
    for n in (6, 10, 25):
        intervals = [campaign_summary.median_interval(random.exponential(size=n)) for _ in range(2000)]
        held = np.mean([low <= np.log(2.0) <= high for low, high in filter(None, intervals)])
        assert len(list(filter(None, intervals))) == 2000
        assert 0.94 < held < 0.99
    assert campaign_summary.median_interval(np.arange(5.0)) is None
    assert campaign_summary.median_interval(np.array([])) is None


def test_the_matrix_shows_which_cell_ended_wrong(tmp_path: Path) -> None:
    campaign = Campaign(
        moments=(Moment("press", "press"), Moment("land", "land")),
        faults=(
            FaultCase("silent", "servos", "silent", ends=("landed",)),
            FaultCase("jump", "odometry", "jump", value=1.0),
        ),
    )
    plan = Plan("cells", campaign)
    store = Store(tmp_path, plan)
    opened(store, resume=False)
    for job, end in zip(plan.jobs(), ("landed", "completed", "resumed", "lost"), strict=True):
        ok = end in (job.ends or campaign_run.SAFE)
        store.put(campaign_run.failed(job, "") | {"end": end, "ok": ok})
    summary = campaign_summary.summarize(plan, store.table())
    assert [cell.ok for cell in summary.cells] == [True, False, True, False]
    assert "phase: land" in summary.cells[1].command
    campaign_report.write(summary, store.table(), tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text().count('class="cell wrong') == 2
    campaign_figures.matrix(summary, tmp_path / "matrix.png")
    assert (tmp_path / "matrix.png").read_bytes().startswith(b"\x89PNG")


# --- the workers ------------------------------------------------------------------------------------------------------


def _odd(job: Job) -> int:
    if job.run % 2:
        raise ValueError("odd")
    return job.run


@pytest.fixture
def threads() -> Iterator[Pool]:
    """A pool in this process."""
    from distributed import Client

    with Client(
        processes=False, n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", set_as_default=False
    ) as client:
        yield Pool(client)


def test_only_a_few_jobs_are_under_way_and_none_is_lost(threads: Pool) -> None:
    given = 0

    def jobs() -> Iterator[Job]:
        nonlocal given
        for k in range(60):
            given += 1
            yield msgspec.structs.replace(BRIEF, run=k)

    told = []
    for result in threads.each(_odd, jobs(), lambda job, why: -job.run if why == "ValueError: odd" else 1000):
        told.append(result)
        assert given <= len(told) + 3
    assert sorted(told) == sorted(k if k % 2 == 0 else -k for k in range(60))


def test_the_same_command_on_a_cluster_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from distributed import LocalCluster

    file = written(tmp_path, "seeds: 3\nlongest: 0.6\n")
    command = ["campaign", file, "--out", str(tmp_path / "out"), "--no-progress", "--scheduler"]
    monkeypatch.setattr(campaign_pool, "_PATIENCE", 0.5)
    assert cli.main([*command, "tcp://127.0.0.1:9"]) == codes.NOT_THERE
    assert "no Dask scheduler answers there" in capsys.readouterr().err
    monkeypatch.undo()
    with LocalCluster(
        processes=False, n_workers=1, threads_per_worker=2, protocol="tcp", host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as cluster:  # fmt: skip
        assert cli.main([*command, cluster.scheduler_address, "--resume"]) == codes.DONE
    assert "3 of 3 runs: 3 grounded" in capsys.readouterr().out


_TINY = """
scenario: paper
runs: 7
longest: 4.0
set: [plan.takeoff_height=0.5]
parameters: [{name: repair.force, low: 2.0, high: 3.0}]
"""


def test_killed_interrupted_and_resumed_no_run_is_lost_or_doubled(tmp_path: Path) -> None:
    file = written(tmp_path, _TINY)
    command = [sys.executable, "-c", "import sys; from groundstation.cli import main; sys.exit(main())"]
    command += ["campaign", file, "--workers", "1", "--out", str(tmp_path / "out"), "--no-progress"]
    parts = tmp_path / "out" / "parts"

    def until(count: int, *more: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*command, *more], cwd=tmp_path, start_new_session=True, stderr=subprocess.PIPE, text=True
        )
        seconds_until(lambda: len(list(parts.glob("*.parquet"))) >= count)
        return process

    killed = until(2)
    assert _listening(killed.pid) <= {"127.0.0.1"}
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    kept = (parts / "0000000.parquet").read_bytes()
    seconds_until(lambda: not _alive(killed.pid))

    interrupted = until(4, "--resume")
    os.killpg(interrupted.pid, signal.SIGINT)
    _, told = interrupted.communicate()
    assert interrupted.returncode == codes.INTERRUPTED, told
    assert re.fullmatch(
        r"pipewright: interrupted: [45] of 7 runs are in \S+; the same command with --resume .*\n", told
    )

    ended = subprocess.run([*command, "--resume"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == codes.DONE, ended.stderr
    assert "7 of 7 runs: 7 unfinished" in ended.stdout
    assert ended.stderr == ""
    table = Store(tmp_path / "out", read(file)).table()
    assert table["run"].to_pylist() == list(range(7))
    first = pq.read_table(pa.BufferReader(kept))
    assert table["wall_s"][0] == first["wall_s"][0], "what was there is not flown again"
    assert (tmp_path / "out" / "report.html").is_file()


def _listening(pid: int) -> set[str]:
    """Addresses at which the process and its children take connections."""
    process = psutil.Process(pid)
    sockets = [s for one in (process, *process.children(recursive=True)) for s in one.net_connections("inet")]
    return {s.laddr.ip for s in sockets if s.status == psutil.CONN_LISTEN}


def _alive(group: int) -> bool:
    """Some process of the group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
