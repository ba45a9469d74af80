"""``pipewright calibrate hover|servos|mount``: find out what the vehicle is.

Each kind has a module of its own, which is imported when it is asked for, so that --help answers at once.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
from typing import Any

from drivers.samples import SERVO_NAMES
from drivers.xc330 import BAUDS

_NAMES = tuple(name.upper() for name in SERVO_NAMES)
_HOVER_EPILOG = """\
Have the vehicle hold in the air for a while, away from the pipe: 5 s at least, better two minutes, so that the voltage
of the battery changes.

examples:
  pipewright calibrate hover runs/jetson-001
  pipewright calibrate hover runs/jetson-001 --config my-vehicle.yaml     writes it into the file
"""
_SERVOS_EPILOG = """\
Torque must be off: stop the flight process. Nothing is written to the servos, and nothing moves. One pose gives the
zeros; with a second one, in which every servo stands elsewhere, the signs are found too. Angles are in degrees; those
of joints are as in docs/frames.md.

examples:
  pipewright calibrate servos --config my-vehicle.yaml --angles 0 0 0 0 0 --then 30 30 30 90 45
  pipewright calibrate servos --port /dev/servos --baud 4000000 --angles 0 0 0 0 0
"""
_MOUNT_EPILOG = """\
Props off, the flight process in PREFLIGHT: take the vehicle in both hands where the camera sees much, and for half a
minute turn it about each of its axes, back and forth, by 30 deg and more, quickly. Then end the process.

examples:
  pipewright calibrate mount runs/jetson-002
  pipewright calibrate mount runs/jetson-002 --config my-vehicle.yaml     writes it into the file
"""


def add_parser(commands: Any) -> None:
    """Add ``calibrate`` to the commands of an argparse parser."""
    words = "find out what the vehicle is: thrust map, zeros of the servos, mount of the camera"
    calibrate = commands.add_parser("calibrate", help=words, description=words.capitalize() + ".")
    kinds = calibrate.add_subparsers(required=True, dest="kind", metavar="WHAT")
    hover = _add(kinds, "hover", "the thrust map, from the hover in the log of a flight", _HOVER_EPILOG)
    words = "zeros and signs of the servos, from the arm stood in known poses by hand"
    servos = _add(kinds, "servos", words, _SERVOS_EPILOG)
    servos.add_argument("--angles", type=float, nargs=5, required=True, metavar=_NAMES, help="of the pose, deg")
    servos.add_argument("--then", type=float, nargs=5, metavar=_NAMES, help="of a second pose, deg: find the signs too")
    bus = servos.add_argument_group("the bus (default: as --config says)")
    bus.add_argument("--port", help="serial port, like /dev/servos")
    bus.add_argument("--baud", type=int, choices=BAUDS, metavar="N", help="of the bus (default: as configured)")
    bus.add_argument("--ids", type=int, nargs=5, metavar=_NAMES, help="of the servos")
    bus.add_argument(
        "--signs", type=int, nargs=5, choices=(1, -1), metavar=_NAMES, help="of the servos (default: as configured)"
    )
    words = "where the camera sits and how it is turned, from the log of a motion"
    mount = _add(kinds, "mount", words, _MOUNT_EPILOG)
    for parser in (hover, mount):
        parser.add_argument("log", type=Path, metavar="RUN", help="log.mcap of a run, or its run folder")
        parser.add_argument("--partial", action="store_true", help="accept a log that was cut off")


def _add(kinds: Any, name: str, words: str, epilog: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = kinds.add_parser(
        name,
        help=words,
        description=words.capitalize() + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    words = "file of the vehicle's configuration: what is found is written into it"
    parser.add_argument("--config", metavar="FILE", help=words)
    parser.set_defaults(run=run)
    return parser


def run(options: argparse.Namespace) -> int:
    """Run one calibration; gives the exit code."""
    guarded = import_module("groundstation.calibration").guarded
    code: int = guarded(import_module(f"groundstation.calibrate_{options.kind}").run)(options)
    return code
