"""Who may hear and ask what on the link: the part of a Zenoh session's configuration that is about certificates.

Access is by name, since names are what Zenoh tells certificates apart by, and is checked at both ends. The keys are
those of the link, below ``pipewright/<vehicle>/``. All that a station writes stands below its own name, so that a name
in a key is a proof: the vehicle lets nobody use another's.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from onboard.identity import Identity, IdentityError
from onboard.roster import Role, Roster

#: Zenoh configuration by path.
Security = dict[str, Any]

#: What the vehicle publishes for everyone.
_PUBLISHED = ("pulse", "telemetry", "event")
#: On which ways a role may ask. Stop, retreat and kill, the ``safety`` way, are for anyone admitted.
_WAYS = {Role.VIEWER: ("safety", "view"), Role.OPERATOR: ("safety", "view", "command")}


def vehicle_security(vehicle: str, identity: Identity, roster: Roster) -> Security:
    """Mutual TLS and access control for the session of ``vehicle``, which listens.

    Who is not on the roster, or revoked on it, is connected and sees nothing. Zenoh reads this when the session is
    opened; another roster takes another session. Raises IdentityError for an identity that is not this vehicle's.
    """
    if identity.role is not Role.VEHICLE:
        raise IdentityError(f"{identity.certificate}: is of {identity.name}, {identity.role}; give a vehicle's folder")
    if identity.name != vehicle:
        # Stations would take it for another, and hear nothing.
        raise IdentityError(f"{identity.certificate}: is of {identity.name}, but this is {vehicle}; make both the same")
    root = f"pipewright/{vehicle}"
    everyone = [*roster.admitted(Role.VIEWER), *roster.admitted(Role.OPERATOR)]
    published = [f"{root}/{what}" for what in _PUBLISHED]
    access = _Access()
    access.allow("subscribe", everyone, "ingress", ["declare_subscriber"], published)
    access.allow("publish", everyone, "egress", ["put"], published)
    access.allow("watch", everyone, "ingress", ["liveliness_query", "declare_liveliness_subscriber"], [f"{root}/alive"])
    access.allow("watched", everyone, "egress", ["liveliness_token"], [f"{root}/alive"])
    # What the vehicle listens to, for all stations in one declaration each.
    access.allow("listen", everyone, "egress", ["declare_subscriber", "declare_queryable"], [f"{root}/station/**"])
    for name in everyone:
        own = f"{root}/station/{name}/*"
        ways = next(_WAYS[role] for role in _WAYS if name in roster.admitted(role))
        access.allow(f"{name} is there", [name], "ingress", ["liveliness_token"], [f"{own}/alive"])
        access.allow(f"{name} pulses", [name], "ingress", ["put"], [f"{own}/pulse"])
        access.allow(f"{name} asks", [name], "ingress", ["query"], [f"{own}/{way}" for way in ways])
        access.allow(f"{name} is answered", [name], "egress", ["reply"], [f"{own}/{way}" for way in ways])
        access.allow(f"{name} follows", [name], "ingress", ["declare_subscriber"], [f"{root}/ack/{name}"])
        access.allow(f"{name} is told", [name], "egress", ["put"], [f"{root}/ack/{name}"])
    return {**_mutual_tls(identity), "access_control": access.settings()}


def station_security(vehicle: str, identity: Identity) -> Security:
    """Mutual TLS for the session of a station, and access control that lets it speak with ``vehicle`` alone.

    Zenoh trusts the public authorities of the web beside ours, and a certificate of our own authority may be another
    vehicle's: neither carries this vehicle's name. Raises IdentityError for an identity that is a vehicle's.
    """
    if identity.role is Role.VEHICLE:
        raise IdentityError(f"{identity.certificate}: is a vehicle's; give the folder of an operator or a viewer")
    root = [f"pipewright/{vehicle}/**"]
    tells = ["put", "reply", "declare_subscriber", "declare_queryable", "liveliness_token"]
    asks = ["put", "query", "declare_subscriber", "liveliness_token", "liveliness_query"]
    access = _Access()
    access.allow("tells", [vehicle], "ingress", tells, root)
    access.allow("asks", [vehicle], "egress", [*asks, "declare_liveliness_subscriber"], root)
    return {**_mutual_tls(identity), "access_control": access.settings()}


def not_for(identity: Identity, way: str) -> str:
    """Why a station need not ask on this way; empty: it may. The vehicle would say nothing."""
    if way in _WAYS.get(identity.role, ()):
        return ""
    return f"{identity.name} is a {identity.role}: for this an operator's certificate is needed"


def _mutual_tls(identity: Identity) -> Security:
    certificate, key = str(identity.certificate.resolve()), str(identity.key.resolve())
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(identity.ca.resolve()),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            # An operator who flies when a certificate expires goes on; the next connection is refused.
            "close_link_on_expiration": False,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        },
    }


class _Access:
    """Rules of Zenoh's access control, one at a time; what no rule allows is denied."""

    def __init__(self) -> None:
        self._rules: list[Security] = []
        self._subjects: list[Security] = []
        self._policies: list[Security] = []

    def allow(self, rule: str, names: Iterable[str], flow: str, messages: list[str], keys: list[str]) -> None:
        """Let messages pass on these keys, from (ingress) or to (egress) certificates of these names."""
        if not (names := list(names)):
            # Zenoh refuses an empty list.
            return
        self._rules.append(
            {"id": rule, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
        )
        self._subjects.append({"id": rule, "cert_common_names": names, "link_protocols": ["tls"]})
        self._policies.append({"rules": [rule], "subjects": [rule]})

    def settings(self) -> Security:
        """As Zenoh reads them."""
        lists = {"rules": self._rules, "subjects": self._subjects, "policies": self._policies}
        return {"enabled": True, "default_permission": "deny", **lists}
