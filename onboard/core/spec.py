"""How a parameter is declared: ``name: Annotated[float, spec(unit, low, high, meaning)] = default``."""

from __future__ import annotations

from msgspec import Meta


def spec(unit: str, low: float, high: float, meaning: str, *, in_flight: bool = True) -> Meta:
    """Bounds (inclusive), unit and meaning of one number, and whether it may change in flight."""
    return Meta(ge=low, le=high, description=meaning, extra={"unit": unit, "in_flight": in_flight})


def note(meaning: str, *, in_flight: bool = True) -> Meta:
    """Meaning of a parameter that is not a number."""
    return Meta(description=meaning, extra={"unit": "", "in_flight": in_flight})
