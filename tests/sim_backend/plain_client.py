"""A short flight by pymavlink alone, as its own examples are written: nothing of this project is imported.

``python plain_client.py udpout:127.0.0.1:14580`` prints what it met as one JSON object.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil

mavlink = mavutil.mavlink


def ack_of(master: Any, command: int) -> int:
    """The result of the last command of that number."""
    end = time.monotonic() + 5.0
    while time.monotonic() < end:
        ack = master.recv_match(type="COMMAND_ACK", blocking=True, timeout=1.0)
        if ack is not None and ack.command == command:
            return int(ack.result)
    raise TimeoutError(f"no answer to command {command}")


def command(master: Any, number: int, *params: float) -> int:
    padded = (*params, *(0.0,) * (7 - len(params)))
    master.mav.command_long_send(master.target_system, master.target_component, number, 0, *padded)
    return ack_of(master, number)


def fetch_parameters(master: Any) -> dict[str, float]:
    found: dict[str, float] = {}
    count = None
    master.param_fetch_all()
    while count is None or len(found) < count:
        message = master.recv_match(type="PARAM_VALUE", blocking=True, timeout=5.0)
        if message is None:
            raise TimeoutError(f"{len(found)} of {count} parameters")
        found[message.param_id], count = message.param_value, message.param_count
    return found


def fly(master: Any, seconds: float, thrust: float) -> None:
    """Level, at 50 Hz."""
    master.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
    for _ in range(round(seconds * 50)):
        master.mav.set_attitude_target_send(
            0, master.target_system, master.target_component, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, thrust
        )
        due = time.monotonic() + 0.02
        while (left := due - time.monotonic()) > 0.0:
            master.recv_match(blocking=True, timeout=left)


def main() -> None:
    met: dict[str, Any] = {}
    master = mavutil.mavlink_connection(sys.argv[1], source_system=255, dialect="common")
    end = time.monotonic() + 60.0
    while master.recv_match(type="HEARTBEAT", blocking=True, timeout=0.5) is None:
        if time.monotonic() > end:
            raise TimeoutError("no heartbeat")
        master.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
    master.target_system, master.target_component = 1, 1
    met["firmware"] = master.messages["HEARTBEAT"].autopilot
    met["parameters"] = len(fetch_parameters(master))
    master.mav.request_data_stream_send(1, 1, mavlink.MAV_DATA_STREAM_ALL, 4, 1)  # what PX4 does not know is ignored
    met["interval"] = command(master, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE, 20000)
    attitude = master.recv_match(type="ATTITUDE", blocking=True, timeout=5.0)
    met["roll"] = attitude.roll
    fly(master, 0.5, 0.1)
    met["offboard"] = command(master, mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, 6)
    fly(master, 0.2, 0.1)
    met["arm"] = command(master, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    fly(master, 1.0, 0.3)
    fly(master, 1.5, 0.45)
    fly(master, 0.5, 0.4)
    met["mode"] = master.flightmode
    met["in_air"] = master.messages["EXTENDED_SYS_STATE"].landed_state == mavlink.MAV_LANDED_STATE_IN_AIR
    met["land"] = command(master, mavlink.MAV_CMD_NAV_LAND)
    master.motors_disarmed_wait()
    met["mode_at_the_end"] = master.flightmode
    print(json.dumps(met))  # noqa: T201


if __name__ == "__main__":
    main()
