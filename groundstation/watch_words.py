"""What the screen of ``pipewright watch`` says: lines of words with a tone, made from a ``View``. Knows no toolkit.

A tone is never the only sign: what is bad is also said, what is old also has its age, so that it reads without colours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from drivers.samples import SERVO_NAMES
from groundstation.watch_marks import (
    Line,
    Span,
    Tone,
    ago,
    bar,
    cut,
    duration,
    faded,
    length,
    number,
    plot,
    within,
    wrapped,
)
from groundstation.watch_model import SILENT, Link, View, clearance
from groundstation.watch_orders import Order
from onboard.messages import Action, Phase, Severity
from onboard.wire import Outcome

P, T = Phase, Tone

#: A sample of a device is old after this time, s.
OLD: Final = 0.5
#: Below this width the head line says less.
_ROOMY: Final = 40
#: Tip and pipe touch within this distance, m; for the word alone.
_NEAR: Final = 0.001
_PHASES: Final = {
    P.PREFLIGHT: "on the ground",
    P.TAKEOFF: "taking off",
    P.APPROACH: "flying to the pipe",
    P.ALIGN: "lining up with the pipe",
    P.ADHESIVE: "putting adhesive round the crack",
    P.TOOL_CHANGE: "turning the tool",
    P.TARE: "taking the force for zero",
    P.ADVANCE: "closing in on the pipe",
    P.PRESS: "pressing the sleeve on",
    P.RELEASE: "letting the sleeve go",
    P.RETREAT: "backing off from the pipe",
    P.RETURN: "flying home",
    P.LAND: "landing",
    P.HOLD: "hovering",
    P.RETREAT_HOLD: "backing off, then hovering",
    P.RETREAT_LAND: "backing off, then landing",
    P.STOPPED: "motors off",
}
_CONFIDENCE: Final = (("failed", T.BAD), ("low", T.WARN), ("medium", T.PLAIN), ("high", T.PLAIN))
_MARKS: Final = {Severity.INFO: ("·", T.PLAIN), Severity.WARNING: ("▲", T.WARN), Severity.ERROR: ("✗", T.BAD)}
_KEYS: Final = (
    ("h", "hold"), ("r", "retreat"), ("s", "stop"), ("k k", "KILL"), ("l", "land"), ("u", "resume"), ("q", "quit"),
)  # fmt: skip


# --- the parts of the screen, from above ------------------------------------------------------------------------------


def head(view: View, vehicle: str, width: int) -> Line:
    """Vehicle, phase and its clock; on the right whether it is live."""
    if view.tick is None:
        phase: Line = (("no tick yet", T.LABEL),)
    else:
        outputs = view.tick.outputs
        name, words = outputs.phase.replace("_", " ").upper(), _PHASES.get(outputs.phase, "")
        phase = ((f"{name}  {outputs.phase_time:.1f} s", T.STRONG), (f"  {words}", T.PLAIN))
        phase = faded(phase) if view.stale else phase
    roomy = width >= _ROOMY
    left: Line = ((f" {vehicle}  " if roomy else " ", T.LABEL), *phase)
    if view.tick is None:
        right: Span = ("", T.PLAIN)
    elif view.stale:
        right = (f"○ {ago(view.age)} ", T.STALE)
    else:
        right = (f"● {'live, ' if roomy else ''}{within(view.age)} ", T.GOOD)
    left = cut(left, width - len(right[0]) - 1)
    return (*left, (" " * (width - length(left) - len(right[0])), T.PLAIN), right)


def alarm(view: View) -> tuple[str, ...]:
    """What must not be overlooked about the link and the loop, a headline first; empty: nothing."""
    alone = "By itself it is to hold, then to retreat and to land."
    match view.link:
        case Link.LOST:
            how = "" if view.contact.present else ", and it is not connected"
            return (
                f"LINK LOST  nothing heard for {duration(view.silent)}{how}",
                f"What is shown is old. {alone if view.flying else 'Is it on, and within reach?'}",
            )
        case Link.DEAF:
            since = "" if math.isinf(view.unheard) else f" for {duration(view.unheard)}"
            return (f"THE VEHICLE DOES NOT HEAR US{since}", f"Orders may not reach it. {alone if view.flying else ''}")
    if view.idle:
        return (
            f"THE VEHICLE'S LOOP STANDS STILL  no tick for {duration(view.idle)}",
            "Its autopilot is to hold or land by itself. Kill acts without the loop.",
        )
    slow = "SLOW LINK" if view.link is Link.SLOW else "OLD PICTURE" if view.tick is not None and view.stale else ""
    return (f"{slow}  what is shown may be {duration(max(view.age, view.contact.age))} old",) if slow else ()


def loud(sentences: Sequence[str], width: int) -> tuple[Line, ...]:
    """Sentences as lines of a loud box, which has its own colours."""
    return tuple(((line, T.LOUD),) for text in sentences for line in wrapped(text, width, 3))


def verdict(view: View, width: int) -> tuple[Line, ...]:
    """What safety says, in words; two lines at most."""
    if view.tick is None:
        return ((("The vehicle has not ticked yet: it waits for its devices.", T.LABEL),),)
    said = view.tick.outputs.verdict
    if said.action is Action.NONE:
        lines: tuple[Line, ...] = ((("✓ all is well", T.GOOD),),)
    else:
        tone = T.WARN if said.action is Action.WARN else T.BAD
        first, *more = said.reasons or ("",)
        words = f"▲ {said.action.name}  {_sentence(view, first)}"
        if more:
            words += f" Also: {', '.join(code.replace('_', ' ') for code in more)}."
        lines = tuple(((line, tone),) for line in wrapped(words, width, 2))
    return tuple(faded(line) for line in lines) if view.stale else lines


def force(view: View, width: int) -> tuple[Line, ...]:
    """Estimated and desired force as numbers and as a bar with a mark."""
    if view.tick is None or not view.trend:
        return ((("no tick yet", T.LABEL),),)
    outputs = view.tick.outputs
    desired, estimated = outputs.reference.force, outputs.estimate.contact_force
    touching = "in contact" if outputs.estimate.in_contact else "free"
    numbers: Line = (
        (f"{number(estimated, 'z.2f')} N", T.ESTIMATED),
        (" of ", T.LABEL),
        (f"{desired:.2f} N", T.DESIRED),
        (f" desired   {touching}", T.LABEL),
    )
    lines = (numbers, bar(desired, estimated, view.scale, width))
    return tuple(faded(line) for line in lines) if view.stale else lines


def trend(view: View, seconds: float, columns: int, rows: int) -> tuple[Line, ...]:
    """The force of the last ``seconds`` up to now: blocks are estimated, the line is desired, what is missing empty."""
    lines = plot(view.trend, view.scale, view.now_ns, seconds, columns, rows)
    return tuple(faded(line) for line in lines) if view.stale else lines


def vehicle(view: View, rows: int) -> tuple[Line, ...]:
    """Attitude, place, and how the devices and the loop do; what matters less only where there is room."""
    if view.tick is None:
        return ()
    inputs, estimate = view.tick.inputs, view.tick.outputs.estimate
    autopilot, odometry = inputs.autopilot, inputs.odometry
    bounds = view.known.safety if view.known is not None else None
    seen, flown = _Device(estimate.age_odometry), _Device(estimate.age_autopilot)
    lines: list[Line] = [
        _row(
            "pitch",
            flown(f"{number(math.degrees(estimate.rpy[1]), '+z.2f')}°"),
            ("   height ", T.LABEL),
            seen(f"{number(estimate.p_WB[2], 'z.2f')} m"),
        ),
        _row("tip", *seen.all(_tip(view))),
    ]
    if odometry is None:
        lines.append(_row("vision", ("nothing yet", T.WARN)))
    else:
        word, tone = _CONFIDENCE[min(max(odometry.confidence, 0), 3)]
        lines.append(_row("vision", seen(f"{word:<9}", tone), ("   ", T.PLAIN), seen.age()))
    if autopilot is None:
        lines += [_row("battery", ("unknown", T.WARN)), _row("autopilot", ("nothing yet", T.WARN))]
    else:
        left, volts = autopilot.battery_remaining, autopilot.battery_voltage
        tone = T.PLAIN
        if bounds is not None:
            low = left < bounds.battery_low or volts < bounds.battery_low_voltage
            critical = left < bounds.battery_critical or volts < bounds.battery_critical_voltage
            tone = T.BAD if critical else T.WARN if low else T.PLAIN
        word = "critical" if tone is T.BAD else "low" if tone is T.WARN else ""
        charge = f"{number(100 * left, 'z.0f')} %   {number(volts, 'z.2f')} V"
        lines.append(_row("battery", flown(charge, tone), flown(f"   {word}", tone)))
        armed = "armed" if autopilot.armed else "disarmed"
        lines.append(_row("autopilot", flown(f"{autopilot.mode}, {armed}"), ("   ", T.PLAIN), flown.age()))
    lines.append(_row("loop", *_loop(view)))
    roll, _, yaw = (number(math.degrees(angle), "+z.2f") for angle in estimate.rpy)
    x, y, _ = (number(p, "+z.2f") for p in estimate.p_WB)
    clipped = ", ".join(name.replace("_", " ") for name in view.tick.outputs.clipped)
    lines += [
        _row("roll", flown(f"{roll}°"), ("   yaw ", T.LABEL), flown(f"{yaw}°")),
        _row("place", seen(f"{x}, {y} m")),
        _row("speed", seen(f"{number(math.hypot(*estimate.v_WB), 'z.2f')} m/s")),
        _row("gate", (f"clips {clipped}", T.WARN) if clipped else ("clips nothing", T.PLAIN)),
        _row("parameters", (f"revision {view.tick.revision}", T.PLAIN)),
    ]
    del lines[rows:]
    return tuple(faded(line) for line in lines) if view.stale else tuple(lines)


def arm(view: View) -> tuple[Line, ...]:
    """The five servos: angle, current, voltage, temperature, trouble."""
    if view.tick is None:
        return ()
    servos = view.tick.inputs.servos
    if servos is None:
        return (_row("servos", ("nothing yet", T.WARN)),)
    device = _Device(view.tick.outputs.estimate.age_servos)
    bounds = view.known.safety if view.known is not None else None
    state = ("no torque", T.BAD) if not servos.torque_on and not device.old else device.age()
    titles = f"{'angle':>7}{'current':>8}{'volt':>6}{'temp':>6}"
    lines: list[Line] = [((f"{state[0]:<8}", state[1]), (titles, T.LABEL))]
    for i, name in enumerate(SERVO_NAMES):
        hot = T.PLAIN
        if bounds is not None and not servos.temperature[i] <= bounds.temperature_warm:
            hot = T.WARN if servos.temperature[i] <= bounds.temperature_hot else T.BAD
        angle = f"{number(math.degrees(servos.position[i]), '+z.1f')}°"
        current, volts = f"{number(servos.current[i], '+z.2f')} A", f"{number(servos.voltage[i], 'z.1f')}"
        error = f" ✗{servos.error[i]:#04x}" if servos.error[i] else " warm" if hot is T.WARN else " hot"
        lines.append(
            (
                (f"{name.replace('theta_', 'theta '):<8}", T.LABEL),
                device(f"{angle:>7}{current:>8}{volts:>6}"),
                device(f"{number(servos.temperature[i], 'z.0f') + '°C':>6}", hot),
                device(error if servos.error[i] or hot is not T.PLAIN else "", T.BAD if servos.error[i] else hot),
            )
        )
    return tuple(faded(line) for line in lines) if view.stale else tuple(lines)


def link(view: View) -> tuple[Line, ...]:
    """Who commands, how old each end's word of the other is, who else is there."""
    contact, pulse = view.contact, view.contact.pulse
    if view.commanding:
        commander: Span = (f"you ({view.station})", T.GOOD)
    elif view.commander:
        commander = (f"{view.commander}, not you", T.PLAIN)
    else:
        commander = ("nobody", T.WARN if view.flying else T.PLAIN)
    lost = view.link is Link.LOST
    missed = contact.missed + (pulse.dropped if pulse is not None else 0)
    names = [heard.name for heard in pulse.stations if heard.present] if pulse is not None else []
    present = ", ".join(
        f"{name} x{names.count(name)}" if names.count(name) > 1 else name for name in sorted(set(names))
    )
    rows = (
        _row("commander", commander),
        _row("stations", (present or "none", T.PLAIN)),
        _row("round trip", (duration(contact.round_trip), T.PLAIN)),
        _row("events", (f"{missed} lost" if missed else "none lost", T.WARN if missed else T.PLAIN)),
    )
    late = T.BAD if lost else T.WARN if contact.age > SILENT else T.PLAIN
    ages = (
        _row("heard", (ago(contact.age), late)),
        _row("hears us", (ago(view.unheard), T.BAD if view.unheard > SILENT else T.PLAIN)),
    )
    who, *others = (faded(row) if lost else row for row in rows)
    return (who, *ages, *others)


