"""Parameters as they fail in the field: every kind of wrong file and option, and what must read back exactly."""

from __future__ import annotations

import string
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from msgspec import NODEFAULT, Meta, Struct, structs

from onboard.declared import defaults, describe, to_mapping
from onboard.layers import ConfigError, Layer, merge, parse_set, parse_yaml, read_yaml
from onboard.params import Change, compose, diff, dump_yaml, load, refused_in_flight


def meta(unit: str, low: float, high: float, doc: str, *, in_flight: bool = True) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": in_flight})


class Mode(StrEnum):
    OFF = "off"
    ON = "on"


class Level(IntEnum):
    LOW = 1
    HIGH = 2


class Gains(Struct, frozen=True):
    kp: Annotated[float, meta("1/s", 0.0, 10.0, "proportional gain")] = 1.5
    ki: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.25


class Part(Struct, frozen=True):
    mass: Annotated[float, meta("kg", 0.0, 5.0, "mass")]
    name: Annotated[str, Meta(min_length=1, max_length=8, pattern="^[a-z]+$")] = "part"


class Span(Struct, frozen=True):
    low: float = 0.0
    high: float = 1.0

    def __post_init__(self) -> None:
        if self.low >= self.high:
            raise ValueError(f"low = {self.low} must be below high = {self.high}")


class Root(Struct, frozen=True):
    mass: Annotated[float, meta("kg", 0.1, 20.0, "take-off mass", in_flight=False)]
    gains: Gains = Gains(kp=2.0)
    point: tuple[Annotated[float, meta("m", -9.0, 9.0, "coordinate")], float, float] = (1.0, 2.0, 3.0)
    weights: Annotated[tuple[float, ...], Meta(min_length=1, max_length=4)] = (0.5,)
    parts: tuple[Part, ...] = ()
    count: Annotated[int, Meta(ge=1, le=1_000_000)] = 1
    mode: Mode = Mode.OFF
    level: Level = Level.LOW
    form: Literal["a", "b"] = "a"
    fast: bool = False
    limit: Annotated[float, Meta(ge=0.0)] | None = None
    extra: Gains | None = None
    span: Span = Span()
    note: str = ""


GOOD = {"mass": 2.0}


def errors_of(values: Any, source: str = "file.yaml") -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        load(Root, values, source)
    return caught.value.errors


def error_of(**values: Any) -> str:
    (error,) = errors_of({**GOOD, **values})
    return error


def composed(*sets: str, file: str = "mass: 2") -> Root:
    return compose(Root, [parse_yaml(file, "file.yaml"), *map(parse_set, sets)])


def composed_errors(*sets: str, file: str = "mass: 2") -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        composed(*sets, file=file)
    return caught.value.errors


# --- right input ------------------------------------------------------------------------------------------------------


def test_only_what_is_given_differs_from_the_defaults() -> None:
    assert load(Root, GOOD, "x") == Root(mass=2.0)


def test_a_group_keeps_the_defaults_that_its_parent_gave_it() -> None:
    assert load(Root, {**GOOD, "gains": {"ki": 0.5}}, "x").gains == Gains(kp=2.0, ki=0.5)


def test_every_kind_is_read() -> None:
    root = load(
        Root,
        {
            "mass": 3,
            "gains": {"kp": 0},
            "point": [1, -2, 3.5],
            "weights": [1, 2],
            "parts": [{"mass": 1, "name": "arm"}, {"mass": 2}],
            "count": 1_000_000,
            "mode": "on",
            "level": 2,
            "form": "b",
            "fast": True,
            "limit": 4,
            "extra": {"kp": 1},
            "span": {"low": -1},
            "note": "Größe",
        },
        "x",
    )
    assert root == Root(
        mass=3.0,
        gains=Gains(kp=0.0),
        point=(1.0, -2.0, 3.5),
        weights=(1.0, 2.0),
        parts=(Part(1.0, "arm"), Part(2.0)),
        count=1_000_000,
        mode=Mode.ON,
        level=Level.HIGH,
        form="b",
        fast=True,
        limit=4.0,
        extra=Gains(kp=1.0),
        span=Span(low=-1.0),
        note="Größe",
    )
    assert type(root.mass) is float
    assert type(root.mode) is Mode
    assert type(root.level) is Level


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("1E5", 1e5),
        ("-2e+3", -2000.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("+7", 7),
        ("010", 10),
        ("0x10", 16),
        ("off", "off"),
        ("yes", "yes"),
        ("true", True),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("2024-01-02", "2024-01-02"),
        ('"1.5"', "1.5"),
        ("~", None),
        ("", None),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: Any) -> None:
    read = parse_yaml(f"a: {text}", "x").values["a"]
    assert read == value
    assert type(read) is type(value)


