"""How every command of a station meets its vehicle: the options, the session, what is said, and the exit codes.

Whatever needs Zenoh is imported when a session is opened, so that --help and completion answer at once.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from groundstation import codes
from onboard.messages import Identity, IdentityError, load_identity, not_for, station_security
from onboard.wire import Ack, Ask, Outcome, Told, Way, way_of

if TYPE_CHECKING:
    from groundstation.client import Client, StationSettings
    from groundstation.urgent import Urgent
    from onboard.endpoints import ZenohConfig

CONNECT, VEHICLE, KEYS = "PIPEWRIGHT_CONNECT", "PIPEWRIGHT_VEHICLE", "PIPEWRIGHT_KEYS"
_VEHICLE: Final = "pipewright"
_PORT: Final = 7447
_TIMEOUT: Final = 5.0

T = TypeVar("T")
Run = Callable[[argparse.Namespace], int]


class WrongInputError(Exception):
    """What a person gave cannot be; the text says what would be right."""


class RefusedError(Exception):
    """The vehicle refuses, or would; the text says why."""


class UnfinishedError(Exception):
    """It was begun as asked, and has ended otherwise; the text says how."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what every command takes that speaks with a vehicle."""
    group = parser.add_argument_group("the vehicle, and who asks")
    group.add_argument(
        "--vehicle", metavar="NAME", help=f"which vehicle is meant (default: ${VEHICLE}, else {_VEHICLE})"
    )
    group.add_argument(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="where it is reached, like tls/falcon.local:7447; repeated: one of several "
        f"(default: ${CONNECT}, else with keys tls/VEHICLE.local:{_PORT}, without tcp/127.0.0.1:{_PORT})",
    )
    group.add_argument(
        "--keys",
        type=Path,
        metavar="DIR",
        help=f"the folder `pipewright keys add` made for this station (default: ${KEYS}, else none)",
    )
    group.add_argument("--plain", action="store_true", help="without keys, which is for loopback only")
    group.add_argument(
        "--station",
        metavar="NAME",
        help="who asks; all commands of one name command together (default: the name in the keys, else user and host)",
    )
    group.add_argument(
        "--timeout",
        type=_seconds,
        default=_TIMEOUT,
        metavar="SECONDS",
        help=f"to find the vehicle, and for each of its answers (default: {_TIMEOUT:g})",
    )
    group.add_argument("--json", action="store_true", help="for a program to read")


def examples_of(prog: str, epilog: str) -> str:
    """Those lines of the examples of a group of commands that are about one of them, as an epilog of its own."""
    lines = [line for line in epilog.splitlines() if f"{line.strip()} ".startswith(f"{prog} ")]
    return "\n".join(["examples:", *lines, ""]) if lines else ""


@contextmanager
def open_client(
    options: argparse.Namespace, *, on_told: Callable[[Told], None] | None = None, urgent: bool = False
) -> Iterator[Client]:
    """The session of a command with its vehicle. What this station may not ask is refused without asking.

    urgent: for who stays, stop, retreat and kill have connections of their own. Raises WrongInputError for options
    that cannot be, LinkError, and NoVehicleError that tells why it is not seen.
    """
    from groundstation.client import Client
    from groundstation.urgent import Urgent

    identity = _identity(options)
    settings = settings_of(options, identity)
    security = _security(settings, identity)
    forbids = None if identity is None else lambda ask: not_for(identity, way_of(ask))
    with ExitStack() as stack:
        with _explained(settings, identity):
            client = Client(settings, timeout=options.timeout, on_told=on_told, security=security, forbids=forbids)
        stack.enter_context(client)
        if urgent:
            client.urgent = stack.enter_context(Urgent(settings, security=security))
        yield client


@contextmanager
def open_urgent(options: argparse.Namespace) -> Iterator[Urgent]:
    """Connections for what is urgent and for nothing else; they wait for no vehicle to be seen.

    Raises as ``open_client``, but NoVehicleError only once something is asked.
    """
    from groundstation.urgent import Urgent

    identity = _identity(options)
    settings = settings_of(options, identity)
    with Urgent(settings, security=_security(settings, identity)) as urgent, _explained(settings, identity):
        yield urgent


@contextmanager
def _explained(settings: StationSettings, identity: Identity | None) -> Iterator[None]:
    """Add to a NoVehicleError why the vehicle is not seen."""
    from onboard.endpoints import NoVehicleError

    try:
        yield
    except NoVehicleError as error:
        raise NoVehicleError("\n".join([str(error), *_reasons(error, settings, identity)])) from None


def _security(settings: StationSettings, identity: Identity | None) -> ZenohConfig | None:
    try:
        return None if identity is None else station_security(settings.vehicle, identity)
    except IdentityError as error:
        raise WrongInputError(str(error)) from None


def settings_of(options: argparse.Namespace, identity: Identity | None) -> StationSettings:
    """Options, environment and defaults put together. Raises WrongInputError."""
    from groundstation.client import StationSettings

    vehicle = options.vehicle or os.environ.get(VEHICLE) or _VEHICLE
    default = f"tls/{vehicle}.local:{_PORT}" if identity is not None else f"tcp/127.0.0.1:{_PORT}"
    connect = options.connect or os.environ.get(CONNECT, "").replace(",", " ").split() or [default]
    station = options.station or ""
    if identity is None:
        if secured := [endpoint for endpoint in connect if endpoint.startswith("tls/")]:
            raise WrongInputError(f"{secured[0]}: give the keys of this station: --keys DIR, or ${KEYS}")
        return StationSettings(vehicle, tuple(connect), station, plain=True)
    if station not in ("", identity.name):
        raise WrongInputError(f"--station {station}: the keys in {identity.folder} are of {identity.name}")
    if plain := [endpoint for endpoint in connect if endpoint.startswith("tcp/")]:
        raise WrongInputError(f"{plain[0]}: is without TLS, and there are keys: use tls/, or give --plain")
    return StationSettings(vehicle, tuple(connect), identity.name)


