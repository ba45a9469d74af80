"""Buttons of input devices: events as the kernel tells them, from a device that the test plays."""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

from groundstation.button import Button, ButtonError, open_button

KEY, ABS, SYN = 1, 3, 0
SOUTH, EAST, SPACE = 0x130, 0x131, 57


class Event(NamedTuple):
    type: int
    code: int
    value: int


class Device:
    """An input device with these keys."""

    def __init__(
        self, path: str = "/dev/input/event7", name: str = "pad", keys: tuple[int, ...] = (SOUTH, EAST)
    ) -> None:
        self.path, self.name, self.keys = path, name, keys
        self.events: list[Event] = []
        self.active: list[int] = []
        self.gone = self.grabbed = self.taken = False
        self.button = Button(self)

    def capabilities(self) -> dict[int, list[int]]:
        return {SYN: [0], **({KEY: list(self.keys)} if self.keys else {})}

    def grab(self) -> None:
        if self.taken:
            raise OSError(errno.EBUSY, "Device or resource busy")
        self.grabbed = True

    def fileno(self) -> int:
        return 0

    def read(self) -> list[Event]:
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")
        events, self.events = self.events, []
        return events

    def active_keys(self) -> list[int]:
        return self.active

    def close(self) -> None:
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")


def changes(device: Device, *events: Event) -> list[bool]:
    device.events += events
    return device.button.read()


def test_any_of_its_buttons_holds() -> None:
    device = Device()
    assert changes(device, Event(KEY, SOUTH, 1)) == [True]
    assert changes(device, Event(KEY, EAST, 1), Event(KEY, SOUTH, 0)) == []
    assert changes(device, Event(KEY, EAST, 2), Event(ABS, 0, 17), Event(SYN, 0, 0)) == []
    assert changes(device, Event(KEY, EAST, 0)) == [False]
    assert changes(device, Event(KEY, EAST, 1), Event(KEY, EAST, 0)) == [True, False]


def test_what_was_down_before_does_not_hold() -> None:
    assert changes(Device(), Event(KEY, SOUTH, 2), Event(KEY, SOUTH, 0)) == []


def test_a_release_that_was_lost() -> None:
    device = Device()
    assert changes(device, Event(KEY, SOUTH, 1)) == [True]
    device.active = [SOUTH]
    assert changes(device, Event(SYN, 3, 0)) == []
    device.active = []
    assert changes(device, Event(SYN, 3, 0)) == [False]


def test_unplugged() -> None:
    device = Device()
    button = Button(device)
    device.gone = True
    with pytest.raises(OSError, match="No such device"):
        button.read()
    button.close()


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    """The devices of this machine."""
    devices: list[Device] = []
    evdev = ModuleType("evdev")

    def opened(path: str | Path) -> Device:
        for device in devices:
            if device.path == str(path):
                return device
        raise OSError(errno.ENOTTY if Path(path).exists() else errno.ENOENT, "")

    evdev.list_devices = lambda: [device.path for device in devices]  # type: ignore[attr-defined]
    evdev.InputDevice = opened  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "evdev", evdev)
    return devices


def test_finds_the_only_gamepad(plugged: list[Device]) -> None:
    plugged += [Device("/dev/input/event0", "keyboard", (SPACE,)), Device(), Device("/dev/input/event9", "lid", ())]
    assert open_button(None).name == "pad"
    assert plugged[1].grabbed
    assert not plugged[0].grabbed


def test_any_button_that_is_named(plugged: list[Device]) -> None:
    plugged.append(Device("/dev/input/event3", "red button", (SPACE,)))
    assert open_button(Path("/dev/input/event3")).name == "red button"


def test_what_cannot_be(plugged: list[Device], tmp_path: Path) -> None:
    with pytest.raises(ButtonError, match=r"no gamepad .* is plugged in; .* --device: none that this user may read"):
        open_button(None)
    plugged += [Device(), Device("/dev/input/event8", "stick"), Device("/dev/input/event9", "lid", ())]
    with pytest.raises(ButtonError, match=r"several could be meant; .*event7 \(pad\), /dev/input/event8 \(stick\)"):
        open_button(None)
    with pytest.raises(ButtonError, match=r"/dev/input/event5: is not there; there are: /dev/input/event7 \(pad\)"):
        open_button(Path("/dev/input/event5"))
    with pytest.raises(ButtonError, match=r"event9: lid has no buttons"):
        open_button(Path("/dev/input/event9"))
    with pytest.raises(ButtonError, match=r"is no input device"):
        open_button(tmp_path)
    plugged[0].taken = True
    with pytest.raises(ButtonError, match=r"event7: another program has taken it"):
        open_button(Path("/dev/input/event7"))


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(ButtonError, match="evdev is not installed: pip install"):
        open_button(None)
