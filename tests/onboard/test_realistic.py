"""The scenario ``realistic``: what it switches on is told in docs/realism.md, and each of it can be had alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml

from drivers.samples import AutopilotCommand, AutopilotState, Engage, Interface, Odometry, ServoState
from onboard.config import CONFIGS, Config, load_config
from onboard.devices import world_of
from sim_backend.mock_devices import MockAutopilot
from sim_backend.sensors import REALISTIC
from sim_backend.world import World

PAGE = Path(__file__).resolve().parents[2] / "docs" / "realism.md"
#: How large or how long something is that another parameter switches on; and what is no different elsewhere.
SIZES = {
    "sensors.odometry.jump", "sensors.odometry.doubt_time", "sensors.odometry.doubt_confidence",
    "sensors.odometry.doubt_noise", "plant.contact.patch", "wind.towards_deg", "autopilot.command_delay",
}  # fmt: skip
#: Too rare to be met within a second, so more of it.
RARE = {
    "sensors.odometry.jump_rate": 5.0, "sensors.odometry.doubt_rate": 5.0, "sensors.autopilot.loss": 0.3,
    "autopilot.command_loss": 0.3,
}  # fmt: skip


#: Between two looks at the devices, s: within the period of each.
LOOK = 0.002


def leaves(values: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


SET = dict(leaves(yaml.safe_load((CONFIGS / "scenarios" / "realistic.yaml").read_text("utf-8"))["world"]))


def test_the_page_tells_every_value_of_the_scenario() -> None:
    rows = [line.split("|")[1:-1] for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| `")]
    told = {name.strip(" `"): yaml.safe_load(value) for name, value, *_ in rows}
    assert {name: float(value) for name, value in told.items()} == {name: float(value) for name, value in SET.items()}
    assert all(meaning.strip() for *_, meaning, _ in rows)


def test_an_emulator_alone_errs_as_the_scenario_says() -> None:
    assert load_config("realistic").world.sensors == REALISTIC


def world(*sets: str, scenario: str = "paper", seed: int = 3) -> World:
    return world_of(load_config(scenario, sets=sets, seed=seed))


def look(where: World) -> tuple[Odometry | None, AutopilotState | None, ServoState | None, list[float]]:
    now, sensors = where.snapshot, where.sensors
    return sensors.odometry(now), sensors.autopilot(now), sensors.servos(now), now.x


def flown(where: World, seconds: float = 1.2) -> list[object]:
    """What the devices tell in a jump into the air, and how the world went."""
    autopilot, weight = MockAutopilot(where), 2.5 * 9.81
    told: list[object] = []
    for k in range(round(seconds / LOOK)):
        lift = weight * (1.1 + 0.02 * (k % 11))
        zero = (0.0, 0.0, 0.0)
        autopilot.command(AutopilotCommand(Engage.OFFBOARD, Interface.ATTITUDE, lift, zero, (1.0, 0.0, 0.0, 0.0), zero))
        where.advance(LOOK)
        told.append(look(where))
    return told


@pytest.fixture(scope="module")
def plain() -> tuple[list[float], list[object]]:
    where = world()
    return where.plant.p.tolist(), flown(where)


@pytest.mark.parametrize("name", sorted(set(SET) - SIZES))
def test_each_condition_alone_is_felt(name: str, plain: tuple[list[float], list[object]]) -> None:
    value = RARE.get(name, SET[name])
    config: Config = load_config("paper", sets=[f"world.{name}={str(value).lower()}"], seed=3)
    before = msgspec.to_builtins(load_config("paper", seed=3).world)
    after = msgspec.to_builtins(config.world)
    assert [path for path, was in leaves(before) if dict(leaves(after))[path] != was] == [name]
    where = world_of(config)
    assert where.plant.p.tolist() != plain[0] or flown(where) != plain[1]


def test_all_at_once_repeat_to_the_bit_and_follow_the_seed() -> None:
    first = flown(world(scenario="realistic"))
    assert first == flown(world(scenario="realistic"))
    assert first != flown(world(scenario="realistic", seed=4))


def test_one_condition_does_not_change_the_random_numbers_of_another() -> None:
    """The same wind with other deviations, and the same bias with other noise of the camera."""
    gusts = "world.wind.gusts=3"
    one, other = world(gusts), world(gusts, "world.deviations.mass=0.03", "world.sensors.odometry.position_noise=0.01")
    assert [one.wind.until(k * 10**8) for k in range(50)] == [other.wind.until(k * 10**8) for k in range(50)]
