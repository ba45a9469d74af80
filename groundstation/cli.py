"""The ``pipewright`` command: fly missions, replay and report them."""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import NoReturn

from groundstation import (
    calibrate,
    campaign,
    completion,
    estop,
    events,
    film,
    keys,
    lease,
    logs,
    orders,
    params,
    preflight,
    recompute,
    status,
    tune,
    watch,
)
from groundstation.codes import BROKEN, DONE, INTERRUPTED, LOST, NOT_THERE, REFUSED, WRONG_INPUT
from groundstation.desk import Desk, WorldError
from groundstation.parsing import Parser

EXIT_CODES = {"completed": DONE, "safe": REFUSED, "unfinished": REFUSED, "lost": LOST}

_EPILOG = """\
exit codes:
  0  done; mission completed; no difference in a replay
  1  a replay differs, or the flight process failed
  2  wrong input; nothing was done or written
  3  the vehicle refuses; or it ended safely, but otherwise than asked
  4  vehicle lost
  5  no vehicle is there, or a device cannot be had
  6  no answer in time: it may or may not be done
  130  interrupted; what was recorded until then is reported
"""
_SIM_EPILOG = """\
examples:
  pipewright sim                                       the paper's experiment
  pipewright sim --law paper --out runs/as-printed     with the equations and Table I as printed
  pipewright sim --set repair.force=3 --set pipe.heading_deg=45 --set pipe.position=[3,1,2]
  pipewright sim --scenario my-pipe.yaml --seed 7
"""
_DESK_EPILOG = """\
The simulated world with an emulator for each device, and the flight process with the real drivers, are two processes.

examples:
  pipewright desk                                              all devices emulated
  pipewright desk --config my-pipe.yaml --set repair.force=3
  pipewright desk --set devices.servos.kind=mock               the servos straight from the world
  pipewright desk --config sitl                                on a real PX4 (docs/px4.md)
"""
_ONBOARD_EPILOG = """\
examples:
  pipewright onboard --config jetson --attended                waits on the ground for what it is asked
  pipewright onboard --config /etc/pipewright.yaml --mission --out /var/log/pipewright/today
"""
#: Packages that a vehicle's computer does not need, and the extra that brings each.
_EXTRAS = {
    "cryptography": "ground", "dask": "campaign", "distributed": "campaign", "matplotlib": "ground",
    "optuna": "campaign", "pyarrow": "campaign", "rich": "ground", "scipy": "campaign", "textual": "ground",
    "tqdm": "sim",
}  # fmt: skip
_LOG_HELP = "log.mcap of a run, or its run folder"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; gives the exit code."""
    parser = _parser()
    completion.complete(parser)
    options = parser.parse_args(arguments)
    try:
        code: int = options.run(options)
        sys.stdout.flush()
    except InputError as error:
        print(f"pipewright: {error}", file=sys.stderr)
        return WRONG_INPUT
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRAS:
            raise
        remedy = f"pip install 'pipewright[{_EXTRAS[package]}]'"
        print(f"pipewright: this takes the package {package}, which is not installed: {remedy}", file=sys.stderr)
        return BROKEN
    except BrokenPipeError:
        # Who read our output has seen enough; the interpreter must not complain of it at its end either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    return code


class InputError(Exception):
    """Wrong input of the user."""


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = Parser(
        prog="pipewright",
        description="Pipe repair by contact with an aerial manipulator.",
        epilog=_EPILOG,
        formatter_class=raw,
    )
    parser.add_argument("--version", action="version", version=f"pipewright {version('pipewright')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    words = "fly the whole repair in a simulated world, faster than real time"
    sim = commands.add_parser(
        "sim", help=words, description=words.capitalize() + ".", epilog=_SIM_EPILOG, formatter_class=raw
    )
    sim.add_argument("--scenario", metavar="NAME|FILE", help="where the pipe is and what to do (default: paper)")
    sim.add_argument(
        "--longest", type=float, metavar="SECONDS", help="break off after so much simulated time (default: 900)"
    )
    sim.set_defaults(run=_sim)
    words = "fly it in real time, real drivers against emulated devices"
    desk = commands.add_parser(
        "desk", help=words, description=words.capitalize() + ".", epilog=_DESK_EPILOG, formatter_class=raw
    )
    desk.add_argument(
        "--config", dest="scenario", default="desk", metavar="NAME|FILE", help="devices, pipe, task (default: desk)"
    )
    desk.add_argument("--duration", type=float, metavar="SECONDS", help="land after this time")
    desk.add_argument("--no-autostart", action="store_true", help="wait on the ground for what stations ask")
    desk.set_defaults(run=_desk)
    words = "fly with the devices of this machine: the process of the vehicle's computer"
    onboard = commands.add_parser(
        "onboard", help=words, description=words.capitalize() + ".", epilog=_ONBOARD_EPILOG, formatter_class=raw
    )
    onboard.add_argument("--config", dest="scenario", required=True, metavar="NAME|FILE", help="devices, pipe, task")
    onboard.add_argument("--duration", type=float, metavar="SECONDS", help="land after this time")
    onboard.add_argument(
        "--attended",
        action="store_true",
        help="take requests (takeoff, start, land, ...) as lines of standard input",
    )
    onboard.add_argument("--mission", action="store_true", help="fly the whole mission once preflight passes, then end")
    onboard.set_defaults(run=_onboard)
    words = "hold a simulated world with emulated devices for a flight process elsewhere"
    world = commands.add_parser("world", help=words, description=words.capitalize() + ".")
    world.add_argument("--config", dest="scenario", required=True, metavar="NAME|FILE", help="devices, pipe, task")
    world.add_argument("--servo-link", type=Path, metavar="PATH", help="symbolic link to make to the servo bus")
    world.set_defaults(run=_world)
    for command in (sim, desk, onboard, world):
        command.add_argument("--law", metavar="paper|tuned", help="controller parameters (default: tuned)")
        command.add_argument(
            "--set",
            action="append",
            default=[],
            dest="sets",
            metavar="KEY=VALUE",
            help="set any parameter; may be repeated",
        )
        command.add_argument("--seed", type=int, metavar="N", help="of everything random in the world (default: 0)")
    for command in (sim, desk, world):
        command.add_argument(
            "--plant",
            choices=("rigid", "pybullet"),
            help="who computes the motion of the simulated world (sets world.plant.kind; default: rigid)",
        )
    for command in (sim, desk, onboard):
        command.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: a new one in runs/)")
        command.add_argument("--no-progress", action="store_true", help="no progress bar")
    of_vehicle = (status, watch, estop, preflight, lease, orders, events, params, logs, recompute)
    for group in (*of_vehicle, calibrate, campaign, tune, film, keys, completion):
        group.add_parser(commands)
    words = "run the recorded inputs through the core again and compare every output to the bit"
    replay = commands.add_parser("replay", help=words, description=words.capitalize() + ".")
    replay.add_argument("log", type=Path, metavar="LOG", help=_LOG_HELP)
    replay.add_argument(
        "--from", dest="start", type=float, metavar="SECONDS", help="begin at the last keyframe before this time"
    )
    replay.add_argument("--partial", action="store_true", help="accept a log that was cut off")
    replay.set_defaults(run=_replay)
    words = "rebuild metrics.json and report.html of a run from its log alone"
    report = commands.add_parser("report", help=words, description=words.capitalize() + ".")
    report.add_argument("log", type=Path, metavar="LOG", help=_LOG_HELP)
    report.add_argument("--partial", action="store_true", help="accept a log that was cut off")
    report.add_argument(
        "--beside",
        type=Path,
        action="append",
        default=[],
        metavar="LOG",
        help="another run to show in the table; may be repeated",
    )
    report.set_defaults(run=_report)
    return parser


def _sim(options: argparse.Namespace) -> int:
    _can_report()
    begun, out = time.perf_counter(), _out(options)
    before = _written(out / "log.mcap")
    code = _flight_process(["sim", "--out", str(out), *_common(options), *_run_options(options)])
    return _outcome(code, out / "log.mcap", before, begun)


def _desk(options: argparse.Namespace) -> int:
    _can_report()
    begun, out = time.perf_counter(), _out(options)
    before = _written(out / "log.mcap")
    mission = [] if options.no_autostart else ["--mission"]
    arguments = [*mission, "--out", str(out), *_run_options(options)]
    try:
        with Desk(_common(options)) as desk:
            endpoints = desk.start_world()
            with _passing_on(desk.pass_on):
                code = _told(desk.fly(arguments, endpoints))
    except KeyboardInterrupt:
        code = INTERRUPTED
    except WorldError as error:
        if error.code not in (WRONG_INPUT, NOT_THERE):
            print(f"pipewright: {error}", file=sys.stderr)
        code = error.code
    return _outcome(code, out / "log.mcap", before, begun)


def _onboard(options: argparse.Namespace) -> int:
    arguments = ["fly", "--out", str(_out(options)), *_common(options), *_run_options(options)]
    arguments += ["--attended"] if options.attended else []
    _become([*arguments, "--mission"] if options.mission else arguments)


def _world(options: argparse.Namespace) -> int:
    link = [] if options.servo_link is None else [f"--servo-link={options.servo_link}"]
    _become(["world", *_common(options), *link])


def _common(options: argparse.Namespace) -> list[str]:
    """What every flight and every world is told."""
    name = "--config" if options.run is not _sim else "--scenario"
    arguments = [] if options.scenario is None else [f"{name}={options.scenario}"]
    given = {name: getattr(options, name) for name in ("law", "seed")}
    arguments += [f"--{name}={value}" for name, value in given.items() if value is not None]
    plant = getattr(options, "plant", None)
    sets = [*options.sets, *([] if plant is None else [f"world.plant.kind={plant}"])]
    return [*arguments, *(f"--set={item}" for item in sets)]


def _run_options(options: argparse.Namespace) -> list[str]:
    duration = getattr(options, "duration", None)
    longest = getattr(options, "longest", None)
    quiet = ["--no-progress"] if options.no_progress else []
    limits = [("duration", duration), ("longest", longest)]
    return [*quiet, *(f"--{name}={value}" for name, value in limits if value is not None)]


def _out(options: argparse.Namespace) -> Path:
    return _run_folder(options.out) if options.out is not None else _new_folder(options.scenario, options.law)


def _outcome(code: int, log: Path, before: int, begun: float) -> int:
    """Report what the flight process has recorded, and make of its exit code that of the command."""
    if code == WRONG_INPUT:
        return WRONG_INPUT
    recorded = _written(log) != before
    if code not in (DONE, INTERRUPTED):
        rest = "what it recorded is reported" if recorded else "it recorded nothing"
        print(f"pipewright: the flight process failed (code {code}); {rest}", file=sys.stderr)
    if not recorded:
        return code if code in (INTERRUPTED, NOT_THERE) else BROKEN
    outcome = _evaluate(log, partial=True, begun=begun)
    return EXIT_CODES[outcome] if code == DONE else INTERRUPTED if code == INTERRUPTED else BROKEN


def _replay(options: argparse.Namespace) -> int:
    arguments = ["replay", str(_log(options.log))]
    arguments += [f"--from={options.start}"] if options.start is not None else []
    arguments += ["--partial"] if options.partial else []
    return _flight_process(arguments)


def _report(options: argparse.Namespace) -> int:
    beside = [_log(path) for path in options.beside]
    _evaluate(_log(options.log), partial=options.partial, beside=beside)
    return DONE


def _can_report() -> None:
    """What a flight's figures are told with is there; found out before it has flown."""
    import_module("rich.console")


