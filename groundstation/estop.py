"""``pipewright estop``: one key that stops, and a button that must be held."""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from groundstation import codes, station

if TYPE_CHECKING:
    from groundstation.button import Button
    from groundstation.estop_panel import Panel
    from groundstation.watch_orders import Orders

_EPILOG: Final = """\
keys:
  space    stop: hold, in contact retreat first; again: land
  k k      kill: the motors and the servos are cut at once, and IT FALLS
  q        close the panel

With --listen, holding any button of a gamepad, joystick or USB button means fly: once it was pressed, letting go of it,
pulling its cable, or closing the panel is a stop. Without it, closing the panel asks nothing of the vehicle.

examples:
  pipewright estop --vehicle falcon
  pipewright estop --vehicle falcon --listen
  pipewright estop --vehicle falcon --device /dev/input/event5 --push
"""
#: An order is repeated for so long; the person sees that there is no answer yet, s.
_PATIENCE: Final = 60.0
_GLANCE: Final = 0.05
_REFRESH: Final = 10.0


def add_parser(commands: Any) -> None:
    """Add ``estop`` to the commands of an argparse parser."""
    words = "one key that stops the vehicle, and a button that must be held"
    estop = commands.add_parser(
        "estop",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    estop.add_argument("--listen", action="store_true", help="listen to the gamepad or joystick that is plugged in")
    estop.add_argument("--device", type=Path, metavar="PATH", help="listen to this one: /dev/input/eventN")
    ways = estop.add_mutually_exclusive_group()
    ways.add_argument(
        "--dead-man", action="store_false", dest="push", help="letting go of it is a stop (as it is without --push)"
    )
    ways.add_argument("--push", action="store_true", help="pushing it is a stop, and so is pulling its cable")
    station.add_options(estop)
    estop.set_defaults(run=run, push=False)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Show the panel until the person leaves; gives the exit code."""
    if options.json or not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise station.WrongInputError("estop wants a terminal; for a program: pipewright stop --json")
    # Imported here so that --help answers at once.
    from groundstation.button import ButtonError, open_button
    from groundstation.estop_keys import DeadMan, Pushed
    from groundstation.estop_panel import Panel
    from groundstation.watch_orders import Orders

    with ExitStack() as stack:
        button: Button | None = None
        if options.listen or options.device is not None:
            try:
                button = open_button(options.device)
            except ButtonError as error:
                raise station.WrongInputError(str(error)) from None
            stack.callback(button.close)
        client = stack.enter_context(station.open_client(options, urgent=True))
        orders = Orders(client, time.monotonic_ns, _PATIENCE)
        way = None if button is None else Pushed() if options.push else DeadMan()
        panel = Panel(client, orders, way, "" if button is None else button.name)
        attend(panel, button)
        return _told(panel, orders, options.timeout)


def attend(panel: Panel, button: Button | None) -> None:
    """Listen to keys and button, and show the panel, until it is left or its terminal has gone."""
    from rich.console import Console
    from rich.live import Live

    # What draws has a thread of its own: a terminal that takes nothing more must not keep a key waiting.
    live = Live(get_renderable=panel.draw, console=Console(), screen=True, refresh_per_second=_REFRESH)
    keyboard = sys.stdin.fileno()
    with _leaving_on_signals(panel), _single_keys(keyboard), _shown(live):
        try:
            while not panel.leaving:
                files: list[Any] = [keyboard] if button is None else [keyboard, button]
                ready, _, _ = select.select(files, [], [], _GLANCE)
                if button is not None and button in ready and not _listened(panel, button):
                    button = None
                if keyboard in ready:
                    _typed(panel, keyboard)
                panel.look()
        finally:
            panel.left()


def _listened(panel: Panel, button: Button) -> bool:
    """Whether the button is still there."""
    try:
        for down in button.read():
            panel.changed(down)
    except OSError:
        panel.gone()
        return False
    return True


def _typed(panel: Panel, keyboard: int) -> None:
    try:
        keys = os.read(keyboard, 1024)
    except OSError:
        keys = b""
    if not keys:  # the terminal has gone
        panel.leaving = True
    for key in keys.decode(errors="replace"):
        panel.press(key)


@contextmanager
def _shown(live: Any) -> Iterator[None]:
    live.start()
    try:
        yield
    finally:
        with suppress(OSError):  # a terminal that has gone needs no restoring
            live.stop()


@contextmanager
def _single_keys(keyboard: int) -> Iterator[None]:
    """Keys come one by one and are not shown; nothing holds the output back."""
    before = termios.tcgetattr(keyboard)
    try:
        tty.setcbreak(keyboard, termios.TCSANOW)
        mode = termios.tcgetattr(keyboard)
        mode[0] &= ~termios.IXON
        termios.tcsetattr(keyboard, termios.TCSANOW, mode)
        yield
    finally:
        with suppress(termios.error):
            termios.tcsetattr(keyboard, termios.TCSANOW, before)


@contextmanager
def _leaving_on_signals(panel: Panel) -> Iterator[None]:
    def leave(number: int, frame: object) -> None:
        panel.leaving = True

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, leave) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _told(panel: Panel, orders: Orders, timeout: float) -> int:
    """Wait for the answers that are owed, for a moment, and tell how all has ended."""
    end = time.monotonic() + timeout
    while any(order.pending for order in orders.latest()) and time.monotonic() < end:
        time.sleep(_GLANCE)
    code = codes.DONE
    with suppress(OSError):
        for order in orders.latest():
            if order.pending:
                code = codes.TIMED_OUT
            print(f"{order.name}: {'no answer' if order.pending else order.text}")
        if panel.flying:
            print("The vehicle flies on, and this panel stops it no more.")
        sys.stdout.flush()
    return code
