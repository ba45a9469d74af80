"""House rules that no linter knows."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("drivers", "sim_backend", "onboard", "groundstation")

#: Of the standard library, the core may use what has no clock, no I/O and no randomness.
PURE = {"__future__", "collections", "dataclasses", "enum", "functools", "itertools", "math", "operator", "types", "typing"}  # fmt: skip  # noqa: E501
CORE_MAY_IMPORT = re.compile(rf"({'|'.join(PURE)}|msgspec|numba|numpy|onboard\.core)(\..*)?|drivers\.(samples|vehicle)")
IMPURE = {"open", "print", "input", "exec", "eval", "__import__", "id", "hash"}


def files(*folders: str) -> list[Path]:
    found = sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    assert found, "the rule would hold for nothing"
    return found


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def imports(path: Path) -> Iterator[str]:
    """Every module that is imported anywhere in the file, inside functions and type-checking blocks too."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or "."


def calls(path: Path) -> Iterator[ast.Call]:
    return (node for node in ast.walk(tree(path)) if isinstance(node, ast.Call))


def lines_with(pattern: str, paths: list[Path]) -> list[str]:
    """Every place where the pattern stands, as file:line: text."""
    return [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in paths
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if re.search(pattern, line)
    ]


def test_the_core_imports_only_what_is_pure() -> None:
    core = files("onboard/core")
    assert not [
        (path.name, module) for path in core for module in imports(path) if not CORE_MAY_IMPORT.fullmatch(module)
    ]


def test_the_core_touches_no_file_and_no_console() -> None:
    core = files("onboard/core")
    assert not [(path.name, ast.unparse(c)) for path in core for c in calls(path) if ast.unparse(c.func) in IMPURE]


def test_the_same_bits_everywhere() -> None:
    """Fast-math and parallel reductions may reorder sums."""
    found = [(path.name, k.arg) for path in files(*PACKAGES, "tests") for c in calls(path) for k in c.keywords]
    assert not [item for item in found if item[1] in ("fastmath", "parallel")]


def test_tests_do_not_sleep() -> None:
    """The bench may: it measures how late a sleep ends."""
    tests = [path for path in files("tests") if "bench" not in path.parts]
    assert not [path.name for path in tests for c in calls(path) if ast.unparse(c.func) == "time.sleep"]


def test_nothing_is_left_for_later() -> None:
    others = [path for path in files(*PACKAGES, "tests") if path != Path(__file__)]
    assert not lines_with(r"\b(TODO|FIXME|XXX|HACK)\b", others)


def test_no_path_of_one_machine() -> None:
    others = [path for path in files(*PACKAGES, "tests") if path != Path(__file__)]
    assert not lines_with(r"(?<![\w.])/(home|root|Users|work)/", others)


def test_only_the_edge_names_the_frames_of_others() -> None:
    assert not lines_with(r"\b(NED|FRD)\b", files("onboard", "groundstation"))


def project() -> dict[str, Any]:
    content: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    return content


def canonical(requirement: str) -> str:
    """The package name of a requirement, normalised as in PEP 503."""
    return re.sub(r"[-_.]+", "-", re.split(r"[<>=!~\[; ]", requirement, maxsplit=1)[0]).lower()


def test_every_dependency_is_pinned() -> None:
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in pins)
    declared = project()
    extras: dict[str, list[str]] = declared["optional-dependencies"]
    assert set(extras) == {"base", "sim", "ground", "campaign", "button", "vision", "bench", "dev"}
    wanted = {canonical(item) for items in (declared["dependencies"], *extras.values()) for item in items}
    assert wanted <= {canonical(line) for line in pins}


def test_every_third_party_import_is_declared() -> None:
    """What a package imports is installed with it: the vehicle needs no tool of the desk."""
    declared = project()
    extras = declared["optional-dependencies"]
    base = {canonical(item) for item in declared["dependencies"]}
    ground = base | {canonical(item) for item in extras["ground"]}
    # of the flight process, only the desk's progress bar and a filter that runs on logs need the extra of the desk
    desk = base | {canonical(item) for item in extras["sim"]}
    # the camera's library is built by hand where there is no wheel of it, so that only the camera's files may need it
    vision = base | {canonical(item) for item in extras["vision"]}
    # a station that has no button needs no compiler
    button = ground | {canonical(item) for item in extras["button"]}
    # nor does one that flies no campaigns need a cluster
    campaign = ground | {canonical(item) for item in extras["campaign"]}
    known = sys.stdlib_module_names | set(PACKAGES)
    for package in PACKAGES:
        for path in files(package):
            third = {module.split(".")[0] for module in imports(path)} - known
            other = {"yaml": "pyyaml", "serial": "pyserial", "zenoh": "eclipse-zenoh", "PIL": "pillow"}
            names = {other.get(module, canonical(module)) for module in third}
            allowed = ground if package == "groundstation" else desk if path.name in ("main.py", "ukf.py") else base
            allowed = vision if path.name.startswith("t265") else button if path.name == "button.py" else allowed
            allowed = campaign if package == "groundstation" and path.name.startswith(("campaign", "tune")) else allowed
            assert names <= allowed, path


def test_the_version_has_its_entry_in_the_changelog() -> None:
    assert f"## [{project()['version']}]" in (ROOT / "CHANGELOG.md").read_text("utf-8")
