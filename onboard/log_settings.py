"""How much of the disk logs may take."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct


def _meta(unit: str, low: float, high: float, doc: str) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


class LogSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """How much of the disk logs may take."""

    budget: Annotated[
        float, _meta("GB", 0.0, 1e5, "of all runs in one folder; beyond it the oldest are removed; 0: none ever is")
    ] = 0.0
    free: Annotated[float, _meta("GB", 0.0, 1e5, "free disk space that preflight wants")] = 0.5
