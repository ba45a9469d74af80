"""The reference of the loop: jerk-limited motion, force profile and compliant offset, phase by phase.

Each phase has a plan of legs, made when the phase begins from where the reference is at that moment (its
velocity and acceleration included), so that no change of phase makes the reference jump. Pressing adds the
desired force and the admittance's displacement along the pipe's normal.
"""

from __future__ import annotations

from math import cos, hypot, pi, sin, sqrt
from typing import TYPE_CHECKING, Annotated

from msgspec import Struct
from msgspec.structs import replace

from drivers.samples import Vec3
from drivers.vehicle import Vehicle
from onboard.core import admittance, force_profile, fuzzy, kinematics, plan
from onboard.core.math3 import wrap_angle
from onboard.core.plan import Eight, Leg, Path, Site
from onboard.core.spec import spec
from onboard.core.types import Estimate, Phase, Reference

if TYPE_CHECKING:
    from onboard.core.derived import Derived
    from onboard.core.params import Params as AllParams

ZERO: Eight = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
STANDING = (Phase.PREFLIGHT, Phase.ARMED, Phase.STOPPED)
PRESSING = (Phase.PRESS, Phase.RELEASE)
#: The tool moves close to the pipe: the arm makes up for where the base is.
AT_THE_PIPE = (Phase.ADHESIVE, Phase.TOOL_CHANGE)
BACKING_OUT = (Phase.RETREAT, Phase.RETREAT_HOLD, Phase.RETREAT_LAND)
#: Between arcs the wrist waits this far back from the middle of the arc, m.
READY_BACK = 0.06
#: A leg at constant speed takes up its speed in this time, s.
SMOOTH_START = 1.0
#: From this height above the standing height on, the vehicle descends at constant speed, m; the reference goes on
#: below the ground by as much again, so that the skids are found wherever they are.
LAST_DESCENT = 0.35
#: The advance goes on this far past the overtravel that ends it, m.
BEYOND = 0.02
#: Contact that is lost is looked for from no farther ahead of the vehicle, m.
NOT_FAR = 0.03
#: The contact is felt, or is not, over this time, s.
FELT_OVER = 0.1
#: An estimate this long (s) after the retreat has begun tells whether there is contact.
SHORTEST_EASE = 0.05
#: Touched down: the reference is this far below the vehicle (m), which sinks no faster than this (m/s).
SUNK, SINKING = 0.06, 0.05


class Params(Struct, frozen=True, forbid_unknown_fields=True):
    """When a motion counts as done, and the tools' angles."""

    settle_time: Annotated[float, spec("s", 0.0, 10.0, "time within the tolerances that ends a motion")] = 0.5
    settle_position: Annotated[float, spec("m", 0.002, 0.5, "tolerance of the base's position")] = 0.04
    settle_yaw: Annotated[float, spec("rad", 0.005, 0.5, "tolerance of the yaw")] = 0.035
    tare_settle: Annotated[float, spec("s", 0.0, 20.0, "rest before the tare")] = 2.0
    tare_time: Annotated[float, spec("s", 0.5, 30.0, "time the tare is averaged over")] = 3.0
    force_down: Annotated[
        float, spec("s", 0.2, 10.0, "time in which the force is taken back before a retreat", in_flight=False)
    ] = 1.0
    pull_back: Annotated[
        float, spec("N", 0.0, 2.0, "pull with which the tip comes free, after the force is back", in_flight=False)
    ] = 0.3
    release_hold: Annotated[float, spec("s", 0.0, 10.0, "time at the bias after the gripper has opened")] = 1.0
    gripper_closed: Annotated[
        float, spec("rad", -3.14, 3.14, "gripper servo angle that holds the sleeve", in_flight=False)
    ] = 0.0
    gripper_open: Annotated[float, spec("rad", -3.14, 3.14, "gripper servo angle that lets it go", in_flight=False)] = (
        1.0
    )
    seek_time: Annotated[
        float,
        spec(
            "s", 0.0, 10.0, "contact lost in the press: looked for at once and for so long; 0: never", in_flight=False
        ),
    ] = 0.0
    seek_speed: Annotated[float, spec("m/s", 0.002, 0.1, "speed with which it is looked for")] = 0.03
    astray: Annotated[float, spec("m", 0.002, 0.2, "needle on its path: dispensing goes on after silent servos")] = 0.03
    stop_acceleration: Annotated[float, spec("m/s^2", 0.1, 3.0, "mean deceleration of a broken-off motion")] = 0.5


