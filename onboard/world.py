"""The simulated world as a process of its own, with an emulator for each device that is not real.

It moves on the wall clock until its standard input closes or it is told to end. Its first line on standard output is
a JSON object: what to set in the configuration of the process that flies in it. After that, each line on standard
input is a fault in YAML that begins now: ``{device: odometry, kind: nan, duration: 2}``.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
from msgspec.structs import replace

from drivers.px4_parameters import read_parameter_file
from onboard import attended
from onboard.config import Config
from onboard.device_config import Kind
from onboard.devices import parameter_file, world_of
from onboard.layers import ConfigError
from sim_backend.array_plant import PlantKind
from sim_backend.dynamixel_emulator import emulate
from sim_backend.faults import Fault, Faults, read_faults
from sim_backend.pace import Crier, Face, Pace
from sim_backend.px4_emulator import Px4StandIn
from sim_backend.px4_simulator_link import Px4SimulatorLink
from sim_backend.px4_sitl import VARIABLE, Px4Sitl, battery_parameters
from sim_backend.tracker import Tracker
from sim_backend.world_link import WorldServer

#: After which the thread of one emulator hands the interpreter to another's, s: each answers within milliseconds.
SWITCH_INTERVAL = 0.0005
#: The same beside PyBullet, which does not let go of the interpreter while it computes.
BUSY_SWITCH_INTERVAL = 0.0002
#: A flight process that is left alone lands first; the world stays for it, but not longer, s.
LAST_FLIGHT = 150.0
_GLANCE = 0.05


class WorldProcess:
    """A world, its faces, and the emulators beside it. Close it to give ports and terminals back.

    Where a real PX4 in software is the autopilot and PIPEWRIGHT_PX4 names its build folder, PX4 is started too.
    ``say`` hears what a person should know. ``servo_link`` is a symbolic link to make to the servo bus's terminal.
    Raises ConfigError for faults that no emulator can show, DeviceError for a port that cannot be had.
    """

    def __init__(self, config: Config, say: Callable[[str], None], servo_link: Path | None = None) -> None:
        kinds, devices = config.devices.kinds(), config.devices
        self._cleanup = ExitStack()
        self._faults: dict[str, Faults] = {}
        #: What to set in the flying process, by dotted path.
        self.endpoints: dict[str, str] = {}
        self.world = world = world_of(config)
        faces: list[Face] = []
        received: Callable[[], Mapping[str, int]] = dict
        tracker: Tracker | None = None
        try:
            if kinds["autopilot"] is Kind.EMULATED:
                stand_in = Px4StandIn(world, faults=config.faults)
                self._cleanup.callback(stand_in.stop)
                faces.append(stand_in)
                received = lambda: stand_in.received  # noqa: E731
                self._faults["autopilot"] = stand_in.faults
                self.endpoints["devices.autopilot.url"] = f"udpout://127.0.0.1:{stand_in.port}"
            if devices.simulator:
                link = Px4SimulatorLink(world, devices.simulator, seed=config.seed)
                self._cleanup.callback(link.close)
                faces += [link, Crier(link.notices, say)]
                if VARIABLE in os.environ and devices.simulator.startswith("tcp:"):
                    parameters = read_parameter_file(parameter_file(devices.autopilot))
                    parameters |= battery_parameters(config.vehicle.battery)
                    px4 = Px4Sitl(Path(os.environ[VARIABLE]), parameters)
                    self._cleanup.callback(px4.stop)
                    px4.start()
                received = lambda: link.received  # noqa: E731
            if kinds["servos"] is Kind.EMULATED:
                bus = devices.servos
                if servo_link is None:  # the name of a terminal may be another's when an adapter comes back
                    servo_link = Path(self._cleanup.enter_context(TemporaryDirectory(prefix="pipewright-"))) / "servos"
                emulator = emulate(bus.servos, world=world, link=servo_link, baud=bus.baud, faults=config.faults)
                emulator.start()
                self._cleanup.callback(emulator.stop)
                self._faults["servos"] = emulator.faults
                self.endpoints["devices.servos.port"] = emulator.path
            if kinds["odometry"] is Kind.EMULATED:
                tracker = Tracker(world, devices.odometry.mount, config.faults, config.seed)
                self._faults["odometry"] = tracker.faults
            self._server = WorldServer(
                world,
                lambda t_ns: self.pace.clock(t_ns),
                tracker,
                received,
                lambda: self.pace.slipped,
                [faults.enter for faults in self._faults.values()],
            )
            self._cleanup.callback(self._server.close)
            self.endpoints["devices.world"] = self._server.address
            self.pace = Pace(world, (*faces, self._server, self._server.camera))
            for fault in config.faults:
                if fault.device not in self._faults:
                    raise ConfigError([f"faults: no {fault.device} is emulated; emulated: {', '.join(self._faults)}"])
        except BaseException as error:
            self.close()
            if isinstance(error, ValueError):
                raise ConfigError([str(error)]) from error
            raise

    @property
    def flown_in(self) -> bool:
        """Somebody flies in it."""
        return self._server.flown_in

    def inject(self, fault: Fault) -> None:
        """One that begins now, or ``start`` seconds from now. Raises ValueError where no emulator can show it."""
        faults = self._faults.get(fault.device)
        if faults is None:
            raise ValueError(f"no {fault.device} is emulated; emulated: {', '.join(self._faults) or 'nothing'}")
        start = fault.start if fault.phase else self.world.time + fault.start
        faults.add(replace(fault, start=start))

    def close(self) -> None:
        """Stop the emulators and close all sockets. Safe to call twice."""
        self._cleanup.close()


def serve(config: Config, servo_link: Path | None = None) -> None:
    """Hold the world until standard input has closed and nobody flies in it any more, or SIGINT or SIGTERM comes."""

    def say(text: str) -> None:
        sys.stderr.write(f"{text}\n")

    process = WorldProcess(config, say, servo_link)
    pace = process.pace
    busy = config.world.plant.kind is not PlantKind.RIGID
    sys.setswitchinterval(BUSY_SWITCH_INTERVAL if busy else SWITCH_INTERVAL)

    def stop(*_: Any) -> None:
        pace.stop()

    def leave() -> None:
        until = time.monotonic() + LAST_FLIGHT
        while process.flown_in and time.monotonic() < until:
            time.sleep(_GLANCE)
        stop()

    def order(line: str) -> None:
        try:
            for fault in read_faults(line, "standard input"):
                process.inject(fault)
        except ValueError as error:
            say(str(error))

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        sys.stdout.write(msgspec.json.encode(process.endpoints).decode() + "\n")
        sys.stdout.flush()
        attended.watch(order, leave)
        pace.run()
    finally:
        process.close()
    if pace.slipped:
        say(f"the simulated world fell behind the wall clock by {pace.slipped:.2f} s")