def events(view: View, width: int, rows: int) -> tuple[Line, ...]:
    """The newest events with their local time, the newest last, as many as there is room for."""
    lines: list[Line] = []
    for told in reversed(view.events):
        if (room := rows - len(lines)) <= 0:
            break
        mark, tone = _MARKS[told.event.severity]
        stamp = f"{_clock(view, told.event.t_ns)} "
        first, *more = wrapped(f"{mark} {told.event.text}", width - len(stamp), room, "  ")
        lines[:0] = [((stamp, T.LABEL), (first, tone)), *(((" " * len(stamp) + line, tone),) for line in more)]
    return tuple(lines)


def answers(orders: Sequence[Order], now_ns: int, width: int, rows: int) -> tuple[Line, ...]:
    """What became of the newest orders, the newest last."""
    return tuple(cut((_answer(order, now_ns),), width) for order in orders[-rows:])


def keys(width: int) -> Line:
    """What may be pressed."""
    gap = "  " if width >= sum(len(key) + len(word) + 3 for key, word in _KEYS) else " "
    spans: list[Span] = []
    for key, word in _KEYS:
        spans += [(f"{gap if spans else ' '}{key} ", T.STRONG), (word, T.BAD if word.isupper() else T.PLAIN)]
    return cut(tuple(spans), width)