def _identity(options: argparse.Namespace) -> Identity | None:
    """Who this station is; None: it has no keys, or is not to use them."""
    if options.plain:
        if options.keys is not None:
            raise WrongInputError("--plain and --keys: give one of them")
        return None
    folder = options.keys or os.environ.get(KEYS)
    if not folder:
        return None
    try:
        return load_identity(Path(folder).expanduser())
    except IdentityError as error:
        raise WrongInputError(str(error)) from None


def _reasons(error: Exception, settings: StationSettings, identity: Identity | None) -> Iterator[str]:
    """What a handshake with TLS alone finds out."""
    from groundstation.refusal import why_refused
    from onboard.endpoints import UnreachableError

    if identity is not None or isinstance(error, UnreachableError):
        for endpoint in settings.connect:
            yield why_refused(endpoint, settings.vehicle, identity)


# --- asking, and saying what came of it -------------------------------------------------------------------------------


def ask(client: Client | Urgent, what: Ask, options: argparse.Namespace) -> Ack:
    """Ask, and give the answer that is final. Raises RefusedError, NoVehicleError, NoAnswerError."""
    ack = client.ask(what, timeout=options.timeout, settled=True)
    if ack.outcome is Outcome.REFUSED:
        raise RefusedError(ack.text)
    return ack


def shown(client: Client, what: Ask, kind: type[T], options: argparse.Namespace) -> T:
    """Ask to be shown something that comes as JSON. Raises as ``ask``, and for what is not understood."""
    data = ask(client, what, options).data
    try:
        return msgspec.json.decode(data, type=kind)
    except (ValueError, RecursionError) as error:
        raise RefusedError(f"what {client.vehicle} shows is not understood: {error}; update it") from None


def command(client: Client, what: Ask, options: argparse.Namespace) -> Ack:
    """As ``ask``, for what the commander alone may ask: a refusal says how to become it."""
    try:
        return ask(client, what, options)
    except RefusedError as error:
        raise RefusedError(f"{error}{_how_to_command(client, what)}") from None


def _how_to_command(client: Client, what: Ask) -> str:
    pulse = client.contact().pulse
    if way_of(what) is not Way.COMMAND or pulse is None or pulse.commander == client.station:
        return ""
    if not pulse.commander:
        return (
            " Run `pipewright lease take` in another terminal and leave it running: the vehicle wants its commander to "
            "be there all the time."
        )
    return " `pipewright lease take --seize` takes it from whoever has it."


def tell(options: argparse.Namespace, text: str, **more: Any) -> None:
    """The end of a command that was done: its sentence, or with --json an object with ``outcome`` and ``text``."""
    tell_data(options, {"outcome": "done", "text": text, **more}, [text])


def tell_data(options: argparse.Namespace, data: Any, lines: Sequence[str]) -> None:
    """Print ``data`` for a program, or ``lines`` for a person."""
    if options.json:
        print(json.dumps(jsonable(data), ensure_ascii=False), flush=True)
    else:
        for line in lines:
            print(line, flush=True)


def jsonable(data: Any) -> Any:
    """The same of plain values; what is no finite number, and so no JSON, is null."""

    def finite(value: Any) -> Any:
        match value:
            case float():
                return value if math.isfinite(value) else None
            case dict():
                return {key: finite(item) for key, item in value.items()}
            case list() | tuple():
                return [finite(item) for item in value]
        return value

    return finite(msgspec.to_builtins(data))


def guarded(run: Run) -> Run:
    """Turn what a command may raise into a sentence and its exit code (``codes``)."""

    @functools.wraps(run)
    def guarding(options: argparse.Namespace) -> int:
        try:
            return run(options)
        except KeyboardInterrupt:
            return codes.INTERRUPTED
        except Exception as error:
            code, outcome = _judged(error)
            if not outcome:
                raise
            if options.json:
                tell_data(options, {"outcome": outcome, "text": str(error)}, [])
            print(f"pipewright: {error}", file=sys.stderr)
            return code

    return guarding


def _judged(error: Exception) -> tuple[int, str]:
    """Exit code and outcome of what a command may raise; no outcome: it is a fault of this program."""
    from groundstation.client import NoAnswerError
    from onboard.endpoints import LinkError, NoVehicleError

    match error:
        case WrongInputError() | LinkError():
            return codes.WRONG_INPUT, "wrong_input"
        case RefusedError():
            return codes.REFUSED, "refused"
        case UnfinishedError():
            return codes.REFUSED, "unfinished"
        case NoVehicleError():
            return codes.NOT_THERE, "no_vehicle"
        case NoAnswerError():
            return codes.TIMED_OUT, "timed_out"
    return codes.BROKEN, ""


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds <= 3600.0:
        raise argparse.ArgumentTypeError(f"{text}: must be a time in seconds, up to 3600")
    return seconds
