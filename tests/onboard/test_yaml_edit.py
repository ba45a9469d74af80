"""Values put into a file that a person has written, and what must not change in it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from onboard.layers import ConfigError, dump_text, merge, parse_yaml
from onboard.yaml_edit import Candidate, edited

CONFIGS = Path(__file__).resolve().parents[2] / "configs"

TEXT = """\
# what this is for
pipe:
  position: [2.0, 0.0, 1.5]   # m, W
  heading_deg: 0.0            # deg

# what is to be done
repair:
  force: 2.5                  # N
  # and for how long it takes

devices:
  autopilot: {kind: emulated, parameters: 'x500.params'}   # the stand-in
  odometry:
    kind: "real"
# the end
"""


def values_of(text: str) -> dict[str, Any]:
    return parse_yaml(text, "f.yaml").values


def leaves(values: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    if not items:
        yield path
    for key, value in items:
        yield from leaves(value, (*path, str(key)))


def with_value(values: Any, path: tuple[str, ...], value: Any) -> Any:
    if not path:
        return value
    if isinstance(values, list):
        return [with_value(item, path[1:], value) if str(i) == path[0] else item for i, item in enumerate(values)]
    return values | {path[0]: with_value(values[path[0]], path[1:], value)}


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*.yaml")), ids=lambda path: path.name)
def test_any_value_of_any_file_is_changed_alone(path: Path) -> None:
    text = path.read_text("utf-8")
    values = values_of(text)
    places = list(leaves(values))
    for place in places[:: len(places) // 15 + 1]:
        after = edited(text, [(place, "else")])
        assert values_of(after) == with_value(values, place, "else")
        assert re.findall("#.*", after) == re.findall("#.*", text)
        assert len(after.splitlines()) == len(text.splitlines())


def test_a_value_is_changed_where_it_stands() -> None:
    after = edited(
        TEXT,
        [
            (("pipe", "position", "1"), -0.5),
            (("repair", "force"), 3.0),
            (("devices", "odometry", "kind"), "mock"),
            (("devices", "autopilot", "parameters"), "mine.params"),
        ],
    )
    wanted = TEXT.replace("[2.0, 0.0, 1.5]   #", "[2.0, -0.5, 1.5]   #").replace("2.5     ", "3.0     ")
    wanted = wanted.replace('"real"', '"mock"').replace("'x500.params'", "'mine.params'")
    assert after == wanted


def test_a_new_value_comes_last_in_its_group_and_headings_stay_with_theirs() -> None:
    after = edited(
        TEXT,
        [
            (("pipe", "radius"), 0.1),
            (("repair", "hold"), 5.0),
            (("devices", "servos", "baud"), 57600),
            (("plan", "speed"), 0.2),
            (("plan", "jerk"), 1.0),
        ],
    )
    assert after == TEXT.replace("# deg\n", "# deg\n  radius: 0.1\n").replace(
        "it takes\n", "it takes\n  hold: 5.0\n"
    ).replace("# the end\n", "  servos:\n    baud: 57600\nplan:\n  speed: 0.2\n  jerk: 1.0\n# the end\n")


def test_a_list_that_is_replaced_leaves_what_stands_behind_it() -> None:
    text = "a:\n  weights:\n  - 1.0\n  - 2.0\n\n# about b\nb: 1\n"
    assert edited(text, [(("a", "weights"), [3.0])]) == "a:\n  weights: [3.0]\n\n# about b\nb: 1\n"


def test_the_indentation_is_that_of_the_file() -> None:
    text = "a:\n    b: 1\n    c:\n        d: 2\n"
    assert edited(text, [(("a", "c", "e", "f"), 3)]) == text + "        e:\n            f: 3\n"


def test_a_list_over_several_lines_keeps_its_comments() -> None:
    text = "may_differ:\n  [A, B,    # of simulators\n   C]        # of batteries\nb: {x: 1,   # one\n    y: 2}\n"
    after = edited(text, [(("may_differ", "1"), "D"), (("b", "y"), 3), (("b", "z"), 4)])
    assert after == text.replace("B,", "D,").replace("y: 2}", "y: 3, z: 4}")


def test_a_value_that_is_empty_or_a_text_of_several_lines_is_replaced() -> None:
    text = "a:\n  b:\n  c: |\n    one\n    two\n\n# about d\nd:   # nothing\n"
    after = edited(text, [(("a", "b"), 1), (("a", "c"), "x"), (("d", "e"), 2)])
    assert after == "a:\n  b: 1\n  c: x\n\n# about d\nd: {e: 2}  # nothing\n"


def test_a_file_of_comments_keeps_them() -> None:
    assert edited("# mine\n\n# alone\n", [(("a", "b"), 1)]) == "# mine\n\n# alone\na:\n  b: 1\n"
    assert edited("", [(("a",), 1)]) == "a: 1\n"


def test_an_element_of_a_list_that_is_not_there_is_refused() -> None:
    for path in (("pipe", "position", "3"), ("pipe", "position", "x"), ("pipe", "position", "0", "x")):
        with pytest.raises(KeyError):
            edited(TEXT, [(path, 1.0)])


def test_an_index_over_a_list_of_another_file_is_found_again() -> None:
    text = edited("", [(("parts", "2", "mass"), 0.1)])
    assert text == "parts:\n  2:\n    mass: 0.1\n"
    again = edited(text, [(("parts", "2", "mass"), 0.2), (("parts", "10", "mass"), 0.3)])
    assert again == "parts:\n  2:\n    mass: 0.2\n  10:\n    mass: 0.3\n"


names = st.sampled_from(["a", "b", "c"])
scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(10**9), 10**9)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.sampled_from(
        ["off", "1e5", "null", "~", "yes", "010", "1:30", "0x1", "", "a: b", "# c", "- d", "x y", "é", "a\nb"]
    )
)
plain = st.recursive(scalars, lambda s: st.lists(s, max_size=3) | st.dictionaries(names, s, max_size=3), max_leaves=6)
files = st.dictionaries(names, plain, max_size=3)


@given(files, st.lists(st.tuples(st.lists(names, min_size=1, max_size=3).map(tuple), plain), max_size=3))
def test_what_is_put_in_is_read_out_and_all_else_is_as_before(
    before: dict[str, Any], values: list[tuple[tuple[str, ...], Any]]
) -> None:
    wanted: Any = before
    for path, value in values:
        at: Any = wanted
        for key in path[:-1]:
            at = at.get(key) if isinstance(at, dict) else None
            if isinstance(at, list):
                return  # a name in a list: refused, above
        wanted = _replaced(wanted, path, value)
    text = edited(dump_text(before) if before else "", values)
    assert repr(values_of(text)) == repr(wanted)


def _replaced(at: Any, path: tuple[str, ...], value: Any) -> Any:
    at = at if isinstance(at, dict) else {}
    inner = value if len(path) == 1 else _replaced(at.get(path[0]), path[1:], value)
    return merge(at, {path[0]: None}) | {path[0]: inner}


# --- the file ---------------------------------------------------------------------------------------------------------


def test_a_file_is_replaced_as_a_whole_and_keeps_what_it_is(tmp_path: Path) -> None:
    file, link = tmp_path / "real.yaml", tmp_path / "link.yaml"
    file.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    file.chmod(0o640)
    link.symlink_to(file.name)
    with Candidate(link) as candidate:
        assert candidate.text == "a: 1\nb: 2\n"
        candidate.write("a: 3\nb: 2\n")
        assert file.read_bytes() == b"\xef\xbb\xbfa: 1\r\nb: 2\r\n"
        candidate.commit()
    assert link.is_symlink()
    assert file.read_bytes() == b"\xef\xbb\xbfa: 3\r\nb: 2\r\n"
    assert file.stat().st_mode & 0o777 == 0o640
    assert sorted(os.listdir(tmp_path)) == ["link.yaml", "real.yaml"]


def test_what_is_not_committed_leaves_nothing(tmp_path: Path) -> None:
    file = tmp_path / "f.yaml"
    file.write_text("a: 1\n")
    with Candidate(file) as candidate:
        candidate.write("a: 2\n")
    assert file.read_text() == "a: 1\n"
    assert os.listdir(tmp_path) == ["f.yaml"]


def test_a_change_by_somebody_else_is_not_overwritten(tmp_path: Path) -> None:
    file = tmp_path / "f.yaml"
    file.write_text("a: 1\n")
    with Candidate(file) as candidate:
        candidate.write("a: 2\n")
        file.write_text("a: 5\n")
        with pytest.raises(ConfigError, match="changed meanwhile"):
            candidate.commit()
    assert file.read_text() == "a: 5\n"


def test_a_file_that_cannot_be_read_or_written_is_told(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.yaml", tmp_path / "no" / "folder.yaml", tmp_path):
        with pytest.raises(ConfigError, match="cannot be written"):
            Candidate(path)