class State(Struct, frozen=True, gc=False):
    """The plan in force and how far along it the reference is."""

    phase: Phase
    legs: tuple[Leg, ...]
    index: int
    time: float
    """Time in the leg, s."""
    start: Eight
    start_rate: Eight
    start_acceleration: Eight
    """Where the leg began; the rates are None-like zeros for a leg that began at rest."""
    moving: bool
    """The leg began in motion."""
    at: Eight
    rate: Eight
    acceleration: Eight
    home: Eight
    settled: float
    """Time within the tolerances since the last leg ended, s."""
    clock: float
    """Time since the last leg of the phase ended, or since a tare was begun after it, s."""
    lift: float
    press_time: float
    """Time since the trigger, s."""
    press_start: float
    """Estimated force at the trigger, N."""
    force: float
    easing: float
    """Time since the force is being taken back for a retreat, s; negative when it is not."""
    admittance: admittance.State
    released_for: float
    """Time since the gripper was seen open, s."""
    tare: bool = False
    """Hovering, a tare was asked for."""
    along: float = 0.0
    """So much farther along the contact normal is the pipe than the mission believes, m."""
    felt: bool = False
    """It was found by touch."""
    seeking: float = -1.0
    """Pressing: time since contact was lost and is being looked for, s; negative when it is not."""
    held: bool = False
    """Pressing: the set force has been held for its time."""
    spare: float = -1.0
    """So much more than contact must have is felt, in the mean over ``FELT_OVER``, N; negative: no contact is felt."""
    waiting: bool = False
    """Dispensing waits: the servos were not heard, and the needle is not back on its path."""


class Progress(Struct, frozen=True, gc=False):
    """What mission and observer need to know of the reference."""

    arrived: bool = False
    pressed: bool = False
    """The force profile has ended, and contact is felt."""
    released: bool = False
    tare_begun: bool = False
    """The readings from now on are to become one tare: those that are made while ``taring``."""
    taring: bool = False
    tared: bool = False
    grounded: bool = False
    """Landing: the motors have been spooled down."""
    feeling: bool = False
    """The tip moves on until it touches the pipe, wherever that is."""
    missed: bool = False
    """It has come to the end of its way without a touch."""
    along: float = 0.0
    """So much farther along the contact normal is the pipe than the mission believes, m."""
    lost: bool = True
    """Contact that is lost is lost for good: it is not, or no longer, looked for."""


def initial() -> State:
    """Before the first sample: nothing is followed."""
    return State(
        phase=Phase.STOPPED, legs=(), index=0, time=0.0, start=ZERO, start_rate=ZERO, start_acceleration=ZERO,
        moving=False, at=ZERO, rate=ZERO, acceleration=ZERO, home=ZERO, settled=0.0, clock=0.0, lift=0.0,
        press_time=0.0, press_start=0.0, force=0.0, easing=-1.0, admittance=admittance.State(), released_for=0.0,
    )  # fmt: skip


def measured(estimate: Estimate, pump: float, vehicle: Vehicle) -> Eight:
    """Where the vehicle is, in the coordinates of a leg."""
    mount = vehicle.arm.mount
    pitch = estimate.rpy[1]
    wx, wz = kinematics.wrist(vehicle.arm, estimate.joints[0], estimate.joints[1])
    bx, bz = wx + mount[0], wz + mount[2]
    c, s = cos(pitch), sin(pitch)
    x, y, z = estimate.p_WB
    return (
        x, y, z, estimate.rpy[2],
        c * bx + s * bz - mount[0], -s * bx + c * bz - mount[2], estimate.joints[2] - pitch, pump,
    )  # fmt: skip


