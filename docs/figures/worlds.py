"""Writes docs/worlds.md and docs/images/film/: whole missions in both worlds, figure by figure, and the film of one.

Run from the repository's root: python -m docs.figures.worlds
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from groundstation import cli, table
from tests.acceptance.flights import Flown, Hangar, completed

ROOT = Path(__file__).parents[2]
FILM = ROOT / "docs" / "images" / "film"
#: Between the force rows of both worlds, N.
APART = 0.03
SCENARIOS = {
    "paper": "ideal motors and servos, wrench interface",
    "desk": "motor lag, gear friction, attitude interface",
}
HEAD = """\
<!-- Written by docs/figures/worlds.py; do not edit. -->
# Two worlds

Whole missions with the law `tuned`, flown twice: the vehicle moved by our equations of motion (10 kHz, leapfrog), and
by PyBullet (4 kHz, its own solver, contact and friction; [0024](decisions/0024-pybullet.md)). All else is the same
code. Forces over the contact, states over the flight, as in Table II. The force rows must be within {apart} N of each
other; the largest difference here is {largest:.4f} N.

    pipewright sim --out runs/rigid
    pipewright sim --plant pybullet --out runs/pybullet
    pipewright report runs/rigid --beside runs/pybullet

![Each phase of the mission in PyBullet, from the middle of the phase](images/film/phases.png)

`pipewright film runs/pybullet` makes the film: [film.gif](images/film/film.gif).
"""


def main() -> None:
    """Fly, compare, film, write."""
    parts, largest = [], 0.0
    with TemporaryDirectory() as folder:
        fly = Hangar(Path(folder))
        for scenario, words in SCENARIOS.items():
            rigid, bullet = (fly(f"world.plant.kind={kind}", scenario=scenario) for kind in ("rigid", "pybullet"))
            assert completed(rigid)
            assert completed(bullet)
            parts.append(f"\n## Scenario `{scenario}`: {words}\n\n" + "\n".join(rows(rigid, bullet)) + "\n")
            one, other = (flown.metrics["force_rmse"] for flown in (rigid, bullet))
            largest = max(largest, *(abs(one[row] - other[row]) for row in one))
            if scenario == "paper":
                assert cli.main(["film", str(bullet.log), "--out", str(FILM)]) == 0
    assert largest <= APART
    for path in FILM.glob("[0-9]*.png"):
        path.unlink()
    (ROOT / "docs" / "worlds.md").write_text(HEAD.format(apart=APART, largest=largest) + "".join(parts))


def rows(rigid: Flown, bullet: Flown) -> Iterator[str]:
    """The rows of Table II, and the figures of the contact."""
    yield "| | unit | paper | rigid body | PyBullet | apart |"
    yield "|---|---|---:|---:|---:|---:|"
    for one, other in zip(table.rows(rigid.metrics), table.rows(bullet.metrics), strict=True):
        assert one.value is not None
        assert other.value is not None
        apart = abs(one.value - other.value)
        yield f"| {one.label} | {one.unit} | {one.paper} | {one.value:.5f} | {other.value:.5f} | {apart:.5f} |"
    for key, unit in (("hold_mean", "N"), ("touchdown_peak", "N"), ("time_to_95", "s"), ("tip_slip", "m")):
        a, b = (float(flown.metrics["contact"][key]) for flown in (rigid, bullet))
        yield f"| {key.replace('_', ' ')} | {unit} | | {a:.5f} | {b:.5f} | {abs(a - b):.5f} |"


if __name__ == "__main__":
    main()
