"""Records what a real PX4 says in a short flight, for tests/drivers/test_px4_recorded.py.

``PIPEWRIGHT_PX4=<build folder> python -m tests.record_px4`` from the root: takes off, hovers, and the flight process is
killed, so that PX4 lands by itself. Rates are thinned; the bytes are PX4's.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.process.flying import PATIENCE, Flying
from tests.px4_traffic import Packet, Tap, write_tlog
from tests.realtime import alone

RECORD = Path(__file__).parent / "drivers" / "data" / "px4_flight.tlog"
_REQUEST = 512  # MAV_CMD_REQUEST_MESSAGE, by which the driver asks for heartbeats
_HEARTBEAT_ACK = "COMMAND_ACK of REQUEST_MESSAGE"
#: So many a second are kept; of others one. 0: all.
_KEPT = {
    "ATTITUDE_QUATERNION": 20.0,
    "HIGHRES_IMU": 10.0,
    "LOCAL_POSITION_NED": 5.0,
    "EXTENDED_SYS_STATE": 5.0,
    "HEARTBEAT": 10.0,
    "COMMAND_ACK": 0.0,
    "PARAM_VALUE": 0.0,
    "STATUSTEXT": 0.0,
}
_AFTER = 3.0  # s recorded after the motors have stopped


def main() -> int:
    """Fly and record."""
    servos = "devices.servos.kind=mock"
    with TemporaryDirectory() as folder, alone(), Tap() as tap:
        url = f"devices.autopilot.url={tap.url}"
        with Flying(Path(folder), servos, url, config="sitl") as flight:
            flight.hover()
            flight.rest(2.0)
            flight.signal(signal.SIGKILL)
            flight.ended_safely(PATIENCE)
            flight.rest(_AFTER)
    RECORD.parent.mkdir(exist_ok=True)
    write_tlog(RECORD, thinned(tap.packets))
    sys.stdout.write(f"{RECORD}: {RECORD.stat().st_size} bytes\n")
    return 0


def thinned(packets: Iterable[Packet]) -> Iterator[Packet]:
    """Fewer of what comes often; every heartbeat that tells a new state."""
    due: dict[str, int] = {}
    state: tuple[str, bool] | None = None
    for packet in packets:
        name = _HEARTBEAT_ACK if getattr(packet.message, "command", 0) == _REQUEST else packet.name
        rate = _KEPT.get(name, 1.0)
        news = packet.name == "HEARTBEAT" and (packet.mode, packet.armed) != state
        if packet.t_ns < due.get(name, 0) and rate and not news:
            continue
        if packet.name == "HEARTBEAT":
            state = (packet.mode, packet.armed)
        if rate:
            due[name] = packet.t_ns + round(1e9 / rate)
        yield packet


if __name__ == "__main__":
    raise SystemExit(main())
