"""Real Zenoh sessions on loopback, and machines with certificates to open them with."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import zenoh

from groundstation.authority import Authority
from onboard.admission import Security
from onboard.identity import Identity, load_identity
from onboard.messages import Role

#: Longer than a loaded machine takes for anything here, s.
LONG = 20.0


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def opened(mode: str, endpoint: str, security: Security) -> zenoh.Session:
    """A session that listens (router) or connects (client, peer)."""
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "listen/endpoints": [endpoint] if mode == "router" else [],
        "connect/endpoints": [] if mode == "router" else [endpoint],
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1},
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,
        **security,
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def wait_until(condition: Callable[[], Any], what: str) -> None:
    """Wait for something that other threads bring about."""
    until, pause = time.monotonic() + LONG, Event()
    while not condition():
        assert time.monotonic() < until, f"not within {LONG} s: {what}"
        pause.wait(0.005)


class Fleet:
    """An authority and those it gave certificates to."""

    def __init__(self, folder: Path, **members: Role) -> None:
        """Make all of them."""
        self.authority = Authority.init(folder)
        self._identities = {name: load_identity(self.authority.add(name, role)) for name, role in members.items()}

    def __getitem__(self, name: str) -> Identity:
        return self._identities[name]
