"""The loop: samples in, one step of the core, commands out, one tick to the recorder. Names no device."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from drivers.protocols import AutopilotDevice, OdometryDevice, ServoDevice
from onboard.clock import Clock
from onboard.core.derived import Derived, adopt, derive
from onboard.core.mission import GROUND
from onboard.core.params import Params
from onboard.core.step import State, initial_state, step
from onboard.core.types import Inputs, LinkState, Outputs, Phase, Request, Tick
from onboard.records import Timing

KEYFRAME_PERIOD_NS = 1_000_000_000


class Devices(Protocol):
    """The three devices of the vehicle, and what concerns more than one of them. No call waits."""

    autopilot: AutopilotDevice
    odometry: OdometryDevice
    servos: ServoDevice

    def relay(self) -> None:
        """Hand on what one device tells another; called once a tick, after the commands are out."""

    def obstacles(self) -> tuple[str, ...]:
        """Sentences on why the vehicle must not arm; looked at once a tick."""


class Sink(Protocol):
    """Where ticks go."""

    def tick(self, tick: Tick) -> None:
        """Take one cycle."""

    def keyframe(self, index: int, t_ns: int, state: State) -> None:
        """Take the core's state just before the tick of this index."""

    def timing(self, timing: Timing) -> None:
        """Take the punctuality of one tick."""

    def revision(self, index: int, t_ns: int, revision: int, config: Params) -> None:
        """Take the parameter set that is in force from the tick of this index on."""


class _Asked(NamedTuple):
    request: Request
    go: Phase | None = None
    done: Callable[[Outputs], None] | None = None


class _Reload(NamedTuple):
    derived: Derived
    grounded: bool
    done: Callable[[int | None], None]


class Loop:
    """Runs the core at ``rate_hz`` on a clock.

    timed: report each tick's lateness to the sink (wall-clock runs). link: what is known of the ground station.
    """

    def __init__(
        self,
        devices: Devices,
        clock: Clock,
        params: Params,
        sink: Sink,
        *,
        rate_hz: float = 250.0,
        timed: bool = False,
        link: Callable[[], LinkState] = LinkState,
    ) -> None:
        derive(params)  # model, places and compiled code are ready before the first tick
        self._devices, self._clock, self._params, self._sink = devices, clock, params, sink
        self._period_ns = round(1e9 / rate_hz)
        self._timed, self._link = timed, link
        self._requests: deque[_Asked] = deque()
        self._reloads: deque[_Reload] = deque()
        self._state = initial_state(params)
        self.revision = 0
        self.outputs: Outputs | None = None

    @property
    def params(self) -> Params:
        """The parameter set in force."""
        return self._params

    def request(
        self, request: Request, *, go: Phase | None = None, done: Callable[[Outputs], None] | None = None
    ) -> None:
        """Ask something of the mission; taken one a tick, in order, but kill and stop before all else; from any thread.

        go: where to, of a GO. done: called by the loop with what came of the tick that took the request.
        """
        asked = _Asked(request, go, done)
        if request in (Request.KILL, Request.STOP):
            self._requests.appendleft(asked)
        else:
            self._requests.append(asked)

    def reload(self, derived: Derived, *, grounded: bool, done: Callable[[int | None], None]) -> None:
        """Put another parameter set into force between two ticks; from any thread.

        derived: the set, with what follows from it, made beforehand so that no tick has to wait for it.
        grounded: it may be put into force only in PREFLIGHT and STOPPED.
        done: called by the loop with the new revision, or with None when the vehicle was not on the ground.
        """
        self._reloads.append(_Reload(derived, grounded, done))

    async def run(self, on_tick: Callable[[Outputs], bool]) -> None:
        """Tick until ``on_tick`` returns False. It is called after each tick's commands are out."""
        clock, devices, sink = self._clock, self._devices, self._sink
        period = self._period_ns
        state = self._state
        index = 0
        due = last = clock.now_ns()
        keyframe_due = due
        while True:
            now = clock.now_ns()
            while self._reloads:
                self._put_into_force(self._reloads.popleft(), index, now)
            asked = self._requests.popleft() if self._requests else None
            inputs = Inputs(
                now,
                (now - last) * 1e-9 if index else period * 1e-9,
                devices.odometry.latest(),
                devices.autopilot.latest(),
                devices.servos.latest(),
                asked.request if asked else None,
                devices.obstacles(),
                asked.go if asked else None,
                self._link(),
            )
            before = state
            state, outputs = step(state, inputs, self._params, inputs.dt)
            devices.autopilot.command(outputs.autopilot)
            sent = clock.now_ns()
            devices.servos.command(outputs.servos)
            devices.relay()
            if now >= keyframe_due:
                sink.keyframe(index, now, before)
                keyframe_due += KEYFRAME_PERIOD_NS
            sink.tick(Tick(index, self.revision, inputs, outputs))
            if self._timed:
                late, busy = (now - due) * 1e-9, (clock.now_ns() - now) * 1e-9
                sink.timing(Timing(index, now, late, busy, (sent - now) * 1e-9))
            self._state, self.outputs = state, outputs
            if asked and asked.done:
                asked.done(outputs)
            if not on_tick(outputs):
                return
            last = now
            index += 1
            due += period
            if self._timed and clock.now_ns() > due + 10 * period:
                due = clock.now_ns()  # after a long stall, go on from here instead of catching up in a burst
            await clock.sleep_until(due)

    def _put_into_force(self, reload: _Reload, index: int, now: int) -> None:
        if reload.grounded and self._state.mission.phase not in GROUND:
            reload.done(None)
            return
        self._params = adopt(reload.derived).params
        self.revision += 1
        self._sink.revision(index, now, self.revision, self._params)
        reload.done(self.revision)