def test_an_empty_file_holds_nothing() -> None:
    assert parse_yaml("# only a comment\n", "x").values == {}


def test_a_byte_order_mark_is_no_key(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfmass: 1\n")
    assert read_yaml(path).values == {"mass": 1}


# --- wrong values -----------------------------------------------------------------------------------------------------


def test_all_errors_of_a_file_are_told_at_once() -> None:
    found = errors_of({"gains": {"kp": -1, "kd": 2}, "point": [0, 99, "x"], "count": 0})
    assert found == (
        "file.yaml: mass: missing; must be a number from 0.1 to 20 kg (take-off mass)",
        "file.yaml: gains.kd: no such parameter; known here: ki, kp",
        "file.yaml: gains.kp = -1: must be a number from 0 to 10 1/s (proportional gain)",
        "file.yaml: point.2 = 'x': must be a number",
        "file.yaml: count = 0: must be a whole number from 1 to 1000000",
    )


@pytest.mark.parametrize(
    "value", [float("nan"), float("inf"), -float("inf"), True, "2.0", "2 kg", None, [2.0], {}, 10**400]
)
def test_what_is_no_number_is_refused(value: Any) -> None:
    (error,) = errors_of({"mass": value})
    assert error.startswith("file.yaml: mass = ")
    assert error.endswith(": must be a number from 0.1 to 20 kg (take-off mass)")


@pytest.mark.parametrize("value", [1.0, 1.5, True, "1", None, 0, 1_000_001])
def test_what_is_no_whole_number_in_bounds_is_refused(value: Any) -> None:
    assert error_of(count=value).endswith(": must be a whole number from 1 to 1000000")


@pytest.mark.parametrize("value", [0, 1, "true", "yes", None])
def test_what_is_no_truth_value_is_refused(value: Any) -> None:
    assert error_of(fast=value).endswith(": must be true or false")


@pytest.mark.parametrize(("low", "high"), [(0.1, 20.0)])
def test_inclusive_bounds_belong_and_the_next_number_does_not(low: float, high: float) -> None:
    assert load(Root, {"mass": low}, "x").mass == low
    assert load(Root, {"mass": high}, "x").mass == high
    assert errors_of({"mass": low - 1e-16})
    assert errors_of({"mass": high + 4e-15})


def test_exclusive_bounds_do_not_belong() -> None:
    assert error_of(gains={"ki": 0}) == "file.yaml: gains.ki = 0: must be a number above 0 and below 1"
    assert error_of(gains={"ki": 1.0}) == "file.yaml: gains.ki = 1.0: must be a number above 0 and below 1"


@pytest.mark.parametrize("value", [[1, 2], [1, 2, 3, 4], 1, "1,2,3", {"x": 1}, None])
def test_a_list_of_fixed_length_has_that_length(value: Any) -> None:
    assert ": must be a list of 3" in error_of(point=value)


def test_a_list_of_bounded_length_has_such_a_length() -> None:
    assert error_of(weights=[]) == "file.yaml: weights = []: must be a list from 1 to 4 long, each a number"
    assert error_of(weights=[1] * 5).endswith("must be a list from 1 to 4 long, each a number")


def test_elements_are_named_by_their_index() -> None:
    assert error_of(parts=[{"mass": 1}, {"mass": 9}]) == (
        "file.yaml: parts.1.mass = 9: must be a number from 0 to 5 kg (mass)"
    )
    assert error_of(parts=[{}]) == "file.yaml: parts.0.mass: missing; must be a number from 0 to 5 kg (mass)"
    assert error_of(parts=[3]) == "file.yaml: parts.0 = 3: must be a group of mass, name"


@pytest.mark.parametrize(
    ("values", "end"),
    [
        ({"mode": "auto"}, "mode = 'auto': must be one of off, on"),
        ({"mode": False}, "mode = false: must be one of off, on"),
        ({"level": 3}, "level = 3: must be one of 1, 2"),
        ({"level": True}, "level = true: must be one of 1, 2"),
        ({"form": "c"}, "form = 'c': must be one of a, b"),
        ({"note": 5}, "note = 5: must be text"),
        ({"gains": 5}, "gains = 5: must be a group of kp, ki"),
        ({"gains": [1, 2]}, "gains = [1, 2]: must be a group of kp, ki"),
        ({"limit": -1}, "limit = -1: must be a number or null at least 0"),
        ({"limit": "none"}, "limit = 'none': must be a number or null at least 0"),
        ({"extra": 1}, "extra = 1: must be a group of kp, ki or null"),
        ({"extra": {"kp": 99}}, "extra.kp = 99: must be a number from 0 to 10 1/s (proportional gain)"),
        (
            {"parts": [{"mass": 1, "name": "Arm"}]},
            "parts.0.name = 'Arm': must be text from 1 to 8 long matching ^[a-z]+$",
        ),
        ({"parts": [{"mass": 1, "name": "toolongname"}]}, "must be text from 1 to 8 long matching ^[a-z]+$"),
        ({"span": {"low": 5}}, "span: low = 5.0 must be below high = 1.0"),
    ],
)
def test_each_wrong_value_says_what_would_be_right(values: dict[str, Any], end: str) -> None:
    assert error_of(**values).endswith(end)


def test_a_long_wrong_value_is_cut_in_the_message() -> None:
    assert len(error_of(mode="x" * 5000)) < 150


def test_null_means_none_only_where_declared() -> None:
    assert load(Root, {**GOOD, "limit": None}, "x").limit is None
    assert "mode = null" in error_of(mode=None)


def test_a_type_that_yaml_cannot_hold_is_an_error_of_the_declaration() -> None:
    class Wrong(Struct, frozen=True):
        when: bytes = b""

    with pytest.raises(TypeError, match="cannot be of type"):
        load(Wrong, {"when": "x"}, "x")
    with pytest.raises(TypeError, match="cannot be of type"):
        describe(Wrong)


# --- unknown keys -----------------------------------------------------------------------------------------------------


def test_an_unknown_key_lists_the_nearest_ones_first() -> None:
    assert error_of(gians={}).startswith("file.yaml: gians: no such parameter; nearest: gains")
    assert error_of(gains={"kpp": 1}).startswith("file.yaml: gains.kpp: no such parameter; nearest: gains.kp")


def test_an_unknown_key_finds_its_name_in_another_group() -> None:
    assert "nearest: gains.ki" in error_of(ki=1)


def test_an_unknown_key_in_a_list_names_the_neighbours_with_the_index() -> None:
    found = error_of(parts=[{"mass": 1, "nam": "x"}])
    assert found.startswith("file.yaml: parts.0.nam: no such parameter; nearest: parts.0.name")
    assert ".N." not in found


def test_an_unknown_key_that_resembles_nothing_lists_what_there_is() -> None:
    assert error_of(gains={"zzzzzz": 1}) == "file.yaml: gains.zzzzzz: no such parameter; known here: ki, kp"


# --- wrong files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1, 2\nb: 3\n", "f.yaml:2:2: not valid YAML: expected ',' or ']'"),
        ("a:\n\tb: 1\n", "f.yaml:2:1: not valid YAML: found character '\\t' that cannot start any token"),
        ("a: b: c\n", "f.yaml:1:5: not valid YAML: mapping values are not allowed here"),
        ("a: 'open\n", "not valid YAML: found unexpected end of stream"),
        ("a: *b\n", "f.yaml:1:4: not valid YAML: found undefined alias"),
        ("a: 1\n\x07: 2\n", "f.yaml:2: not valid YAML: the character U+0007"),
        ("a: 1\n---\nb: 2\n", "f.yaml:2:1: not valid YAML: but found another document"),
        ("- 1\n- 2\n", "f.yaml: must be a mapping of names to values, not [1, 2]"),
        ("just text\n", "f.yaml: must be a mapping of names to values, not 'just text'"),
        ("a: 1\nb:\n  c: 1\n  d: 2\n  c: 3\n", "f.yaml:5: b.c: given twice"),
        ("{}: 1\n", "f.yaml:1: (root): a key must be a name"),
        ("a: &x [*x]\n", "f.yaml:1: a.0: contains itself"),
        ("a: !!python/object/apply:os.system [ls]\n", "with the tag tag:yaml.org,2002:python/object/apply:os.system"),
        ("a: !!float x\n", "f.yaml:1: a: 'x' with the tag tag:yaml.org,2002:float is not allowed"),
        ("a: !thing\n  b: 1\n", "with the tag !thing is not allowed"),
        ("a: " + "[" * 5000, "f.yaml: nested too deeply"),
    ],
)
def test_broken_yaml_gives_one_error_with_its_place(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "f.yaml")
    (error,) = caught.value.errors
    assert message in error
    assert "\n" not in error


