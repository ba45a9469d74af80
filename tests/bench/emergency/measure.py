"""How long a stop and a kill take from a station's call to the wire, under four conditions, beside raw Zenoh.

Station and vehicle are processes of their own, as are autopilot and servos; all share one clock. A kill is over when
the kernel has its MAVLink command in the queue of the autopilot's socket, and when the emulated bus has the packet that
switches the torque off; a stop, when the first set-point has come that was made after it, or, for a loop that is stuck,
the command to land.
"""

from __future__ import annotations

import os
import subprocess
import sys
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from math import ceil, inf
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Final, TypeVar

import msgspec
from msgspec import Struct

from groundstation.authority import Authority
from groundstation.desk import prefer
from onboard.roster import Role
from tests.bench.emergency.messages import StationOptions, Stations, Vehicle, VehicleOptions
from tests.bench.emergency.vehicle import NAME, PRIORITY
from tests.lossy_network import ADDRESSES, LossyNetwork, UnavailableError
from tests.zenoh_sessions import free_port

LOSS, DELAY = 0.2, 0.2
#: What the 99th percentile shall be, ms: of a kill, and of a stop.
_SOON: Final = (50.0, 100.0)
_THROUGH_LOSS: Final = (1000.0, 1000.0)
#: Through the lossy network so many stations ask at once, so that it does not take an hour; each rests as long, s.
_STATIONS, _REST = 8, (1.0, 2.0)
_PORT = 7447
_LONGEST = 3600.0

T = TypeVar("T")


class Spread(Struct, frozen=True):
    """A set of times, ms. What never came is later than all else: a percentile may be infinite."""

    median: float
    p99: float
    worst: float
    """Of those that came."""
    count: int
    missing: int
    """Of these, nothing came, or no answer."""


class Condition(Struct, frozen=True):
    """What was measured under one condition. Times from the station's call on."""

    name: str
    kill_target: float
    stop_target: float
    """For the 99th percentile, ms."""
    kill: Spread
    """To the autopilot's socket."""
    limp: Spread
    """Of the kill too, to the servo bus."""
    stop: Spread
    """To the autopilot's socket."""
    answer: Spread
    """To the vehicle's answer, at the station."""
    put: Spread
    """A raw message over a connection of its own, to the vehicle."""
    get: Spread
    """A raw query there and back."""


class Emergency(Struct, frozen=True):
    """Under all conditions."""

    conditions: tuple[Condition, ...]
    skipped: str = ""
    """Why there was no lossy network."""


def measure(trials: int = 1000) -> Emergency:
    """``trials`` of stop and of kill under each condition. Raises RuntimeError when a process fails."""
    conditions = [_loopback("loopback, idle", trials), _loopback("loopback, the loop stuck", trials, stuck=True)]
    with _load():
        conditions.append(_loopback(f"loopback, {os.cpu_count()} busy processes", trials))
    try:
        conditions.append(_lossy(f"{LOSS:.0%} of the packets lost, {DELAY * 1e3:.0f} ms each way", trials))
    except UnavailableError as error:
        return Emergency(tuple(conditions), str(error))
    return Emergency(tuple(conditions))


@contextmanager
def _load() -> Iterator[None]:
    """Every processor has something else to do."""
    with ExitStack() as stack:
        for _ in range(os.cpu_count() or 1):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(busy.kill)
        yield


def _command(side: str, options: Struct) -> list[str]:
    return [sys.executable, "-m", f"tests.bench.emergency.{side}", msgspec.json.encode(options).decode()]


