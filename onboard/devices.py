"""The devices of a run: the only file that names concrete ones."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from math import isfinite, radians
from pathlib import Path
from time import monotonic_ns
from typing import Any

from msgspec.structs import replace

from drivers.dynamixel import Dynamixel
from drivers.mailbox import Notice
from drivers.protocols import AutopilotDevice, Device, DeviceError, OdometryDevice, ServoDevice
from drivers.px4 import Px4, Px4Settings
from drivers.samples import Interface
from drivers.spread import Summary
from drivers.t265 import T265
from drivers.thrust import ThrustMap
from onboard.agreement import Agreement
from onboard.config import CONFIGS, Config
from onboard.device_config import Kind
from onboard.layers import ConfigError
from sim_backend.faults import Faults
from sim_backend.mock_devices import MockAutopilot, MockOdometry, MockServos
from sim_backend.pipe import Pipe
from sim_backend.software_camera import SoftwareCamera
from sim_backend.world import World
from sim_backend.world_client import LinkedAutopilot, LinkedOdometry, LinkedServos, WorldClient
from sim_backend.world_messages import Camera, Look

#: For the world to answer, s: it has told its address, so it moves.
_WORLD_PATIENCE = 10.0
_TELL_PERIOD = 0.1
_NAMES = ("autopilot", "odometry", "servos")


class DeviceSet:
    """The three devices of one vehicle."""

    def __init__(self, autopilot: AutopilotDevice, odometry: OdometryDevice, servos: ServoDevice) -> None:
        self.autopilot = autopilot
        self.odometry = odometry
        self.servos = servos

    def relay(self) -> None:
        """What one device must hear of another, once a tick: nothing."""

    def obstacles(self) -> tuple[str, ...]:
        """Why the vehicle must not arm: nothing speaks against it."""
        return ()


def world_of(config: Config) -> World:
    """The simulated world of a configuration. Raises ConfigError for one that cannot be had."""
    pipe = config.pipe
    believed = Pipe(pipe.position, radians(pipe.heading_deg), pipe.radius, pipe.length)
    try:
        return World(config.vehicle, config.world, believed, config.seed)
    except ValueError as error:
        raise ConfigError([str(error)]) from error


def mock_devices(world: World) -> DeviceSet:
    """All devices in process, on the world's own time."""
    return DeviceSet(MockAutopilot(world), MockOdometry(world), MockServos(world))


class SimulatedDevices(DeviceSet):
    """Devices in process that may be spoilt by faults, and hear of the mission's phase for that."""

    def __init__(
        self,
        autopilot: AutopilotDevice,
        odometry: OdometryDevice,
        servos: ServoDevice,
        world: World,
        faults: list[Faults],
    ) -> None:
        super().__init__(autopilot, odometry, servos)
        self._world, self._faults = world, faults

    def enter(self, phase: str) -> None:
        """The mission is in this phase. May be told in every tick."""
        for faults in self._faults:
            faults.enter(phase, self._world.time)


def simulated_devices(world: World, config: Config) -> SimulatedDevices:
    """All devices in process, failing as ``config.faults`` says. Raises ConfigError for a fault that none can show."""
    faults, seed, tracker = config.faults, config.seed, config.devices.odometry
    struck = {fault.device for fault in faults}
    if struck:
        from sim_backend.faulty_devices import FaultyAutopilot, FaultyOdometry, FaultyServos
    errors = [f"faults: no device {name!r}; there are: {', '.join(_NAMES)}" for name in sorted(struck - set(_NAMES))]
    if errors:
        raise ConfigError(errors)
    autopilot: AutopilotDevice = MockAutopilot(world)
    odometry: OdometryDevice = MockOdometry(world)
    servos: ServoDevice = MockServos(world)
    spoilt: list[Faults] = []
    try:
        if "autopilot" in struck:
            autopilot = px4 = FaultyAutopilot(world, faults, seed)
            spoilt.append(px4.faults)
        if "odometry" in struck:
            odometry = camera = FaultyOdometry(world, faults, tracker.mount, tracker.jump, tracker.silence, seed)
            spoilt.append(camera.faults)
        if "servos" in struck:
            servos = bus = FaultyServos(world, faults, config.devices.servos, seed)
            spoilt.append(bus.faults)
    except ValueError as error:
        raise ConfigError([f"faults: {error}"]) from error
    return SimulatedDevices(autopilot, odometry, servos, world, spoilt)


