"""One run as columns of numbers, read from its log alone."""

from __future__ import annotations

import itertools
from collections.abc import Generator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from onboard.messages import (
    DEVICES,
    EVENT,
    PARAMS,
    TICK,
    TIMING,
    TRUTH,
    DeviceReport,
    Event,
    LogError,
    LogReader,
    Pipe,
    Repair,
    RunInfo,
    Timing,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]
Five = tuple[float, float, float, float, float]


def stretches(mask: Mask) -> NDArray[np.int64]:
    """How many ticks each stretch has in which it holds, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    lengths: NDArray[np.int64] = edges[1::2] - edges[::2]
    return lengths


# What is read of the recorded structs: the same names, only the fields that are used here.


class _Odometry(Struct, gc=False):
    t_ns: int
    q_WB: Four
    confidence: int
    reset_counter: int


class _Autopilot(Struct, gc=False):
    t_ns: int
    q_WB: Four
    landed: str


class _Servos(Struct, gc=False):
    t_ns: int
    current: Five
    voltage: Five
    temperature: Five
    error: Five


class _Link(Struct, frozen=True, gc=False):
    commander: str = ""
    heard_ns: int = 0
    present: bool = False


class _Inputs(Struct, gc=False):
    t_ns: int
    odometry: _Odometry | None
    autopilot: _Autopilot | None
    servos: _Servos | None
    link: _Link = _Link()


class _Force(Struct, frozen=True, gc=False):
    contact: float = 0.0


class _Forces(Struct, frozen=True, gc=False):
    paper: _Force = _Force()
    body: _Force = _Force()
    momentum: _Force = _Force()
    kalman: _Force = _Force()
    felt: float = 0.0
    alarm: bool = False


class _Estimate(Struct, gc=False):
    p_WB: Three
    rpy: Three
    joints: Three
    contact_force: float
    in_contact: bool
    payload: bool
    age_odometry: float
    age_autopilot: float
    age_servos: float
    forces: _Forces | None = None


class _Reference(Struct, gc=False):
    p: Three
    force: float
    dispensing: bool


class _Control(Struct, gc=False):
    attitude: Three
    joints: Three


class _Command(Struct, gc=False):
    engage: str


class _Outputs(Struct, gc=False):
    phase: str
    estimate: _Estimate
    reference: _Reference
    control: _Control
    autopilot: _Command


class _Tick(Struct, gc=False):
    index: int
    inputs: _Inputs
    outputs: _Outputs


class _Truth(Struct, gc=False):
    p_WB: Three
    q_WB: Four
    joints: Three
    joint_torque: Three
    rotor_thrust: Four
    tip_W: Three
    needle_W: Three
    contact_force: float
    contact_peak: float
    tip_slip: float
    sleeve_on_pipe: bool
    on_ground: bool
    crashed: str


class _Plan(Struct):
    needle_gap: float


class _Rotors(Struct):
    max_thrust: float


class _Servo(Struct):
    stall_torque: float


class _Vehicle(Struct):
    rotors: _Rotors
    servo: _Servo


class _Plant(Struct, frozen=True):
    kind: str = "rigid"


class _World(Struct, frozen=True):
    plant: _Plant = _Plant()


class _Estimators(Struct, frozen=True):
    selected: str = "paper"


class _Contact(Struct, frozen=True):
    threshold: float = 0.15
    debounce: float = 0.10


class RunConfig(Struct):
    """The parameters that figures of merit are measured against."""

    pipe: Pipe
    repair: Repair
    plan: _Plan
    vehicle: _Vehicle
    world: _World = _World()
    estimators: _Estimators = _Estimators()
    contact: _Contact = _Contact()


class _Revision(Struct):
    config: RunConfig


@dataclass(frozen=True)
class Truths:
    """What was true at each tick: n rows, NaN where nothing fresh was recorded. SI, W, angles in rad.

    A simulated world is recorded with each tick. One in a process of its own is recorded at its own times: a tick then
    has the newest truth at or before it, and none before the first or when that is older than ``TRUTH_LASTS``.
    """

    p: Array
    rpy: Array
    joints: Array
    torque: Array
    """Joint torques, (n, 3)."""
    thrust: Array
    """Rotor thrusts, (n, 4)."""
    tip: Array
    needle: Array
    force: Array
    """Compressive contact force, (n,)."""
    peak: Array
    """Largest contact force since the tick before, (n,)."""
    slip: Array
    """Tangential sliding so far, (n,)."""
    known: Mask
    """Ticks that have a truth, (n,)."""
    sleeve_on_pipe: bool
    """At the end."""
    on_ground: bool
    """At the end."""
    crashed: str
    """Empty, or what happened to the vehicle."""


@dataclass(frozen=True)
class Health:
    """How servos, tracker and link did at each tick: n rows, NaN where they told nothing."""

    current: Array
    voltage: Array
    temperature: Array
    error: Array
    """Of the servos, (n, 5): A, V, degC, hardware-error bits."""
    confidence: Array
    """Of the tracker, 0 to 3, (n,)."""
    resets: Array
    """Its frame's jumps so far, (n,)."""
    lean: Array
    """Between the verticals of tracker and autopilot, rad, (n,)."""
    link_age: Array
    """Time since the commanding station was certainly there, s, (n,); NaN while nobody commands."""
    link_present: Mask
    """It is connected, (n,)."""
    commanders: tuple[str, ...]
    """Names of the stations that have commanded, in order."""


