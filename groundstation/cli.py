"""The ``pipewright`` command: fly missions, replay and report them."""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from types import FrameType

COMPLETED, BROKEN, WRONG_INPUT, SAFE, LOST, INTERRUPTED = 0, 1, 2, 3, 4, 130
EXIT_CODES = {"completed": COMPLETED, "safe": SAFE, "unfinished": SAFE, "lost": LOST}

_EPILOG = """\
exit codes:
  0  mission completed, or no difference in a replay
  1  a replay differs, or the flight process failed
  2  wrong input; nothing was written
  3  ended safely, but not completed
  4  vehicle lost
  5  a device cannot be had
  130  interrupted; what was recorded until then is reported
"""
_SIM_EPILOG = """\
examples:
  pipewright sim                                       the paper's experiment
  pipewright sim --law paper --out runs/as-printed     with the equations and Table I as printed
  pipewright sim --set repair.force=3 --set pipe.heading_deg=45 --set pipe.position=[3,1,2]
  pipewright sim --scenario my-pipe.yaml --seed 7
"""
_LOG_HELP = "log.mcap of a run, or its run folder"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; gives the exit code."""
    options = _parser().parse_args(arguments)
    try:
        code: int = options.run(options)
    except InputError as error:
        print(f"pipewright: {error}", file=sys.stderr)
        return WRONG_INPUT
    return code


class InputError(Exception):
    """Wrong input of the user."""


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="pipewright",
        description="Pipe repair by contact with an aerial manipulator.",
        epilog=_EPILOG,
        formatter_class=raw,
    )
    parser.add_argument("--version", action="version", version=f"pipewright {version('pipewright')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, words in (
        ("sim", "fly the whole repair in a simulated world, faster than real time"),
        ("desk", "fly it in real time against a stand-in autopilot"),
    ):
        fly = commands.add_parser(
            name, help=words, description=words.capitalize() + ".", epilog=_SIM_EPILOG.replace(" sim ", f" {name} "),
            formatter_class=raw,
        )  # fmt: skip
        fly.add_argument("--scenario", metavar="NAME|FILE", help="where the pipe is and what to do (default: paper)")
        fly.add_argument("--law", metavar="paper|tuned", help="controller parameters (default: tuned)")
        fly.add_argument(
            "--set",
            action="append",
            default=[],
            dest="sets",
            metavar="KEY=VALUE",
            help="set any parameter; may be repeated",
        )
        fly.add_argument("--seed", type=int, metavar="N", help="of everything random in the world (default: 0)")
        fly.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: a new one in runs/)")
        fly.add_argument("--no-progress", action="store_true", help="no progress bar")
        fly.set_defaults(run=_fly, command=name)
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


def _fly(options: argparse.Namespace) -> int:
    begun = time.perf_counter()
    out = _run_folder(options.out) if options.out is not None else _new_folder(options.scenario, options.law)
    arguments = [options.command, "--out", str(out)]
    given = {name: getattr(options, name) for name in ("scenario", "law", "seed")}
    arguments += [f"--{name}={value}" for name, value in given.items() if value is not None]
    arguments += [f"--set={item}" for item in options.sets]
    arguments += ["--no-progress"] if options.no_progress else []
    log = out / "log.mcap"
    before = _written(log)
    code = _onboard(arguments)
    if code == WRONG_INPUT:
        return WRONG_INPUT
    recorded = _written(log) != before
    if code not in (COMPLETED, INTERRUPTED):
        rest = "what it recorded is reported" if recorded else "it recorded nothing"
        print(f"pipewright: the flight process failed (code {code}); {rest}", file=sys.stderr)
    if not recorded:
        return INTERRUPTED if code == INTERRUPTED else BROKEN
    outcome = _evaluate(log, partial=True, begun=begun)
    return EXIT_CODES[outcome] if code == COMPLETED else INTERRUPTED if code == INTERRUPTED else BROKEN


def _replay(options: argparse.Namespace) -> int:
    arguments = ["replay", str(_log(options.log))]
    arguments += [f"--from={options.start}"] if options.start is not None else []
    arguments += ["--partial"] if options.partial else []
    return _onboard(arguments)


def _report(options: argparse.Namespace) -> int:
    beside = [_log(path) for path in options.beside]
    _evaluate(_log(options.log), partial=options.partial, beside=beside)
    return COMPLETED


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


def _onboard(arguments: list[str]) -> int:
    """Run the flight process in this terminal; gives its exit code.

    It has a process group of its own and every interrupt is passed on to it once, so that it can end in order.
    """
    child: subprocess.Popen[bytes] | None = None
    early: list[int] = []

    def pass_on(number: int, frame: FrameType | None) -> None:
        if child is None:
            early.append(number)
        else:
            child.send_signal(number)

    former = {number: signal.signal(number, pass_on) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        child = subprocess.Popen([sys.executable, "-P", "-m", "onboard", *arguments], process_group=0)
        for number in early:
            child.send_signal(number)
        code = child.wait()
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
    return INTERRUPTED if code in (-signal.SIGINT, -signal.SIGTERM) else code


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
