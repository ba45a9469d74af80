"""How a Zenoh session is opened, the same at both ends: what is plain stays on this machine, nothing is discovered.

Endpoints are explicit, multicast and gossip are off. Both ends announce the same lease, so that a peer which is
frozen or unplugged is gone after it.
"""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, Literal

import zenoh

#: Zenoh configuration by path: ``{"transport/link/tls/...": value}``.
ZenohConfig = Mapping[str, object]

_ENDPOINT: Final = re.compile(r"(tcp|tls)/(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+):([0-9]{1,5})")
_COMMON: Final[ZenohConfig] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # nobody is to be discovered
    "adminspace/enabled": False,
    "transport/shared_memory/enabled": False,
    "connect/exit_on_failure": True,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
}


class NoVehicleError(Exception):
    """The vehicle cannot be reached; the text says what to look at."""


class UnreachableError(NoVehicleError):
    """Nobody could even be connected to."""


class LinkError(Exception):
    """The link cannot be opened as asked; the text says where and what would be right."""


def unfit(endpoints: Sequence[str], *, plain: bool, secured: bool) -> Iterator[str]:
    """What is wrong with each of ``endpoints``. plain: allowed on loopback; secured: keys for TLS are there."""
    for endpoint in endpoints:
        match = _ENDPOINT.fullmatch(endpoint)
        if match is None or not 0 < int(match[3]) < 65536:
            yield f"{endpoint}: is no endpoint; like tls/192.168.1.10:7447 or, on one machine, tcp/127.0.0.1:7447"
        elif match[1] == "tls" and not secured:
            yield f"{endpoint}: there are no keys for TLS; make some, or use tcp/127.0.0.1:{match[3]} on one machine"
        elif match[1] == "tcp" and not _loopback(match[2]):
            instead = f"tls/{match[2]}:{match[3]}, or tcp/127.0.0.1:{match[3]} on one machine"
            yield f"{endpoint}: plain TCP is only for loopback; use {instead}"
        elif match[1] == "tcp" and not plain:
            yield f"{endpoint}: is plain, which is not allowed here; allow it (plain: true), or use tls"


def open_session(
    mode: Literal["router", "client"],
    endpoints: Sequence[str],
    *,
    plain: bool,
    lease: float,
    security: ZenohConfig,
    timeout: float = 0.0,
    more: ZenohConfig | None = None,
) -> zenoh.Session:
    """Open a session that listens at (router) or connects to (client) ``endpoints``. The caller closes it.

    lease: after which a silent peer is gone, s. security: configuration for TLS and access control, empty without.
    timeout: how long a client tries to connect, s. more: further configuration.
    Raises LinkError, UnreachableError when a client finds nobody in time.
    """
    if wrong := list(unfit(endpoints, plain=plain, secured=bool(security))):
        raise LinkError("\n".join(wrong))
    if not endpoints:
        raise LinkError("the link has no endpoint; like tls/192.168.1.10:7447 or, on one machine, tcp/127.0.0.1:7447")
    config = zenoh.Config()
    own: ZenohConfig = {
        "mode": mode,
        "listen/endpoints": list(endpoints) if mode == "router" else [],
        "connect/endpoints": list(endpoints) if mode == "client" else [],
        "connect/timeout_ms": round(timeout * 1e3),
        "transport/link/tx/lease": round(lease * 1e3),
    }
    for path, value in {**_COMMON, **own, **(more or {}), **security}.items():
        config.insert_json5(path, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(endpoints)
        if "Unable to connect" in str(error):
            raise UnreachableError(f"nothing lets us in at {where} within {timeout:g} s: is the vehicle on?") from None
        # Zenoh appends where in its sources it happened.
        reason = re.sub(r" at \S+\.rs:\d+\.?|\[|\]", "", str(error))
        raise LinkError(f"{where}: {reason}") from None


def _loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
