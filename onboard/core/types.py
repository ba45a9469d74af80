"""What the blocks of the core hand to each other in one tick."""

from __future__ import annotations

from enum import IntEnum, StrEnum

from msgspec import Struct

from drivers.samples import AutopilotCommand, AutopilotState, Odometry, Quat, ServoCommand, ServoState, Vec3

#: Row-major 3x3 matrix.
Mat3 = tuple[float, float, float, float, float, float, float, float, float]


class Phase(StrEnum):
    """Phases of the repair mission, and the safe states beside it."""

    PREFLIGHT = "preflight"
    ARMED = "armed"
    """On the ground, the motors idle."""
    TAKEOFF = "takeoff"
    APPROACH = "approach"
    ALIGN = "align"
    ADHESIVE = "adhesive"
    TOOL_CHANGE = "tool_change"
    TARE = "tare"
    ADVANCE = "advance"
    PRESS = "press"
    RELEASE = "release"
    RETREAT = "retreat"
    RETURN = "return"
    LAND = "land"
    HOLD = "hold"
    RETREAT_HOLD = "retreat_hold"
    RETREAT_LAND = "retreat_land"
    STOPPED = "stopped"


class Request(StrEnum):
    """What a person may ask of the mission."""

    TAKEOFF = "takeoff"
    """Take off and hover."""
    START = "start"
    """Run the whole mission (takes off first when on the ground)."""
    HOLD = "hold"
    RESUME = "resume"
    RETREAT = "retreat"
    LAND = "land"
    KILL = "kill"
    RESET = "reset"
    """Back to preflight, on the ground only."""
    STOP = "stop"
    """Whatever it does: hold, in contact retreat; on hold, land."""
    ARM = "arm"
    """Arm, and idle on the ground."""
    TARE = "tare"
    """Hovering: take what the observer reads away from contact for no force."""
    GO = "go"
    """On hold: go to the phase that ``Inputs.go`` names."""


class Action(IntEnum):
    """What safety demands; the most severe wins."""

    NONE = 0
    WARN = 1
    HOLD = 2
    RETREAT = 3
    LAND = 4
    KILL = 5


class LinkState(Struct, frozen=True, gc=False):
    """What is known of the link: facts, on the clock of the ticks."""

    commander: str = ""
    """Name of the station that commands; empty: nobody does."""
    heard_ns: int = 0
    """What was last heard of it was certainly sent after this time."""
    present: bool = False
    """It is connected. It is not once it has closed or died, or was frozen or out of reach for the peer lease."""

    def age(self, t_ns: int) -> float:
        """Time since the commander was certainly there, s; 0 when nobody commands."""
        return max(0, t_ns - self.heard_ns) * 1e-9 if self.commander else 0.0


class Inputs(Struct, frozen=True, gc=False):
    """Everything the core sees in one tick."""

    t_ns: int
    """Time of the tick."""
    dt: float
    """Measured time since the last tick, s (not clamped)."""
    odometry: Odometry | None
    autopilot: AutopilotState | None
    servos: ServoState | None
    request: Request | None = None
    obstacles: tuple[str, ...] = ()
    """Sentences on why the vehicle must not arm, from outside the core."""
    go: Phase | None = None
    """Where ``Request.GO`` is to lead; with any other request, nothing."""
    link: LinkState = LinkState()
    """The station that commands."""


class Estimator(StrEnum):
    """The force estimators that run side by side."""

    PAPER = "paper"
    """The paper's disturbance observer, eq. 11 to 17."""
    BODY = "body"
    """Specific force less thrust, in B."""
    MOMENTUM = "momentum"
    """Generalised momentum, arm included."""
    KALMAN = "kalman"
    """Random walks of contact and wind."""


class Force(Struct, frozen=True, gc=False):
    """What one estimator reads."""

    force_W: Vec3 = (0.0, 0.0, 0.0)
    """External force on the vehicle, tared, N, W."""
    contact: float = 0.0
    """Compressive force on the pipe along the contact normal, N; positive presses."""


class Forces(Struct, frozen=True, gc=False):
    """What all estimators read, and what they share."""

    paper: Force = Force()
    body: Force = Force()
    momentum: Force = Force()
    kalman: Force = Force()
    felt: float = 0.0
    """Compression that the joints' currents tell of, N."""
    wind: Vec3 = (0.0, 0.0, 0.0)
    """Disturbance that the Kalman filter tells apart from the contact, N, W."""
    thrust_scale: float = 1.0
    """Thrust in hover over the thrust commanded."""
    alarm: bool = False
    """Away from the pipe: the contact trigger would have been pulled, had the tip been at the crack."""


