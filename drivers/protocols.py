"""The device protocols. Each device has two calls that never wait; all waiting is hidden behind them."""

from __future__ import annotations

from typing import Protocol

from drivers.mailbox import Notice
from drivers.samples import AutopilotCommand, AutopilotState, Engage, Odometry, ServoCommand, ServoState


class Device(Protocol):
    """Life cycle shared by all devices."""

    async def start(self) -> None:
        """Connect. Raises ``DeviceError`` with the reason and the remedy when the device cannot be had."""

    async def stop(self) -> None:
        """Release the device; safe to call twice, and after a failed start."""

    def notices(self) -> tuple[Notice, ...]:
        """Sentences for a person since the last call, oldest first."""


class AutopilotDevice(Device, Protocol):
    """The flight controller."""

    def latest(self) -> AutopilotState | None:
        """Newest state, or None before the first."""

    def command(self, command: AutopilotCommand) -> None:
        """Hand over one fresh set-point. It is sent at most once."""

    def insist(self, engage: Engage | None) -> None:
        """From any thread: this (KILL or LAND) is wanted from now on, whatever is commanded; None: no more.

        It is asked for at once, by the calling thread, and again with each call. Meanwhile no set-point leaves and
        nothing else is asked for, but a commanded KILL. Afterwards, what it has left is not taken back by itself: it
        is as if a pilot had done it.
        """


class OdometryDevice(Device, Protocol):
    """The visual-inertial tracker."""

    def latest(self) -> Odometry | None:
        """Newest pose, or None before the first."""


class ServoDevice(Device, Protocol):
    """The bus of five servos."""

    def latest(self) -> ServoState | None:
        """Newest cycle, or None before the first."""

    def command(self, command: ServoCommand) -> None:
        """Hand over the goals for the next cycle."""

    def insist(self, off: bool) -> None:
        """From any thread: torque off as soon as the bus is free, and off whatever is commanded; False: no more.

        With each call it is switched off again.
        """


class DeviceError(Exception):
    """A device cannot be had or was lost; the text says what, where and what to do."""
