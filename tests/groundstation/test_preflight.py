"""The checklist as a person and as a program see it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator

import msgspec
import pytest

from groundstation import codes, preflight
from groundstation.client import Contact
from onboard.orders import NotShownError
from onboard.wire import Check, ShowPreflight
from tests.groundstation.vehicle import run, showing
from tests.zenoh_sessions import free_port

WELL = Check("battery", True, "16.2 V, 98%")
LOW = Check("battery", False, "13.1 V, 8%", "Change it.")


class Vessel:
    """What the vehicle says, one list after the other, the last for good."""

    def __init__(self) -> None:
        self.lists: list[tuple[Check, ...]] = [(WELL,)]
        self.asked = 0
        self.show: Callable[[], bytes] = self._next

    def _next(self) -> bytes:
        self.asked += 1
        return msgspec.json.encode(self.lists.pop(0) if len(self.lists) > 1 else self.lists[0])


@pytest.fixture
def vessel() -> Vessel:
    return Vessel()


@pytest.fixture
def port(vessel: Vessel) -> Iterator[int]:
    with showing({ShowPreflight: lambda ask: vessel.show()}) as port:
        yield port


def test_all_is_well(port: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(preflight.add_parser, port, "preflight") == codes.DONE
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["✓", "battery", "16.2", "V,", "98%"]
    assert [line.split()[:2] for line in lines[1:3]] == [["✓", "contact"], ["✓", "clock"]]
    assert lines[-1] == "all is well"


def test_a_cross_with_its_remedy(vessel: Vessel, port: int, capsys: pytest.CaptureFixture[str]) -> None:
    vessel.lists = [(LOW,)]
    assert run(preflight.add_parser, port, "preflight") == codes.REFUSED
    out = capsys.readouterr().out
    assert "✗ battery 13.1 V, 8%" in out
    assert "→ Change it." in out
    assert "1 of 3 are not well: do not fly" in out
    assert vessel.asked == 1


def test_it_waits_until_all_is_well(vessel: Vessel, port: int) -> None:
    vessel.lists = [(LOW,), (LOW,), (WELL,)]
    assert run(preflight.add_parser, port, "preflight", "--wait", "60") == codes.DONE
    assert vessel.asked == 3


def test_it_does_not_wait_for_ever(vessel: Vessel, port: int) -> None:
    vessel.lists = [(LOW,)]
    assert run(preflight.add_parser, port, "preflight", "--wait", "0.2") == codes.REFUSED
    assert vessel.asked == 2


def test_for_a_program(vessel: Vessel, port: int, capsys: pytest.CaptureFixture[str]) -> None:
    vessel.lists = [(LOW,)]
    assert run(preflight.add_parser, port, "preflight", "--json") == codes.REFUSED
    told = json.loads(capsys.readouterr().out)
    assert not told["ok"]
    assert told["checks"][0] == {"name": "battery", "ok": False, "text": "13.1 V, 8%", "remedy": "Change it."}
    assert [row["name"] for row in told["checks"]] == ["battery", "contact", "clock"]


def test_a_vehicle_that_does_not_tell(vessel: Vessel, port: int, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse() -> bytes:
        raise NotShownError("no checklist here.")

    vessel.show = refuse
    assert run(preflight.add_parser, port, "preflight") == codes.REFUSED
    assert capsys.readouterr().err == "pipewright: no checklist here.\n"
    vessel.show = lambda: b'[{"name": 3}]'
    assert run(preflight.add_parser, port, "preflight") == codes.REFUSED
    assert "is not understood" in capsys.readouterr().err


def test_no_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(preflight.add_parser, free_port(), "preflight", "--timeout", "0.5") == codes.NOT_THERE
    assert capsys.readouterr().err.startswith("pipewright: ")


@pytest.mark.parametrize("wait", ["-1", "soon", "nan", "1e9"])
def test_a_wait_that_cannot_be(wait: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run(preflight.add_parser, 1, "preflight", f"--wait={wait}")
    assert f"{wait}: must be a time in seconds" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("contact", "texts", "well"),
    [
        (Contact(True, 0.1, 2e-3, 0.004), ("heard 100.0 ms ago, 2.0 ms there", "4.0 ms ahead of this"), (True, True)),
        (Contact(True, 0.1, 2e-3, -90.0), ("heard 100.0 ms ago", "90.0 s behind"), (True, False)),
        (Contact(True, 3.0, 2e-3, 0.0), ("heard 3.0 s ago", "0.0 ms ahead"), (False, True)),
        (Contact(False, math.inf, math.inf, math.nan), ("heard never ago", "not compared yet"), (False, False)),
    ],
)
def test_what_the_station_sees(contact: Contact, texts: tuple[str, str], well: tuple[bool, bool]) -> None:
    rows = preflight.seen(contact)
    assert tuple(row.ok for row in rows) == well
    assert tuple(bool(row.remedy) for row in rows) == tuple(not ok for ok in well)
    for row, text in zip(rows, texts, strict=True):
        assert text in row.text