def test_a_number_longer_than_python_reads_is_no_number() -> None:
    (error,) = composed_errors(file="mass: " + "9" * 5000)
    assert error.startswith("file.yaml:1: mass = ")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"mass: \xff\xfe\n")
    for path, reason in [
        (tmp_path / "absent.yaml", "cannot be read: No such file or directory"),
        (tmp_path, "cannot be read: Is a directory"),
        (binary, "not UTF-8 text (byte 6)"),
        (Path("nul\0.yaml"), "cannot be read: embedded null byte"),
    ]:
        with pytest.raises(ConfigError) as caught:
            read_yaml(path)
        assert caught.value.errors == (f"{path}: {reason}",)


# --- layers -----------------------------------------------------------------------------------------------------------


def test_later_layers_win_and_groups_merge() -> None:
    base = {"a": {"x": 1, "y": [1, 2]}, "b": 1}
    overlay = {"a": {"y": [3]}, "c": {"d": 4}}
    assert merge(base, overlay) == {"a": {"x": 1, "y": [3]}, "b": 1, "c": {"d": 4}}
    assert base == {"a": {"x": 1, "y": [1, 2]}, "b": 1}


def test_an_index_reaches_into_a_list_and_into_a_default() -> None:
    root = composed("parts.1.mass=3", "point.2=-1", file="mass: 2\nparts: [{mass: 1}, {mass: 2, name: arm}]")
    assert root.parts == (Part(1.0), Part(3.0, "arm"))
    assert root.point == (1.0, 2.0, -1.0)


