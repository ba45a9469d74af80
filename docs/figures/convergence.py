"""Writes docs/convergence.md: the figures of the table with ever smaller physics steps.

Run from the repository's root: python -m docs.figures.convergence
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.acceptance.convergence import FLOORS, RELATIVE, Change, changes
from tests.acceptance.flights import Hangar, completed

ROOT = Path(__file__).parents[2]
#: Physics steps, us; the second is the default.
STEPS = (200, 100, 50, 25)
DEFAULT, HALF = 100, 50
#: Scenario, title and what to know.
MISSIONS = {
    "paper": "Scenario `paper`: ideal motors and servos\n",
    "desk": "Scenario `desk`: motor lag, gear friction, attitude interface\n\n"
    "The slide of the tip differs by 2 um, or 4 %. It does not shrink with the step: no error of integration.\n",
}
HEAD = """\
<!-- Written by docs/figures/convergence.py; do not edit. -->
# Convergence of the world

Missions flown with four physics steps. In the scenario `paper`, halving the default step of {default} us must
change no figure by more than {relative:.0%}; `tests/acceptance/test_convergence.py` holds it to that.
A change counts as none where it is below the floor of its unit: {floors}.
The loop runs at 250 Hz in all of them.
"""


def main() -> None:
    """Fly, compare, write."""
    floors = ", ".join(f"{floor:g} {unit}" for unit, floor in FLOORS.items() if unit)
    parts = [HEAD.format(default=DEFAULT, relative=RELATIVE, floors=floors)]
    with TemporaryDirectory() as folder:
        fly = Hangar(Path(folder))
        for scenario, title in MISSIONS.items():
            flown = {step: fly(f"world.plant.step={step * 1e-6:g}", scenario=scenario) for step in STEPS}
            assert all(completed(one) for one in flown.values())
            found = {step: changes(flown[DEFAULT].metrics, flown[step].metrics) for step in STEPS}
            parts.append(f"\n## {title}\n" + "\n".join(table(found)) + "\n")
    (ROOT / "docs" / "convergence.md").write_text("".join(parts))


def table(found: dict[int, list[Change]]) -> Iterator[str]:
    """A row for each figure: its value with each step, and what halving the default step changes."""
    yield "| figure | unit | " + " | ".join(f"{step} us" for step in STEPS) + f" | {DEFAULT} to {HALF} us |"
    yield "|---|---|" + "---:|" * (len(STEPS) + 1)
    for row in zip(*found.values(), strict=True):
        by_step = dict(zip(found, row, strict=True))
        figure = by_step[DEFAULT].figure
        values = [number(by_step[step].other, figure.unit) for step in STEPS]
        yield f"| {figure.name} | {figure.unit or '1'} | {' | '.join(values)} | {by_step[HALF].relative:.2%} |"


def number(value: float, unit: str) -> str:
    """Four digits; 0 below the floor."""
    return "0" if abs(value) <= FLOORS[unit] else f"{value:.4g}"


if __name__ == "__main__":
    main()