class Estimate(Struct, frozen=True, gc=False):
    """What the core believes about the vehicle. Angles of the body are ZYX Euler angles (roll, pitch, yaw), rad."""

    p_WB: Vec3
    v_WB: Vec3
    rpy: Vec3
    rpy_rate: Vec3
    R_WB: Mat3
    w_WB_B: Vec3
    a_WB: Vec3
    """Acceleration of the body origin from the IMU, m/s^2, W."""
    joints: Vec3
    joint_rates: Vec3
    tip_W: Vec3
    """Tip of the active tool, m, W."""
    force_W: Vec3
    """Estimated external force on the vehicle, tared, N, W."""
    force_ee: Vec3
    """The same in frame E (eq. 17)."""
    contact_force: float
    """Estimated compressive force on the pipe along the contact normal, N; positive presses."""
    in_contact: bool
    """Output of the contact trigger."""
    payload: bool
    """The sleeve is in the gripper."""
    age_odometry: float
    age_autopilot: float
    age_servos: float
    """Ages of the samples at the tick, s; infinity before the first."""
    valid: bool
    """All three devices have told something finite at least once."""
    forces: Forces = Forces()
    """Of all estimators; ``force_W`` and ``contact_force`` are the selected one's."""


class Reference(Struct, frozen=True, gc=False):
    """What the loop follows in this tick."""

    p: Vec3
    v: Vec3
    a: Vec3
    """Base position, velocity, acceleration, m, W, compliant offset included."""
    yaw: float
    yaw_rate: float
    yaw_acceleration: float
    wrist: tuple[float, float]
    """Wrist relative to the arm mount in the levelled heading frame: forward, up, m."""
    wrist_rate: tuple[float, float]
    elevation: float
    """Elevation of the gripper's direction in the levelled heading frame, rad (the needle's is pi/2 more)."""
    elevation_rate: float
    pump: float
    gripper: float
    """Goal angles of the pump and gripper servos, rad."""
    lift: float
    """Share of the actuation in force: 0 standing, 1 flying, in between while the motors spool up or down."""
    force: float
    """Desired compressive force, N."""
    force_ahead: float
    """The same a moment later: what is fed forward, since the attitude lags."""
    pressing: bool
    """The force loop is closed."""
    dispensing: bool
    """The needle sweeps the arc of the pipe."""
    steady: bool
    """The arm makes up for the base's position error, so that the tool follows its path in the world."""
    compliant_acceleration: float
    compliant_velocity: float
    compliant_displacement: float
    """State of the admittance along the heading, m/s^2, m/s, m."""


class Verdict(Struct, frozen=True, gc=False):
    """What safety says in one tick."""

    action: Action
    reasons: tuple[str, ...]
    """Codes of the active conditions, most severe first."""


class Severity(StrEnum):
    """How loud an event is."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Event(Struct, frozen=True, gc=False):
    """A sentence a person acts on."""

    t_ns: int
    code: str
    severity: Severity
    text: str


class Control(Struct, frozen=True, gc=False):
    """What the laws want, before the gate."""

    thrust: float
    """Along +z of B, N."""
    torque_B: Vec3
    joint_torque: Vec3
    attitude: Vec3
    """Roll, pitch, yaw the attitude law follows, rad."""
    attitude_rate: Vec3
    """Their rates."""
    joints: Vec3
    """Joint angles the joint law follows, rad."""
    joint_rates: Vec3
    w_WB_B: Vec3
    """Body rates that realise the attitude law, rad/s."""
    q_WB: Quat
    """Attitude set-point for the ``attitude`` interface."""


class Outputs(Struct, frozen=True, gc=False):
    """Everything the core says in one tick."""

    phase: Phase
    phase_time: float
    verdict: Verdict
    estimate: Estimate
    reference: Reference
    control: Control
    autopilot: AutopilotCommand
    servos: ServoCommand
    clipped: tuple[str, ...]
    """What the gate changed, by name of the limit."""
    events: tuple[Event, ...]


class Tick(Struct, frozen=True, gc=False):
    """One cycle: the unit of log, telemetry and replay."""

    index: int
    revision: int
    """Revision of the parameter set in force."""
    inputs: Inputs
    outputs: Outputs
