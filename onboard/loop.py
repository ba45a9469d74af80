"""The loop: samples in, one step of the core, commands out, one tick to the recorder. Names no device."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

from drivers.protocols import AutopilotDevice, OdometryDevice, ServoDevice
from onboard.clock import Clock
from onboard.core.derived import derive
from onboard.core.params import Params
from onboard.core.step import State, initial_state, step
from onboard.core.types import Inputs, Outputs, Request, Tick
from onboard.records import Timing

KEYFRAME_PERIOD_NS = 1_000_000_000


class Devices(Protocol):
    """The three devices of the vehicle."""

    autopilot: AutopilotDevice
    odometry: OdometryDevice
    servos: ServoDevice


class Sink(Protocol):
    """Where ticks go."""

    def tick(self, tick: Tick) -> None:
        """Take one cycle."""

    def keyframe(self, index: int, t_ns: int, state: State) -> None:
        """Take the core's state just before the tick of this index."""

    def timing(self, timing: Timing) -> None:
        """Take the punctuality of one tick."""


class Loop:
    """Runs the core at ``rate_hz`` on a clock.

    timed: report each tick's lateness to the sink (wall-clock runs).
    """

    def __init__(
        self, devices: Devices, clock: Clock, params: Params, sink: Sink, *, rate_hz: float = 250.0, timed: bool = False
    ) -> None:
        derive(params)  # model, places and compiled code are ready before the first tick
        self._devices, self._clock, self._params, self._sink = devices, clock, params, sink
        self._period_ns = round(1e9 / rate_hz)
        self._timed = timed
        self._requests: deque[Request] = deque()
        self._state = initial_state(params)
        self.revision = 0
        self.outputs: Outputs | None = None

    def request(self, request: Request) -> None:
        """Ask something of the mission; taken one a tick, in order."""
        self._requests.append(request)

    async def run(self, on_tick: Callable[[Outputs], bool]) -> None:
        """Tick until ``on_tick`` returns False. It is called after each tick's commands are out."""
        clock, devices, sink = self._clock, self._devices, self._sink
        period = self._period_ns
        state, params = self._state, self._params
        index = 0
        due = last = clock.now_ns()
        keyframe_due = due
        while True:
            now = clock.now_ns()
            inputs = Inputs(
                now,
                (now - last) * 1e-9 if index else period * 1e-9,
                devices.odometry.latest(),
                devices.autopilot.latest(),
                devices.servos.latest(),
                self._requests.popleft() if self._requests else None,
            )
            before = state
            state, outputs = step(state, inputs, params, inputs.dt)
            devices.autopilot.command(outputs.autopilot)
            sent = clock.now_ns() if self._timed else now
            devices.servos.command(outputs.servos)
            if now >= keyframe_due:
                sink.keyframe(index, now, before)
                keyframe_due += KEYFRAME_PERIOD_NS
            sink.tick(Tick(index, self.revision, inputs, outputs))
            if self._timed:
                busy = clock.now_ns() - now
                sink.timing(Timing(index, now, (now - due) * 1e-9, busy * 1e-9, (sent - now) * 1e-9))
            self._state, self.outputs = state, outputs
            if not on_tick(outputs):
                return
            last = now
            index += 1
            due += period
            if self._timed and clock.now_ns() > due + 10 * period:
                due = clock.now_ns()  # after a long stall, go on from here instead of catching up in a burst
            await clock.sleep_until(due)
