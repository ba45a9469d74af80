"""Stories of one flight, flown one after the other, and judged each by itself when the log is closed."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest
from msgspec import Struct

from onboard.core.types import Action, Phase, Verdict
from onboard.logfile import LogReader
from onboard.records import TICK
from sim_backend.world_messages import Look
from tests.process.flying import Flying, flying

#: On top of the time after which a condition acts, s: the machine may be busy.
MARGIN = 1.0
#: For stories of other devices: a machine that is busy keeps the bytes of a pseudo-terminal back.
PATIENT_BUS = ("devices.servos.reply_margin=0.02", "devices.servos.silent_after=0.4")
#: What any flight may say beside its story, on a machine that is busy.
_ASIDE = re.compile(r"tick came after|The loop is slow|comes at \d+ Hz|at the rates? asked for|reading of the servos")
_RATE = 250.0
_DIGITS = re.compile(r"[\d.]+")

#: What is done in a story, from a hover or a preflight that passes, to one.
Story = Callable[[Flying], None]


class _Inputs(Struct, gc=False):
    t_ns: int


class _Outputs(Struct, gc=False):
    phase: Phase
    verdict: Verdict


class _Tick(Struct, gc=False):
    """What is read of a tick."""

    index: int
    inputs: _Inputs
    outputs: _Outputs


class Told(Struct):
    """What came of one story."""

    name: str
    began_ns: int
    ended_ns: int
    lines: list[str]
    looks: list[Look]
    ticks: list[_Tick]

    def lives_on(self) -> None:
        """The process ticked throughout, and the vehicle is whole."""
        seconds = (self.ended_ns - self.began_ns) * 1e-9
        assert len(self.ticks) > 0.8 * _RATE * seconds, f"{len(self.ticks)} ticks in {seconds:.1f} s"
        assert {look.truth.crashed for look in self.looks} == {""}

    def says(self, *sentences: str) -> None:
        """Each of these once, in this order, and nothing twice (but for numbers, and what a busy machine does)."""
        places = []
        for words in sentences:
            at = [number for number, line in enumerate(self.lines) if words in line]
            assert len(at) == 1, f"{words!r} was said {len(at)} times:\n" + "\n".join(self.lines)
            places += at
        assert places == sorted(places), "\n".join(self.lines)
        told = [_DIGITS.sub("#", line) for line in self.lines if not _ASIDE.search(line) or line in sentences]
        assert len(told) == len(set(told)), "\n".join(self.lines)

    def says_no(self, words: str) -> None:
        """Nothing of this."""
        assert not any(words in line for line in self.lines), "\n".join(self.lines)

    def acts(self, code: str, action: Action, within: float) -> None:
        """The condition demands this within so many seconds (and a margin), and nothing demanded as much before."""
        for tick in self.ticks:
            verdict = tick.outputs.verdict
            if code in verdict.reasons and verdict.action >= action:
                assert verdict.action is action, f"{verdict} in place of {action.name}"
                seconds = (tick.inputs.t_ns - self.began_ns) * 1e-9
                assert seconds < within + MARGIN, f"{code} after {seconds:.2f} s"
                return
        raise AssertionError(f"{code} never demanded {action.name}; demanded were {self.demands}")

    @property
    def demands(self) -> set[str]:
        """Codes of all conditions that were active."""
        return {code for tick in self.ticks for code in tick.outputs.verdict.reasons}

    def calms_down(self) -> None:
        """At the end, nothing is demanded any more."""
        assert self.ticks[-1].outputs.verdict.action <= Action.WARN, self.ticks[-1].outputs.verdict

    @property
    def phases(self) -> list[Phase]:
        """Phases in order, from the one in which it began."""
        found: list[Phase] = []
        for tick in self.ticks:
            if not found or found[-1] is not tick.outputs.phase:
                found.append(tick.outputs.phase)
        return found

    def hovers(self, away: float = 0.25) -> None:
        """It held in the air, no farther than this (m) from where it was."""
        assert set(self.phases) == {Phase.HOLD}
        x, y, z = self.looks[0].truth.p_WB
        for look in self.looks:
            p = look.truth.p_WB
            assert max(abs(p[0] - x), abs(p[1] - y), abs(p[2] - z)) < away, p

    def lands(self) -> None:
        """It came down out of the hover, and the mission has ended on the ground."""
        down = [Phase.HOLD, Phase.LAND, Phase.STOPPED]
        assert self.phases[: len(down)] == down, self.phases
        last = self.looks[-1]
        assert last.truth.on_ground
        assert not last.armed


class Book:
    """All stories of one flight."""

    def __init__(
        self,
        folder: Path,
        stories: Mapping[str, Story],
        *sets: str,
        begin: Callable[[Flying], object] = Flying.hover,
        arguments: Sequence[str] = (),
    ) -> None:
        """Fly ``begin``, then them. One that fails ends the flight: it and those after it fail when asked for."""
        self._told: dict[str, Told] = {}
        self._failed = ""
        with flying(folder, *sets, arguments=arguments) as flight:
            begin(flight)
            for name, story in stories.items():
                began = flight.look().t_ns
                try:
                    story(flight)
                except AssertionError as error:
                    said = "\n".join(line.text for line in flight.lines if line.t_ns >= began)
                    self._failed = f"{name}: {error}\n{said}"
                    break
                ended = flight.look().t_ns
                self._told[name] = Told(
                    name,
                    began,
                    ended,
                    [line.text for line in flight.lines if began <= line.t_ns <= ended],
                    [look for look in flight.looks if began <= look.t_ns <= ended],
                    [],
                )
        self._read(folder / "log.mcap")

    def _read(self, log: Path) -> None:
        with LogReader(log) as reader:
            ticks = list(reader.one(TICK, _Tick))
        for told in self._told.values():
            told.ticks = [tick for tick in ticks if told.began_ns <= tick.inputs.t_ns <= told.ended_ns]

    def __getitem__(self, name: str) -> Told:
        if name not in self._told:
            pytest.fail(f"the flight ended before its end. {self._failed}")
        return self._told[name]


def strikes(device: str, kind: str, rest: float, **fault: object) -> Story:
    """In the hover, a fault that begins now; then so many seconds."""

    def story(flight: Flying) -> None:
        flight.inject(device=device, kind=kind, **fault)
        flight.rest(rest)

    return story


def lands(device: str, kind: str, duration: float, **fault: object) -> Story:
    """In the hover, a fault that ends the flight; told until its end and the vehicle's landing."""

    def story(flight: Flying) -> None:
        until = flight.look().t_ns + round((duration + 1.6) * 1e9)
        flight.inject(device=device, kind=kind, duration=duration, **fault)
        flight.stopped()
        flight.wait("the end of what is told", lambda look: look.t_ns >= until)

    return story


def down(flight: Flying) -> None:
    """Land if it flies, and be ready for the next flight."""
    if flight.look().phase != Phase.STOPPED:
        flight.land()
    flight.reset()


def again(flight: Flying) -> None:
    """Land if it flies, and hover once more, as if nothing had been."""
    down(flight)
    flight.hover()