def step(
    state: State,
    estimate: Estimate,
    phase: Phase,
    tare: bool,
    engaged: bool,
    pump: float,
    derived: Derived,
    params: AllParams,
    dt: float,
) -> tuple[State, Reference, Progress]:
    """One tick of the reference.

    tare: hovering, a tare was asked for; engaged: the autopilot follows our set-points; pump: measured angle of the
    pump servo, rad.
    """
    own, site = params.guidance, plan.found(derived.site, state.along)
    if not estimate.valid:
        return state, _reference(state, params, 0.0, 0.0, False), Progress()
    if phase is not state.phase:
        state = _enter(state, phase, estimate, pump, derived, params)
        site = plan.found(derived.site, state.along)
    if phase in STANDING:
        here: Eight = (*measured(estimate, pump, params.vehicle)[:4], *state.at[4:])
        state = replace(state, at=here, home=here)
        return state, _reference(state, params, 0.0, 0.0, False), Progress()

    lift, easing, clock, settled = state.lift, state.easing, state.clock, state.settled
    if tare and not state.tare:
        clock = 0.0
    if phase is Phase.TAKEOFF:
        if engaged and lift < 1.0:
            lift = min(1.0, lift + dt / params.plan.spool)
        paused = lift < 1.0
    else:
        paused = False
    if phase is Phase.LAND and _touched_down(state, estimate):
        lift = max(0.0, lift - dt / params.plan.spool)

    seeking, spare = state.seeking, _spare(state.spare, estimate, params, dt)
    sought = phase is Phase.PRESS or (phase is Phase.RELEASE and (estimate.payload or seeking >= 0.0))
    if sought and own.seek_time > 0.0:
        if seeking >= 0.0:
            seeking += dt
            if estimate.in_contact:
                found = _ahead_measured(state.at, estimate, site)
                state, seeking = _press(state, found, estimate, derived, params), -1.0
        elif not estimate.in_contact:
            state, seeking = _seek(state, estimate, site, params), 0.0
    else:
        seeking = -1.0
    leg = state.legs[state.index] if state.index < len(state.legs) else None
    if leg is not None and leg.feeling and estimate.in_contact:
        state = replace(
            _start_from(state, _base_measured(state.at, estimate)), along=_along(estimate, derived), felt=True
        )
        site = plan.found(derived.site, state.along)
        state = replace(state, legs=_plan(phase, state, site, params))

    force, ahead, pressing, pressed = 0.0, 0.0, phase in PRESSING and seeking < 0.0, False
    press_time, lead = state.press_time, params.force_profile.lead
    if phase is Phase.PRESS and seeking < 0.0:
        press_time += dt
        force, pressed = _profile(press_time, state, params)
        ahead, _ = _profile(press_time + lead, state, params)
    elif phase is Phase.RELEASE and seeking < 0.0:
        # as the sleeve's mass goes the tip springs off: whoever went on pressing then would strike the sleeve with it
        held = estimate.payload or estimate.contact_force >= params.contact.lost_force
        force = ahead = params.force_profile.bias if held else -own.pull_back
    elif easing >= 0.0:
        easing += dt
        # without contact there is no force to take back: what is left of it would push the vehicle into the pipe
        into_nothing = (
            easing > SHORTEST_EASE
            and state.force > params.force_profile.bias
            and estimate.contact_force < params.contact.lost_force
        )
        if easing < own.force_down and not into_nothing:
            pressing, paused = True, True
            force, ahead = _taken_back(easing, state, own), _taken_back(easing + lead, state, own)
        else:
            state = replace(_start_from(state, _base_measured(state.at, estimate)), press_start=0.0)
            # the vehicle is on its way already: the retreat goes on from the speed with which it leaves the pipe
            (nx, ny), (vx, vy, _) = site.normal, estimate.v_WB
            away = min(0.0, max(-params.plan.near_speed, vx * nx + vy * ny))
            leaving = (away * nx, away * ny, *ZERO[2:])
            state = replace(state, start_rate=leaving, moving=True, legs=_plan(phase, state, site, params))
            easing = -1.0

    ended = state.index >= len(state.legs)
    # servos that were not heard may have let go, and the arm hangs: adhesive would land beside the crack
    unheard = estimate.age_servos > params.safety.servos_late
    waiting = leg is not None and leg.pumping and (unheard or (state.waiting and _astray(state, estimate, params)))
    if waiting:
        paused, state = True, replace(state, rate=ZERO, acceleration=ZERO)
    if not ended and not paused:
        state = _follow(state, site, params, dt)
        ended = state.index >= len(state.legs)
    if ended and easing < 0.0:
        clock += dt
        near = _near(state, estimate, own)
        settled = settled + dt if near else 0.0
    released_for = state.released_for
    if phase is Phase.RELEASE and not estimate.payload:
        released_for += dt

    compliant, acceleration = state.admittance, 0.0
    if pressing:
        wanted = fuzzy.evaluate(force - estimate.contact_force, max(0.0, estimate.rpy[1]), params.fuzzy)
        compliant, acceleration = admittance.step(compliant, wanted, params.admittance, dt)
    state = State(
        phase, state.legs, state.index, state.time, state.start, state.start_rate, state.start_acceleration,
        state.moving,
        state.at, state.rate, state.acceleration, state.home, settled, clock, lift, press_time, state.press_start,
        force, easing, compliant, released_for, tare, state.along, state.felt, seeking, state.held, spare,
        waiting,
    )  # fmt: skip
    arrived = ended and easing < 0.0 and settled >= own.settle_time and lift >= 1.0
    tare_begun = tare or phase is Phase.TARE
    taring = tare_begun and arrived and clock >= own.tare_settle
    tared = taring and clock >= own.tare_settle + own.tare_time
    leg = state.legs[state.index] if not ended else None
    if leg is not None and leg.taring:
        tare_begun, taring = True, state.time >= own.tare_settle
        tared = state.time + dt >= leg.duration
    progress = Progress(
        arrived,
        pressed and spare >= 0.0,
        released_for >= own.release_hold,
        tare_begun,
        taring,
        tared,
        phase is Phase.LAND and lift <= 0.0,
        leg is not None and leg.feeling,
        ended and bool(state.legs) and state.legs[-1].feeling,
        state.along,
        own.seek_time <= 0.0 or seeking > own.seek_time,
    )
    return state, _reference(state, params, acceleration, ahead, pressing), progress