@pytest.mark.parametrize("index", ["3", "01", "x"])
def test_an_index_that_is_not_there_is_refused(index: str) -> None:
    (error,) = composed_errors(f"point.{index}=0")
    assert error == f"--set point.{index}=0: point = {{'{index}': 0}}: must be a list of 3"


def test_each_error_says_which_file_and_line_or_option_it_came_from() -> None:
    layers = [
        parse_yaml("mass: 99\ngains:\n  kp: 99\n  ki: 99\n", "one.yaml"),
        parse_yaml("gains:\n\n  ki: 98\npoint:\n  - 1\n  - x\n  - 3\n", "two.yaml"),
        parse_set("count=-1"),
    ]
    with pytest.raises(ConfigError) as caught:
        compose(Root, layers)
    assert [error.split(" = ")[0] for error in caught.value.errors] == [
        "one.yaml:1: mass",
        "one.yaml:3: gains.kp",
        "two.yaml:3: gains.ki",
        "two.yaml:6: point.1",
        "--set count=-1: count",
    ]


def test_a_missing_value_is_asked_of_the_file_that_holds_its_group() -> None:
    layers = [parse_yaml("mass: 1\nparts:\n  - name: a\n", "one.yaml"), parse_yaml("count: 2\n", "two.yaml")]
    with pytest.raises(ConfigError, match=r"^one\.yaml:3: parts\.0\.mass: missing"):
        compose(Root, layers)


