"""A short made-up mission with known errors, for everything that reads logs. Nothing here flies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from drivers.samples import (
    AutopilotCommand,
    AutopilotState,
    Engage,
    FlightMode,
    Interface,
    JointMode,
    Landed,
    Odometry,
    ServoCommand,
    ServoState,
)
from onboard.core.repair import Pipe, Repair
from onboard.core.types import (
    Action,
    Control,
    Estimate,
    Event,
    Force,
    Forces,
    Inputs,
    Outputs,
    Phase,
    Reference,
    Severity,
    Tick,
    Verdict,
)
from onboard.recorder import Recorder
from onboard.records import RunInfo
from sim_backend.plant import Truth

DT_NS = 4_000_000
PIPE = Pipe(position=(2.0, 0.0, 1.5), heading_deg=30.0, radius=0.08)
REPAIR = Repair(force=2.5, hold=1.0)
NEEDLE_GAP = 0.003
#: Constant errors put into the mission: truth against reference.
X_ERROR = 0.002
PITCH_ERROR = math.radians(0.02)
JOINT_ERROR = math.radians(0.1)
MEASURED_ERROR = 0.04
ESTIMATED_ERROR = 0.01
KALMAN_ERROR = -0.005
NEEDLE_ERROR = 0.0005

PHASES: tuple[tuple[Phase, float], ...] = (
    (Phase.PREFLIGHT, 0.2),
    (Phase.TAKEOFF, 0.8),
    (Phase.APPROACH, 0.6),
    (Phase.ALIGN, 0.2),
    (Phase.ADHESIVE, 1.0),
    (Phase.TOOL_CHANGE, 0.2),
    (Phase.TARE, 0.2),
    (Phase.ADVANCE, 0.4),
    (Phase.PRESS, 3.0),
    (Phase.RELEASE, 0.2),
    (Phase.RETREAT, 0.4),
    (Phase.RETURN, 0.4),
    (Phase.LAND, 0.6),
    (Phase.STOPPED, 0.2),
)


class PlanStub(Struct, frozen=True):
    """The part of the plan that the metrics read."""

    needle_gap: float = NEEDLE_GAP


class RotorsStub(Struct, frozen=True):
    """Limits of the rotors."""

    max_thrust: float = 13.0


class ServoStub(Struct, frozen=True):
    """Limits of the servos."""

    stall_torque: float = 0.93


class VehicleStub(Struct, frozen=True):
    """The part of the vehicle that the report reads."""

    rotors: RotorsStub = RotorsStub()
    servo: ServoStub = ServoStub()


class ConfigStub(Struct, frozen=True):
    """The parts of the configuration that the metrics and the report read."""

    pipe: Pipe = PIPE
    repair: Repair = REPAIR
    plan: PlanStub = PlanStub()
    vehicle: VehicleStub = VehicleStub()


def desired_force(t: float) -> float:
    """Bias 0.3 N, quintic up in 0.8 s, hold 1.4 s, quintic down in 0.8 s."""
    s = min(1.0, max(0.0, min(t, 3.0 - t) / 0.8))
    return 0.3 + (REPAIR.force - 0.3) * s**3 * (10 - 15 * s + 6 * s * s)


def mission() -> Iterator[tuple[Tick, Truth]]:
    """All ticks of the mission with what is true beside them."""
    index = 0
    for phase, length in PHASES:
        for k in range(round(length * 250)):
            yield _cycle(index, phase, k * 0.004, k * 0.004 / length)
            index += 1


def _cycle(index: int, phase: Phase, phase_time: float, share: float) -> tuple[Tick, Truth]:
    t_ns = index * DT_NS
    t = index * 0.004
    order = [p for p, _ in PHASES]
    late = order.index(phase)
    pressing = phase is Phase.PRESS
    released = late >= order.index(Phase.RETREAT)
    grounded = phase in (Phase.PREFLIGHT, Phase.STOPPED)
    height = {Phase.PREFLIGHT: 0.24, Phase.STOPPED: 0.24, Phase.TAKEOFF: 0.24 + share, Phase.LAND: 1.24 - share}
    p = (0.3 * math.sin(t), 0.1 * math.cos(t), height.get(phase, 1.5))
    attitude = (0.0, 0.05 * math.sin(0.5 * t), 0.3)
    joints = (-0.9, 0.6, 0.1 * math.sin(t))
    force = desired_force(phase_time) if pressing else 0.0
    measured = force + MEASURED_ERROR if pressing else 0.0
    estimated = measured + (ESTIMATED_ERROR if pressing else 0.0)
    truth_joints = (joints[0], joints[1], joints[2] + JOINT_ERROR)
    truth_q = _quaternion(attitude[0], attitude[1] + PITCH_ERROR, attitude[2])
    truth_p = (p[0] + X_ERROR, p[1], p[2])
    zero = (0.0, 0.0, 0.0)
    dispensing = phase is Phase.ADHESIVE and 0.2 <= share < 0.8
    needle = _needle(-1.0 + (share - 0.2) / 0.6 * 2.0) if phase is Phase.ADHESIVE else zero
    inputs = Inputs(
        t_ns=t_ns,
        dt=0.004,
        odometry=Odometry(t_ns, truth_p, truth_q, zero, 3),
        autopilot=AutopilotState(
            t_ns,
            truth_q,
            zero,
            t_ns,
            (0.0, 0.0, 9.8),
            not grounded,
            FlightMode.OFFBOARD,
            Landed.ON_GROUND if grounded else Landed.IN_AIR,
            16.0,
            0.9,
        ),
        servos=ServoState(
            t_ns, (*truth_joints, 0.0, 0.0), (0.0,) * 5, (0.0,) * 5, (5.0,) * 5, (30.0,) * 5, (0,) * 5, True
        ),
    )
    estimate = Estimate(
        p_WB=truth_p,
        v_WB=zero,
        rpy=(attitude[0], attitude[1] + PITCH_ERROR, attitude[2]),
        rpy_rate=zero,
        R_WB=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        w_WB_B=zero,
        a_WB=zero,
        joints=truth_joints,
        joint_rates=zero,
        tip_W=zero,
        force_W=zero,
        force_ee=zero,
        contact_force=estimated,
        in_contact=pressing,
        payload=not released,
        age_odometry=0.0,
        age_autopilot=0.0,
        age_servos=0.0,
        valid=True,
        forces=Forces(
            paper=Force((0.0, 0.0, 0.0), estimated),
            body=Force((0.0, 0.0, 0.0), estimated),
            momentum=Force((0.0, 0.0, 0.0), estimated),
            kalman=Force((0.0, 0.0, 0.0), measured + KALMAN_ERROR if pressing else 0.0),
            felt=measured,
        ),
    )
    reference = Reference(
        p=p,
        v=zero,
        a=zero,
        yaw=0.3,
        yaw_rate=0.0,
        yaw_acceleration=0.0,
        wrist=(0.3, 0.0),
        wrist_rate=(0.0, 0.0),
        elevation=0.0,
        elevation_rate=0.0,
        pump=0.0,
        gripper=0.0,
        lift=0.0 if grounded else 1.0,
        force=force,
        force_ahead=force,
        pressing=pressing,
        dispensing=dispensing,
        steady=dispensing,
        compliant_acceleration=0.0,
        compliant_velocity=0.0,
        compliant_displacement=0.0,
    )
    control = Control(25.0, zero, zero, attitude, zero, joints, zero, zero, truth_q)
    events: tuple[Event, ...] = ()
    if phase_time == 0.0:
        events = (Event(t_ns, "phase", Severity.INFO, f"now in {phase}"),)
    outputs = Outputs(
        phase=phase,
        phase_time=phase_time,
        verdict=Verdict(Action.NONE, ()),
        estimate=estimate,
        reference=reference,
        control=control,
        autopilot=AutopilotCommand(Engage.OFFBOARD, Interface.WRENCH, 25.0, zero, truth_q, zero),
        servos=ServoCommand(JointMode.TORQUE, zero, (*joints, 0.0, 0.0), 1.0),
        clipped=(),
        events=events,
    )
    truth = Truth(
        t=t,
        p_WB=truth_p,
        v_WB=zero,
        q_WB=truth_q,
        w_WB_B=zero,
        f_B=(0.0, 0.0, 9.8),
        joints=truth_joints,
        joint_rates=zero,
        joint_torque=(0.2, -0.4, 0.1 * math.sin(t)),
        servo_current=zero,
        pump=0.0,
        gripper=0.0,
        rotor_thrust=(6.0, 6.1, 6.2, 6.3 + 0.5 * math.sin(t)),
        tip_W=_tip(phase, share),
        needle_W=needle,
        contact_force=measured,
        contact_peak=measured + 0.1 if pressing else 0.0,
        contact_W=zero,
        tip_slip=0.001 if late >= order.index(Phase.PRESS) else 0.0,
        sliding=False,
        sleeve_on_pipe=released,
        on_ground=grounded,
        battery_voltage=16.0,
        battery_remaining=0.9,
        crashed="",
    )
    return Tick(index=index, revision=1, inputs=inputs, outputs=outputs), truth


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    cr, sr, cp, sp, cy, sy = (f(0.5 * a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _needle(angle: float) -> tuple[float, float, float]:
    """A point on the needle's circle; ``angle`` in rad from the crack, positive up."""
    r = PIPE.radius + NEEDLE_GAP + NEEDLE_ERROR
    return _from_axis(-r * math.cos(angle), r * math.sin(angle))