def _astray(state: State, estimate: Estimate, params: AllParams) -> bool:
    """The needle is off its path, in the plane of the arm: across it the arm cannot help."""
    x, y, z, _, wx, wz, elevation, _ = (
        a - b for a, b in zip(measured(estimate, 0.0, params.vehicle), state.at, strict=True)
    )
    ahead = x * cos(state.at[3]) + y * sin(state.at[3])
    return hypot(ahead + wx, z + wz) + params.vehicle.arm.needle * abs(elevation) > params.guidance.astray


def _spare(before: float, estimate: Estimate, params: AllParams, dt: float) -> float:
    """How much more than the contact trigger wants is felt, in the mean, N."""
    own = params.contact
    spare = estimate.contact_force - own.threshold
    if own.felt > 0.0:
        spare = min(spare, estimate.forces.felt - own.felt)
    return before + (spare - before) * dt / (FELT_OVER + dt)


def _profile(t: float, state: State, params: AllParams) -> tuple[float, bool]:
    repair = params.repair
    if state.held:
        return force_profile.settled(t, state.press_start, params.force_profile)
    return force_profile.desired_force(t, state.press_start, repair.force, repair.hold, params.force_profile)


def _taken_back(t: float, state: State, params: Params) -> float:
    return state.press_start - (state.press_start + params.pull_back) * force_profile.quintic(t / params.force_down)


def _reference(state: State, params: AllParams, compliant: float, force_ahead: float, pressing: bool) -> Reference:
    x, y, z, yaw, wx, wz, elevation, pump = state.at
    vx, vy, vz, yaw_rate, vwx, vwz, elevation_rate, _ = state.rate
    ax, ay, az, yaw_acceleration, _, _, _, _ = state.acceleration
    offset = state.admittance
    if pressing:
        nx, ny = cos(yaw), sin(yaw)
        x, y = x + offset.displacement * nx, y + offset.displacement * ny
        vx, vy = vx + offset.velocity * nx, vy + offset.velocity * ny
        ax, ay = ax + compliant * nx, ay + compliant * ny
    own = params.guidance
    # only a pipe that is felt is given the sleeve
    open_gripper = (state.phase is Phase.RELEASE and state.spare >= 0.0) or state.released_for > 0.0
    leg = state.legs[state.index] if state.index < len(state.legs) else None
    return Reference(
        (x, y, z), (vx, vy, vz), (ax, ay, az), yaw, yaw_rate, yaw_acceleration, (wx, wz), (vwx, vwz), elevation,
        elevation_rate, pump, own.gripper_open if open_gripper else own.gripper_closed, state.lift, state.force,
        force_ahead, pressing,
        leg is not None and leg.pumping and not state.waiting, state.phase in AT_THE_PIPE, compliant, offset.velocity,
        offset.displacement,
    )  # fmt: skip


