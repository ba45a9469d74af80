"""A vehicle that shows what no station understands: told, and no more than told."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from groundstation import codes, logs, params, preflight
from onboard.wire import ListLogs, ShowParams, ShowPreflight
from tests.groundstation.vehicle import run, showing
from tests.link.wrong_input import laughs

COMMANDS: dict[str, tuple[Callable[[Any], None], tuple[str, ...]]] = {
    "preflight": (preflight.add_parser, ("preflight",)),
    "log list": (logs.add_parser, ("log", "list")),
    "log fetch": (logs.add_parser, ("log", "fetch", "x")),
    "params get": (params.add_parser, ("params", "get", "plan.speed")),
}
STRANGE = (b"", b"\xff", b"[" * 100_000, b'[{"name":' * 20_000, b"{}", b'[{"name":1}]', b"null", b"[1e999]", b"\x00",
           laughs().encode(), b"plan: {speed: fast}")  # fmt: skip


class Vehicle:
    """What it shows, whatever it is asked for."""

    data = b""

    def show(self, ask: object) -> bytes:
        return self.data


@pytest.fixture(scope="module")
def strange() -> Iterator[tuple[Vehicle, int]]:
    vehicle = Vehicle()
    with showing(dict.fromkeys((ShowPreflight, ListLogs, ShowParams), vehicle.show)) as port:
        yield vehicle, port


@pytest.mark.parametrize("command", COMMANDS)
def test_it_is_told_and_no_more_than_told(
    strange: tuple[Vehicle, int], command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle, port = strange
    add_parser, arguments = COMMANDS[command]
    for data in STRANGE:
        vehicle.data = data
        code = run(add_parser, port, *arguments)
        told = capsys.readouterr().err
        assert code in (codes.REFUSED, codes.WRONG_INPUT), (data[:20], told)
        assert told.startswith("pipewright: "), told
        assert "pipewright" in told.partition(": ")[2], "which vehicle"
