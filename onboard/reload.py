"""New parameters for a running loop: the files are read again, checked as a whole, and swapped in between two ticks.

All or nothing. Three kinds of parameters are told apart:

- declared ``in_flight``: may change at any time;
- the others of the core: only on the ground (PREFLIGHT, STOPPED);
- what devices, world and process were built from (``BUILT_FROM`` and everything that the core does not read): only
  by starting the process again.

Whatever takes time happens in a thread of its own. A tick gives it the interpreter for no longer than the switch
interval, see ``onboard.scheduling``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from queue import SimpleQueue
from threading import Event as Flag
from threading import Thread
from typing import Final

from onboard.core.derived import check_mission
from onboard.core.params import Params
from onboard.core.plan import InfeasibleError
from onboard.core.types import Event, Severity
from onboard.layers import ConfigError, show
from onboard.loop import Loop
from onboard.params import Change, diff

#: What the core reads too, but devices were set up for.
BUILT_FROM: Final = frozenset({"vehicle", "interface", "joints"})
_CHANGEABLE: Final = frozenset(Params.__struct_fields__) - BUILT_FROM


def needs_restart(change: Change) -> bool:
    """Whether something was built from this parameter that a reload does not build anew."""
    return change.path.partition(".")[0] not in _CHANGEABLE


#: Told of the end: whether it was done, and the sentences on it.
Done = Callable[[bool, Sequence[str]], None]


class _RefusedError(Exception):
    """The parameters stay as they are; one reason a line."""

    def __init__(self, reasons: Iterable[str]) -> None:
        self.reasons = tuple(reasons)
        super().__init__("\n".join(self.reasons))


class Reloader:
    """Changes the parameters of ``loop`` when asked to, and whatever else concerns them and takes time.

    load: reads the files again; called in the reloader's thread.
    """

    def __init__(self, load: Callable[[], Params], loop: Loop) -> None:
        self._load, self._loop = load, loop
        self._asked: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._said: deque[tuple[str, Severity, str]] = deque()
        self._thread = Thread(target=self._work, name="reload", daemon=True)
        self._thread.start()

    def ask(self, load: Callable[[], Params] | None = None, done: Done | None = None) -> None:
        """Put what ``load`` gives into force (without: the files, read again); returns at once.

        done: told what came of it, in the reloader's thread. It is an event too, or one for each error.
        """
        self._asked.put(lambda: self._try(lambda: self._swap(load or self._load), "Parameters stay as they are.", done))

    def ask_to(self, save: Callable[[Params], Sequence[Change]], done: Done) -> None:
        """Call ``save`` with the parameters in force; it gives what was changed in the files, or raises ConfigError."""
        self._asked.put(lambda: self._try(lambda: self._saved(save), "Parameters were not saved.", done))

    def close(self) -> None:
        """Take no more orders. What waits for a loop that no longer ticks ends with the process."""
        self._asked.put(None)

    def join(self, timeout: float) -> None:
        """After ``close``, wait for what was asked before it, at most ``timeout`` seconds."""
        self._thread.join(timeout)

    def events(self, t_ns: int) -> tuple[Event, ...]:
        """What there has been to tell since the last call, stamped with ``t_ns``: every error, or every change."""
        if not self._said:
            return ()
        return tuple(Event(t_ns, *self._said.popleft()) for _ in range(len(self._said)))

    def _work(self) -> None:
        while (job := self._asked.get()) is not None:
            job()

    def _try(self, job: Callable[[], Sequence[str]], failed: str, done: Done | None) -> None:
        try:
            told, well = job(), True
        except ConfigError as error:
            told, well = error.errors, False
        except (InfeasibleError, _RefusedError) as error:
            told, well = str(error).splitlines(), False
        except Exception as error:  # whatever is wrong with a file must not end a flight, nor go untold
            told, well = [f"{type(error).__name__}: {error}"], False
        if not well:
            for reason in told:
                self._say("reload_refused", Severity.ERROR, f"{failed} {reason}.")
        if done is not None:
            done(well, told)

    def _swap(self, load: Callable[[], Params]) -> Sequence[str]:
        params = load()
        changes = diff(self._loop.params, params)
        if not changes:
            self._say("reload_unchanged", Severity.INFO, "Parameters read again: nothing differs.")
            return ["nothing differs"]
        if fixed := [change for change in changes if needs_restart(change)]:
            raise _RefusedError(f"{_told(change)}: takes a restart of the process" for change in fixed)
        settled = Flag()
        revisions: list[int | None] = []

        def done(revision: int | None) -> None:
            revisions.append(revision)
            settled.set()

        grounded = [change for change in changes if not change.in_flight]
        self._loop.reload(check_mission(params), grounded=bool(grounded), done=done)
        settled.wait()
        (revision,) = revisions
        if revision is None:
            raise _RefusedError(f"{_told(change)}: may change on the ground only" for change in grounded)
        for change in changes:
            self._say("reloaded", Severity.INFO, f"Parameters, revision {revision}: {_told(change)}.")
        return [f"revision {revision}", *map(_told, changes)]

    def _saved(self, save: Callable[[Params], Sequence[Change]]) -> Sequence[str]:
        changes = save(self._loop.params)
        for change in changes:
            self._say("saved", Severity.INFO, f"Parameters saved: {_told(change)}.")
        return [*map(_told, changes)] or ["the files make these parameters already"]

    def _say(self, code: str, severity: Severity, text: str) -> None:
        self._said.append((code, severity, text))


def _told(change: Change) -> str:
    return f"{change.path} = {show(change.old)} -> {show(change.new)}"
