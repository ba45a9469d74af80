"""``pipewright keys``: the certificates of vehicles and of those who fly or watch them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from onboard.messages import Member, Role

#: A certificate that expires sooner is pointed out, days.
SOON = 30
AUTHORITY = Path("~/.config/pipewright/authority")

_EPILOG = """\
examples:
  pipewright keys init
  pipewright keys add falcon --role vehicle --host 10.0.0.7
  pipewright keys add alice --role operator
  pipewright keys list
  pipewright keys revoke alice

What has to be copied where is in docs/keys.md.
"""
_COPY = "copy {roster} to every vehicle, beside its key.pem, and restart its link"


def add_parser(commands: Any) -> None:
    """Add ``keys`` to the commands of an argparse parser."""
    words = "certificates: who is a vehicle, who may command it, who may watch"
    keys = commands.add_parser(
        "keys",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = keys.add_subparsers(required=True, metavar="WHAT", dest="what")
    words = "make the authority that signs all certificates, in a new folder"
    init = what.add_parser("init", help=words, description=words.capitalize() + ".")
    words = "make a key and a certificate for a person or a machine"
    add = what.add_parser("add", help=words, description=words.capitalize() + ".")
    add.add_argument("name", metavar="NAME", help="of the person or machine; for good")
    words = "what it is: may watch and stop, may command, or is a vehicle"
    add.add_argument("--role", type=Role, choices=list(Role), required=True, metavar="|".join(Role), help=words)
    add.add_argument(
        "--host",
        action="append",
        default=[],
        dest="hosts",
        metavar="HOST",
        help="name or address a vehicle is reached by, beside NAME and NAME.local; may be repeated",
    )
    add.add_argument("--days", type=int, metavar="N", help="how long it is valid (default: two years)")
    add.add_argument("--renew", action="store_true", help="for a name that has one already")
    add.add_argument("--out", type=Path, metavar="DIR", help="new folder for them (default: NAME in the authority)")
    words = "admit a person or machine no more, for good"
    revoke = what.add_parser("revoke", help=words, description=words.capitalize() + ".")
    revoke.add_argument("name", metavar="NAME")
    words = "show who has a certificate, and until when"
    show = what.add_parser("list", help=words, description=words.capitalize() + ".")
    for command in (init, add, revoke, show):
        command.add_argument(
            "--authority",
            type=Path,
            default=AUTHORITY,
            metavar="DIR",
            help=f"folder of the authority (default: {AUTHORITY})",
        )
        command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run ``keys``; gives the exit code: 0, or 2 when nothing could be done as asked."""
    # Imported here so that --help answers at once.
    from groundstation.authority import KeysError

    try:
        for line in _answer(options):
            print(line)
    except KeysError as error:
        print(f"pipewright: {error}", file=sys.stderr)
        return 2
    return 0


def _answer(options: argparse.Namespace) -> Iterator[str]:
    from groundstation.authority import DAYS, Authority

    folder: Path = options.authority.expanduser()
    if options.what == "init":
        authority = Authority.init(folder)
        yield f"{folder}: made an authority, valid until {authority.not_after:%Y-%m-%d}"
        yield f"keep {folder / 'ca.key'} on this machine, and a copy of the folder in a safe place"
        return
    authority = Authority(folder)
    roster = folder / "roster.json"
    match options.what:
        case "add":
            days = DAYS if options.days is None else options.days
            made = authority.add(
                options.name, options.role, hosts=options.hosts, days=days, renew=options.renew, out=options.out
            )
            member = authority.roster.member(options.name)
            assert member is not None
            yield f"{made}: key and certificate of {member.name} ({member.role}), valid until {member.expires:%Y-%m-%d}"
            if member.role is Role.VEHICLE:
                yield f"move it to the vehicle, with {roster} in it"
            else:
                yield f"move it to the machine of {member.name}; {_COPY.format(roster=roster)}"
        case "revoke":
            member = authority.revoke(options.name)
            yield f"{member.name}: is admitted no more by vehicles that know of it: {_COPY.format(roster=roster)}"
        case "list":
            yield from listed(authority.roster.members, authority.not_after, datetime.now(UTC))


def listed(members: tuple[Member, ...], authority_expires: datetime, now: datetime) -> Iterator[str]:
    """The table of ``keys list``."""
    rows = [("NAME", "ROLE", "EXPIRES", "")]
    rows += [(m.name, m.role.value, f"{m.expires:%Y-%m-%d}", _state(m, now)) for m in members]
    rows += [("(the authority)", "", f"{authority_expires:%Y-%m-%d}", _lasts(authority_expires, now))]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, (*widths, 0), strict=True))
        yield "  ".join(cells).rstrip()


def _state(member: Member, now: datetime) -> str:
    return f"revoked {member.revoked:%Y-%m-%d}" if member.revoked is not None else _lasts(member.expires, now)


def _lasts(expires: datetime, now: datetime) -> str:
    left = (expires - now).days
    if expires <= now:
        return "EXPIRED"
    return f"{left} days left" + ("; renew it" if left < SOON else "")
