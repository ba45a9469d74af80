"""The bench itself, on the first seconds of a mission: no figure is judged, only that they belong together."""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from onboard.config import load_config
from tests.bench import compare
from tests.bench.__main__ import main
from tests.bench.table import WIDTH


@pytest.mark.filterwarnings("ignore:Passing more than 2:DeprecationWarning")  # scikit-fuzzy with a new NumPy
def test_a_short_run_fills_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "bench.json"
    assert (
        main(["--longest", "4", "--cycles", "120", "--trials", "0", "--runs", "0", "--no-desk", "--json", str(out)])
        == 0
    )
    report = json.loads(out.read_text("utf-8"))
    core, flight = report["core"], report["flight"]
    assert core["step"]["count"] == 1001
    assert 0.5 < sum(part["share"] for part in core["parts"]) < 1.5
    for part in core["parts"]:
        assert part["time"]["median"] < core["step"]["median"]
        assert sum(inside["share"] for inside in part["inside"]) < part["share"] + 0.1
    assert flight["core_s"] + flight["world_s"] + flight["recorder_s"] < flight["wall_s"]
    assert flight["sim_s"] == pytest.approx(4.0)
    assert flight["log_bytes"] > 100_000
    other = report["bullet"]
    assert other["sim_s"] == pytest.approx(4.0)
    assert 0.0 < other["sim_s"] / other["world_s"] < flight["sim_s"] / flight["world_s"]
    for row in report["comparisons"]:
        assert row["ratio"] is None or row["difference"] < 0.01, row["package"]
    assert [row["baud"] for row in report["servos"]] == [1_000_000, 4_000_000]
    assert report["setpoints"]["ours"]["count"] == report["setpoints"]["bare"]["count"] == 120
    assert report["lateness"]["loop"]["count"] == report["lateness"]["bare"]["count"] == 120
    assert report["worlds"]["ours"] > 10_000
    assert report["throughput"] is None
    assert report["desk"] is None
    assert report["emergency"] is None

    text = capsys.readouterr().out
    assert max(map(len, text.split("\nThe same")[0].splitlines())) <= WIDTH
    for name in (
        "whole step",
        "dynamics",
        "limits",
        "recorder",
        "In PyBullet",
        "a tick of 16 steps",
        "fuzzy law",
        "mass matrix",
        "servo cycle",
        "bare UDP",
        "bare timer",
        "rigid-body world",
    ):
        assert name in text


def test_a_package_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare, "version", _not_installed)
    config = load_config()
    rows = compare.compare(config.fuzzy, config.vehicle)
    assert {row.name for row in rows} == {"fuzzy law", "inverse dynamics", "mass matrix"}
    assert all(row.ratio is None and "is not installed" in row.package for row in rows)


def _not_installed(distribution: str) -> str:
    raise PackageNotFoundError(distribution)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--longest", "0"], "from 1 to 900 s"),
        (["--cycles", "3"], "from 40 to 100000"),
        (["--trials", "3"], "0, or from 10 to 100000"),
        (["--runs", "-1"], "from 0 to 1000"),
        (["--json", "{here}"], "cannot be written"),
        (["--set", "no.such=1"], "no.such"),
    ],
)
def test_wrong_input(arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [text.format(here=tmp_path) for text in arguments]
    json_at = [] if "--json" in given else ["--json", str(tmp_path / "bench.json")]
    try:
        code = main([*given, *json_at])
    except SystemExit as stop:
        code = int(stop.code or 0)
    assert code == 2
    assert words in capsys.readouterr().err
