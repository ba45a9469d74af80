"""The commands that ask something of the mission: ``arm``, ``takeoff``, ``hold``, ``kill``, and the others."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from groundstation import codes, station
from groundstation.events import Printer
from groundstation.follow import AT_REST, follow
from onboard.messages import Phase, Request
from onboard.wire import Arm, Ask, Go, Mission, Stop, Tare, Way, way_of

if TYPE_CHECKING:
    from groundstation.client import Client

P = Phase
#: The phases of the mission, in their order. Where ``go`` may lead at the moment, and where not, the vehicle says.
_MISSION: Final = (
    P.APPROACH,
    P.ALIGN,
    P.ADHESIVE,
    P.TOOL_CHANGE,
    P.TARE,
    P.ADVANCE,
    P.PRESS,
    P.RELEASE,
    P.RETREAT,
    P.RETURN,
)
GOALS: Final = tuple(phase.value for phase in _MISSION)


class _Order(NamedTuple):
    """One command."""

    words: str
    example: str
    ask: Ask | None
    """None: it depends on the arguments."""
    moves: bool = False
    """Sets the vehicle going: somebody must stay on the link."""
    ended: tuple[Phase, ...] = ()
    """With --wait: at rest in one of these it has done what was asked."""
    told: tuple[str, ...] = ()
    """One of these events must have told so."""


R = Request
#: What was told of an end may come after the tick that ended, s.
_LATE: Final = 1.0
_RUN: Final = ("completed", "hover")
_ORDERS: Final = {
    "arm": _Order("arm, and stay on the ground", "", Arm(), moves=True),
    "takeoff": _Order("take off and hover", "--wait", Mission(R.TAKEOFF), moves=True, ended=(P.HOLD,)),
    "start": _Order(
        "fly the whole mission; from the ground it takes off first",
        "--wait",
        Mission(R.START),
        moves=True,
        ended=AT_REST,
        told=_RUN,
    ),
    "go": _Order("go on with this phase of the mission", "tare --wait", None, moves=True),
    "hold": _Order("hover in place; in contact it first retreats", "--wait", Mission(R.HOLD), ended=(P.HOLD,)),
    "resume": _Order(
        "go on with what was interrupted", "--wait", Mission(R.RESUME), moves=True, ended=AT_REST, told=_RUN
    ),
    "retreat": _Order(
        "take the force back, move away from the pipe and hover (anyone may, without the lease)",
        "--wait",
        Mission(R.RETREAT),
        ended=(P.HOLD,),
    ),
    "land": _Order("land here", "--wait", Mission(R.LAND), ended=(P.STOPPED, P.PREFLIGHT)),
    "stop": _Order(
        "hold, in contact retreat; asked again: land (anyone may, without the lease)", "--wait", Stop(), ended=AT_REST
    ),
    "kill": _Order(
        "cut the motors and the servos at once, wherever it is: IT FALLS (anyone may, without the lease)",
        "--now",
        Mission(R.KILL),
    ),
    "reset": _Order("begin preflight anew, on the ground", "", Mission(R.RESET)),
    "tare": _Order("while it hovers, take the force it feels for zero", "", Tare()),
}


def add_parser(commands: Any) -> None:
    """Add the orders to the commands of an argparse parser."""
    for name, order in _ORDERS.items():
        parser = commands.add_parser(
            name,
            help=order.words,
            description=f"{order.words[0].upper()}{order.words[1:]}.",
            epilog=f"example:\n  pipewright {name} {order.example}".rstrip() + "\n",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name == "go":
            parser.add_argument("phase", type=_phase, choices=GOALS, metavar="PHASE", help=f"one of {', '.join(GOALS)}")
        if name == "kill":
            parser.add_argument("--now", action="store_true", help="without asking for confirmation")
        if order.ended or name == "go":
            parser.add_argument(
                "--wait",
                action="store_true",
                help="tell the events until it has ended; code 3 if it ended otherwise than asked",
            )
        station.add_options(parser)
        parser.set_defaults(run=run, order=name, wait=False)


@station.guarded
def run(options: argparse.Namespace) -> int:
    """Ask, and tell the answer; with --wait, how it ended. Gives the exit code."""
    order = _ORDERS[options.order]
    if options.order == "kill" and not options.now and not sys.stdin.isatty():
        raise station.WrongInputError("kill asks for confirmation, and here is no terminal to ask on: give --now")
    ask = order.ask if order.ask is not None else Go(Phase(options.phase))
    printer = Printer(options)
    if way_of(ask) is Way.SAFETY:
        return _urgently(options, printer, order, ask)
    with station.open_client(options, on_told=printer.hear) as client:
        if order.moves:
            _accompanied(client)
        text = station.command(client, ask, options).text or f"{options.order}: done"
        if not options.wait:
            station.tell(options, text)
            return codes.DONE
        if not options.json:
            print(text, flush=True)
        return _wait(client, options, printer, order)


def _urgently(options: argparse.Namespace, printer: Printer, order: _Order, ask: Ask) -> int:
    """Ask as soon as any connection is there, and look only then what comes of it."""
    with station.open_urgent(options) as urgent:
        if options.order == "kill" and not options.now:
            _confirm(urgent.vehicle)
        text = station.ask(urgent, ask, options).text or f"{options.order}: done"
        # Told before the connections are closed, which may take its time where the network is bad.
        if not options.wait:
            station.tell(options, text)
            return codes.DONE
        if not options.json:
            print(text, flush=True)
    with station.open_client(options, on_told=printer.hear) as client:
        return _wait(client, options, printer, order)


def _wait(client: Client, options: argparse.Namespace, printer: Printer, order: _Order) -> int:
    """Tell the events until the order has come to its end, and whether that is the one that was asked for."""
    goal = Phase(options.phase) if order.ask is None else None
    phase, seconds = follow(client, options, printer, _passed(goal) if goal is not None else AT_REST.__contains__)
    if goal is not None:
        well = phase.value in GOALS or (goal is P.RETURN and phase is P.LAND)
    else:
        well = phase in order.ended and (not order.told or printer.await_one(client, order.told, _LATE))
    text = f"{client.vehicle} is in {phase.upper()}, {seconds:.1f} s later"
    if not well:
        raise station.UnfinishedError(f"{text}: {options.order} has not ended as asked")
    station.tell(options, f"{text}.", phase=phase.value, seconds=round(seconds, 3))
    return codes.DONE


def _passed(goal: Phase) -> Callable[[Phase], bool]:
    """Whether a phase has been gone through; or what came instead of it has ended."""
    later = GOALS[GOALS.index(goal.value) + 1 :]
    seen = False

    def ended(phase: Phase) -> bool:
        nonlocal seen
        seen = seen or phase is goal
        # one that is shorter than the time between two looks is not seen
        return phase in AT_REST or phase.value in later or (seen and phase is not goal)

    return ended


def _accompanied(client: Client) -> None:
    """Refuse to set a vehicle going and leave it: it would be without its commander as soon as this command ends."""
    pulse = client.contact().pulse
    if pulse is None or pulse.commander != client.station:
        return  # the vehicle itself says what is wrong
    others = (heard for heard in pulse.stations if heard.name == client.station and heard.session != client.session)
    if not any(heard.present for heard in others):
        raise station.RefusedError(
            f"{client.station} commands {client.vehicle}, but nothing keeps the link: once this command has ended the "
            "vehicle would be without its commander. Run `pipewright lease take` in another terminal and leave it "
            "running."
        )


def _confirm(vehicle: str) -> None:
    print(f"This cuts the motors of {vehicle} at once. In the air IT FALLS.", file=sys.stderr)
    print(f"Type {vehicle} or kill to do it: ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip() not in (vehicle, "kill"):
        raise station.WrongInputError("not confirmed: nothing was asked of the vehicle")


def _phase(text: str) -> str:
    """As a person may write it: TOOL-CHANGE."""
    return text.strip().lower().replace("-", "_").replace(" ", "_")
