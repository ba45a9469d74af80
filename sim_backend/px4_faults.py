"""What can go wrong with the autopilot and its link."""

from __future__ import annotations

from sim_backend.faults import Kind

DEVICE = "autopilot"
KINDS = (
    Kind.DROP, Kind.DELAY, Kind.CORRUPT, Kind.FREEZE, Kind.NAN, Kind.SILENT, Kind.UNPLUGGED, Kind.REBOOT,
)  # fmt: skip
