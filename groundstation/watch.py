"""``pipewright watch``: the vehicle on a terminal screen, with keys for what is urgent."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from groundstation import codes, station

_EPILOG = """\
keys:
  h hold   r retreat   s or space stop (again: land)   k k kill (twice within 2 s)   l land   u resume   q quit

Stop, retreat and kill are open to every station that is admitted; the rest to the one that commands.

examples:
  pipewright watch --vehicle falcon
  pipewright watch --vehicle falcon --lease         take command, and give it back at the end
"""


def add_parser(commands: Any) -> None:
    """Add ``watch`` to the commands of an argparse parser."""
    words = "the vehicle on a terminal screen, with keys for what is urgent"
    watch = commands.add_parser(
        "watch",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    station.add_options(watch)
    watch.add_argument("--lease", action="store_true", help="take command if nobody has it, and keep it while watching")
    watch.set_defaults(run=station.guarded(run))


def run(options: argparse.Namespace) -> int:
    """Show the screen until the person leaves; gives the exit code."""
    if options.json or not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise station.WrongInputError("watch wants a terminal; for a program: pipewright status --json")
    # Imported here so that --help answers at once.
    from groundstation.watch_app import WatchApp

    with station.open_client(options, urgent=True) as client:
        app = WatchApp(client, lease=options.lease, timeout=options.timeout)
        app.run(mouse=False)  # so that the terminal still selects text, and nothing but keys comes in
        if (release := app.release()) is not None:
            print(client.ask(release, timeout=options.timeout).text)
    return app.return_code or codes.DONE
