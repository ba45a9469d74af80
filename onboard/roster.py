"""Who is admitted to a vehicle, by the names in their certificates."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct

from onboard.wire import NAME_RULE, is_name


class Role(StrEnum):
    """What a certificate is for."""

    VIEWER = "viewer"
    """Sees everything, asks for nothing but stop, retreat and kill."""
    OPERATOR = "operator"
    """May ask for everything."""
    VEHICLE = "vehicle"
    """Is a vehicle: publishes and answers under its own name only."""


class Member(Struct, frozen=True, forbid_unknown_fields=True):
    """One person or machine."""

    name: str
    """The common name of its certificates."""
    role: Role
    expires: datetime
    """When its newest certificate does (UTC)."""
    revoked: datetime | None = None
    """Since when it is admitted no more (UTC)."""


class Roster(Struct, frozen=True, forbid_unknown_fields=True):
    """All who were ever given a certificate. A name stands for one person or machine, for good."""

    version: Literal[1] = 1
    members: tuple[Member, ...] = ()

    def __post_init__(self) -> None:
        """A name that is doubtful is refused, since access is by name."""
        names = [member.name for member in self.members]
        if wrong := [name for name in names if not is_name(name)]:
            raise ValueError(f"{wrong[0]!r} is no name; {NAME_RULE}")
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"{twice[0]} is there twice")

    def member(self, name: str) -> Member | None:
        """The one of this name."""
        return next((member for member in self.members if member.name == name), None)

    def admitted(self, role: Role) -> tuple[str, ...]:
        """The names in a role that are not revoked."""
        return tuple(m.name for m in self.members if m.role is role and m.revoked is None)


class RosterError(Exception):
    """A roster cannot be read; the text says where and why."""


def load_roster(path: Path) -> Roster:
    """Read ``roster.json``. Raises RosterError."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Roster)
    except OSError as error:
        raise RosterError(
            f"{path}: {error.strerror}; `pipewright keys` writes it into the authority's folder"
        ) from None
    except (ValueError, RecursionError) as error:
        raise RosterError(f"{path}: {error}; copy it again from the folder of the authority") from None
