"""A gamepad, or a USB button, on this machine: Linux's input devices, read through evdev."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

#: Of linux/input-event-codes.h.
EV_SYN, EV_KEY = 0, 1
SYN_DROPPED: Final = 3
#: Buttons of mice, joysticks and gamepads begin here; keys of keyboards are below.
_BTN_JOYSTICK, _BTN_DIGI = 0x120, 0x140


class ButtonError(Exception):
    """There is no such button; the text says what would be right."""


class InputEvent(Protocol):
    """What is read of one event."""

    @property
    def type(self) -> int:
        """Of linux/input-event-codes.h."""

    @property
    def code(self) -> int:
        """Which button."""

    @property
    def value(self) -> int:
        """0 up, 1 down, 2 still down."""


class InputDevice(Protocol):
    """The part of an ``evdev.InputDevice`` that is used. Its calls raise OSError when it was unplugged."""

    name: str
    path: str

    def fileno(self) -> int:
        """To wait on."""

    def read(self) -> Iterable[InputEvent]:
        """What has happened."""

    def active_keys(self) -> list[int]:
        """What is down."""

    def close(self) -> None:
        """Give it back."""


class Button:
    """All buttons of a device as one: it is down while any of them is.

    One that was down when the device was opened counts as up until it is pressed anew.
    """

    def __init__(self, device: InputDevice) -> None:
        self._device = device
        self._down: set[int] = set()
        self.name = device.name

    def fileno(self) -> int:
        """To wait on."""
        return self._device.fileno()

    @property
    def down(self) -> bool:
        """It is held."""
        return bool(self._down)

    def read(self) -> list[bool]:
        """What it has done since the last call: went down (True), up (False). Raises OSError when it is unplugged."""
        changes: list[bool] = []
        for event in self._device.read():
            before = self.down
            if (event.type, event.code) == (EV_SYN, SYN_DROPPED):
                # Events were lost; what is held still, the device knows.
                self._down &= set(self._device.active_keys())
            elif event.type == EV_KEY and event.value == 1:
                self._down.add(event.code)
            elif event.type == EV_KEY and event.value == 0:
                self._down.discard(event.code)
            if self.down is not before:
                changes.append(self.down)
        return changes

    def close(self) -> None:
        """Give it back; safe when it is unplugged."""
        with suppress(OSError):
            self._device.close()


def open_button(path: Path | None) -> Button:
    """The button at ``path``, or the only gamepad or joystick there is. Raises ButtonError."""
    try:
        import evdev
    except ImportError:
        raise ButtonError("evdev is not installed: pip install 'pipewright[button]' (Linux only)") from None
    device: Any = _opened(evdev, path) if path is not None else _found(evdev)
    try:
        # A button that types, as many do, must not type into this terminal.
        device.grab()
    except OSError as error:
        raise ButtonError(f"{device.path}: another program has taken it ({error.strerror})") from None
    return Button(device)


def _opened(evdev: Any, path: Path) -> Any:
    try:
        device = evdev.InputDevice(path)
    except FileNotFoundError:
        raise ButtonError(f"{path}: is not there; there are: {_names(evdev)}") from None
    except PermissionError:
        raise ButtonError(f"{path}: no permission; add the user to the group input") from None
    except OSError as error:
        raise ButtonError(f"{path}: is no input device ({os.strerror(error.errno or 0)})") from None
    if not device.capabilities().get(EV_KEY):
        raise ButtonError(f"{path}: {device.name} has no buttons; there are: {_names(evdev)}")
    return device


def _found(evdev: Any) -> Any:
    devices = [evdev.InputDevice(path) for path in evdev.list_devices()]
    pads = [device for device in devices if _is_pad(device)]
    if len(pads) == 1:
        return pads[0]
    if not pads:
        raise ButtonError(f"no gamepad or joystick is plugged in; name another button with --device: {_names(evdev)}")
    raise ButtonError(f"several could be meant; name one with --device: {_names(evdev)}")


def _is_pad(device: Any) -> bool:
    return any(_BTN_JOYSTICK <= code < _BTN_DIGI for code in device.capabilities().get(EV_KEY, ()))


def _names(evdev: Any) -> str:
    devices = [evdev.InputDevice(path) for path in evdev.list_devices()]
    found = [f"{device.path} ({device.name})" for device in devices if device.capabilities().get(EV_KEY)]
    return ", ".join(sorted(found)) or "none that this user may read (group input)"