def _enter(state: State, phase: Phase, estimate: Estimate, pump: float, derived: Derived, params: AllParams) -> State:
    """The state with the plan of ``phase``, begun where the reference is."""
    before, site = state.phase, plan.found(derived.site, state.along)
    if phase in STANDING:
        # nothing of the last flight is left but the gripper, which stays open until the next preflight
        released_for = state.released_for if phase is Phase.STOPPED else 0.0
        here = measured(estimate, pump, params.vehicle)
        return replace(initial(), phase=phase, at=here, home=here, released_for=released_for)
    if before in STANDING:
        state = _start_from(state, measured(estimate, pump, params.vehicle))
    force = state.force
    easing = -1.0
    if phase is Phase.PRESS:
        state = _press(state, _base_measured(state.at, estimate), estimate, derived, params)
        state = replace(state, held=False)
        force = state.press_start
    elif phase is not Phase.RELEASE:
        if phase in BACKING_OUT and state.easing >= 0.0:
            easing = state.easing  # one retreat turns into another: the force goes on being taken back
        elif phase in BACKING_OUT and before in PRESSING:
            easing = 0.0
            state = replace(state, press_start=force)
        elif before in PRESSING or state.easing >= 0.0:
            state = _start_from(state, _base_measured(state.at, estimate))
            state = replace(state, admittance=admittance.State())
    state = replace(state, phase=phase, force=force, easing=easing, settled=0.0, clock=0.0)
    if phase is Phase.RELEASE or easing >= 0.0:
        return replace(state, legs=(), index=0, time=0.0)
    stop = _stop_time(state, params)
    if phase is Phase.HOLD and state.index < len(state.legs):
        leg = state.legs[state.index]
        if not leg.uniform and leg.duration - state.time <= stop:
            return replace(state, legs=(leg,), index=0)  # it comes to rest sooner, and nearer, than it could be stopped
    state = replace(
        state, start=state.at, start_rate=state.rate, start_acceleration=state.acceleration, moving=any(state.rate),
        index=0, time=0.0,
    )  # fmt: skip
    legs = _plan(phase, state, site, params)
    if state.moving and legs and legs[0].duration < stop:
        legs = (replace(legs[0], duration=stop), *legs[1:])  # a short leg must not make the way out of motion hard
    return replace(state, legs=legs)


def _press(state: State, at: Eight, estimate: Estimate, derived: Derived, params: AllParams) -> State:
    """The state with the force loop closed at ``at``, where contact was felt.

    The profile begins anew, but a force that has been held once is not held again.
    """
    # the translation law pushes as it did at the trigger: with what it feeds forward, and an offset for the rest
    push = min(max(0.0, estimate.contact_force), params.repair.force)
    lead = (1.0 - params.backstepping.feed_forward) * push / derived.normal_stiffness
    n = derived.site.normal
    state = _start_from(state, (at[0] + lead * n[0], at[1] + lead * n[1], *at[2:]))
    along = _along(estimate, derived) if params.plan.feel else state.along
    held = state.held or state.press_time >= force_profile.held_at(params.repair.hold, params.force_profile)
    return replace(
        state, legs=(), press_time=0.0, press_start=push, admittance=admittance.State(), along=along, held=held
    )


def _seek(state: State, estimate: Estimate, site: Site, params: AllParams) -> State:
    """The state with the tip on its way back to the pipe, which is where it was felt last."""
    tip, (nx, ny), at = estimate.tip_W, site.normal, _ahead_measured(state.at, estimate, site)
    gap = min(NOT_FAR, max(0.0, (site.crack[0] - tip[0]) * nx + (site.crack[1] - tip[1]) * ny))
    state = _start_from(state, (at[0] + gap * nx, at[1] + gap * ny, *at[2:]))
    speed = params.guidance.seek_speed
    way = speed * (params.guidance.seek_time + SMOOTH_START)
    aside = (site.crack[0] - at[0]) * -ny + (site.crack[1] - at[1]) * nx  # back to the crack's middle
    leg = _uniform(state.at, (way * nx, way * ny, 0.0), speed)
    x, y, *rest = leg.target
    return replace(state, legs=(replace(leg, target=(x - aside * ny, y + aside * nx, *rest)),))


