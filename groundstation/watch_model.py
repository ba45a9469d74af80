"""What the screen of ``pipewright watch`` shows, as values: pure, fed with what the client has, and the time.

No clocks are compared, and yet each tick has an age that it certainly does not exceed. A pulse of the vehicle, sent at
P by its clock, was sent after the newest of our stamps that it tells to have heard, E by our clock: whatever the
vehicle stamps T was made after E + (T - P) by our clock. Of the newest pulses the largest E - P counts.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections import deque
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Final

from msgspec import Struct

from groundstation.client import Contact
from groundstation.follow import GROUND
from onboard.messages import Action, Pipe, Severity, Tick
from onboard.wire import Telemetry, Told, VehiclePulse

#: A tick older than this is not live, s.
STALE: Final = 0.8
#: The link is lost when no sign of life has come for this long, s; the vehicle is deaf when it hears none of ours.
SILENT: Final = 1.0
#: The loop has stopped when the vehicle is there and has made no tick for this long, s.
STOPPED: Final = 0.5
#: The trend goes back so far, s.
TREND: Final = 30.0
#: Lateness of the loop is that of the last, s; its rate that of the last, s.
LATENESS, RATE = 10.0, 2.0
#: Least force that fills the scale, N.
SCALE: Final = 3.0
_PULSES: Final = 300
#: An event is stamped no later than the newest pulse, but for what comes between two, ns.
_AHEAD_NS: Final = 5_000_000_000


class Link(StrEnum):
    """How it stands with the link."""

    GOOD = "good"
    SLOW = "slow"
    """All arrives, but late."""
    DEAF = "deaf"
    """The vehicle is heard, but does not hear us."""
    LOST = "lost"
    """Nothing is heard of the vehicle."""


class Bounds(Struct, frozen=True):
    """The bounds of safety that values are shown against; others are left unread, and may be of another version."""

    temperature_warm: float
    temperature_hot: float
    battery_low: float
    battery_low_voltage: float
    battery_critical: float
    battery_critical_voltage: float
    tick_late: float


class Known(Struct, frozen=True):
    """What is read of the vehicle's configuration."""

    pipe: Pipe
    safety: Bounds


class Force(Struct, frozen=True, gc=False):
    """Desired and estimated compressive force, N, and when this was first seen here."""

    seen_ns: int
    desired: float
    estimated: float


class Punctuality(Struct, frozen=True):
    """How the loop keeps time, from the ticks that came."""

    rate: float = math.nan
    """Hz; of all ticks, also of those between."""
    worst: float = math.nan
    """Longest time from one tick to the next, s: of ticks that came, or of a stall that was not caught up."""


class View(Struct, frozen=True):
    """All that is shown of the vehicle at one moment."""

    now_ns: int
    station: str
    """Our name."""
    session: str
    """Of this screen."""
    contact: Contact = Contact()
    link: Link = Link.LOST
    silent: float = math.inf
    """Since the last sign of life came, s."""
    unheard: float = math.inf
    """The vehicle's newest word of us is so old, s."""
    tick: Tick | None = None
    age: float = math.inf
    """The tick is at most so old, s."""
    idle: float = 0.0
    """The vehicle is there, and its loop has made no tick for so long, s; 0: it ticks, or that is not known."""
    punctuality: Punctuality = Punctuality()
    trend: tuple[Force, ...] = ()
    """Oldest first."""
    parameters: tuple[int, int] = (0, 0)
    """Which set is in force: how often the vehicle began anew since we watch, and the revision."""
    known: Known | None = None
    unknown: str = ""
    """Why the configuration is not known; empty: it is, or is being asked."""
    events: tuple[Told, ...] = ()
    """Oldest first."""
    sentences: Mapping[str, str] = {}
    """The newest sentence of each condition that was told, by its code."""

    @property
    def stale(self) -> bool:
        """The tick is not live."""
        return self.age > STALE or self.link is Link.LOST or self.idle > 0.0

    @property
    def flying(self) -> bool:
        """By the newest tick, however old it is."""
        return self.tick is not None and self.tick.outputs.phase not in GROUND

    @property
    def commander(self) -> str:
        """Who commands, as last told; empty: nobody."""
        return self.contact.pulse.commander if self.contact.pulse is not None else ""

    @property
    def commanding(self) -> bool:
        """We do."""
        return self.commander == self.station

    @property
    def alone(self) -> bool:
        """No other session of our name is there, to command when this one is gone."""
        stations = self.contact.pulse.stations if self.contact.pulse is not None else ()
        return not any(h.present and h.name == self.station and h.session != self.session for h in stations)

    @property
    def action(self) -> Action:
        """What safety demanded in the tick."""
        return self.tick.outputs.verdict.action if self.tick is not None else Action.NONE

    @property
    def scale(self) -> float:
        """Force that fills the bar, N: whole newtons."""
        forces = (value for force in self.trend for value in (force.desired, force.estimated))
        return max(SCALE, float(math.ceil(1.05 * max(filter(math.isfinite, forces), default=0.0))))


