"""Who commands: one station at a time. A state and what may become of it; no clock, no wire.

The lease is a station's, by name, and so are all sessions of that name: a person may watch in one window and command
from another. It is never lost by silence, since nothing of what the vehicle does may change because a packet was late:
that the commander is silent is a fact for the core, and lets others take the lease without seizing it.
"""

from __future__ import annotations

from msgspec import Struct
from msgspec.structs import replace


class Lease(Struct, frozen=True):
    """Who commands."""

    holder: str = ""
    """Name of the station; empty: nobody."""
    heard_ns: int = 0
    """What was last heard of it was certainly sent after this time."""


class Ruling(Struct, frozen=True):
    """What became of a wish, and a sentence on it."""

    lease: Lease
    granted: bool
    text: str


def take(lease: Lease, station: str, t_ns: int, heard_ns: int, patience_ns: int, *, seize: bool = False) -> Ruling:
    """``station``, last heard at ``heard_ns``, wants the lease at ``t_ns``; one silent for ``patience_ns`` loses it."""
    taken = Lease(station, heard_ns)
    silent = (t_ns - lease.heard_ns) * 1e-9
    if lease.holder == station:
        return Ruling(keep(lease, station, heard_ns), True, f"{station} commands already.")
    if not lease.holder:
        return Ruling(taken, True, f"{station} commands.")
    if seize:
        return Ruling(taken, True, f"{station} has seized command from {lease.holder}.")
    if t_ns - lease.heard_ns > patience_ns:
        return Ruling(taken, True, f"{station} commands: {lease.holder} was silent for {silent:.1f} s.")
    return Ruling(
        lease, False, f"{lease.holder} commands; it was heard {silent:.1f} s ago. It can release, or be seized."
    )


def release(lease: Lease, station: str, *, flying: bool) -> Ruling:
    """``station`` wants to command no more. A flying vehicle is not left: it is landed first, or seized by another."""
    if refusal := commands(lease, station):
        return Ruling(lease, False, refusal)
    if flying:
        return Ruling(lease, False, "The vehicle flies: land first, or let another station seize command.")
    return Ruling(Lease(), True, f"{station} commands no more.")


def keep(lease: Lease, station: str, heard_ns: int) -> Lease:
    """Something came from ``station`` that was sent after ``heard_ns``."""
    if lease.holder != station or heard_ns <= lease.heard_ns:
        return lease
    return replace(lease, heard_ns=heard_ns)


def commands(lease: Lease, station: str) -> str:
    """Why ``station`` may not command; empty: it may."""
    if lease.holder == station:
        return ""
    if lease.holder:
        return f"{lease.holder} commands, not {station}: seize command first, if you must."
    return "Nobody commands: take the lease first."


class Watch:
    """Tells, once each, that the commander is lost and that it is back: heard as of less than half the silence ago."""

    def __init__(self, silence_ns: int) -> None:
        self._silence_ns = silence_ns
        self._lost: Lease | None = None
        """As it was when its holder was found lost."""

    def look(self, lease: Lease, *, present: bool, t_ns: int) -> tuple[bool, str]:
        """What there is to tell at ``t_ns`` (empty: nothing), and whether it is bad news.

        present: a session of the holder is there.
        """
        before = self._lost
        if before is not None and before.holder != lease.holder:
            before = self._lost = None  # whoever took or left the lease has told so
        silent_ns = t_ns - lease.heard_ns
        if lease.holder and (not present or silent_ns > self._silence_ns):
            if before is None:
                self._lost = lease
                how = f"silent for {silent_ns * 1e-9:.1f} s" if present else "gone"
                return True, f"the commanding station {lease.holder} is {how}."
        elif before is not None and silent_ns < self._silence_ns / 2:
            self._lost = None
            silent = (lease.heard_ns - before.heard_ns) * 1e-9
            return (
                False,
                f"the commanding station {lease.holder} is back after {silent:.1f} s. Nothing resumes by itself.",
            )
        return False, ""
