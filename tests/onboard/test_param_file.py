"""Parameters of a configuration file: looked up, set, compared and saved."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from onboard.config import CONFIGS, dump_config, load_config
from onboard.layers import ConfigError
from onboard.param_file import ParameterFile, save
from onboard.params import diff


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.yaml"
    shutil.copy(CONFIGS / "desk.yaml", path)
    return path


def refused(*errors: str) -> pytest.RaisesExc[ConfigError]:
    return pytest.RaisesExc(
        ConfigError, check=lambda error: all(any(e in line for line in error.errors) for e in errors)
    )


# --- looking up -------------------------------------------------------------------------------------------------------


def test_a_name_is_a_parameter_an_element_or_a_group() -> None:
    file = ParameterFile("desk")
    (force,) = file.find(["repair.force"])
    assert (force.value, force.unit, force.may_change) == (2.5, "N", "on the ground")
    assert {entry.path for entry in file.find(["repair"])} >= {"repair.force", "repair.hold"}
    (height,) = file.find(["pipe.position.2"])
    assert (height.value, height.unit) == (1.5, "m")
    (sign,) = file.find(["devices.servos.servos.1.sign"])
    assert (sign.value, sign.may_change) == (1, "by a restart")
    assert next(entry.path for entry in file.find(["repair.hold", "repair", "repair.hold"])) == "repair.hold"


def test_all_are_listed_once_and_each_is_found_by_its_name() -> None:
    table = ParameterFile("desk").find([])
    assert len(table) == len({entry.path for entry in table}) > 300
    assert {entry.may_change for entry in table} == {"in flight", "on the ground", "by a restart"}
    some = table[::25]
    assert ParameterFile("desk").find([entry.path for entry in some]) == some


def test_every_wrong_name_is_told_with_its_nearest() -> None:
    with refused(
        "repair.forc: no such parameter; nearest: repair.force",
        "pip.radius: no such parameter; nearest: pipe.radius",
        "pipe.position.3: no such parameter",
        "repair.force.x: no such parameter",
    ):
        ParameterFile("desk").find(["repair.forc", "pip.radius", "pipe.position.3", "repair.force.x", "repair.hold"])


# --- setting ----------------------------------------------------------------------------------------------------------


def test_values_are_put_into_the_file_and_nothing_else_changes(mine: Path) -> None:
    before, text = load_config(str(mine)), mine.read_text()
    changes = ParameterFile(str(mine)).put(["repair.force=3", "pipe.position.1=0.5", "pipe.length=3"])
    assert [(change.path, change.old, change.new) for change in changes] == [
        ("pipe.position.1", 0.0, 0.5),
        ("pipe.length", before.pipe.length, 3.0),
        ("repair.force", 2.5, 3.0),
    ]
    assert diff(before, load_config(str(mine))) == list(changes)
    assert mine.read_text() == text.replace("[2.0, 0.0,", "[2.0, 0.5,").replace("force: 2.5", "force: 3.0").replace(
        "0.08                # m\n", "0.08                # m\n  length: 3.0\n"
    )


def test_a_value_that_is_there_already_leaves_the_file_untouched(mine: Path) -> None:
    before = mine.stat()
    assert ParameterFile(str(mine)).put(["repair.force=2.5"]) == ()
    assert (mine.stat().st_ino, mine.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_all_that_is_wrong_is_told_at_once_and_nothing_written(mine: Path) -> None:
    text = mine.read_text()
    with refused("--set pipe.radius=9: pipe.radius = 9: must be", "repair.forc: no such parameter; nearest",
                 "--set x: must have the form"):  # fmt: skip
        ParameterFile(str(mine)).put(["pipe.radius=9", "repair.forc=1", "x", "repair.hold=5"])
    assert mine.read_text() == text
    assert list(mine.parent.iterdir()) == [mine]


def test_a_law_and_an_interface_bring_their_gains_and_only_their_names_are_written(mine: Path) -> None:
    ParameterFile(str(mine)).put(["law=paper", "interface=body_rate"])
    assert load_config(str(mine)) == load_config(str(mine), "paper", ["interface=body_rate"])
    assert len(mine.read_text().splitlines()) == len((CONFIGS / "desk.yaml").read_text().splitlines()) + 1


def test_a_list_of_another_file_is_changed_by_one_group_or_written_as_a_whole(mine: Path) -> None:
    ParameterFile(str(mine)).put(["vehicle.arm.parts.2.mass=0.02", "vehicle.arm.parts.3.along.0=0.11"])
    config = load_config(str(mine))
    assert config.vehicle.arm.parts[2].mass == 0.02
    assert config.vehicle.arm.parts[3].along == (0.11, 0.0, 0.0)
    assert mine.read_text().endswith(
        "    parts:\n      2:\n        mass: 0.02\n      3:\n        along: [0.11, 0.0, 0.0]\n"
    )


def test_a_group_that_need_not_be_there_comes_and_goes(mine: Path) -> None:
    thrust = (
        "{hover_thrust: 0.4, hover_force: 24.0, hover_voltage: 15.0, curve: 0.3, px4_curve: 0.3, voltage_exponent: 1.0}"
    )
    file = ParameterFile(str(mine))
    file.put([f"devices.autopilot.thrust={thrust}"])
    (found,) = file.find(["devices.autopilot.thrust.hover_force"])
    assert found.value == 24.0
    file.put(["devices.autopilot.thrust.hover_force=25"])
    file.put(["devices.autopilot.thrust=null"])
    assert load_config(str(mine)).devices.autopilot.thrust is None


def test_a_value_that_shares_its_text_with_another_is_not_written(mine: Path) -> None:
    text = mine.read_text().replace("force: 2.5 ", "force: &two 2.5 ").replace("hold: 12.0", "hold: *two")
    mine.write_text(text)
    with refused("repair.hold = 2.5: the file would still make it 3.0", "nothing was written"):
        ParameterFile(str(mine)).put(["repair.force=3"])
    assert mine.read_text() == text


def test_a_group_that_shares_its_text_with_another_is_not_written(mine: Path) -> None:
    text = mine.read_text().replace(
        "autopilot: {kind: emulated, parameters: x500.params}", "autopilot: &same {kind: mock}"
    )
    text = text.replace("odometry: {kind: emulated}", "odometry: *same")
    mine.write_text(text)
    with refused("devices.odometry.kind = 'mock': the file would still make it 'real'", "nothing was written"):
        ParameterFile(str(mine)).put(["devices.autopilot.kind=real"])
    assert mine.read_text() == text


def test_a_name_belongs_to_the_program(tmp_path: Path) -> None:
    with refused("--config desk: belongs to the program; copy its file"):
        ParameterFile("desk").put(["repair.force=3"])
    with refused("no scenario of the name 'dusk'"):
        ParameterFile("dusk").put(["repair.force=3"])
    with refused("cannot be read: No such file"):
        ParameterFile(str(tmp_path / "absent.yaml")).put(["repair.force=3"])


# --- comparing and saving ---------------------------------------------------------------------------------------------


def run_folder(folder: Path, *sets: str) -> Path:
    folder.mkdir()
    (folder / "config.yaml").write_text(dump_config(load_config("desk", sets=sets)))
    return folder


def test_a_run_is_compared_with_a_file_and_saved_into_it(mine: Path, tmp_path: Path) -> None:
    run = run_folder(tmp_path / "run", "repair.force=3", "fuzzy.output_scale=7", "seed=4")
    file = ParameterFile(str(mine))
    assert {change.path for change in file.differences(str(run))} == {"repair.force", "fuzzy.output_scale", "seed"}
    changes = file.save(str(run))
    assert {change.path for change in changes} == {"repair.force", "fuzzy.output_scale", "seed"}
    assert file.differences(str(run)) == file.save(str(run)) == ()
    assert "# m, W" in mine.read_text()


def test_without_another_the_defaults_are_compared() -> None:
    changed = {change.path for change in ParameterFile("paper").differences(None)}
    law, ideal_servos = {path for path in changed if path.startswith("fuzzy.")}, "estimators.momentum.supply_current"
    assert law
    assert changed == {*law, ideal_servos}
    paths = {change.path for change in ParameterFile("desk").differences(None)}
    assert paths >= {"interface", "devices.autopilot.kind"}
    assert "scenario" not in paths


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "repair.force": st.floats(0.5, 4.0),
            "pipe.heading_deg": st.floats(-180.0, 180.0),
            "law": st.sampled_from(["paper", "tuned"]),
            "joints": st.sampled_from(["torque", "position"]),
            "interface": st.sampled_from(["wrench", "attitude", "body_rate"]),
            "devices.autopilot.url": st.sampled_from(["udpin://0.0.0.0:14540", "", "off", "a # b: c"]),
            "process.cpu": st.lists(st.integers(0, 7), max_size=3),
            "world.sensors.servos.grain": st.booleans(),
        },
    )
)
@settings(max_examples=12, deadline=None)
def test_whatever_is_wanted_the_file_makes_it(
    tmp_path_factory: pytest.TempPathFactory, values: dict[str, object]
) -> None:
    path = tmp_path_factory.mktemp("any") / "mine.yaml"
    shutil.copy(CONFIGS / "desk.yaml", path)
    law = str(values.pop("law", "tuned"))
    sets = [f"{name}={text(value)}" for name, value in values.items()]
    wanted = load_config("desk", law, sets)
    save(path, wanted)
    assert diff(load_config(str(path)), wanted) == diff(load_config(str(path)), load_config("desk", law, sets))
    assert {change.path for change in diff(load_config(str(path)), wanted)} == {"scenario"}


def text(value: object) -> str:
    return f"'{value}'" if isinstance(value, str) else str(value).lower()
