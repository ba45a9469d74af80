"""Files that people write or damage: configurations, rosters, PX4's parameters, lists of faults. Refused in words."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.px4_parameters import read_parameters
from onboard.config import CONFIGS, Config, dump_config, load_config, load_config_file
from onboard.declared import to_mapping
from onboard.layers import LARGEST, ConfigError, dump_text, parse_set, parse_yaml, read_yaml
from onboard.param_file import ParameterFile
from onboard.params import load
from onboard.roster import RosterError, load_roster
from sim_backend.faults import Fault, Faults, Kind, read_fault_file, read_faults
from tests.link.wrong_input import damaged, examples, laughs, misspelt, nested, plain, spoilt, taken, yamlish

TEXTS = tuple(path.read_text() for path in sorted(CONFIGS.rglob("*.yaml")) if path.name != "vehicle.yaml")
#: What people write into YAML that programs do not.
ODD = (
    "base: &base {speed: 0.3}\nplan: *base\n",
    "plan:\n  ? speed\n  : 0.3\n",
    "---\nplan: {speed: 0.3, # slow\n  acceleration: 0.2}\n...\n",
    "plan:\r\n  speed: 0.3 # slow\r\n",
    "\ufeffplan:\n  'speed': \"0.3\"\n",
    "repair:\n  force: !!float 3\n  hold: 0x1F\npipe:\n  position:\n  - 2\n  - 0.0\n  - 1.5\n",
    "faults:\n- {device: odometry, kind: nan, start: 3}\n- device: servos\n  kind: silent\n  duration: ~\n",
    "law: >-\n  tuned\nscenario: |\n  x\n",
    "# nothing but words\n",
    "",
)
FAULTS = (
    "{device: servos, kind: silent, part: theta_2, duration: 2}",
    "- {device: odometry, kind: jump, value: 0.3, phase: press}\n- {device: autopilot, kind: drop, value: 0.5}",
)
CONFIG = load_config("paper")
VALUES = to_mapping(CONFIG)


# --- YAML -------------------------------------------------------------------------------------------------------------


def understood(text: str) -> None:
    """What is read as a mapping of plain values can be written, and is read as the same again."""
    layer = taken(lambda: parse_yaml(text, "here"), ConfigError)
    if layer is not None:
        again = parse_yaml(dump_text(layer.values), "there").values
        assert repr(again) == repr(layer.values)


@examples(400)
@given(misspelt(TEXTS + ODD) | yamlish)
def test_any_yaml(text: str) -> None:
    understood(text)


@examples(100)
@given(damaged([text.encode() for text in ODD]) | st.binary(max_size=60))
def test_any_bytes(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(data)
    taken(lambda: read_yaml(path), ConfigError)
    taken(lambda: load_config_file(path), ConfigError)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (laughs(), "more than 20000 values (each alias counts)"),
        ("a: " + "[" * 5000, "nested too deeply"),
        ("a: " + "{a: " * 5000, "nested too deeply"),
        ("- " * 5000 + "x", "nested too deeply"),
        ("".join(f"{' ' * n}a:\n" for n in range(500)), ""),
        ('a: "\\UFFFFFFFF"', "not valid YAML: a character or version that cannot be"),
        ('a: "\\uD800"', "a: '\\ud800' holds half a character"),
        ('"\\uD800": a', "a key must be a name"),
        (f"%YAML 1.{'1' * 5000}\n---\na: 1\n", "not valid YAML: a character or version that cannot be"),
        ("a: !!timestamp x", "is not allowed"),
        ("<<: [*a]", "undefined alias"),
        ("a: &a\n  <<: *a\n", "a.<<: contains itself"),
        ("a: \x00", "the character U+0000"),
    ],
)
def test_yaml_that_is_meant_to_hurt(text: str, said: str) -> None:
    if said:
        with pytest.raises(ConfigError) as caught:
            parse_yaml(text, "here")
        assert said in str(caught.value)
        assert len(str(caught.value)) < 5000
    understood(text)


def test_files_that_are_none(tmp_path: Path) -> None:
    large = tmp_path / "large.yaml"
    large.write_text("# x\n" * LARGEST)
    with pytest.raises(ConfigError, match=r"large\.yaml: is larger than 256 kB"):
        read_yaml(large)
    for path in (Path("/dev/zero"), tmp_path, tmp_path / ("x" * 300), tmp_path / "a\0b", tmp_path / "none.yaml"):
        with pytest.raises(ConfigError):
            read_yaml(path)


# --- configurations ---------------------------------------------------------------------------------------------------


@examples(150)
@given(spoilt(VALUES, plain))
def test_any_values_of_parameters(values: Any) -> None:
    config = taken(lambda: load(Config, values, "here"), ConfigError)
    if config is not None:
        assert load(Config, to_mapping(config), "here") == config
        assert dump_config(config)


@pytest.mark.parametrize("kind", [list, dict])
def test_pits_of_values(kind: type) -> None:
    for depth in (10, 200):
        for values in ({"plan": nested(depth, kind)}, {"x": nested(depth, kind)}, nested(depth, kind)):
            assert taken(lambda values=values: load(Config, values, "here"), ConfigError) is None  # type: ignore[misc]


@examples(60)
@given(misspelt(TEXTS + ODD))
def test_any_configuration(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "some.yaml"
    path.write_text(text, errors="replace")
    config = taken(lambda: load_config(str(path)), ConfigError)
    if config is not None:
        assert load(Config, parse_yaml(dump_config(config), "dumped").values, "dumped") == config


@examples(150)
@given(
    st.builds(
        "{}{}{}".format,
        st.sampled_from(["plan.speed", "plan", "vehicle.arm.parts.2.mass", "faults.0.kind", "a..b", "", "x" * 300]),
        st.sampled_from(["=", " = ", "", "=="]),
        yamlish,
    )
)
def test_any_option(text: str) -> None:
    layer = taken(lambda: parse_set(text), ConfigError)
    if layer is not None:
        taken(lambda: load_config("paper", sets=[text]), ConfigError)


@examples(40)
@given(
    st.sampled_from(ODD) | misspelt(ODD),
    st.lists(
        st.sampled_from(
            ["plan.speed=0.35", "plan.acceleration=0.25", "repair.force=2.5", "repair.hold=4", "law=paper", "seed=7",
             "pipe.position=[2,0,1.4]", "pipe.position.1=0.5", "faults=[]", "interface=wrench", "joints=torque"]
        ),
        min_size=1, max_size=4, unique=True,
    ),
)  # fmt: skip
def test_values_are_put_into_any_file_or_it_stays_as_it_is(
    tmp_path_factory: pytest.TempPathFactory, text: str, sets: list[str]
) -> None:
    folder = tmp_path_factory.getbasetemp() / "edited"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    path = folder / "mine.yaml"
    data = text.encode(errors="replace")
    path.write_bytes(data)
    before = taken(lambda: load_config(str(path)), ConfigError)
    changes = taken(lambda: ParameterFile(str(path)).put(sets), ConfigError)
    assert list(folder.iterdir()) == [path], "nothing is left beside it"
    if changes:
        law = next((given.partition("=")[2] for given in sets if given.startswith("law=")), None)
        path_before = folder / "before.yaml"
        path_before.write_bytes(data)
        others = [given for given in sets if not given.startswith("law=")]
        wanted = load_config(str(path_before), law, others)
        assert msgspec.structs.replace(load_config(str(path)), scenario="") == msgspec.structs.replace(
            wanted, scenario=""
        )
    else:
        assert path.read_bytes() == data
        assert changes is None or before is not None


# --- other files ------------------------------------------------------------------------------------------------------

ROSTER = (
    b'{"version":1,"members":[{"name":"alice","role":"operator","expires":"2027-01-01T00:00:00Z"},'
    b'{"name":"x500","role":"vehicle","expires":"2027-01-01T00:00:00Z","revoked":"2026-12-01T00:00:00Z"}]}'
)


@examples(200)
@given(
    damaged([ROSTER])
    | spoilt(msgspec.json.decode(ROSTER), plain).map(lambda tree: msgspec.json.encode(tree, enc_hook=str))
    | st.sampled_from([b"\xff", b"[" * 100_000, b'{"members":' * 100_000, b'{"version":1e999}', b""])
)
def test_any_roster(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "roster.json"
    path.write_bytes(data)
    taken(lambda: load_roster(path), RosterError)


PX4 = (CONFIGS / "px4" / "x500.params").read_text()


@examples(100)
@given(
    misspelt([PX4])
    | st.builds(
        "\t".join, st.lists(st.sampled_from(["1", "6", "9", "A_B", "1e999", "nan", "9" * 5000, "²"]), min_size=5)
    )
)
def test_any_parameters_of_px4(text: str) -> None:
    taken(lambda: read_parameters(text, "here"), ValueError)


def in_force(faults: tuple[Fault, ...]) -> None:
    """Declare them, and ask for them now and then: whatever was let in can be asked for."""
    device = Faults("odometry", Kind)
    for fault in faults:
        if taken(lambda fault=fault: device.add(fault), ValueError) is None:  # type: ignore[misc]
            device.enter("press", 1.0)
    for t in (0.0, 1.0, 1e6):
        assert all(fault.start == fault.start and fault.value == fault.value for fault in device.active(t))


@examples(250)
@given(misspelt(FAULTS) | yamlish)
def test_any_fault(text: str) -> None:
    faults = taken(lambda: read_faults(text, "here"), ValueError)
    if faults:
        in_force(faults)


@examples(150)
@given(
    spoilt([{"device": "odometry", "kind": "jump", "start": 1.0, "value": 0.1, "phase": "press", "count": 2}], plain)
)
def test_any_values_of_faults(values: Any) -> None:
    text = msgspec.json.encode(values).decode()
    faults = taken(lambda: read_faults(text, "here"), ValueError)
    if faults:
        in_force(faults)


@pytest.mark.parametrize(
    "text",
    ["[" * 5000, "{a: " * 5000, "kind: !!bool x", "kind: !!int ''", "kind: !!timestamp x", "value: 2020-13-45",
     'part: "\\UFFFFFFFF"', "value: .nan", "start: .nan", "duration: .nan", "value: " + "9" * 5000,
     "value: " + "9" * 400, "? [a]\n: b", "!!python/name:os.system x", "1: 2", "a: &a\n  <<: *a\n",
     "a0: &a0 {x: 1}\n" + "".join(f"a{n}: &a{n}\n  <<: [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40))],
)  # fmt: skip
def test_faults_that_are_meant_to_hurt(text: str) -> None:
    one = re.fullmatch(r"\w+: .*", text)
    whole = f"{{device: odometry, kind: jump, {text}}}" if one else text
    assert taken(lambda: read_faults(whole, "here"), ValueError) is None


def test_files_of_faults_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "latin").write_bytes(b"kind: \xff")
    readers: tuple[Callable[[], object], ...] = tuple(
        lambda path=path: read_fault_file(path)  # type: ignore[misc]
        for path in (tmp_path, tmp_path / "latin", tmp_path / "a\0b", tmp_path / "none")
    )
    for read in readers:
        assert taken(read, ValueError) is None