def _loopback(name: str, trials: int, *, stuck: bool = False) -> Condition:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with subprocess.Popen(
        _command("vehicle", VehicleOptions(endpoint, stuck=stuck)),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as vehicle:
        prefer(vehicle.pid, PRIORITY)
        _ready(vehicle)
        stations = subprocess.run(
            _command("stations", StationOptions(endpoint, trials)),
            stdout=subprocess.PIPE,
            text=True,
            check=False,
            timeout=_LONGEST,
        )
        return _judge(name, _SOON, _told(vehicle, Vehicle), _read(stations.stdout, Stations), stuck=stuck)


def _lossy(name: str, trials: int) -> Condition:
    """With TLS, since nothing else is allowed off loopback. Raises UnavailableError."""
    with TemporaryDirectory() as folder, LossyNetwork(LOSS, DELAY, linear=True) as network:
        keys = Path(folder) / "keys"
        authority = Authority.init(keys)
        authority.add(NAME, Role.VEHICLE, hosts=[ADDRESSES[0]])
        for number in range(_STATIONS):
            authority.add(f"s{number}", Role.OPERATOR)
        asked = StationOptions(f"tls/{ADDRESSES[0]}:{_PORT}", trials, _STATIONS, _REST, str(keys))
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        listening = VehicleOptions(f"tls/{ADDRESSES[0]}:{_PORT}", str(keys / NAME))
        with network.start(_command("vehicle", listening), **pipes) as vehicle:
            _ready(vehicle)
            with network.start(_command("stations", asked), **pipes) as stations:
                noted = _told(stations, Stations)
            return _judge(name, _THROUGH_LOSS, _told(vehicle, Vehicle), noted)


def _ready(vehicle: subprocess.Popen[str]) -> None:
    assert vehicle.stdout is not None
    if vehicle.stdout.readline() != "ready\n":
        raise RuntimeError("the vehicle's side of the bench did not start")


def _told(process: subprocess.Popen[str], kind: type[T]) -> T:
    told, _ = process.communicate(timeout=_LONGEST)
    return _read(told, kind)


def _read(told: str, kind: type[T]) -> T:
    if not told:
        raise RuntimeError("a side of the bench has failed")
    return msgspec.json.decode(told, type=kind)


def _judge(
    name: str, targets: tuple[float, float], vehicle: Vehicle, stations: Stations, *, stuck: bool = False
) -> Condition:
    """Put together what both sides have noted."""
    heard = {order.id: order.t_ns for order in vehicle.orders}
    frames = vehicle.frames
    kills = [trial for trial in stations.trials if trial.kind == "kill"]
    stops = [trial for trial in stations.trials if trial.kind == "stop"]

    def first(arrivals: Sequence[int], order: str) -> int | None:
        """The first arrival after the vehicle has heard an order: no earlier one can be of it."""
        at = bisect_left(arrivals, heard[order]) if order in heard else len(arrivals)
        return arrivals[at] if at < len(arrivals) else None

    marks = sorted(frames.marks)

    def stopped(order: str) -> int | None:
        """Of two stops that were taken together, the set-points bear the later mark."""
        if stuck:
            return first(frames.lands, order)
        at = bisect_left(marks, vehicle.marks.get(order, len(heard) + 1))
        return frames.marks[marks[at]] if at < len(marks) else None

    return Condition(
        name,
        *targets,
        kill=_spread([(trial.asked_ns, first(frames.kills, trial.id)) for trial in kills]),
        limp=_spread([(trial.asked_ns, first(frames.limp, trial.id)) for trial in kills]),
        stop=_spread([(trial.asked_ns, stopped(trial.id)) for trial in stops]),
        answer=_spread([(trial.asked_ns, trial.answered_ns if trial.id else None) for trial in stations.trials]),
        put=_spread([(at, vehicle.puts.get(index)) for index, at in stations.puts.items()]),
        get=_spread([(0, took) for took in stations.gets]),
    )


def _spread(times: Sequence[tuple[int, int | None]]) -> Spread:
    took = sorted(inf if there is None else (there - began) * 1e-6 for began, there in times)
    came = [time for time in took if time < inf]
    if not came:
        raise RuntimeError("nothing came of what was asked")
    ninety_ninth = took[ceil(0.99 * len(took)) - 1]
    return Spread(median(took), ninety_ninth, came[-1], len(took), len(took) - len(came))