def _evaluate(log: Path, *, partial: bool, begun: float | None = None, beside: Sequence[Path] = ()) -> str:
    """Write metrics and report beside a log and print the summary; gives the outcome.

    begun: when the command began (perf_counter); without it the run's duration is taken from a former metrics.json.
    beside: logs of other runs to show in the table.
    """
    # Imported here so that --help and wrong input answer at once.
    from rich.console import Console

    from groundstation import metrics, report, terminal
    from groundstation.run import read_run
    from onboard.messages import LogError

    try:
        run = read_run(log, partial=partial)
        others = [metrics.compute(read_run(path, partial=partial)) for path in beside]
    except LogError as error:
        raise InputError(str(error)) from None
    target = log.with_name("metrics.json")
    wall_s = time.perf_counter() - begun if begun is not None else metrics.former_wall_s(target)
    figures = metrics.compute(run, wall_s)
    page = log.with_name("report.html")
    metrics.write(figures, target)
    report.write(run, figures, page, others)
    terminal.summarize(run, figures, page, Console(highlight=False), others)
    return str(figures["outcome"])


def _flight_process(arguments: list[str]) -> int:
    """Run an onboard process in this terminal; gives its exit code.

    It has a process group of its own and every interrupt is passed on to it once, so that it can end in order.
    """
    child: subprocess.Popen[bytes] | None = None
    early: list[int] = []

    def pass_on(number: int) -> None:
        if child is None:
            early.append(number)
        else:
            child.send_signal(number)

    with _passing_on(pass_on):
        child = subprocess.Popen(_command(arguments), process_group=0)
        for number in early:
            child.send_signal(number)
        return _told(child.wait())