def _along(estimate: Estimate, derived: Derived) -> float:
    """How far the tip is beyond the crack that the mission believes, along the contact normal, m."""
    tip, crack, n = estimate.tip_W, derived.site.crack, derived.site.normal
    return (tip[0] - crack[0]) * n[0] + (tip[1] - crack[1]) * n[1]


def _stop_time(state: State, params: AllParams) -> float:
    """Time in which a motion is broken off, s."""
    vx, vy, vz = state.rate[:3]
    return max(1.0, 2.0 * hypot(vx, vy, vz) / params.guidance.stop_acceleration)


def _start_from(state: State, at: Eight) -> State:
    """The state at rest at ``at``."""
    return replace(
        state, at=at, rate=ZERO, acceleration=ZERO, start=at, start_rate=ZERO, start_acceleration=ZERO, moving=False,
        index=0, time=0.0, admittance=admittance.State(),
    )  # fmt: skip


def _base_measured(at: Eight, estimate: Estimate) -> Eight:
    """``at`` with the horizontal position of the base as measured: where contact has put it."""
    return (estimate.p_WB[0], estimate.p_WB[1], *at[2:])


def _ahead_measured(at: Eight, estimate: Estimate, site: Site) -> Eight:
    """``at`` with the base as far towards the pipe as measured; along the pipe it is not given up what was held."""
    (nx, ny), p = site.normal, estimate.p_WB
    ahead = (p[0] - at[0]) * nx + (p[1] - at[1]) * ny
    return (at[0] + ahead * nx, at[1] + ahead * ny, *at[2:])


def _plan(phase: Phase, state: State, site: Site, params: AllParams) -> tuple[Leg, ...]:
    """Legs of one phase from where the reference is."""
    p, at = params.plan, state.at
    path = Path(at, p)
    n = site.normal
    ready = (p.needle_reach - READY_BACK, 0.0, -0.5 * pi)
    if phase is Phase.TAKEOFF:
        path.to(base=(at[0], at[1], state.home[2] + p.takeoff_height))
    elif phase is Phase.APPROACH:
        for point in plan.route(at, plan.beside(site, site.far), params.pipe, site, p):
            path.to(base=point, arm=ready)
    elif phase is Phase.ALIGN:
        if p.feel and not state.felt:
            _feel(path, site, params)
        else:
            if p.feel:  # back from the pipe first, to where the arm may move
                path.to(base=plan.beside(site, site.near - p.gap + p.feel_room), slow=True)
            _arm_first(path, ready, plan.beside(site, site.needle))
            path.to(yaw=site.yaw).to(base=plan.beside(site, site.needle), slow=True)
    elif phase is Phase.ADHESIVE:
        if at[:3] != plan.beside(site, site.needle):
            _arm_first(path, ready, plan.beside(site, site.needle))
            path.to(yaw=site.yaw).to(base=plan.beside(site, site.needle), slow=True)
        _adhesive(path, site, params)
    elif phase is Phase.TOOL_CHANGE:
        _arm_first(path, ready, plan.beside(site, site.near))
        path.to(base=plan.beside(site, site.near), yaw=site.yaw, slow=True).to(arm=(p.press_reach, 0.0, 0.0))
    elif phase is Phase.TARE:
        _arm_first(path, (p.press_reach, 0.0, 0.0), plan.beside(site, site.near))
        path.to(base=plan.beside(site, site.near), yaw=site.yaw, arm=(p.press_reach, 0.0, 0.0), slow=True)
    elif phase is Phase.ADVANCE:
        way = p.gap + p.overtravel + BEYOND
        path.add(_uniform(at, (way * n[0], way * n[1], 0.0), p.advance_speed))
    elif phase in BACKING_OUT:
        path.to(base=(at[0] - p.retreat * n[0], at[1] - p.retreat * n[1], at[2]), slow=True)
    elif phase is Phase.RETURN:
        home = (state.home[0], state.home[1], state.home[2] + p.takeoff_height)
        for point in plan.route(at, home, params.pipe, site, p):
            path.to(base=point, arm=(*p.fold, 0.0))
        path.to(yaw=state.home[3])
    elif phase is Phase.LAND:
        ground = state.home[2]
        path.to(base=(at[0], at[1], min(at[2], ground + LAST_DESCENT)), arm=(*p.fold, 0.0))
        path.add(_uniform(path.at, (0.0, 0.0, -2.0 * LAST_DESCENT), p.descent_speed))
    elif phase is Phase.HOLD:
        time = _stop_time(state, params)
        target = tuple(a + 0.5 * time * v for a, v in zip(at, state.rate, strict=True))
        path.add(Leg(target, time))  # type: ignore[arg-type]
    return path.legs