@dataclass(frozen=True)
class Run:
    """Everything that metrics and report need. Arrays have n rows, one per tick; SI, W, angles in rad."""

    path: Path
    info: RunInfo
    config: RunConfig
    config_yaml: str
    complete: bool
    """The log was finished."""
    index: NDArray[np.int64]
    t: Array
    """Time since the first tick, s."""
    phase: NDArray[np.str_]
    p: Array
    rpy: Array
    joints: Array
    """Estimates, (n, 3)."""
    p_ref: Array
    attitude_ref: Array
    joints_ref: Array
    """What the loop follows, (n, 3)."""
    force_des: Array
    force_est: Array
    forces: dict[str, Array]
    """Compression by each estimator, (n,) each, and by the joints alone (``FELT``); empty when none was recorded."""
    triggered: Mask
    """The contact trigger is pulled."""
    alarm: Mask
    """It would have been, away from the pipe, had the tip been at the crack."""
    dispensing: Mask
    payload: Mask
    stamps: dict[str, Array]
    """Time of the newest sample of each device, s on the clock of ``t``."""
    ages: dict[str, Array]
    """Its age at the tick, s."""
    landed: str
    """Last word of the autopilot's land detector."""
    truth: Truths | None
    offboard: Mask
    """A set-point was handed to the autopilot."""
    late: Array
    busy: Array
    sent: Array
    """Start of the tick against its schedule, its duration, and its part until the set-point had left, s; NaN where
    nothing was recorded, as in every simulated run."""
    health: Health
    devices: list[DeviceReport] = field(default_factory=list)
    """How the devices did, about once a second of a wall-clock run."""
    events: list[Event] = field(default_factory=list)
    """In order of their times."""
    start_ns: int = 0

    def with_estimates(self, forces: dict[str, Array], triggered: Mask, alarm: Mask, selected: str) -> Run:
        """The same run with other estimates of the contact force, the ``selected`` one being believed."""
        config = msgspec.structs.replace(self.config, estimators=_Estimators(selected))
        return replace(self, forces=forces, triggered=triggered, alarm=alarm, config=config)

    def where(self, *phases: str) -> Mask:
        """Ticks in any of these phases."""
        return np.isin(self.phase, phases)


SOURCES = ("odometry", "autopilot", "servos")
ESTIMATORS = ("paper", "body", "momentum", "kalman")
FELT = "felt"
_NO_SERVOS, _NO_POSE, _NO_ATTITUDE, _NO_FORCES = ((float("nan"),) * count for count in (10, 6, 4, 6))
#: An older truth says nothing of a tick, s.
TRUTH_LASTS = 0.05


class Source(Protocol):
    """What a run is told by, and what is known of it in the end."""

    @property
    def info(self) -> RunInfo:
        """What the run was."""

    @property
    def config_yaml(self) -> str:
        """All that was in force, as text."""

    @property
    def complete(self) -> bool:
        """It was told to its end."""


def read_run(path: Path, *, partial: bool = False) -> Run:
    """Read a whole log.

    Raises:
        LogError: it cannot be read, or holds no ticks.
    """
    with LogReader(path, partial=partial) as log:
        gathering = Gathering(path, log)
        for topic, t_ns, message in log.timed(_KINDS):
            gathering.take(topic, t_ns, message)
        return gathering.end()


