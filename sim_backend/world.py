"""One simulated world: the rigid-body plant, the autopilot around it, the servo bus, and its clock."""

from __future__ import annotations

from math import ceil, hypot, isfinite

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from drivers.samples import JointMode, ServoCommand, Vec3
from drivers.vehicle import Vehicle
from sim_backend import layout as at
from sim_backend.autopilot import Autopilot, AutopilotParams
from sim_backend.compiled import compiled
from sim_backend.inner_loops import LoopParams, inner_loops, put_loops
from sim_backend.plant import Truth
from sim_backend.rigid_body import PlantParams, RigidBody, physics, truth_of

Array = NDArray[np.float64]


class WorldParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that can be set about a simulated world, the vehicle and the pipe apart."""

    plant: PlantParams = PlantParams()
    loops: LoopParams = LoopParams()
    autopilot: AutopilotParams = AutopilotParams()


@compiled("(f8[::1], f8[::1], f8[::1], i8)")
def _fly(x: Array, p: Array, u: Array, steps: int) -> None:
    """Advance by ``steps`` physics steps, running the inner loops whenever they are due."""
    period = int(p[at.LOOP_STEPS])
    done = 0
    while done < steps:
        phase = int(x[at.PHASE])
        if phase == 0:
            inner_loops(x, p, u)
        count = min(period - phase, steps - done)
        physics(x, p, u, count)
        done += count
        phase += count
        x[at.PHASE] = 0.0 if phase == period else phase


class World:
    """A vehicle, a pipe, and time. Deterministic: same calls, same bits.

    ``pipe_position`` (m, W) is a point of the pipe's axis, ``pipe_heading`` (rad) the horizontal direction in which
    the vehicle presses (the axis is square to it), ``pipe_radius`` in m. The vehicle starts standing at the origin.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        params: WorldParams | None = None,
        pipe_position: Vec3 = (2.0, 0.0, 1.5),
        pipe_heading: float = 0.0,
        pipe_radius: float = 0.08,
        seed: int = 0,
    ) -> None:
        self.vehicle = vehicle
        self.params = params = params or WorldParams()
        self.plant = RigidBody(vehicle, params.plant, pipe_position, pipe_heading, pipe_radius)
        put_loops(self.plant.p, vehicle, params.loops, params.plant.start_joints, params.plant.step)
        self.autopilot = Autopilot(params.autopilot)
        self._servo_command: ServoCommand | None = None
        self._state: list[float] = self.plant.x.tolist()
        self._last_steps = 1
        self._truth: Truth | None = None

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.plant.time

    @property
    def t_ns(self) -> int:
        """Simulated time, ns."""
        return round(self.plant.time * 1e9)

    @property
    def state(self) -> list[float]:
        """The plant's state after the last advance, in the order of ``layout``."""
        return self._state

    @property
    def last_steps(self) -> int:
        """Length of the last advance in physics steps."""
        return self._last_steps

    def truth(self) -> Truth:
        """What is true after the last advance."""
        if self._truth is None:
            self._truth = truth_of(self._state, self.time, self._last_steps)
        return self._truth

    def command_servos(self, command: ServoCommand) -> None:
        """Set the goals of the five servos, from the next advance on."""
        self._servo_command = command

    def advance(self, duration: float) -> None:
        """Advance by ``duration`` seconds, a whole number of physics steps (else ValueError)."""
        plant = self.plant
        x, u, step = plant.x, plant.u, plant.params.step
        left = total = plant.steps_of(duration)
        x[at.CONTACT_PEAK] = 0.0
        x[at.SPECIFIC_FORCE_SUM : at.SPECIFIC_FORCE_SUM + 3] = 0.0
        command, self._servo_command = self._servo_command, None
        if command is not None:
            self._drive_servos(command, u)
        state = self._state
        longest = ceil(MODE_PERIOD / step)
        while left:
            speed = hypot(state[at.VELOCITY], state[at.VELOCITY + 1], state[at.VELOCITY + 2])
            self.autopilot.update(plant.time, state[at.ON_GROUND] != 0.0, speed, u)
            change = self.autopilot.next_change() - plant.time
            until = ceil(change / step - 1e-6) if isfinite(change) else left
            count = min(left, longest, max(1, until))
            _fly(x, plant.p, u, count)
            plant.count(count)
            left -= count
            state = x.tolist()
        self._last_steps = total
        self._state = state
        self._truth = None

    def _drive_servos(self, command: ServoCommand, u: Array) -> None:
        u[at.U_TORQUE_ON] = command.mode is not JointMode.OFF
        u[at.U_POSITION_MODE] = command.mode is JointMode.POSITION
        u[at.U_TORQUE : at.U_TORQUE + 3] = command.torque
        u[at.U_GOAL : at.U_GOAL + 5] = command.position
        u[at.U_CURRENT_LIMIT] = command.current_limit

    @property
    def servo_torque_on(self) -> bool:
        """Torque is enabled on the servo bus."""
        return bool(self.plant.u[at.U_TORQUE_ON] != 0.0)


#: The autopilot's modes are looked at no less often than this, s.
MODE_PERIOD = 0.02