def test_a_layer_can_be_moved_under_a_key_with_its_lines() -> None:
    class Outer(Struct, frozen=True):
        root: Root

    with pytest.raises(ConfigError, match=r"^f\.yaml:2: root\.count = 0"):
        compose(Outer, [parse_yaml("mass: 1\ncount: 0\n", "f.yaml").under("root")])


def test_no_layers_and_something_missing() -> None:
    with pytest.raises(ConfigError, match=r"^configuration: mass: missing"):
        compose(Root, [])


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("mass=1e-1", {"mass": 0.1}),
        (" gains.kp = 3 ", {"gains": {"kp": 3}}),
        ("point=[1, 2, 3]", {"point": [1, 2, 3]}),
        ("gains={kp: 1, ki: 0.5}", {"gains": {"kp": 1, "ki": 0.5}}),
        ("note=a=b", {"note": "a=b"}),
        ("note=", {"note": None}),
        ("mode=off", {"mode": "off"}),
    ],
)
def test_options_are_yaml(text: str, values: dict[str, Any]) -> None:
    assert parse_set(text).values == values


@pytest.mark.parametrize("text", ["mass", "=1", "a..b=1", ".a=1", "a.=1", "a b=1", "", "a-b=1"])
def test_options_without_a_name_or_value_are_refused(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_set(text)
    assert caught.value.errors == (f"--set {text}: must have the form name.of.parameter=value",)


def test_an_option_with_broken_yaml_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^--set point=\[1, 2:1:\d+: not valid YAML: "):
        parse_set("point=[1, 2")


def test_an_unknown_option_lists_the_nearest_full_names() -> None:
    (error,) = composed_errors("gain.kpp=1")
    assert error.startswith("--set gain.kpp=1: gain.kpp: no such parameter; nearest: gains.kp,")
    (error,) = composed_errors("gains_ki=1")
    assert error.startswith("--set gains_ki=1: gains_ki: no such parameter; nearest: gains.ki,")


# --- reading back -----------------------------------------------------------------------------------------------------

finite = st.floats(allow_nan=False, allow_infinity=False)
texts = st.one_of(
    st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "S", "Zs"]), max_size=20),
    st.sampled_from(
        ["off", "1e5", "1.5", "null", "~", "true", "yes", "010", "0x1", "", " ", "a: b", "# c", "- d", "1e-05"]
    ),
)
roots = st.builds(
    Root,
    mass=st.floats(0.1, 20.0),
    gains=st.builds(Gains, kp=st.floats(0.0, 10.0)),
    point=st.tuples(st.floats(-9.0, 9.0), finite, finite),
    weights=st.lists(finite, min_size=1, max_size=4).map(tuple),
    parts=st.lists(
        st.builds(Part, st.floats(0.0, 5.0), st.text(string.ascii_lowercase, min_size=1, max_size=8)), max_size=3
    ).map(tuple),
    count=st.integers(1, 1_000_000),
    mode=st.sampled_from(Mode),
    level=st.sampled_from(Level),
    form=st.sampled_from(["a", "b"]),
    fast=st.booleans(),
    limit=st.none() | st.floats(min_value=0.0, allow_infinity=False),
    extra=st.none() | st.just(Gains()),
    note=texts,
)


