"""How a parameter of the simulated world is declared."""

from __future__ import annotations

from msgspec import Meta


def knob(unit: str, doc: str, low: float, high: float) -> Meta:
    """Unit, meaning and bounds of a number; nothing about a world changes while it runs."""
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


def switch(doc: str) -> Meta:
    """Meaning of a yes or no."""
    return Meta(description=doc, extra={"unit": "", "in_flight": False})
