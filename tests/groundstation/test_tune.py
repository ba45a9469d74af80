"""Tuning: the search goes on where it was, finds what is best, and what it has found can be flown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from groundstation import campaign_pool, campaign_run, cli, codes
from groundstation.campaign_file import Job
from groundstation.tune_file import SHIPPED, Objective, read_tuning
from onboard.config import load_config
from onboard.headless import ConfigError, range_of

CAMPAIGN = "scenario: paper\nseeds: 3\nset: [repair.hold=2.0]\n"
TUNING = """
campaign: seeds.yaml
trials: 14
parameters:
  - {name: fuzzy.output_scale, low: 1.0, high: 100.0, log: true}
  - {name: repair.force, low: 1.0, high: 3.0}
"""


class Workers:
    """Flies nothing: each run's figure follows from the parameters it would be flown with. Best at 20 and 2.5."""

    def __init__(self) -> None:
        self.flown: list[Job] = []
        self.stop_at = 10_000

    def each(
        self, function: Callable[[Job], Any], jobs: Iterable[Job], lost: Callable[[Job, str], Any]
    ) -> Iterator[dict[str, Any]]:
        for job in jobs:
            if len(self.flown) >= self.stop_at:
                raise KeyboardInterrupt
            self.flown.append(job)
            config = load_config(job.scenario, job.law, job.sets, job.seed)
            off = abs(config.fuzzy.output_scale - 20.0) / 20.0 + abs(config.repair.force - 2.5) + 0.01 * job.seed
            yield campaign_run.failed(job, "") | {"end": "completed", "ok": True, "meas_des": off}


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> Workers:
    found = Workers()

    @contextmanager
    def pool(count: int, scheduler: str | None) -> Iterator[Workers]:
        yield found

    monkeypatch.setattr(campaign_pool, "pool", pool)
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "seeds.yaml").write_text(CAMPAIGN)
    (tmp_path / "gains.yaml").write_text(TUNING)
    return tmp_path


def tune(folder: Path, *more: str) -> int:
    return cli.main(["tune", str(folder / "gains.yaml"), "--out", str(folder / "study"), "--no-progress", *more])


def test_it_begins_with_what_is_in_force_and_what_it_finds_can_be_flown(
    folder: Path, workers: Workers, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune(folder) == codes.DONE
    now = load_config("paper")
    assert f"fuzzy.output_scale={now.fuzzy.output_scale}" in workers.flown[0].sets
    assert {job.seed for job in workers.flown} == {0, 1, 2}
    best = load_config(str(folder / "study" / "best.yaml"), seed=0)
    assert best.repair.hold == 2.0
    assert abs(best.fuzzy.output_scale - 20.0) / 20.0 + abs(best.repair.force - 2.5) < 0.5
    assert set(yaml_of(folder / "study" / "gains.yaml")) == {"fuzzy", "repair"}
    page = (folder / "study" / "study.md").read_text()
    assert "`fuzzy.output_scale`" in page
    for picture in ("history", "importance", "parameters"):
        assert (folder / "study" / "images" / f"tune-gains-{picture}.png").is_file()
    assert "pipewright sim --scenario" in capsys.readouterr().out


def yaml_of(path: Path) -> dict[str, Any]:
    from onboard.layers import read_yaml

    return read_yaml(path).values


def test_broken_off_it_goes_on_where_it_was(folder: Path, workers: Workers) -> None:
    workers.stop_at = 3 * 4 + 1
    assert tune(folder) == codes.INTERRUPTED
    broken = workers.flown[-1].sets
    workers.stop_at = 10_000
    assert tune(folder, "--trials", "6") == codes.DONE
    trials = [job.sets for job in workers.flown if job.seed == 0]
    assert len(trials) == 5 + 2, "six trials, the fifth of them twice"
    assert trials[5] == broken, "what was broken off is flown again"
    flown = len(workers.flown)
    assert tune(folder, "--trials", "6") == codes.DONE
    assert len(workers.flown) == flown, "there is nothing left to do"


def test_another_tuning_does_not_go_into_the_same_study(
    folder: Path, workers: Workers, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune(folder, "--trials", "1") == codes.DONE
    (folder / "gains.yaml").write_text(TUNING.replace("high: 3.0", "high: 2.8"))
    assert tune(folder) == codes.WRONG_INPUT
    assert "holds the study of another tuning" in capsys.readouterr().err


def test_the_worst_run_counts_and_what_is_lost_counts_more() -> None:
    good, late = {"meas_des": 0.1, "end": "completed"}, {"meas_des": 0.3, "end": "completed"}
    objective = Objective()
    assert objective.value([good, late]) == pytest.approx(0.3)
    assert Objective(quantile=0.5).value([good, late]) == pytest.approx(0.2)
    assert objective.value([good, {"meas_des": 0.1, "end": "landed"}]) == pytest.approx(0.1 + 2.0 / 2)
    assert objective.value([good, {"meas_des": None, "end": "lost"}]) == pytest.approx(3.0 + 2.0 / 2 + 20.0 / 2)


def test_every_error_at_once(folder: Path) -> None:
    (folder / "gains.yaml").write_text(
        """
        campaign: seeds.yaml
        objective: {metric: meas}
        parameters:
          - {name: fuzzy.output_scal, low: 1, high: 2}
          - {name: repair.force, low: 1, high: 1000}
          - {name: repair, low: 1, high: 2}
        """
    )
    with pytest.raises(ConfigError) as told:
        read_tuning(str(folder / "gains.yaml"))
    words = "\n".join(told.value.errors)
    assert len(told.value.errors) == 4
    assert "objective.metric = 'meas': no such figure; nearest: meas_des" in words
    assert "fuzzy.output_scal: no such parameter; nearest: fuzzy.output_scale" in words
    assert "repair.force: from 1 to 1000: must be within" in words
    assert "repair: is no single number or choice" in words


def test_bounds_come_from_the_declarations() -> None:
    assert range_of("pipe.position.0").low < 0.0
    assert range_of("interface").choices == ("wrench", "attitude", "body_rate")
    assert range_of("seed").whole
    assert range_of("observer.tare").choices == (False, True)


@pytest.mark.parametrize("name", SHIPPED.names())
def test_what_is_shipped_can_be_tuned(name: str) -> None:
    study = read_tuning(name)
    assert study.jobs({})[0].scenario
