"""Watching, after an order, what the vehicle makes of it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from groundstation.events import Printer
from onboard.messages import Phase, Tick

if TYPE_CHECKING:
    from groundstation.client import Client, Contact

#: In these the vehicle waits for what it is asked: on the ground, and hovering.
GROUND: Final = (Phase.PREFLIGHT, Phase.STOPPED)
AT_REST: Final = (*GROUND, Phase.HOLD)
_LOOK: Final = 0.1


def since_now(client: Client, timeout: float) -> int:
    """A time of the vehicle's monotonic clock (ns) that is certainly later than this call, and not by much.

    What was on its way before, a tick of before an order say, is stamped earlier. Raises NoVehicleError.
    """
    from onboard.endpoints import NoVehicleError

    began = time.monotonic()
    client.wait(lambda contact: contact.age < time.monotonic() - began, timeout)
    contact = client.contact()
    if contact.pulse is None or contact.age >= time.monotonic() - began:
        raise NoVehicleError(f"{client.vehicle} was not heard for {timeout:g} s")
    return contact.pulse.sent_ns


def follow(
    client: Client, options: argparse.Namespace, printer: Printer, ended: Callable[[Phase], bool]
) -> tuple[Phase, float]:
    """Print the events from now on until the vehicle is in a phase that ends it; gives that, and the seconds it took.

    Raises NoVehicleError when the vehicle is not heard for ``options.timeout`` seconds, NoAnswerError when its loop
    makes no tick for so long.
    """
    begin_ns = since_now(client, options.timeout)
    while True:
        contact = client.contact()
        tick = _newest(client)
        _alive(client, contact, tick, options.timeout)
        if tick is not None and tick.inputs.t_ns >= begin_ns and ended(tick.outputs.phase):
            # What was told of the end may come a moment after it.
            printer.print_new(contact, _LOOK)
            return tick.outputs.phase, (tick.inputs.t_ns - begin_ns) * 1e-9
        printer.print_new(contact, _LOOK)


def _newest(client: Client) -> Tick | None:
    telemetry = client.telemetry()
    return telemetry.tick if telemetry is not None else None


def _alive(client: Client, contact: Contact, tick: Tick | None, timeout: float) -> None:
    from groundstation.client import NoAnswerError
    from onboard.endpoints import NoVehicleError

    at = f"It was in {tick.outputs.phase.upper()}." if tick is not None else "Nothing was heard of its flight."
    if contact.age > timeout:
        raise NoVehicleError(f"{client.vehicle} is not heard any more, for {contact.age:.1f} s. {at}")
    if contact.pulse is not None and (stands := (contact.pulse.sent_ns - contact.pulse.tick_ns) * 1e-9) > timeout:
        raise NoAnswerError(f"the loop of {client.vehicle} has made no tick for {stands:.1f} s. {at}")