@given(roots)
def test_what_is_written_reads_back_to_the_same_set(root: Root) -> None:
    text = dump_yaml(root)
    again = load(Root, parse_yaml(text, "config.yaml").values, "config.yaml")
    assert again == root
    assert repr(again) == repr(root)
    assert dump_yaml(again) == text


@given(roots)
def test_other_yaml_readers_find_the_same_numbers(root: Root) -> None:
    assert yaml.safe_load(dump_yaml(root)) == to_mapping(root)


anything = st.recursive(
    finite | texts | st.booleans(), lambda s: st.lists(s, max_size=3) | st.dictionaries(texts, s, max_size=3)
)


@given(st.dictionaries(st.sampled_from([*Root.__struct_fields__, "x"]), anything))
def test_any_mapping_is_either_read_or_refused_with_reasons(values: dict[str, Any]) -> None:
    try:
        root = load(Root, values, "x")
    except ConfigError as error:
        refused = error.errors
    else:
        assert load(Root, to_mapping(root), "x") == root
        return
    assert refused
    assert all(line.startswith("x: ") and "\n" not in line for line in refused)


# --- describing and comparing -----------------------------------------------------------------------------------------


def test_defaults_leave_out_what_must_be_given() -> None:
    values = defaults(Root)
    assert "mass" not in values
    assert values["gains"] == {"kp": 2.0, "ki": 0.25}
    assert values["mode"] == "off"


def test_every_parameter_is_described() -> None:
    found = {parameter.path: parameter for parameter in describe(Root)}
    mass = found["mass"]
    assert (mass.type, mass.default, mass.unit) == ("number", NODEFAULT, "kg")
    assert (mass.bounds, mass.in_flight, mass.doc) == ("from 0.1 to 20", False, "take-off mass")
    assert found["gains.kp"].default == 2.0
    assert found["gains.kp"].in_flight
    assert found["parts.N.mass"].unit == "kg"
    assert found["point"].type == "list of 3, each number"
    assert found["mode"].type == "one of off, on"
    assert set(found) >= {"span.low", "limit", "extra", "weights"}


def test_only_what_differs_is_told_with_its_path() -> None:
    old = Root(mass=2.0, parts=(Part(1.0), Part(2.0)))
    new = structs.replace(old, mass=3.0, gains=Gains(kp=3.0), parts=(Part(1.0), Part(4.0)), point=(5.0, 2.0, 3.0))
    assert diff(old, old) == []
    assert diff(old, new) == [
        Change("mass", 2.0, 3.0, in_flight=False),
        Change("gains.kp", 2.0, 3.0, in_flight=True),
        Change("point.0", 1.0, 5.0, in_flight=True),
        Change("parts.1.mass", 2.0, 4.0, in_flight=True),
    ]
    assert refused_in_flight(old, new) == ["mass"]


def test_lists_that_grow_and_groups_that_come_differ_as_a_whole() -> None:
    old = Root(mass=2.0)
    new = structs.replace(old, weights=(1.0, 2.0), extra=Gains())
    assert diff(old, new) == [
        Change("weights", [0.5], [1.0, 2.0], in_flight=False),
        Change("extra", None, {"kp": 1.5, "ki": 0.25}, in_flight=False),
    ]
    assert diff(new, structs.replace(new, extra=Gains(kp=9.0))) == [Change("extra.kp", 1.5, 9.0, in_flight=True)]


def test_what_says_nothing_may_not_change_in_flight() -> None:
    assert refused_in_flight(Root(mass=2.0), Root(mass=2.0, count=5)) == ["count"]


def test_an_error_prints_one_line_each() -> None:
    assert str(ConfigError(["a: b", "c: d"])) == "a: b\nc: d"


def test_a_layer_without_lines_still_names_its_source() -> None:
    with pytest.raises(ConfigError, match=r"^somewhere: count = 0"):
        compose(Root, [Layer("somewhere", {"mass": 1, "count": 0})])
