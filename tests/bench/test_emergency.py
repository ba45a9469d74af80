"""The bench of the emergency stop, on a few trials: no figure is judged, only that they belong together."""

from __future__ import annotations

import pytest

from tests.bench.emergency import measure
from tests.bench.emergency.measure import Condition, Emergency
from tests.bench.table import WIDTH, emergency_rows
from tests.lossy_network import UnavailableError


def judged(condition: Condition, trials: int) -> None:
    assert condition.kill.count == condition.limp.count == condition.stop.count == trials
    assert condition.answer.count == condition.put.count == 2 * trials
    assert condition.get.count == trials
    for spread in (condition.kill, condition.limp, condition.stop, condition.answer, condition.put, condition.get):
        assert 0.0 < spread.median <= spread.p99
    rows = emergency_rows(Emergency((condition,), "no namespaces"))
    assert max(map(len, rows)) <= WIDTH
    assert sum("target" in row for row in rows) == 3
    assert rows[-1] == "no lossy network here: no namespaces"


@pytest.mark.parametrize("stuck", [False, True])
def test_loopback(stuck: bool) -> None:
    condition = measure._loopback("loopback", 12, stuck=stuck)
    judged(condition, 12)
    assert not condition.kill.missing
    assert not condition.stop.missing


def test_lossy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "LOSS", 0.05)
    monkeypatch.setattr(measure, "DELAY", 0.02)
    monkeypatch.setattr(measure, "_STATIONS", 4)
    try:
        condition = measure._lossy("lossy", 12)
    except UnavailableError as error:
        pytest.skip(str(error))
    assert condition.kill.median > 20.0
    assert condition.get.median > 40.0