def _tip(phase: Phase, share: float) -> tuple[float, float, float]:
    gap = {Phase.ADVANCE: 0.05 * (1 - share), Phase.PRESS: 0.0, Phase.RELEASE: 0.0}.get(phase, 0.05)
    return _from_axis(-PIPE.radius - gap, 0.0)


def _from_axis(along: float, up: float) -> tuple[float, float, float]:
    heading = math.radians(PIPE.heading_deg)
    x, y, z = PIPE.position
    return (x + along * math.cos(heading), y + along * math.sin(heading), z + up)


def record(
    path: Path,
    cycles: list[tuple[Tick, Truth]] | None = None,
    *,
    info: RunInfo | None = None,
    truth: bool = True,
    background: bool = False,
) -> Path:
    """Record the mission (or the given cycles) with the real recorder."""
    info = info or RunInfo(version="0.1.0", scenario="paper", law="tuned", seed=7)
    with Recorder(path, info, ConfigStub(), "pipe: {}\n", background=background) as recorder:
        for tick, true in cycles if cycles is not None else mission():
            recorder.tick(tick, true if truth else None)
    return path


def change_outputs(tick: Tick, **changes: object) -> Tick:
    """The tick with some of its outputs replaced."""
    return replace(tick, outputs=replace(tick.outputs, **changes))
