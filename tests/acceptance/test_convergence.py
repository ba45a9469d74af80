"""The world's physics step is small enough: halving it changes no figure of the table by more than 2 per cent."""

from __future__ import annotations

from tests.acceptance.convergence import RELATIVE, changes
from tests.acceptance.flights import Hangar, completed


def test_halving_the_physics_step_changes_nothing(fly: Hangar) -> None:
    usual, halved = fly(), fly("world.plant.step=5e-5")
    assert completed(usual)
    assert completed(halved)
    found = changes(usual.metrics, halved.metrics)
    assert len(found) == 3 + 2 * 9 + 9 + 2 + 2
    assert any(change.other != change.figure.value for change in found), "the step was really another"
    moved = {change.figure.name: (change.figure.value, change.other) for change in found if change.relative > RELATIVE}
    assert not moved