def parameter_file(settings: Px4Settings) -> Path:
    """The file with the parameters that PX4 must hold: a name in ``configs/px4``, or a path."""
    name = settings.parameters
    return Path(name) if "/" in name else CONFIGS / "px4" / name


def check_devices(config: Config) -> None:
    """Raises ConfigError with everything about the devices that cannot be flown."""
    devices, errors = config.devices, []
    kinds = devices.kinds()
    if kinds["autopilot"] is not Kind.MOCK and config.interface is Interface.WRENCH:
        errors.append("interface = wrench: no autopilot accepts a wrench; choose attitude or body_rate")
    if kinds["autopilot"] is not Kind.MOCK and not devices.autopilot.url:
        errors.append("devices.autopilot.url: missing; want for example serial:///dev/ttyTHS1:921600")
    if kinds["servos"] is not Kind.MOCK and not devices.servos.port:
        errors.append("devices.servos.port: missing; want for example /dev/servos")
    unreal = [name for name, kind in kinds.items() if kind is not Kind.REAL]
    if unreal and not devices.world:
        errors.append(
            f"devices.world: missing, and {' and '.join(unreal)} need a world; pipewright desk starts one, and "
            "pipewright world tells its address"
        )
    if errors:
        raise ConfigError(errors)


class FlightDevices(DeviceSet):
    """The devices that a configuration asks for, on the machine's monotonic clock.

    ``on_look`` may be set to hear how the simulated world looks, if there is one, in a thread of its own.
    """

    on_look: Callable[[Look], None] | None = None

    def __init__(self, config: Config) -> None:
        """Connects to nothing yet. Raises ConfigError for devices that cannot be flown."""
        check_devices(config)
        devices, kinds = config.devices, config.devices.kinds()
        self._px4: Px4 | None = None
        self._tracker: T265 | None = None
        self._camera: SoftwareCamera | None = None
        self._bus: Dynamixel | None = None
        self.world: WorldClient | None = None
        if any(kind is not Kind.REAL for kind in kinds.values()):
            mocks = tuple(name for name, kind in kinds.items() if kind is Kind.MOCK)
            self.world = WorldClient(devices.world, mocks, self._look, self._see, self._is_streaming)
        super().__init__(self._autopilot_of(config), self._odometry_of(config), self._servos_of(config))
        self._named: dict[str, Device] = {
            "autopilot": self.autopilot, "odometry": self.odometry, "servos": self.servos
        }  # fmt: skip
        self._mixed = _mixed(kinds, devices.hitl)
        self._agreement = Agreement(devices.agreement)
        self._told: list[tuple[str, Notice]] = []

    def _autopilot_of(self, config: Config) -> AutopilotDevice:
        settings = config.devices.autopilot
        if settings.kind is Kind.MOCK:
            assert self.world is not None
            return LinkedAutopilot(self.world)
        parameters = str(parameter_file(settings)) if settings.parameters else ""
        self._px4 = Px4(replace(settings, parameters=parameters), thrust=ThrustMap.of(config.vehicle))
        return self._px4

    def _odometry_of(self, config: Config) -> OdometryDevice:
        settings = config.devices.odometry
        if settings.kind is Kind.MOCK:
            assert self.world is not None
            return LinkedOdometry(self.world)
        settings = replace(settings, start=settings.start or (0.0, 0.0, config.vehicle.base.gear_height))
        find: Callable[[], Any] | None = None
        if settings.kind is Kind.EMULATED:
            self._camera = SoftwareCamera()
            find = self._camera.find
        self._tracker = T265(settings, find)
        return self._tracker

    def _servos_of(self, config: Config) -> ServoDevice:
        settings = config.devices.servos
        if settings.kind is Kind.MOCK:
            assert self.world is not None
            return LinkedServos(self.world)
        self._bus = Dynamixel(settings)
        return self._bus

    # -- life cycle -----------------------------------------------------------------------------------------------

    async def start(self, say: Callable[[str], None]) -> None:
        """Connect to all at once; ``say`` hears what is waited for. Raises DeviceError with every reason."""
        if self.world is not None:
            await asyncio.to_thread(self.world.start, _WORLD_PATIENCE)
        starts = {name: asyncio.create_task(device.start(), name=name) for name, device in self._named.items()}
        pending = set(starts.values())
        try:
            while pending:
                _, pending = await asyncio.wait(pending, timeout=_TELL_PERIOD)
                for _, notice in self.notices():
                    say(notice.text)
        finally:
            for task in pending:
                task.cancel()
        failures = [task.exception() for task in starts.values()]
        if any(failures):
            await self.stop()
            for failure in failures:
                if failure is not None and not isinstance(failure, DeviceError):
                    raise failure
            raise DeviceError("\n".join(str(failure) for failure in failures if failure is not None))

    async def stop(self) -> None:
        """Release all, the world's link last."""
        await asyncio.gather(*(device.stop() for device in self._named.values()))
        if self.world is not None:
            await asyncio.to_thread(self.world.stop)

    # -- in every tick --------------------------------------------------------------------------------------------

    def relay(self) -> None:
        """Hand the newest pose to PX4's own estimator, and see whether that follows it."""
        if self._px4 is not None and self._tracker is not None:
            pose = self._tracker.latest()
            if pose is not None:
                self._px4.odometry(pose, *self._tracker.trust(pose.confidence))
                notice = self._agreement.judge(monotonic_ns(), self._px4.vision_disagreement(pose))
                if notice is not None:
                    self._told.append(("autopilot", notice))

    def obstacles(self) -> tuple[str, ...]:
        """Why the vehicle must not arm."""
        apart = self._agreement.obstacle
        differences = () if self._px4 is None else self._px4.parameter_differences()
        if not differences and not apart:
            return self._mixed
        found = [f"PX4's parameters are not those of the vehicle: {'; '.join(differences)}."] if differences else []
        return (*self._mixed, *found, *([apart] if apart else []))

    def notices(self) -> list[tuple[str, Notice]]:
        """What the drivers have had to tell since the last call, each with the name of its device."""
        told, self._told = self._told, []
        told += [(name, notice) for name, device in self._named.items() for notice in device.notices()]
        return sorted(told, key=lambda item: item[1].t_ns)

    def statistics(self) -> dict[str, float]:
        """Rates, counts and times of drivers and link since the start, by dotted name; SI."""
        values: dict[str, float] = {}
        now = monotonic_ns()
        if self._px4 is not None:
            values |= {f"autopilot.{name}.rate": counts.rate for name, counts in self._px4.counts().items()}
            values |= {"autopilot.setpoints": self._px4.sent(), "autopilot.poses": self._px4.vision_sent()}
        if self._tracker is not None:
            values |= {f"odometry.{name}.rate": counts.rate for name, counts in self._tracker.counts().items()}
        if self._bus is not None:
            bus = self._bus.statistics()
            values |= {f"servos.cycle.{name}": value for name, value in _percentiles(bus.cycle).items()}
            values |= {f"servos.period.{name}": value for name, value in _percentiles(bus.period).items()}
            values |= {"servos.rate": bus.samples.rate, "servos.errors": float(sum(bus.errors.values()))}
            values |= {"servos.late": bus.late}
        if self.world is not None and (look := self.world.latest()) is not None:
            values |= {"world.age": (now - look.t_ns) * 1e-9, "world.slipped": look.slipped}
        return {name: float(value) for name, value in values.items() if isfinite(value)}

    def tell_phase(self, phase: str) -> None:
        """The mission's phase, for faults that are declared for one."""
        if self.world is not None:
            self.world.tell_phase(phase)

    @property
    def lost(self) -> str:
        """What happened to the simulated vehicle; empty while it is whole, and for a real one."""
        look = None if self.world is None else self.world.latest()
        return "" if look is None else look.truth.crashed

    # -- what the world's link calls, in its thread ---------------------------------------------------------------

    def _look(self, look: Look) -> None:
        if (hear := self.on_look) is not None:
            hear(look)

    def _is_streaming(self) -> bool:
        return self._camera is not None and self._camera.streaming

    def _see(self, camera: Camera) -> None:
        device = self._camera
        if device is not None:
            device.gone = camera.gone
            for pose in camera.poses:
                device.tell(pose)


def _percentiles(summary: Summary) -> dict[str, float]:
    return {"p50": summary.p50, "p99": summary.p99, "max": summary.max}


def _mixed(kinds: dict[str, Kind], hitl: bool) -> tuple[str, ...]:
    unreal = [f"{name} is {kind}" for name, kind in kinds.items() if kind is not Kind.REAL]
    if hitl or not unreal or kinds["autopilot"] is not Kind.REAL:
        return ()
    return (f"The autopilot is real, but {' and '.join(unreal)}: only with devices.hitl, propellers off.",)
