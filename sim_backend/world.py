"""One simulated world: a plant, the autopilot around it, the servo bus, the sensors, and its clock."""

from __future__ import annotations

from math import ceil, isfinite

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from drivers.samples import JointMode, ServoCommand
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.array_plant import ArrayPlant, PlantKind, PlantParams, truth_of
from sim_backend.autopilot import Autopilot, AutopilotParams
from sim_backend.deviations import AS_MODELLED, DeviationParams, Deviations, deviations
from sim_backend.inner_loops import LoopParams, put_loops
from sim_backend.pipe import Pipe
from sim_backend.plant import Truth
from sim_backend.rigid_body import RigidBody
from sim_backend.sensors import SensorParams, Sensors, Snapshot
from sim_backend.wind import Wind, WindParams

Array = NDArray[np.float64]

Limp = tuple[bool, bool, bool, bool, bool]
NONE_LIMP: Limp = (False, False, False, False, False)

#: The autopilot's modes are looked at no less often than this, s.
MODE_PERIOD = 0.02


class WorldParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that can be set about a simulated world, the vehicle and the pipe apart."""

    plant: PlantParams = PlantParams()
    loops: LoopParams = LoopParams()
    autopilot: AutopilotParams = AutopilotParams()
    sensors: SensorParams = SensorParams()
    wind: WindParams = WindParams()
    deviations: DeviationParams = DeviationParams()


def plant_of(
    vehicle: Vehicle,
    params: PlantParams,
    pipe: Pipe,
    truth: Deviations = AS_MODELLED,
) -> ArrayPlant:
    """The plant of the kind that ``params`` asks for; ValueError when this machine cannot have it."""
    if params.kind is PlantKind.RIGID:
        return RigidBody(vehicle, params, pipe, truth)
    # Imported here since not every machine that flies has PyBullet.
    from sim_backend.pybullet_plant import PyBulletPlant

    return PyBulletPlant(vehicle, params, pipe, truth)


class World:
    """A vehicle, a pipe, and time. Deterministic: same seed and calls, same bits.

    The vehicle starts at rest on the ground at the origin, disarmed, the sleeve in the gripper, the arm folded and held
    by its servos until they are commanded. ``vehicle`` and ``pipe`` are what is believed of them.

    One thread advances the world; others may read ``snapshot`` and ``truth`` and command the servos meanwhile.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        params: WorldParams | None = None,
        pipe: Pipe | None = None,
        seed: int = 0,
    ) -> None:
        self.vehicle = vehicle
        self.params = params = params or WorldParams()
        #: How the true vehicle and pipe differ from ``vehicle`` and the pipe that was asked for.
        self.deviations = truth = deviations(params.deviations, seed)
        self.plant = plant_of(vehicle, params.plant, pipe or Pipe(), truth)
        put_loops(self.plant.p, vehicle, params.loops, self.plant.step)
        self.autopilot = Autopilot(params.autopilot, seed)
        self.wind = Wind(params.wind, seed)
        self.sensors = Sensors(params.sensors, vehicle, seed)
        self._servo_command: tuple[ServoCommand, Limp] | None = None
        self.snapshot = self._look(self.plant.x.tolist(), self.plant.last_steps)
        self.sensors.observe(self.snapshot)
        self._truth = (self.snapshot, self.plant.truth())

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.plant.time

    def truth(self) -> Truth:
        """What is true after the last advance."""
        now = self.snapshot
        seen, truth = self._truth
        if seen is not now:
            truth = truth_of(now.x, now.t_ns * 1e-9, now.steps)
            self._truth = (now, truth)
        return truth

    def command_servos(self, command: ServoCommand, limp: Limp = NONE_LIMP) -> None:
        """Set the goals of the five servos, from the next advance on; one that is not finite is ignored.

        ``limp`` are servos that give no torque though the others do.
        """
        if isfinite(sum(command.torque) + sum(command.position) + command.current_limit):
            self._servo_command = (command, limp)

    def advance(self, duration: float) -> None:
        """Advance by ``duration`` seconds, a whole number of physics steps (else ValueError)."""
        plant = self.plant
        x, u, step = plant.x, plant.u, plant.step
        left = total = plant.steps_of(duration)
        longest = ceil(MODE_PERIOD / step)
        plant.begin()
        commanded, self._servo_command = self._servo_command, None
        if commanded is not None:
            command, limp = commanded
            u[at.U_LIMP : at.U_LIMP + 5] = limp
            u[at.U_TORQUE_ON] = command.mode is not JointMode.OFF
            u[at.U_POSITION_MODE] = command.mode is JointMode.POSITION
            u[at.U_TORQUE : at.U_TORQUE + 3] = command.torque
            u[at.U_GOAL : at.U_GOAL + 5] = command.position
            u[at.U_CURRENT_LIMIT] = command.current_limit
        state = self.snapshot.x
        while left:
            t = plant.time
            self.autopilot.update(t, state, u)
            if self.wind.blows:
                u[at.U_WIND : at.U_WIND + 3] = self.wind.until(round(t * 1e9))
            until = (self.autopilot.next_change() - t) / step
            count = min(left, longest)
            if until < count:
                count = max(1, ceil(until - 1e-6))
            plant.fly(count)
            plant.count(count)
            left -= count
            state = x.tolist()
        self.snapshot = self._look(state, total)
        self.sensors.observe(self.snapshot)

    def _look(self, x: list[float], steps: int) -> Snapshot:
        autopilot = self.autopilot
        return Snapshot(
            round(self.plant.time * 1e9),
            x,
            steps,
            autopilot.armed,
            autopilot.mode,
            autopilot.landed,
            bool(self.plant.u[at.U_TORQUE_ON] != 0.0),
        )