class Gathering:
    """A run, told message by message: those of a log, or of a flight in this process while it is flown."""

    def __init__(self, path: Path, source: Source) -> None:
        self._steps = _gather(path, source)
        next(self._steps)

    def take(self, topic: str, t_ns: int, message: Any) -> None:
        """Take one message of a topic."""
        self._steps.send((topic, t_ns, message))

    def take_config(self, config: Struct) -> None:
        """Take the parameters in force from now on, as the flight has them."""
        self.take(PARAMS, 0, _Revision(msgspec.json.decode(msgspec.json.encode(config), type=RunConfig)))

    def end(self) -> Run:
        """All that was told. Raises LogError when there was no tick."""
        try:
            self._steps.send(None)
        except StopIteration as end:
            run: Run = end.value
            return run
        raise AssertionError("it ends when nothing more is told")


_KINDS: dict[str, Any] = {
    TICK: _Tick,
    TRUTH: _Truth,
    EVENT: Event,
    TIMING: Timing,
    DEVICES: DeviceReport,
    PARAMS: _Revision,
}


def _gather(path: Path, log: Source) -> Generator[None, tuple[str, int, Any] | None, Run]:
    """Take messages until None is sent."""
    ticks: list[float] = []
    phases: list[str] = []
    truths: list[float] = []
    truth_ns: list[int] = []
    landed = ""
    last: _Truth | None = None
    crashed = ""
    events: list[Event] = []
    timings: list[Timing] = []
    devices: list[DeviceReport] = []
    commanders: list[str] = []
    config: RunConfig | None = None
    start_ns = 0
    nowhere = float("nan")
    while (told := (yield)) is not None:
        topic, t_ns, message = told
        if topic == TICK:
            inputs, outputs = message.inputs, message.outputs
            estimate, reference, control = outputs.estimate, outputs.reference, outputs.control
            if not phases:
                start_ns = inputs.t_ns
            phases.append(outputs.phase)
            odometry, autopilot, servos = inputs.odometry, inputs.autopilot, inputs.servos
            ticks += (
                message.index,
                (inputs.t_ns - start_ns) * 1e-9,
                *estimate.p_WB,
                *estimate.rpy,
                *estimate.joints,
                *reference.p,
                *control.attitude,
                *control.joints,
                reference.force,
                estimate.contact_force,
                reference.dispensing,
                estimate.payload,
                nowhere if odometry is None else (odometry.t_ns - start_ns) * 1e-9,
                nowhere if autopilot is None else (autopilot.t_ns - start_ns) * 1e-9,
                nowhere if servos is None else (servos.t_ns - start_ns) * 1e-9,
                estimate.age_odometry,
                estimate.age_autopilot,
                estimate.age_servos,
                outputs.autopilot.engage == "offboard",
                *(_NO_SERVOS if servos is None else (*servos.current, *servos.voltage)),
                *(_NO_SERVOS if servos is None else (*servos.temperature, *servos.error)),
                *(_NO_POSE if odometry is None else (odometry.confidence, odometry.reset_counter, *odometry.q_WB)),
                *(_NO_ATTITUDE if autopilot is None else autopilot.q_WB),
                (inputs.t_ns - inputs.link.heard_ns) * 1e-9 if inputs.link.commander else nowhere,
                inputs.link.present,
                estimate.in_contact,
                *_read_forces(estimate.forces),
            )
            if (name := inputs.link.commander) and name not in commanders[-1:]:
                commanders.append(name)
            if autopilot is not None:
                landed = autopilot.landed
        elif topic == TRUTH:
            truth_ns.append(t_ns)
            truths += (
                *message.p_WB,
                *message.q_WB,
                *message.joints,
                *message.joint_torque,
                *message.rotor_thrust,
                *message.tip_W,
                *message.needle_W,
                message.contact_force,
                message.contact_peak,
                message.tip_slip,
            )
            last = message
            crashed = crashed or message.crashed
        elif topic == EVENT:
            events.append(message)
        elif topic == TIMING:
            timings.append(message)
        elif topic == DEVICES:
            devices.append(message)
        elif config is None:
            config = message.config
    if not phases or config is None:
        raise LogError(f"{path}: holds no cycle; the run ended before its first tick")
    rows = np.array(ticks).reshape(len(phases), -1)
    index = rows[:, 0].astype(np.int64)
    punctuality = _by_tick(index, timings)
    return Run(
        path=path,
        info=log.info,
        config=config,
        config_yaml=log.config_yaml,
        complete=log.complete,
        index=index,
        t=rows[:, 1],
        phase=np.array(phases),
        p=rows[:, 2:5],
        rpy=rows[:, 5:8],
        joints=rows[:, 8:11],
        p_ref=rows[:, 11:14],
        attitude_ref=rows[:, 14:17],
        joints_ref=rows[:, 17:20],
        force_des=rows[:, 20],
        force_est=rows[:, 21],
        forces={} if np.isnan(rows[:, 64]).all() else dict(zip((*ESTIMATORS, FELT), rows[:, 64:69].T, strict=True)),
        triggered=rows[:, 63] > 0,
        alarm=rows[:, 69] > 0,
        dispensing=rows[:, 22] > 0,
        payload=rows[:, 23] > 0,
        stamps=dict(zip(SOURCES, rows[:, 24:27].T, strict=True)),
        ages=dict(zip(SOURCES, rows[:, 27:30].T, strict=True)),
        landed=landed,
        truth=_truths(truths, (np.array(truth_ns) - start_ns) * 1e-9, rows[:, 1], last, crashed)
        if last is not None
        else None,
        offboard=rows[:, 30] > 0,
        late=punctuality[:, 0],
        busy=punctuality[:, 1],
        sent=punctuality[:, 2],
        health=Health(
            current=rows[:, 31:36],
            voltage=rows[:, 36:41],
            temperature=rows[:, 41:46],
            error=rows[:, 46:51],
            confidence=rows[:, 51],
            resets=rows[:, 52],
            lean=_lean(rows[:, 53:57], rows[:, 57:61]),
            link_age=rows[:, 61],
            link_present=rows[:, 62] > 0,
            commanders=tuple(commanders),
        ),
        devices=devices,
        events=sorted(events, key=lambda event: event.t_ns),
        start_ns=start_ns,
    )


