"""A viewer that floods its vehicle, as a process of its own: ``python -m tests.link.flood KEYS VEHICLE ENDPOINT``.

Right and wrong messages on every key that it may write, and on some that it may not, as fast as one process can, until
its standard input closes. Then it tells how many there were.
"""

from __future__ import annotations

import itertools
import random
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread

import zenoh

from onboard.admission import station_security
from onboard.core.types import Phase, Request
from onboard.endpoints import open_session
from onboard.identity import load_identity
from onboard.wire import (
    LARGEST,
    Ask,
    Go,
    Keys,
    ListLogs,
    Mission,
    Order,
    ReadLog,
    ShowEvents,
    ShowParams,
    ShowPreflight,
    StationPulse,
    TakeLease,
    Way,
    encode,
)

VIEWS: tuple[Ask, ...] = (
    ShowParams(), ShowPreflight(), ShowEvents(), ListLogs(), ReadLog("flight/log.mcap", 0, 256 * 1024),
    ReadLog("../../etc/passwd", 2**62, 1),
)  # fmt: skip
ORDERS: tuple[Ask, ...] = (Mission(Request.START), Go(Phase.PRESS), TakeLease(seize=True))


def messages(keys: Keys, name: str) -> Iterator[tuple[str, bytes, bool]]:
    """Key, payload, and whether it asks for an answer."""
    chance = random.Random(1)
    own = {way: keys.station(name, "flood", way) for way in Way}
    pulse = keys.station(name, "flood", "pulse")
    foreign = keys.station("bob", "flood", "pulse")
    for number in itertools.count():
        now = time.monotonic_ns()
        yield own[Way.VIEW], encode(Order(f"f{number}", chance.choice(VIEWS), now)), True
        yield own[Way.COMMAND], encode(Order(f"g{number}", chance.choice(ORDERS), now)), True
        yield own[Way.SAFETY], encode(Order(f"h{number}", ShowParams(), now)), True
        yield pulse, encode(StationPulse(now, chance.getrandbits(63))), False
        yield foreign, encode(StationPulse(now, now)), False
        yield chance.choice((pulse, *own.values())), chance.randbytes(chance.choice((0, 3, 200, LARGEST))), True
        yield own[Way.VIEW], encode(Order("x", ShowParams()))[:-1] + b"\x91" * 2000, True
        yield keys.telemetry, chance.randbytes(500), False
        yield keys.station(name, f"s{number}", "pulse"), encode(StationPulse(1)), False
        yield chance.choice((pulse, own[Way.SAFETY])), bytes(100_000), False


def main(folder: str, vehicle: str, endpoint: str) -> None:
    """Flood."""
    identity = load_identity(Path(folder))
    security = station_security(vehicle, identity)
    session = open_session("client", [endpoint], plain=False, lease=2.0, security=security, timeout=20.0)
    over, sent = Event(), 0

    def wait() -> None:
        sys.stdin.read()
        over.set()

    Thread(target=wait, daemon=True).start()
    with session:
        sys.stdout.write("flooding\n")
        sys.stdout.flush()
        for key, payload, answered in messages(Keys(vehicle), identity.name):
            if over.is_set():
                break
            sent += 1
            if answered:
                session.get(key, lambda reply: None, payload=payload, timeout=1.0)
            else:
                session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)
    sys.stdout.write(f"{sent}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
