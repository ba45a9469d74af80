"""The stations' side: ``python -m tests.bench.emergency.stations OPTIONS``. Tells ``Stations`` as JSON."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Barrier, Event, Thread

import msgspec
import zenoh

from groundstation.client import NoAnswerError, StationSettings
from groundstation.urgent import CONNECTIONS, Urgent
from onboard.admission import Security, station_security
from onboard.core.types import Request
from onboard.endpoints import NoVehicleError, open_session
from onboard.identity import load_identity
from onboard.wire import Ask, Mission, Stop
from tests.bench.emergency.messages import Kind, StationOptions, Stations, Trial
from tests.bench.emergency.vehicle import LEASE, NAME, RAW_GET, RAW_PUT

#: For an answer, and for a connection through a bad network, s.
PATIENCE, _CONNECTING = 10.0, 60.0
_RAW_PATIENCE = 3.0
_ASKS: dict[Kind, Ask] = {"kill": Mission(Request.KILL), "stop": Stop()}


def main() -> None:
    """Ask, from all stations at once."""
    options = msgspec.json.decode(sys.argv[1], type=StationOptions)
    noted = Stations([], {}, [])
    # Closing a session that stands still holds up the others of a process: none is closed before all are done.
    done = Barrier(options.stations)
    threads = [Thread(target=_station, args=(options, number, noted, done)) for number in range(options.stations)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(msgspec.json.encode(noted).decode(), flush=True)


def _station(options: StationOptions, number: int, noted: Stations, done: Barrier) -> None:
    name = f"s{number}"
    security: Security | None = None
    if options.keys:
        security = station_security(NAME, load_identity(Path(options.keys) / name))
        del security["access_control"]
    settings = StationSettings(NAME, (options.connect,), name, plain=not options.keys)
    chance = random.Random(number)
    pause = Event()
    with _raw(settings, security) as raw, _asking(settings, security) as urgent:
        pause.wait(1.0)
        for turn in range(number, options.trials, options.stations):
            for kind in ("kill", "stop"):
                pause.wait(chance.uniform(*options.rest))
                noted.trials.append(_trial(urgent, kind))
                index = 2 * turn + (kind == "stop")
                noted.puts[index] = time.monotonic_ns()
                raw.put(RAW_PUT, str(index), express=True, priority=zenoh.Priority.REAL_TIME)
                if index % 2:
                    _get(raw, noted)
        done.wait()


def _trial(urgent: Urgent, kind: Kind) -> Trial:
    began = time.monotonic_ns()
    try:
        name = urgent.ask(_ASKS[kind], timeout=PATIENCE).id
    except (NoAnswerError, NoVehicleError):
        name = ""
    return Trial(kind, name, began, time.monotonic_ns())


def _get(raw: zenoh.Session, noted: Stations) -> None:
    began = time.monotonic_ns()
    took = None
    for reply in raw.get(RAW_GET, timeout=_RAW_PATIENCE, express=True, priority=zenoh.Priority.REAL_TIME):
        if reply.ok is not None:
            took = time.monotonic_ns() - began
    noted.gets.append(took)


@contextmanager
def _raw(settings: StationSettings, security: Security | None) -> Iterator[zenoh.Session]:
    session = open_session(
        "client",
        settings.connect,
        plain=settings.plain,
        lease=LEASE,
        security=security or {},
        timeout=_CONNECTING,
    )
    yield session
    with suppress(zenoh.ZError):  # through a bad network
        session.close()


@contextmanager
def _asking(settings: StationSettings, security: Security | None) -> Iterator[Urgent]:
    with Urgent(settings, security=security) as urgent:
        end = time.monotonic() + _CONNECTING
        while urgent.connections < CONNECTIONS and time.monotonic() < end:
            time.sleep(0.05)
        yield urgent


if __name__ == "__main__":
    main()
