from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from groundstation import cli
from groundstation.codes import BROKEN
from onboard.core.types import Phase
from tests.synthetic import change_outputs, mission, record

CYCLES = list(mission())
Fake = Callable[[list[str]], int]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Stand-in for the flight process: records a made-up mission; gives the arguments of each call."""
    calls: list[list[str]] = []

    def fly(arguments: list[str]) -> int:
        calls.append(arguments)
        out = Path(arguments[2])
        out.mkdir(parents=True, exist_ok=True)
        (out / "config.yaml").write_text("")
        record(out / "log.mcap")
        return 0

    monkeypatch.setattr(cli, "_flight_process", fly)
    return calls


def fake(monkeypatch: pytest.MonkeyPatch, function: Fake) -> None:
    monkeypatch.setattr(cli, "_flight_process", function)


def test_run_folder_holds_everything(flight: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["sim", "--law", "paper", "--seed", "3", "--set", "repair.force=2", "--no-progress"]) == 0
    assert flight == [
        ["sim", "--out", "runs/paper-paper-001", "--law=paper", "--seed=3", "--set=repair.force=2", "--no-progress"]
    ]
    assert {path.name for path in Path("runs/paper-paper-001").iterdir()} == {
        "log.mcap",
        "config.yaml",
        "metrics.json",
        "report.html",
    }
    metrics = json.loads(Path("runs/paper-paper-001/metrics.json").read_text())
    assert metrics["wall_s"] > 0.0
    assert "mission completed" in capsys.readouterr().out


def test_folders_are_numbered(flight: list[list[str]]) -> None:
    Path("runs/paper-tuned-009").mkdir(parents=True)
    for _ in range(2):
        cli.main(["sim"])
    cli.main(["sim", "--scenario", "my pipes/steep one.yaml"])
    assert [call[2] for call in flight] == ["runs/paper-001", "runs/paper-002", "runs/steep_one-001"]


def test_former_run_may_be_replaced_but_nothing_else(
    flight: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["sim", "--out", "here"]) == 0
    assert cli.main(["sim", "--out", "here"]) == 0
    Path("thesis").mkdir()
    Path("thesis/chapter.tex").write_text("precious")
    assert cli.main(["sim", "--out", "thesis"]) == 2
    assert "holds other files" in capsys.readouterr().err
    assert cli.main(["sim", "--out", "thesis/chapter.tex"]) == 2
    assert "is a file" in capsys.readouterr().err
    assert [path.name for path in Path("thesis").iterdir()] == ["chapter.tex"]
    assert len(flight) == 2


@pytest.mark.parametrize(
    ("crashed", "last", "code"),
    [("", Phase.HOLD, 3), ("hit the ground at 3.2 m/s", Phase.APPROACH, 4), ("", Phase.STOPPED, 4)],
)
def test_exit_codes(monkeypatch: pytest.MonkeyPatch, crashed: str, last: Phase, code: int) -> None:
    def fly(arguments: list[str]) -> int:
        out = Path(arguments[2])
        out.mkdir(parents=True)
        tick, truth = CYCLES[700]
        record(out / "log.mcap", [*CYCLES[:700], (change_outputs(tick, phase=last), replace(truth, crashed=crashed))])
        return 0

    fake(monkeypatch, fly)
    assert cli.main(["sim"]) == code


def test_wrong_input_writes_nothing(monkeypatch: pytest.MonkeyPatch, elsewhere: Path) -> None:
    fake(monkeypatch, lambda arguments: 2)
    assert cli.main(["sim", "--set", "nothing=1"]) == 2
    assert not list(elsewhere.iterdir())


def test_killed_flight_is_reported_as_far_as_it_was_recorded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly(arguments: list[str]) -> int:
        path = record(Path(arguments[2]) / "log.mcap")
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        return -9

    Path("out").mkdir()
    fake(monkeypatch, fly)
    assert cli.main(["sim", "--out", "out"]) == 1
    captured = capsys.readouterr()
    assert "code -9" in captured.err
    assert "broken off" in captured.out
    assert json.loads(Path("out/metrics.json").read_text())["outcome"] == "unfinished"


def test_flight_that_recorded_nothing_leaves_the_former_run(
    flight: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main(["sim", "--out", "out"])
    capsys.readouterr()
    fake(monkeypatch, lambda arguments: 1)
    assert cli.main(["sim", "--out", "out"]) == 1
    captured = capsys.readouterr()
    assert "it recorded nothing" in captured.err
    assert not captured.out


def test_report_is_rebuilt_from_the_log_alone(flight: list[list[str]]) -> None:
    cli.main(["sim", "--out", "out"])
    page, figures = Path("out/report.html").read_text(), json.loads(Path("out/metrics.json").read_text())
    Path("out/report.html").unlink()
    Path("out/config.yaml").unlink()
    assert cli.main(["report", "out"]) == 0
    assert Path("out/report.html").read_text() == page
    assert json.loads(Path("out/metrics.json").read_text()) == figures
    Path("out/metrics.json").unlink()
    assert cli.main(["report", "out/log.mcap"]) == 0
    assert json.loads(Path("out/metrics.json").read_text()) == {**figures, "wall_s": None}


def test_report_of_a_cut_off_log(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    path = record(elsewhere / "log.mcap")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert cli.main(["report", "log.mcap"]) == 2
    assert "--partial reads them" in capsys.readouterr().err
    assert [p.name for p in elsewhere.iterdir()] == ["log.mcap"]
    assert cli.main(["report", "log.mcap", "--partial"]) == 0
    assert Path("report.html").is_file()


def test_other_runs_stand_beside(flight: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["sim", "--out", "a"])
    cli.main(["sim", "--out", "b"])
    capsys.readouterr()
    assert cli.main(["report", "a", "--beside", "b", "--beside", "b/log.mcap"]) == 0
    assert Path("a/report.html").read_text().count('<th class="n">scenario paper, law tuned, seed 7</th>') == 2
    assert capsys.readouterr().out.count("0.04000") == 3
    assert cli.main(["report", "a", "--beside", "none"]) == 2


def test_report_of_nothing(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    assert cli.main(["report", "none.mcap"]) == 2
    assert capsys.readouterr().err == "pipewright: none.mcap: no such log; give the log.mcap of a run folder\n"
    assert not list(elsewhere.iterdir())


def test_replay_passes_everything_on(monkeypatch: pytest.MonkeyPatch, elsewhere: Path) -> None:
    calls: list[list[str]] = []

    def onboard(arguments: list[str]) -> int:
        calls.append(arguments)
        return 1

    fake(monkeypatch, onboard)
    assert cli.main(["replay", str(elsewhere), "--from", "12.5", "--partial"]) == 1
    assert calls == [["replay", f"{elsewhere}/log.mcap", "--from=12.5", "--partial"]]


@pytest.mark.parametrize("arguments", [[], ["sim", "--seed", "x"], ["sim", "extra"], ["replay"]])
def test_wrong_commands(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(arguments)
    assert exit_.value.code == 2
    assert "usage: pipewright" in capsys.readouterr().err


def test_help_names_commands_and_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    text = capsys.readouterr().out
    for word in ("sim", "desk", "replay", "report", "vehicle lost"):
        assert word in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sim", "--set", "repair.force=9"], "repair.force"),
        (["sim", "--scenario", "none.yaml"], "none.yaml"),
        (["replay", "none.mcap"], "no such log"),
    ],
)
def test_real_flight_process_refuses_wrong_input(
    arguments: list[str], message: str, capfd: pytest.CaptureFixture[str], elsewhere: Path
) -> None:
    assert cli.main(arguments) == 2
    assert message in capfd.readouterr().err
    assert not list(elsewhere.iterdir())


def test_interrupts_reach_the_flight_process_once(monkeypatch: pytest.MonkeyPatch) -> None:
    script = (
        "import signal, sys\n"
        # blocked, an interrupt waits for the one who asks for it, whenever it comes
        "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})\n"
        "print('ready', flush=True)\n"
        "signal.sigwait({signal.SIGINT})\n"
        "sys.exit(41 + len(signal.sigpending()))\n"
    )
    real = subprocess.Popen
    read_end, write_end = os.pipe()

    def start(command: list[str], **options: int) -> subprocess.Popen[bytes]:
        assert command[1:5] == ["-P", "-m", "onboard", "sim"]
        return real([sys.executable, "-c", script], stdout=write_end, **options)  # type: ignore[call-overload, no-any-return]

    def interrupt() -> None:
        with os.fdopen(read_end) as ready:
            ready.readline()
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(subprocess, "Popen", start)
    helper = threading.Thread(target=interrupt)
    helper.start()
    before = signal.getsignal(signal.SIGINT)
    code = cli._flight_process(["sim"])
    helper.join()
    os.close(write_end)
    assert code == 41
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("command", ["sim", "desk", "report"])
def test_a_package_that_is_not_installed_is_named_with_its_extra(
    command: str, flight: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything has flown, not after."""
    monkeypatch.setitem(sys.modules, "rich", None)
    monkeypatch.setitem(sys.modules, "rich.console", None)
    assert cli.main([command] if command != "report" else ["report", "."]) == BROKEN
    assert "pip install 'pipewright[ground]'" in capsys.readouterr().err
    assert not flight
    assert not Path("runs").exists()
