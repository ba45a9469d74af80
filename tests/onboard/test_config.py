"""The configuration of a run: composed from its files and options, refused with every reason, read back exactly."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from msgspec import structs

from onboard.config import (
    CONFIGS,
    Config,
    dump_config,
    law_names,
    load_config,
    load_config_file,
    scenario_names,
)
from onboard.declared import describe, to_mapping
from onboard.layers import ConfigError
from onboard.params import diff, load, refused_in_flight


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    """A copy of the vehicle, with two small laws and two small scenarios."""
    shutil.copy(CONFIGS / "vehicle.yaml", tmp_path)
    for name, text in {
        "controllers/tuned.yaml": "repair: {hold: 3.0}\n",
        "controllers/plain.yaml": "repair:\n  hold: 4.0\n  force: 3.0\n",
        "scenarios/paper.yaml": "pipe:\n  radius: 0.05\n",
        "scenarios/high.yaml": "law: plain\nseed: 7\npipe:\n  position: [2, 0, 3]\nrepair: {force: 1.5}\n",
    }.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return tmp_path


def errors_of(
    scenario: str = "paper", *sets: str, law: str | None = None, directory: Path = CONFIGS
) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        load_config(scenario, law, sets, None, directory)
    return caught.value.errors


def error_of(scenario: str = "paper", *sets: str, law: str | None = None, directory: Path = CONFIGS) -> str:
    (error,) = errors_of(scenario, *sets, law=law, directory=directory)
    return error


# --- what is shipped --------------------------------------------------------------------------------------------------


def test_every_law_flies_every_scenario_that_is_shipped() -> None:
    assert {"paper", "tuned"} <= set(law_names())
    assert "paper" in scenario_names()
    for law in law_names():
        for scenario in scenario_names():
            config = load_config(scenario, law)
            assert (config.law, config.scenario) == (law, scenario)


def test_the_default_is_the_tuned_law_and_the_paper_scenario() -> None:
    config = load_config()
    assert (config.scenario, config.law, config.seed) == ("paper", "tuned", 0)


def test_every_default_lies_within_its_bounds() -> None:
    """Also for what no shipped file touches."""
    config = Config(vehicle=load_config().vehicle)
    assert load(Config, to_mapping(config), "defaults") == config


def test_every_number_has_bounds_and_a_meaning() -> None:
    numbers = [parameter for parameter in describe(Config) if "number" in parameter.type]
    assert len(numbers) > 100
    assert [p.path for p in numbers if not (p.bounds and p.doc)] == []


def test_nothing_physical_may_change_in_flight() -> None:
    fixed = ("vehicle.", "pipe.", "repair.", "world.", "scenario", "law", "seed")
    assert [p.path for p in describe(Config) if p.in_flight and p.path.startswith(fixed)] == []


# --- composition ------------------------------------------------------------------------------------------------------


def test_later_layers_win(configs: Path) -> None:
    plain = load_config("high", directory=configs)
    assert (plain.law, plain.seed) == ("plain", 7)
    assert (plain.repair.hold, plain.repair.force) == (4.0, 1.5)
    assert plain.pipe.position == (2.0, 0.0, 3.0)
    tuned = load_config("high", "tuned", ["repair.force=2", "repair.force=2.25"], 9, configs)
    assert (tuned.law, tuned.seed) == ("tuned", 9)
    assert (tuned.repair.hold, tuned.repair.force) == (3.0, 2.25)


def test_the_seed_option_wins_over_all(configs: Path) -> None:
    assert load_config("high", None, ["seed=3"], None, configs).seed == 3
    assert load_config("high", None, ["seed=3"], 4, configs).seed == 4


@pytest.mark.parametrize(
    ("option", "path", "value"),
    [
        ("pipe.radius=6e-2", "pipe.radius", 0.06),
        ("repair.force=1", "repair.force", 1.0),
        ("vehicle.base.mass=2", "vehicle.base.mass", 2.0),
        ("vehicle.arm.parts.2.mass=0.02", "vehicle.arm.parts.2.mass", 0.02),
        ("pipe.position.2=2.5", "pipe.position.2", 2.5),
        ("joint_current=0.5", "joint_current", 0.5),
    ],
)
def test_options_reach_scenario_laws_and_vehicle(option: str, path: str, value: object) -> None:
    changes = diff(load_config(), load_config(sets=[option]))
    assert [(change.path, change.new) for change in changes] == [(path, value)]


def test_the_interface_brings_its_gains_and_options_still_win() -> None:
    rate = load_config(sets=["interface=body_rate", "tilt.bandwidth=7"])
    assert rate.interface == "body_rate"
    assert rate.control.rate_lead > 0.0 == load_config().control.rate_lead
    assert rate.tilt.bandwidth == 7.0
    assert load_config(sets=["joints=position"]).tilt.bandwidth < load_config().tilt.bandwidth


def test_an_option_reaches_every_parameter() -> None:
    """Setting each parameter to the value it has changes nothing, and is never refused."""
    config = load_config()
    values = to_mapping(config)

    def leaves(node: object, path: str) -> list[tuple[str, object]]:
        if isinstance(node, dict):
            return [leaf for key, value in node.items() for leaf in leaves(value, f"{path}.{key}".strip("."))]
        if isinstance(node, list) and node and isinstance(node[0], dict):
            return [leaf for i, value in enumerate(node) for leaf in leaves(value, f"{path}.{i}")]
        return [(path, node)]

    found = [(path, value) for path, value in leaves(values, "") if path not in ("scenario", "law")]
    sets = [f"{path}={str(value).lower() if isinstance(value, bool) else value}" for path, value in found]
    sets = ["null".join(text.split("None")) if text.endswith("=None") else text for text in sets]
    sets = [f"{text}''" if text.endswith("=") else text for text in sets]
    assert load_config(sets=sets) == config


def test_a_scenario_may_be_a_file_anywhere(configs: Path) -> None:
    path = configs / "my scene.yaml"
    path.write_text("pipe: {radius: 0.1}\n")
    config = load_config(str(path), directory=configs)
    assert config.pipe.radius == 0.1
    assert config.scenario == str(path)


# --- reading back -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["paper", "tuned"])
def test_the_config_of_a_run_reads_back_to_the_identical_set(tmp_path: Path, law: str) -> None:
    config = load_config(law=law, sets=["pipe.radius=0.07000000000000001", "repair.force=2.1"], seed=5)
    path = tmp_path / "config.yaml"
    path.write_text(dump_config(config))
    assert load_config_file(path) == config
    assert dump_config(load_config_file(path)) == dump_config(config)


def test_a_run_is_repeated_from_its_config(tmp_path: Path) -> None:
    config = load_config(law="paper", sets=["repair.force=2.1"], seed=5)
    path = tmp_path / "config.yaml"
    path.write_text(dump_config(config))
    assert load_config(str(path)) == config
    changed = load_config(str(path), sets=["repair.hold=1"], seed=6)
    assert changed == structs.replace(config, seed=6, repair=structs.replace(config.repair, hold=1.0))
    assert error_of(str(path), law="tuned").startswith("--law tuned: ")


# --- refused ----------------------------------------------------------------------------------------------------------


def test_a_scenario_that_is_not_there_lists_those_that_are_nearest_first(configs: Path) -> None:
    assert error_of("hihg", directory=configs) == (
        "--scenario hihg: no scenario of the name 'hihg'; there are: high, paper"
    )
    assert error_of("papper", directory=configs).endswith("there are: paper, high")
    assert error_of("", directory=configs).startswith("--scenario : no scenario of the name ''; there are: ")


def test_a_law_that_is_not_there_lists_those_that_are_nearest_first(configs: Path) -> None:
    assert error_of(law="tune", directory=configs) == "--law tune: no law of the name 'tune'; there are: tuned, plain"
    (configs / "scenarios" / "odd.yaml").write_text("law: 5\n")
    assert re.search(r"odd\.yaml: no law of the name '5'; there are: ", error_of("odd", directory=configs))


@pytest.mark.parametrize("name", ["../vehicle", "..", ".", "paper/..", "*"])
def test_a_name_leads_nowhere_else(configs: Path, name: str) -> None:
    assert len(errors_of(name, directory=configs)) == 1
    assert "no law" in error_of(law=name, directory=configs)


def test_a_scenario_file_that_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "absent.yaml"
    assert error_of(str(path)) == f"{path}: cannot be read: No such file or directory"


def test_a_full_config_that_is_not_complete(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("scenario: paper\nlaw: tuned\n")
    with pytest.raises(ConfigError, match=r"config\.yaml: vehicle: missing; must be a group of gravity, base"):
        load_config_file(path)


def test_no_configs_at_all(tmp_path: Path) -> None:
    errors = errors_of(directory=tmp_path)
    assert len(errors) == 3
    assert all("not found" in error or "there is none in" in error for error in errors)


def test_wrong_options_are_all_told_at_once() -> None:
    errors = errors_of("papre", "pipe.radius", "law=paper", "scenario=x", "a=[1", law="tund")
    assert [error.split(":")[0] for error in errors] == [
        "--scenario papre",
        "--set pipe.radius",
        "--set law=paper",
        "--set scenario=x",
        "--set a=[1",
        "--law tund",
    ]


def test_wrong_values_are_all_told_at_once_with_their_place(configs: Path) -> None:
    vehicle = configs / "vehicle.yaml"
    vehicle.write_text(vehicle.read_text().replace("curve: 0.3 ", "curve: 3.0 "))
    (configs / "controllers" / "plain.yaml").write_text("repair:\n  hold: long\n")
    (configs / "scenarios" / "high.yaml").write_text("law: plain\npipe:\n  raduis: 0.1\n  heading_deg: 270\n")
    errors = errors_of("high", "repair.force=25", directory=configs)
    assert len(errors) == 5
    assert re.search(r"vehicle\.yaml:\d+: vehicle\.rotors\.curve = 3\.0: must be a number from 0 to 1", errors[0])
    assert re.search(r"high\.yaml:3: pipe\.raduis: no such parameter; nearest: pipe\.radius", errors[1])
    assert re.search(r"high\.yaml:4: pipe\.heading_deg = 270: must be a number from -180 to 180 deg", errors[2])
    assert re.search(r"--set repair\.force=25: repair\.force = 25: must be a number from 0\.5 to 4 N", errors[3])
    assert re.search(r"plain\.yaml:2: repair\.hold = 'long': must be a number from 0\.5 to 120 s", errors[4])


def test_an_unknown_option_lists_the_nearest_parameters() -> None:
    assert "nearest: pipe.radius" in error_of("paper", "pipe.raduis=1")
    assert "repair.force" in error_of("paper", "force=1")
    assert "nearest: vehicle.base.mass" in error_of("paper", "vehicle.base.mas=1")
    assert "nearest: vehicle.arm.parts.2.mass" in error_of("paper", "vehicle.arm.parts.2.mas=1")


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_out_of_bounds(seed: int) -> None:
    with pytest.raises(
        ConfigError, match=rf"^--seed {seed}: seed = {seed}: must be a whole number from 0 to 4294967295"
    ):
        load_config(seed=seed)


def test_in_flight_only_what_may_change_may_change() -> None:
    config = load_config()
    assert refused_in_flight(config, load_config(sets=["pipe.radius=0.1", "backstepping.alpha=1.5"])) == ["pipe.radius"]
