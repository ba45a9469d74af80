"""What stations ask, carried out. Orders arrive on the link's threads; all that is done there is to hand them on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

from msgspec import Struct

from onboard.config import Config
from onboard.core.params import Params
from onboard.core.types import Outputs, Phase, Request
from onboard.declared import to_mapping
from onboard.layers import Layer, parse_set
from onboard.link import Asked
from onboard.params import Change, compose
from onboard.reload import Done
from onboard.wire import (
    Ack,
    Arm,
    Go,
    Mission,
    Outcome,
    ReloadParams,
    SaveParams,
    SetParams,
    Stop,
    Tare,
)

_REFUSED = "refused_"


class NotShownError(Exception):
    """What was asked to be shown is not there; the text says what is."""


class _Loop(Protocol):
    """What is needed of the loop."""

    @property
    def params(self) -> Params: ...

    def request(
        self, request: Request, *, go: Phase | None = None, done: Callable[[Outputs], None] | None = None
    ) -> None: ...


class _Reloader(Protocol):
    def ask(self, load: Callable[[], Params] | None = None, done: Done | None = None) -> None: ...

    def ask_to(self, save: Callable[[Params], Sequence[Change]], done: Done) -> None: ...


class _Emergency(Protocol):
    def stop(
        self, done: Callable[[Outputs], None] | None = None, instead: Callable[[str], None] | None = None
    ) -> None: ...

    def kill(self) -> None: ...


Settle = Callable[[Asked, Ack], None]
#: What is shown for an order, as bytes; raises NotShownError.
Shows = Mapping[type[Struct], Callable[[Any], bytes]]


class Orders:
    """Answers each order at once, and settles it when it is done.

    settle: tells a station what became of an order that was accepted. save: writes parameters into the files.
    """

    def __init__(
        self,
        loop: _Loop,
        reloader: _Reloader,
        emergency: _Emergency,
        settle: Settle,
        save: Callable[[Params], Sequence[Change]],
        shows: Shows,
    ) -> None:
        self._loop, self._reloader, self._emergency = loop, reloader, emergency
        self._settle, self._save, self._shows = settle, save, shows

    def __call__(self, asked: Asked) -> Ack:
        """Take one order on, or refuse it."""
        answered = partial(self._answered, asked)
        changed = partial(self._changed, asked)
        match asked.ask:
            case Stop():
                self._emergency.stop(answered, lambda text: self._settle(asked, asked.done(text)))
            case Mission(request=Request.KILL):
                self._emergency.kill()  # done, whatever the loop does; that the mission has seen it, an event tells
                return asked.done("Killed: the motors and the servos' torque are cut until a reset.")
            case Mission(request=request):
                self._loop.request(request, done=answered)
            case Go(phase=phase):
                self._loop.request(Request.GO, go=phase, done=answered)
            case Arm():
                self._loop.request(Request.ARM, done=answered)
            case Tare():
                self._loop.request(Request.TARE, done=answered)
            case SetParams(values=values):
                self._reloader.ask(partial(self._with, values), changed)
            case ReloadParams():
                self._reloader.ask(done=changed)
            case SaveParams():
                self._reloader.ask_to(self._save, changed)
            case ask:
                return self._shown(asked, ask)
        return asked.accepted()

    def _with(self, values: Sequence[str]) -> Config:
        """The parameters in force, with these. Raises ConfigError with every error."""
        in_force = Layer("parameters in force", to_mapping(self._loop.params))
        return compose(Config, [in_force, *map(parse_set, values)])

    def _shown(self, asked: Asked, ask: Struct) -> Ack:
        show = self._shows.get(type(ask))
        if show is None:
            return asked.refused(f"this vehicle knows nothing of {type(ask).__name__}.")
        try:
            return asked.done(data=show(ask))
        except NotShownError as error:
            return asked.refused(str(error))

    def _answered(self, asked: Asked, outputs: Outputs) -> None:
        """In the loop: what the mission has said to it."""
        said = [event for event in outputs.events if event.code.startswith(_REFUSED)]
        if said:
            self._settle(asked, asked.refused(said[0].text))
        else:
            told = outputs.events[-1].text if outputs.events else f"In phase {outputs.phase}."
            self._settle(asked, asked.done(told))

    def _changed(self, asked: Asked, well: bool, told: Sequence[str]) -> None:
        text = "\n".join(told)
        self._settle(asked, Ack(asked.id, Outcome.DONE if well else Outcome.REFUSED, text))