class Model:
    """Remembers what came, as far back as it is shown."""

    def __init__(self, station: str, session: str) -> None:
        self._station, self._session = station, session
        self._pulse: VehiclePulse | None = None
        self._pulse_ns = 0
        """When it came."""
        self._bounds: deque[int] = deque(maxlen=_PULSES)
        """Of each pulse, E - P, ns."""
        self._starts = 0
        self._ticks: deque[Tick] = deque()
        self._trend: deque[Force] = deque()

    def look(
        self,
        now_ns: int,
        contact: Contact,
        telemetry: Telemetry | None,
        events: Sequence[Told] = (),
        known: Known | None = None,
        unknown: str = "",
    ) -> View:
        """What is to be seen at ``now_ns`` (monotonic): contact and telemetry are of this moment."""
        self._hear(now_ns, contact)
        tick = telemetry.tick if telemetry is not None else None
        if tick is not None and (not self._ticks or tick is not self._ticks[-1]):
            self._take(now_ns, tick)
        while self._trend and now_ns - self._trend[0].seen_ns > TREND * 1e9:
            self._trend.popleft()
        silent = (now_ns - self._pulse_ns) * 1e-9 if self._pulse is not None else math.inf
        unheard = self._unheard(silent)
        return View(
            now_ns=now_ns,
            station=self._station,
            session=self._session,
            contact=contact,
            link=_link(contact, silent, unheard),
            silent=silent,
            unheard=unheard,
            tick=tick,
            age=self._age(now_ns, tick),
            idle=self._idle(),
            punctuality=self._punctuality(),
            trend=tuple(self._trend),
            parameters=(self._starts, tick.revision if tick is not None else 0),
            known=known,
            unknown=unknown,
            events=tuple(events),
            sentences={told.event.code: told.event.text for told in events if told.event.severity is not Severity.INFO},
        )

    def _hear(self, now_ns: int, contact: Contact) -> None:
        pulse, before = contact.pulse, self._pulse
        if pulse is None or (before is not None and pulse.sent_ns == before.sent_ns):
            return
        if before is not None and pulse.sent_ns < before.sent_ns:  # its clock has begun anew: the machine restarted
            self._bounds.clear()
        self._pulse, self._pulse_ns = pulse, now_ns
        if math.isfinite(contact.age):
            self._bounds.append(now_ns - round(contact.age * 1e9) - pulse.sent_ns)

    def _take(self, now_ns: int, tick: Tick) -> None:
        if self._ticks and tick.index <= self._ticks[-1].index:  # the process has begun anew
            self._starts += 1
            self._ticks.clear()
            self._trend.clear()
        self._ticks.append(tick)
        while tick.inputs.t_ns - self._ticks[0].inputs.t_ns > LATENESS * 1e9:
            self._ticks.popleft()
        self._trend.append(Force(now_ns, tick.outputs.reference.force, tick.outputs.estimate.contact_force))

    def _age(self, now_ns: int, tick: Tick | None) -> float:
        if tick is None or not self._bounds:
            return math.inf
        return max(0, now_ns - max(self._bounds) - tick.inputs.t_ns) * 1e-9

    def _unheard(self, silent: float) -> float:
        stations = self._pulse.stations if self._pulse is not None else ()
        held = [heard.held_ns for heard in stations if heard.session == self._session and heard.heard_ns]
        return held[0] * 1e-9 + silent if held else math.inf

    def _idle(self) -> float:
        if self._pulse is None or not self._pulse.tick_ns:
            return 0.0
        idle = (self._pulse.sent_ns - self._pulse.tick_ns) * 1e-9
        return idle if idle > STOPPED else 0.0

    def _punctuality(self) -> Punctuality:
        if len(self._ticks) < 2:
            return Punctuality()
        last = self._ticks[-1]
        first = next(tick for tick in self._ticks if last.inputs.t_ns - tick.inputs.t_ns <= RATE * 1e9)
        lasted = (last.inputs.t_ns - first.inputs.t_ns) * 1e-9
        rate = (last.index - first.index) / lasted if lasted > 0.0 else math.nan
        steps = [
            ((b.inputs.t_ns - a.inputs.t_ns) * 1e-9, b.index - a.index) for a, b in itertools.pairwise(self._ticks)
        ]
        period = statistics.median(time / count for time, count in steps)
        lost = max(time - count * period for time, count in steps)
        return Punctuality(rate, max(period + lost, *(tick.inputs.dt for tick in self._ticks)))


def gathered(before: Sequence[Told], heard: Sequence[Told], pulse: VehiclePulse | None) -> tuple[Told, ...]:
    """Events that the vehicle remembers and those that came, each once, oldest first.

    What is stamped in the future is of before the vehicle's machine was restarted, and left out.
    """
    latest = pulse.sent_ns + _AHEAD_NS if pulse is not None else math.inf
    known = {(told.event.t_ns, told.number): told for told in (*before, *heard) if told.event.t_ns <= latest}
    return tuple(known[key] for key in sorted(known))


def clearance(tip: tuple[float, float, float], pipe: Pipe) -> float:
    """Distance of a point (m, W) from the surface of the pipe, m; negative inside."""
    heading = math.radians(pipe.heading_deg)
    x, y, up = (a - b for a, b in zip(tip, pipe.position, strict=True))
    ahead = x * math.cos(heading) + y * math.sin(heading)
    aside = abs(y * math.cos(heading) - x * math.sin(heading))
    off = math.hypot(ahead, up) - pipe.radius
    beyond = aside - pipe.length / 2
    return off if beyond <= 0.0 else math.hypot(max(off, 0.0), beyond)


def _link(contact: Contact, silent: float, unheard: float) -> Link:
    if not contact.present or silent > SILENT:
        return Link.LOST
    if unheard > SILENT:
        return Link.DEAF
    return Link.SLOW if contact.age > SILENT else Link.GOOD