def _arm_first(path: Path, arm: tuple[float, float, float], base: Vec3) -> None:
    """Away from ``base``, beside the pipe, bring the arm into the pose in which it may come there."""
    if path.at[:3] != base and path.at[4:7] != arm:
        path.to(arm=arm)


def _feel(path: Path, site: Site, params: AllParams) -> None:
    """To the pipe with the gripper ahead; at rest before it the observers are tared, then on until it is felt."""
    p, own = params.plan, params.guidance
    room = plan.beside(site, site.near - p.gap + p.feel_room)
    path.to(yaw=site.yaw, arm=(p.press_reach, 0.0, 0.0)).to(base=room, slow=True)
    path.add(Leg(path.at, own.tare_settle + own.tare_time, taring=True))
    way, n = p.feel_room + p.feel_reach, site.normal
    leg = _uniform(path.at, (way * n[0], way * n[1], 0.0), p.feel_speed)
    path.add(replace(leg, feeling=True))


def _adhesive(path: Path, site: Site, params: AllParams) -> None:
    """Off the pipe, around it at a distance to one end of the arc, in, along the arc with the pump, out, and back."""
    p = params.plan
    needle = params.pipe.radius + p.needle_gap
    clear = needle + p.needle_clear
    first, last = site.arc

    def sweep(begin: float, end: float, radius: float, speed: float, pump: float) -> None:
        wx, wz, elevation = plan.wrist_on_arc(end, radius, params.pipe.radius, params.vehicle, p)
        at = path.at
        length = abs(end - begin) * (radius + params.vehicle.arm.needle)
        time = plan.duration(length, speed, 0.2, 0.6)
        path.add(Leg((*at[:4], wx, wz, elevation, at[7] + pump), time, arc=(begin, end, radius), pumping=pump != 0.0))

    def to(angle: float, radius: float) -> None:
        path.to(arm=plan.wrist_on_arc(angle, radius, params.pipe.radius, params.vehicle, p), slow=True)

    begin = min(last, max(first, -path.at[6] - 0.5 * pi))  # at rest anywhere on the arc, the needle is lifted off there
    to(begin, clear)
    sweep(begin, first, clear, 2.0 * p.arm_speed, 0.0)
    to(first, needle)
    scale = (needle + params.vehicle.arm.needle) / needle
    sweep(first, last, needle, p.needle_speed * scale, p.pump_ratio * needle * (last - first))
    to(last, clear)
    sweep(last, 0.0, clear, 2.0 * p.arm_speed, 0.0)
    path.to(arm=(p.needle_reach - READY_BACK, 0.0, -0.5 * pi))


def _uniform(at: Eight, way: tuple[float, float, float], speed: float) -> Leg:
    target = (at[0] + way[0], at[1] + way[1], at[2] + way[2], *at[3:])
    return Leg(target, hypot(*way) / speed + 0.5 * SMOOTH_START, uniform=True)


