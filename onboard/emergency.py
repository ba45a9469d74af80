"""The emergency stop. It acts in the thread of whoever calls it, and goes on in one of its own, whatever the loop does.

``kill`` and ``stop`` are for any thread, the link's above all. They take no lock that is held while anything is waited
for, raise nothing, and use neither the event loop nor the recorder nor the link.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from threading import Event, Lock, Thread
from time import monotonic_ns
from typing import Final, Protocol

from drivers.mailbox import Level, Notices, Teller
from drivers.protocols import AutopilotDevice, ServoDevice
from drivers.samples import Engage, FlightMode
from onboard.core.types import Outputs, Request

#: A loop that makes no tick for so long is stuck, ns.
STUCK_NS: Final = 150_000_000
#: What is insisted on is said again after this time, s.
PERIOD: Final = 0.05
#: A kill is said again for so long whatever the autopilot tells, which may be older than the kill, ns.
_SURELY_NS: Final = 500_000_000
#: A kill that is not confirmed by then is told, ns.
_PATIENCE_NS: Final = 1_000_000_000
_CLOSING: Final = 0.5


Done = Callable[[Outputs], None]


class _Ask(Protocol):
    def __call__(self, request: Request, *, done: Done | None = None) -> None: ...


class Emergency:
    """Stop and kill for the devices of one vehicle, with a thread of its own from ``start`` to ``close``.

    request: hands a request to the loop, which calls ``done`` once it has taken it; never waits. ticked: time of the
    newest tick whose commands are out, ns on ``clock``; 0 before the first. notices: where sentences go.
    """

    def __init__(
        self,
        autopilot: AutopilotDevice,
        servos: ServoDevice,
        request: _Ask,
        ticked: Callable[[], int],
        notices: Notices,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._autopilot, self._servos = autopilot, servos
        self._request, self._ticked, self._clock = request, ticked, clock
        self._teller = Teller(notices, clock, "emergency stop")
        self._changing = Lock()
        """Held for the change of what follows, and never longer."""
        self._wanted: Engage | None = None
        self._since_ns = 0
        """When that began to be wanted."""
        self._stopped_ns: int | None = None
        """When a stop was asked for that the loop has not taken yet."""
        self._instead: Callable[[str], None] | None = None
        self._limp = False
        self._troubled = False
        self._confirmed = False
        self._wake = Event()
        self._closing = False
        self._thread = Thread(target=self._work, name="emergency", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread. What is insisted on stays so in the drivers. Safe to call twice."""
        self._closing = True
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join(_CLOSING)

    # -- from any thread ----------------------------------------------------------------------------------------------

    def kill(self) -> None:
        """Cut the motors and the servos' torque now, and keep them so until ``release``."""
        new = not self.killed
        self._want(Engage.KILL, instead_of=(None, Engage.LAND, Engage.KILL))
        self._wake.set()
        self._insist()
        self._guarded("the loop", partial(self._request, Request.KILL))
        if new:
            self._teller.tell(Level.WARNING, "killed: the motors and the servos' torque are cut until a reset.")

    def stop(self, done: Done | None = None, instead: Callable[[str], None] | None = None) -> None:
        """Ask the loop to stop; if it is stuck, now or a moment later, the autopilot lands by itself.

        done: called by the loop with what came of the tick that took the request. instead: called with a sentence when
        the autopilot is told to land in the place of a loop that is stuck.
        """
        with self._changing:
            self._stopped_ns, self._instead = self._clock(), instead
            lands = self._wanted is Engage.LAND
        self._guarded("the loop", partial(self._request, Request.STOP, done=done))
        self._look()
        self._wake.set()
        if lands and self._wanted is Engage.LAND and instead is not None:
            instead("The loop makes no tick: the autopilot was told to land already.")

    def release(self) -> None:
        """A kill is over, since the mission is back in preflight; to be called in any tick in which it is there.

        One that was called after that tick had begun is not over: the mission has not seen it yet.
        """
        if self.killed and self._since_ns <= self._ticked() and self._want(None, instead_of=(Engage.KILL,)):
            self._insist()
            self._teller.tell(Level.INFO, "the kill is over.")

    @property
    def killed(self) -> bool:
        """A kill is in force."""
        return self._wanted is Engage.KILL

    # -- the thread ---------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._closing:
            idle = self._wanted is None and self._stopped_ns is None
            self._wake.wait(None if idle else PERIOD)
            self._wake.clear()
            self._look()

    def _look(self) -> None:
        """Do what is due."""
        self._guarded("the emergency stop", self._judge_loop)
        self._guarded("the emergency stop", self._judge_autopilot)

    def _judge_loop(self) -> None:
        """Land in the place of a loop that is stuck; leave the autopilot to one that ticks again."""
        now, ticked_ns, stopped_ns = self._clock(), self._ticked(), self._stopped_ns
        if stopped_ns is not None:
            if ticked_ns > stopped_ns:
                with self._changing:
                    if self._stopped_ns == stopped_ns:
                        self._stopped_ns = None
            elif now - ticked_ns >= STUCK_NS and self._flies_on() and self._want(Engage.LAND, instead_of=(None,)):
                self._insist()
                silent = f"for {(now - ticked_ns) * 1e-9:.2f} s" if ticked_ns else "yet"
                text = f"the loop has made no tick {silent}: the autopilot is told to land."
                self._teller.tell(Level.ERROR, text)
                if (instead := self._instead) is not None:
                    instead(text[0].upper() + text[1:])
        if ticked_ns > self._since_ns and self._want(None, instead_of=(Engage.LAND,)):
            self._insist()
            self._teller.tell(Level.WARNING, "the loop ticks again.")

    def _flies_on(self) -> bool:
        """It neither lands nor has landed. One that is not armed would not arm again in that mode."""
        told = self._autopilot.latest()
        return told is None or (told.armed and told.mode is not FlightMode.LAND)

    def _judge_autopilot(self) -> None:
        """Say again what it has not done yet."""
        if self._wanted is Engage.LAND and self._flies_on():
            self._insist()
        elif self._wanted is Engage.KILL:
            told, since_ns = self._autopilot.latest(), self._clock() - self._since_ns
            done = told is not None and not told.armed
            if not done or self._troubled or since_ns < _SURELY_NS:
                self._insist()
            elif not self._confirmed:
                self._confirmed = True
                self._teller.tell(Level.INFO, "the autopilot is disarmed.")
            if not done and since_ns > _PATIENCE_NS:
                self._teller.once(
                    "unconfirmed",
                    Level.ERROR,
                    f"the autopilot does not say that it is disarmed, {since_ns * 1e-9:.1f} s after the kill; trying "
                    "again. Use the pilot's kill switch.",
                )

    def _want(self, engage: Engage | None, *, instead_of: tuple[Engage | None, ...]) -> bool:
        """Want something else, unless another thread has changed it already."""
        with self._changing:
            if self._wanted not in instead_of:
                return False
            self._wanted, self._since_ns, self._confirmed = engage, self._clock(), False
            return True

    def _insist(self) -> None:
        """Tell the devices what is wanted; again, if another thread has changed it meanwhile."""
        while True:
            wanted = self._wanted
            sound = True
            if wanted is Engage.KILL or self._limp:
                self._limp = limp = wanted is Engage.KILL
                sound = self._guarded("the servos", partial(self._servos.insist, limp))
            sound &= self._guarded("the autopilot", partial(self._autopilot.insist, wanted))
            self._troubled = not sound
            if wanted is self._wanted:
                return

    def _guarded(self, what: str, act: Callable[[], None]) -> bool:
        """Whether it could be done; what went wrong is told."""
        try:
            act()
        except Exception as error:
            self._teller.once(what, Level.ERROR, f"{what} failed: {type(error).__name__}: {error}")
            return False
        return True