@contextmanager
def _passing_on(hear: Callable[[int], None]) -> Iterator[None]:
    """Hand interrupts to ``hear`` instead of ending at once."""

    def on_signal(number: int, frame: FrameType | None) -> None:
        hear(number)

    former = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _told(code: int) -> int:
    """The exit code of a child; one that was ended by an interrupt was interrupted."""
    return INTERRUPTED if code in (-signal.SIGINT, -signal.SIGTERM) else code


def _become(arguments: list[str]) -> NoReturn:
    """Go on as an onboard process: same process id, so that a service manager sees the flight itself."""
    command = _command(arguments)
    os.execv(command[0], command)


def _command(arguments: list[str]) -> list[str]:
    return [sys.executable, "-P", "-m", "onboard", *arguments]


def _log(path: Path) -> Path:
    return path / "log.mcap" if path.is_dir() else path


def _written(path: Path) -> int:
    """When a file was last written, ns; 0 when there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


def _run_folder(path: Path) -> Path:
    """Check that a folder may be written: new, empty, or an older run."""
    if path.exists() and not path.is_dir():
        raise InputError(f"--out {path}: is a file; give a folder")
    if path.is_dir() and any(path.iterdir()) and not (path / "log.mcap").is_file():
        raise InputError(f"--out {path}: holds other files and no former run; give a new or empty folder")
    return path


def _new_folder(scenario: str | None, law: str | None) -> Path:
    """The next free ``runs/<scenario>[-<law>]-<number>``."""
    stem = "-".join(filter(None, (Path(scenario or "paper").stem, law)))
    stem = re.sub(r"[^\w.-]+", "_", stem)
    names = (re.fullmatch(re.escape(stem) + r"-(\d+)", path.name) for path in Path("runs").glob("*"))
    last = max((int(match[1]) for match in names if match), default=0)
    return Path("runs") / f"{stem}-{last + 1:03d}"
