"""How the vehicle can be reached, and what it expects of its stations."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from onboard.wire import NAME


def _meta(unit: str, low: float, high: float, doc: str) -> Meta:
    return Meta(ge=low, le=high, description=doc, extra={"unit": unit, "in_flight": False})


def _note(doc: str) -> Meta:
    return Meta(description=doc, extra={"unit": "", "in_flight": False})


class LinkSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The link to the ground stations."""

    vehicle: Annotated[str, Meta(pattern=NAME), _note("name of the vehicle, the same for no other")] = "pipewright"
    listen: Annotated[
        tuple[str, ...],
        _note("where stations connect to: tls/0.0.0.0:7447, or tcp/127.0.0.1:7447 on one machine; none: no link"),
    ] = ()
    plain: Annotated[bool, _note("allow endpoints without TLS, on loopback only")] = False
    keys: Annotated[str, _note("folder with the vehicle's identity and roster; empty: none, and plain is needed")] = ""
    telemetry_rate: Annotated[float, _meta("Hz", 0.1, 100.0, "at which the newest tick is sent")] = 20.0
    pulse_period: Annotated[float, _meta("s", 0.02, 1.0, "between two signs of life")] = 0.1
    peer_lease: Annotated[
        float, _meta("s", 0.2, 10.0, "without a sign of the other machine, then it is gone; more than its round trip")
    ] = 2.0
    silence: Annotated[float, _meta("s", 0.2, 60.0, "of the commander, then this is told")] = 0.8
    patience: Annotated[float, _meta("s", 1.0, 600.0, "of a silent commander, then anyone may take the lease")] = 10.0
    order_age: Annotated[
        float, _meta("s", 0.2, 60.0, "an order that may have travelled longer is refused; not so stop, retreat, kill")
    ] = 2.0