def _read_forces(told: _Forces | None) -> tuple[float, ...]:
    if told is None:
        return _NO_FORCES
    return (
        told.paper.contact, told.body.contact, told.momentum.contact, told.kalman.contact, told.felt, told.alarm
    )  # fmt: skip


def _by_tick(index: NDArray[np.int64], timings: list[Timing]) -> Array:
    """Lateness, duration and sending (s) of each tick, (n, 3); NaN where none was recorded."""
    table = np.full((len(index), 3), np.nan)
    at = np.array([timing.index for timing in timings], dtype=np.int64)
    rows = np.minimum(np.searchsorted(index, at), len(index) - 1)
    values = np.array([(timing.late, timing.busy, timing.sent) for timing in timings]).reshape(-1, 3)
    found = index[rows] == at
    table[rows[found]] = values[found]
    return table


def _truths(values: list[float], times: Array, t: Array, last: _Truth, crashed: str) -> Truths:
    """Give each tick (at ``t``, s) the newest truth (at ``times``, s), and the peaks of all since the tick before."""
    recorded = np.array(values).reshape(len(times), -1)
    order = np.argsort(times, kind="stable")
    recorded, times = recorded[order], times[order]
    newest = np.searchsorted(times, t, side="right") - 1
    known = (newest >= 0) & (t - times[newest] <= TRUTH_LASTS)
    table = np.where(known[:, None], recorded[newest], np.nan)
    for row, (since, until) in enumerate(itertools.pairwise(newest.tolist()), 1):
        if until > since + 1:
            table[row, 24] = recorded[since + 1 : until + 1, 24].max()
    return Truths(
        p=table[:, 0:3],
        rpy=euler(table[:, 3:7]),
        joints=table[:, 7:10],
        torque=table[:, 10:13],
        thrust=table[:, 13:17],
        tip=table[:, 17:20],
        needle=table[:, 20:23],
        force=table[:, 23],
        peak=table[:, 24],
        slip=table[:, 25],
        known=known,
        sleeve_on_pipe=last.sleeve_on_pipe,
        on_ground=last.on_ground,
        crashed=crashed,
    )


def _lean(one: Array, other: Array) -> Array:
    """Angle (rad) between the verticals of two series of quaternions, (n, 4) each."""
    a, b = (
        np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))) for w, x, y, z in (one.T, other.T)
    )
    angle: Array = np.arctan2(np.linalg.norm(np.cross(a, b, axis=0), axis=0), np.sum(a * b, axis=0))
    return angle


def euler(q: Array) -> Array:
    """Roll, pitch, yaw (ZYX, rad) of quaternions (w, x, y, z); (n, 4) to (n, 3)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack((roll, pitch, yaw), axis=1)