def _follow(state: State, site: Site, params: AllParams, dt: float) -> State:
    """Advance along the plan by dt."""
    leg = state.legs[state.index]
    time = state.time + dt
    total = leg.duration
    if time >= total:
        return replace(
            state, index=state.index + 1, time=0.0, at=leg.target, rate=ZERO, acceleration=ZERO, start=leg.target,
            start_rate=ZERO, start_acceleration=ZERO, moving=False,
        )  # fmt: skip
    u = time / total
    if leg.uniform:
        part = min(1.0, time / SMOOTH_START)
        speed = 1.0 / (total - 0.5 * SMOOTH_START)
        s = speed * (SMOOTH_START * part**4 * (2.5 + part * (part - 3.0)) + max(0.0, time - SMOOTH_START))
        ds = speed * force_profile.quintic(part)
        dds = speed * 30.0 * (part * (1.0 - part)) ** 2 / SMOOTH_START
    else:
        v = u * (1.0 - u)
        s = u * u * u * (10.0 + u * (6.0 * u - 15.0))
        ds = 30.0 * v * v / total
        dds = 60.0 * v * (1.0 - 2.0 * u) / (total * total)
    a, b = state.start, leg.target
    d0, d1, d2, d3, d4, d5, d6, d7 = (
        b[0] - a[0], b[1] - a[1], b[2] - a[2], b[3] - a[3], b[4] - a[4], b[5] - a[5], b[6] - a[6], b[7] - a[7]
    )  # fmt: skip
    at: Eight = (
        a[0] + d0 * s, a[1] + d1 * s, a[2] + d2 * s, a[3] + d3 * s,
        a[4] + d4 * s, a[5] + d5 * s, a[6] + d6 * s, a[7] + d7 * s,
    )  # fmt: skip
    rate: Eight = (d0 * ds, d1 * ds, d2 * ds, d3 * ds, d4 * ds, d5 * ds, d6 * ds, d7 * ds)
    acceleration: Eight = (d0 * dds, d1 * dds, d2 * dds, d3 * dds, d4 * dds, d5 * dds, d6 * dds, d7 * dds)
    if leg.arc is not None:
        begin, end, radius = leg.arc
        angle, angle_rate = begin + (end - begin) * s, (end - begin) * ds
        wx, wz, elevation = plan.wrist_on_arc(angle, radius, params.pipe.radius, params.vehicle, params.plan)
        rho = radius + params.vehicle.arm.needle
        at = (*at[:4], wx, wz, elevation, at[7])
        rate = (*rate[:4], rho * sin(angle) * angle_rate, rho * cos(angle) * angle_rate, -angle_rate, rate[7])
    if state.moving:
        at, rate, acceleration = _with_start_motion(state, at, rate, acceleration, u, total)
    return replace(state, time=time, at=at, rate=rate, acceleration=acceleration)


def _with_start_motion(
    state: State, at: Eight, rate: Eight, acceleration: Eight, u: float, total: float
) -> tuple[Eight, Eight, Eight]:
    """Add what the velocity and acceleration at the start of the leg contribute; both fade out to its end."""
    u2 = u * u
    u3 = u2 * u
    h = total * (u - 6.0 * u3 + 8.0 * u2 * u2 - 3.0 * u2 * u3)
    dh = 1.0 - 18.0 * u2 + 32.0 * u3 - 15.0 * u2 * u2
    ddh = (-36.0 * u + 96.0 * u2 - 60.0 * u3) / total
    k = 0.5 * total * total * (u2 - 3.0 * u3 + 3.0 * u2 * u2 - u2 * u3)
    dk = 0.5 * total * (2.0 * u - 9.0 * u2 + 12.0 * u3 - 5.0 * u2 * u2)
    ddk = 0.5 * (2.0 - 18.0 * u + 36.0 * u2 - 20.0 * u3)
    v, a = state.start_rate, state.start_acceleration

    def plus(values: Eight, of_rate: float, of_acceleration: float) -> Eight:
        return tuple(x + of_rate * y + of_acceleration * z for x, y, z in zip(values, v, a, strict=True))  # type: ignore[return-value]

    return plus(at, h, k), plus(rate, dh, dk), plus(acceleration, ddh, ddk)


def _near(state: State, estimate: Estimate, params: Params) -> bool:
    p = estimate.p_WB
    x, y, z = p[0] - state.at[0], p[1] - state.at[1], p[2] - state.at[2]
    return (
        sqrt(x * x + y * y + z * z) < params.settle_position
        and abs(wrap_angle(estimate.rpy[2] - state.at[3])) < params.settle_yaw
    )


def _touched_down(state: State, estimate: Estimate) -> bool:
    """The reference has gone into the ground and well below the vehicle, which no longer sinks: it stands.

    Or it is being spooled down already. Above the ground a gust can lift it as far, and hold it there for a moment.
    """
    sunk = state.at[2] < state.home[2] and estimate.p_WB[2] - state.at[2] > SUNK
    return state.lift < 1.0 or (sunk and abs(estimate.v_WB[2]) < SINKING)
