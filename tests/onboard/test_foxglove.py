"""The layout for Foxglove names only what a log holds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from onboard.config import CONFIGS, load_config
from onboard.core.step import State
from onboard.mcapfile import flat_schema
from onboard.recorder import Recorder
from onboard.records import DeviceReport, Keyframe, RunInfo, Timing
from tests.synthetic import mission

SCRIPT = (CONFIGS / "foxglove" / "scene.ts").read_text()
LAYOUT = json.loads((CONFIGS / "foxglove" / "pipewright.json").read_text())
PANELS: dict[str, dict[str, Any]] = LAYOUT["configById"]


@pytest.fixture(scope="module")
def schemas(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The JSON schema of each topic of a run on the wall clock."""
    log = tmp_path_factory.mktemp("run") / "log.mcap"
    info = RunInfo(version="0.1.0", scenario="desk", law="tuned", seed=0, realtime=True)
    with Recorder(log, info, load_config(), "") as recorder:
        for tick, truth in list(mission())[:50]:
            recorder.tick(tick, truth)
            recorder.timing(Timing(tick.index, tick.inputs.t_ns, 0.0, 0.0, 0.0))
        recorder.devices(DeviceReport(0, {"cpu.loop": 0.3}))
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        return {
            channel.topic: json.loads(summary.schemas[channel.schema_id].data) for channel in summary.channels.values()
        }


def paths() -> Iterator[str]:
    for panel in PANELS.values():
        yield from (path["value"] for path in panel.get("paths", ()))
        yield from filter(None, (panel.get("topicPath"), panel.get("xAxisPath", {}).get("value")))


def kind(schemas: dict[str, Any], path: str) -> str:
    """Type of what a message path leads to. Raises KeyError for one that leads nowhere."""
    topic, *fields = path.split(".")
    node = schemas[topic]
    for field in fields:
        name, index = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field).groups()  # type: ignore[union-attr]
        node = node["properties"][name]
        if index is not None:
            node = node["items"]
    return str(node["type"])


@pytest.mark.parametrize("path", sorted(set(paths())))
def test_every_path_is_in_the_log(schemas: dict[str, Any], path: str) -> None:
    assert kind(schemas, path) in (("object",) if path == "/event" else ("number", "integer", "string"))


def test_what_is_plotted_is_a_number(schemas: dict[str, Any]) -> None:
    for name, panel in PANELS.items():
        if name.startswith("Plot!"):
            assert {kind(schemas, path["value"]) for path in panel["paths"]} <= {"number", "integer"}, name


def test_a_path_that_leads_nowhere_would_be_noticed(schemas: dict[str, Any]) -> None:
    for path in ("/tick.outputs.estimate.p_WC[0]", "/ticks.index", "/tick.outputs.phase.name"):
        with pytest.raises(KeyError):
            kind(schemas, path)


def read_by_the_script() -> set[str]:
    """Message paths of all that the script takes from the log, also by a name that it gave to a part."""
    whole = {"tick": "/tick", "set": "/params"}
    for name, root, fields in re.findall(r"const (\w+) = (\w+)((?:\.\w+)+);", SCRIPT):
        if root in whole:
            whole[name] = whole[root] + fields
    used = re.findall(r"(?<![\w.])(\w+)((?:\.\w+)+)", SCRIPT)
    return {whole[root] + fields.removesuffix(".toFixed") for root, fields in used if root in whole}


@pytest.mark.parametrize("path", sorted(read_by_the_script()))
def test_the_script_of_the_scene_reads_only_what_is_in_the_log(schemas: dict[str, Any], path: str) -> None:
    assert kind(schemas, path)


def test_the_scene_has_vehicle_arm_pipe_and_force() -> None:
    for what in ("rotors.radius", "arm.link_2", "pipe.heading_deg", "estimate.force_W", "estimate.R_WB"):
        assert any(path.endswith(what) for path in read_by_the_script())


def test_the_layout_holds_the_script_of_the_scene(schemas: dict[str, Any]) -> None:
    assert [script["sourceCode"] for script in LAYOUT["userNodes"].values()] == [SCRIPT]
    (inputs,) = re.findall(r"^export const inputs = (.*);$", SCRIPT, re.MULTILINE)
    (output,) = re.findall(r'^export const output = "(.*)";$', SCRIPT, re.MULTILINE)
    assert set(json.loads(inputs)) <= set(schemas)
    assert output not in schemas
    assert output in PANELS["3D!scene"]["topics"]


def refused(schema: dict[str, Any], path: str = "") -> Iterator[str]:
    """Paths of a schema that Foxglove does not read: it then refuses the whole topic."""
    if "oneOf" in schema:
        yield from (path for option in schema["oneOf"] if not isinstance(option["const"], int))
    elif schema["type"] == "object":
        for name, field in schema["properties"].items():
            yield from refused(field, f"{path}.{name}")
    elif schema["type"] == "array" and schema["items"]["type"] != "array":
        yield from refused(schema["items"], path)
    elif schema["type"] not in ("boolean", "string", "number", "integer"):
        yield path


def test_foxglove_reads_every_topic(schemas: dict[str, Any]) -> None:
    assert {"/tick", "/truth", "/event", "/params", "/timing", "/devices"} <= set(schemas)
    for topic, schema in {**schemas, "/keyframe": flat_schema(Keyframe[State])}.items():
        assert schema["type"] == "object"
        assert list(refused(schema)) == [], topic


def test_a_field_that_foxglove_refuses_would_be_noticed() -> None:
    numbers = {"type": "array", "items": {"type": "number"}}
    schema = {"type": "object", "properties": {"a": numbers, "b": {"type": "array", "items": numbers}}}
    assert list(refused(schema)) == [".b"]


def test_the_safety_action_is_shown_as_a_word(schemas: dict[str, Any]) -> None:
    action = schemas["/tick"]["properties"]["outputs"]["properties"]["verdict"]["properties"]["action"]
    assert {"title": "HOLD", "const": 2} in action["oneOf"]


def test_poses_force_joints_and_events_are_shown() -> None:
    shown = "\n".join(paths())
    for what in ("p_WB", "contact_force", "joints", "/event", "outputs.phase", "servos.temperature", "/timing.late"):
        assert what in shown


def panels_of(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
        for tab in PANELS[node].get("tabs", ()):
            yield from panels_of(tab["layout"])
    else:
        assert set(node) == {"direction", "first", "second", "splitPercentage"}
        yield from panels_of(node["first"])
        yield from panels_of(node["second"])


def test_each_panel_stands_once_on_the_screen() -> None:
    assert sorted(panels_of(LAYOUT["layout"])) == sorted(PANELS)


def test_it_is_installed_with_the_program() -> None:
    project = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    assert '"*.json"' in project
