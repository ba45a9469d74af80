"""The layout for Foxglove names only what a log holds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from onboard.config import CONFIGS
from onboard.recorder import Recorder
from onboard.records import DeviceReport, RunInfo, Timing
from tests.synthetic import ConfigStub, mission

LAYOUT = json.loads((CONFIGS / "foxglove" / "pipewright.json").read_text())
PANELS: dict[str, dict[str, Any]] = LAYOUT["configById"]


@pytest.fixture(scope="module")
def schemas(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The JSON schema of each topic of a run on the wall clock."""
    log = tmp_path_factory.mktemp("run") / "log.mcap"
    info = RunInfo(version="0.1.0", scenario="desk", law="tuned", seed=0, realtime=True)
    with Recorder(log, info, ConfigStub(), "") as recorder:
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
