"""All that the ground station knows of the onboard side: the messages, and how to read a log of them."""

from __future__ import annotations

from onboard.admission import not_for, station_security
from onboard.core.repair import Pipe, Repair
from onboard.core.types import Action, Event, Phase, Request, Severity, Tick
from onboard.identity import Identity, IdentityError, load_identity
from onboard.logfile import LogError, LogReader
from onboard.records import (
    DEVICES,
    EVENT,
    KEYFRAME,
    PARAMS,
    TICK,
    TIMING,
    TRUTH,
    DeviceReport,
    Keyframe,
    Revision,
    RunInfo,
    Timing,
)
from onboard.roster import Member, Role, Roster, RosterError, load_roster
from onboard.wire import NAME_RULE, is_name
from sim_backend.plant import Truth

__all__ = [
    "DEVICES",
    "EVENT",
    "KEYFRAME",
    "NAME_RULE",
    "PARAMS",
    "TICK",
    "TIMING",
    "TRUTH",
    "Action",
    "DeviceReport",
    "Event",
    "Identity",
    "IdentityError",
    "Keyframe",
    "LogError",
    "LogReader",
    "Member",
    "Phase",
    "Pipe",
    "Repair",
    "Request",
    "Revision",
    "Role",
    "Roster",
    "RosterError",
    "RunInfo",
    "Severity",
    "Tick",
    "Timing",
    "Truth",
    "is_name",
    "load_identity",
    "load_roster",
    "not_for",
    "station_security",
]
