"""Our world as the simulator of a real PX4: sensors to it, motors from it (MAVLink HIL_SENSOR, HIL_ACTUATOR_CONTROLS).

In software (SITL) PX4 comes as a TCP client and lives on the world's time: each HIL_SENSOR is answered by one
HIL_ACTUATOR_CONTROLS, and the world does not move on before it. On its board (HITL) it keeps its own time on a serial
port: the newest motor controls count. (docs/px4.md)
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import msgspec
import yaml
from msgspec import Struct
from pymavlink.dialects.v20 import common as mavlink

from drivers.mailbox import Level, Notice, Notices
from drivers.protocols import DeviceError
from drivers.thrust import thrust_fraction
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import PlantParams
from sim_backend.autopilot import STOPPED, Rotors
from sim_backend.knob import knob, switch
from sim_backend.motors import rated_voltage
from sim_backend.pace import Crier, Pace
from sim_backend.px4_sensors import Px4SensorParams, Px4Sensors
from sim_backend.px4_wire import LostError, wire_of
from sim_backend.sensors import REALISTIC, SensorParams, hover_thrust
from sim_backend.world import World, WorldParams

_SIMULATOR = (1, 200)  # MAVLink system and component
_LOCKSTEP = 1  # HIL_ACTUATOR_CONTROLS.flags
_HEARTBEAT_PERIOD = 1.0
_NONSENSE = 256  # so many bytes that are no MAVLink are told


class LinkParams(Struct, frozen=True, forbid_unknown_fields=True):
    """How patient the simulator is with PX4, and what it simulates for it."""

    patience: Annotated[float, knob("s", "the world waits so long for an answer, in lockstep", 0.01, 60.0)] = 1.0
    silence: Annotated[float, knob("s", "without motor controls for so long the motors stop", 0.05, 10.0)] = 0.5
    start_patience: Annotated[float, knob("s", "a PX4 that has not come by then is told", 1.0, 600.0)] = 15.0
    gps: Annotated[bool, switch("there is a GPS receiver")] = False
    sensors: Px4SensorParams = Px4SensorParams()


class Px4SimulatorLink:
    """A face (``pace.Face``) of a world that a real PX4 flies; ``url`` as for ``px4_wire.wire_of``.

    From the start on the world's own autopilot is not in charge. PX4 may go and come back. Raises DeviceError when the
    port cannot be had.
    """

    period = 0.004

    def __init__(self, world: World, url: str, params: LinkParams | None = None, seed: int = 0) -> None:
        self.world = world
        self.params = params = params or LinkParams()
        #: Messages received and sent so far, by name.
        self.received: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        #: Answers that the world waited for in vain.
        self.unanswered = 0
        self._told = Notices()
        self._sensors = Px4Sensors(world.params.sensors, hover_thrust(world.vehicle), params.sensors, params.gps, seed)
        self._mav = mavlink.MAVLink(None, srcSystem=_SIMULATOR[0], srcComponent=_SIMULATOR[1])
        self._full = world.vehicle.rotors.max_thrust
        self._curve = world.vehicle.rotors.curve
        self._rated = rated_voltage(world.vehicle.battery)
        self._wire = wire_of(url)
        world.autopilot.hand_over(STOPPED)
        self._forget()
        self._awaited = time.monotonic()
        self._complained = False

    def _forget(self) -> None:
        """Nothing is known of the PX4 at the other end."""
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._in_step = False
        self._sent_us = 0
        self._answered_us = 0
        self._heard: float | None = None
        self._stopped = False
        self._nonsense = 0
        self._beat_due = 0.0

    @property
    def where(self) -> str:
        """For people: where PX4 is looked for, with the port that was given out."""
        return self._wire.where

    @property
    def connected(self) -> bool:
        """Somebody is at the other end."""
        return self._wire.connected

    @property
    def in_step(self) -> bool:
        """PX4 answers, and the world waits for its answers."""
        return self._in_step

    def notices(self) -> tuple[Notice, ...]:
        """Sentences for a person since the last call, oldest first."""
        return self._told.take()

    def expect(self, seconds: float) -> None:
        """Wait for PX4, once, before the world moves. Raises DeviceError when it does not come."""
        end = time.monotonic() + seconds
        while not self._meet():
            if time.monotonic() > end:
                raise DeviceError(f"PX4's simulator: {self._absence()}")
            time.sleep(0.01)

    def close(self) -> None:
        """Give the port back. Safe to call twice."""
        self._wire.close()

    # -- the face -------------------------------------------------------------------------------------------------

    def receive(self) -> None:
        """Take what PX4 has answered; in lockstep, wait for the answer to the last sensors."""
        if self._meet():
            try:
                self._take()
                self._wait()
            except LostError as lost:
                self._on_lost(lost)
        self._judge()

    def publish(self) -> None:
        """Send what the sensors measure now."""
        if not self._wire.connected:
            return
        now = self.world.snapshot
        messages = self._sensors.measure(now)
        if self.world.time >= self._beat_due:
            self._beat_due = self.world.time + _HEARTBEAT_PERIOD
            messages.append(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GENERIC, 8, 0, 0, 4, 3))
        self._sent_us = now.t_ns // 1000
        try:
            for message in messages:
                self._wire.write(message.pack(self._mav))
                self.sent[message.get_type()] += 1
        except LostError as lost:
            self._on_lost(lost)

    # -- what comes in --------------------------------------------------------------------------------------------

    def _meet(self) -> bool:
        if self._wire.connected:
            return True
        if not self._wire.open():
            return False
        self._forget()
        self._awaited, self._complained = time.monotonic(), False
        self._tell(Level.INFO, f"PX4 has come on {self.where}")
        return True

    def _take(self) -> None:
        data = self._wire.read()
        controls = None
        for message in self._parser.parse_buffer(data) or () if data else ():
            name = message.get_type()
            if name == "BAD_DATA":
                self._on_nonsense(message.data)
                continue
            self.received[name] += 1
            if name == "HIL_ACTUATOR_CONTROLS":
                controls = message
        if controls is not None:
            self._on_controls(controls)

    def _wait(self) -> None:
        if not self._in_step or self._answered_us >= self._sent_us:
            return
        end = time.monotonic() + self.params.patience
        while self._answered_us < self._sent_us:
            left = end - time.monotonic()
            if left <= 0.0:
                self._in_step = False
                self.unanswered += 1
                self._tell(Level.WARNING, f"PX4 has not answered for {self.params.patience:g} s; going on without it")
                return
            self._wire.wait(left)
            self._take()

    def _on_controls(self, m: Any) -> None:
        armed = bool(m.mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        share = self.world.snapshot.x[at.VOLTAGE] / self._rated
        full = self._full * share * share
        a, b, c, d = (full * thrust_fraction(_control(u), self._curve) if armed else 0.0 for u in m.controls[:4])
        self.world.autopilot.hand_over(Rotors(armed, (a, b, c, d)))
        if self._stopped:
            self._tell(Level.WARNING, "PX4 tells its motors again")
        elif self._heard is None:
            self._tell(Level.INFO, "PX4 flies in this world")
        self._heard, self._stopped = self.world.time, False
        self._answered_us = m.time_usec
        # Only an answer to what was sent last; one to older sensors, read late, is not yet in step.
        if self._wire.lockstep and m.flags & _LOCKSTEP and m.time_usec == self._sent_us:
            self._in_step = True

    def _on_nonsense(self, data: bytes) -> None:
        told = self._nonsense >= _NONSENSE
        self._nonsense += len(data)
        if self._nonsense >= _NONSENSE and not told:
            self._tell(
                Level.ERROR,
                f"{self._nonsense} bytes on {self.where} are no MAVLink (the last: {bytes(data[:8]).hex(' ')}); "
                "is it PX4's simulator link, and is the baud rate right?",
            )

    def _on_lost(self, lost: LostError) -> None:
        self._forget()
        self._awaited, self._complained = time.monotonic(), False
        self.world.autopilot.hand_over(STOPPED)
        self._tell(Level.ERROR, f"PX4 on {self.where} is gone ({lost}); motors stopped, waiting for it to come back")

    def _judge(self) -> None:
        """Stop the motors of a PX4 that has fallen silent; tell of one that never came."""
        if self._heard is None:
            if not self._complained and time.monotonic() - self._awaited > self.params.start_patience:
                self._complained = True
                self._tell(Level.WARNING, self._absence())
        elif not self._stopped and self.world.time - self._heard > self.params.silence:
            self._stopped = True
            self.world.autopilot.hand_over(STOPPED)
            self._tell(Level.ERROR, f"no motor controls from PX4 for {self.params.silence:g} s: motors stopped")

    def _absence(self) -> str:
        if not self._wire.connected:
            return f"no PX4 has come to {self.where}; start it so that it looks for a simulator there (docs/px4.md)"
        if self._wire.lockstep:
            return f"PX4 on {self.where} tells no motor controls; has it an airframe with motors, and has it started?"
        return f"PX4 on {self.where} tells no motor controls; want SYS_HITL = 1, and a restart after setting it"

    def _tell(self, level: Level, text: str) -> None:
        self._told.tell(time.monotonic_ns(), level, f"simulator: {text}")


def _control(value: float) -> float:
    """A motor's control within 0 to 1; one that is not finite is PX4's word for a motor that stands."""
    return min(max(value, 0.0), 1.0) if isfinite(value) else 0.0


# -- alone, from the command line -----------------------------------------------------------------------------------

_VEHICLE = Path(__file__).resolve().parent.parent / "configs" / "vehicle.yaml"


def main(arguments: Sequence[str] | None = None) -> int:
    """A vehicle on the ground beside a pipe, simulated for a real PX4 until interrupted."""
    parser = argparse.ArgumentParser(prog="python -m sim_backend.px4_simulator_link", description=main.__doc__)
    parser.add_argument("--url", default="tcp://127.0.0.1:4560", help="or serial:///dev/ttyACM0:921600")
    parser.add_argument("--vehicle", type=Path, default=_VEHICLE, help="vehicle file")
    parser.add_argument("--seed", type=int, default=0, help="of the sensors' noise")
    parser.add_argument("--exact", action="store_true", help="sensors without noise")
    parser.add_argument("--gps", action="store_true", help="simulate a GPS receiver too")
    parser.add_argument("--wait", type=float, default=60.0, metavar="S", help="for PX4 to come, at first")
    given = parser.parse_args(arguments)
    try:
        vehicle = msgspec.convert(yaml.safe_load(given.vehicle.read_text(encoding="utf-8")), Vehicle)
    except (OSError, yaml.YAMLError, msgspec.ValidationError) as error:
        sys.stderr.write(f"{given.vehicle}: not a vehicle file ({error})\n")
        return 2
    world = World(
        vehicle,
        WorldParams(plant=PlantParams(ideal_motors=False), sensors=SensorParams() if given.exact else REALISTIC),
        seed=given.seed,
    )
    try:
        link = Px4SimulatorLink(world, given.url, LinkParams(gps=given.gps), given.seed)
    except DeviceError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    try:
        sys.stdout.write(f"{link.where}\n")
        sys.stdout.flush()
        link.expect(given.wait)
        Pace(world, (link, Crier(link.notices, lambda text: sys.stderr.write(f"{text}\n")))).run()
    except DeviceError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except KeyboardInterrupt:
        pass
    finally:
        link.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