# --- words and marks --------------------------------------------------------------------------------------------------


class _Device:
    """Says values of one device: as they are while its sample is young, as old ones after ``OLD``."""

    def __init__(self, age: float) -> None:
        self._age, self.old = age, not age <= OLD

    def __call__(self, text: str, tone: Tone = T.PLAIN) -> Span:
        return text, T.STALE if self.old else tone

    def all(self, spans: Iterable[Span]) -> Line:
        """Several."""
        return tuple(self(*span) for span in spans)

    def age(self) -> Span:
        """How old the sample was at the tick."""
        return (ago(self._age), T.BAD) if self.old else (duration(self._age), T.LABEL)


def _tip(view: View) -> Iterator[Span]:
    assert view.tick is not None
    if view.known is None:
        yield f"pipe not known: {view.unknown}" if view.unknown else "pipe not known yet", T.LABEL
        return
    estimate = view.tick.outputs.estimate
    off = clearance(estimate.tip_W, view.known.pipe)
    words = f"{number(1000 * off, 'z.1f')} mm" if abs(off) < 0.1 else f"{number(off, 'z.2f')} m"
    yield f"{words} from the pipe", T.STRONG if off <= _NEAR else T.PLAIN


def _loop(view: View) -> Iterator[Span]:
    found = view.punctuality
    if math.isnan(found.rate):
        yield "not known yet", T.LABEL
        return
    late = view.known is not None and found.worst > view.known.safety.tick_late
    yield f"{found.rate:.1f} Hz", T.PLAIN
    yield "  worst ", T.LABEL
    yield f"{1000 * found.worst:.{1 if found.worst < 0.1 else 0}f} ms", T.WARN if late else T.PLAIN


def _sentence(view: View, code: str) -> str:
    """What a condition means: as the vehicle told it when it began, else its name."""
    return view.sentences.get(code, f"{code.replace('_', ' ')}.")


def _answer(order: Order, now_ns: int) -> Span:
    age = duration((now_ns - order.asked_ns) * 1e-9)
    text = order.text.removeprefix(f"{order.name} refused. ").removesuffix(".")
    match order.outcome:
        case None if order.pending:
            return f"… {order.name} asked {age} ago", T.WARN
        case None:
            return f"? {order.name} asked {age} ago: {text}", T.BAD
        case Outcome.REFUSED:
            return f"✗ {order.name} refused, {age} ago: {text}", T.BAD
        case outcome:
            return f"✓ {order.name} {outcome}, {age} ago{': ' if text else ''}{text}", T.GOOD


def _row(label: str, *spans: Span) -> Line:
    return ((f"{label:<11}", T.LABEL), *spans)


def _clock(view: View, t_ns: int) -> str:
    """Local time of a moment on the vehicle's clock."""
    when = view.contact.when(t_ns)
    return "--:--:--" if when is None else f"{when.astimezone():%H:%M:%S}"
