"""The ground stations of one flight: the link, and what it is joined to."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from drivers.mailbox import Level, Notice, Notices
from drivers.protocols import AutopilotDevice, DeviceError, ServoDevice
from onboard.admission import vehicle_security
from onboard.core.params import Params
from onboard.core.types import Event, LinkState, Outputs, Phase, Severity, Tick
from onboard.emergency import Emergency
from onboard.endpoints import LinkError, ZenohConfig, unfit
from onboard.identity import IdentityError, load_identity
from onboard.layers import ConfigError
from onboard.link import Link
from onboard.link_settings import LinkSettings
from onboard.loop import Loop
from onboard.orders import Orders, Shows
from onboard.params import Change
from onboard.reload import Reloader
from onboard.roster import RosterError, load_roster

#: In the folder of the vehicle's keys.
ROSTER = "roster.json"


class Stations:
    """Tells stations what there is, and carries out what they ask; no call of the loop waits.

    save: writes the parameters in force into the files; shows: what can be looked at. Raises ConfigError for
    settings that cannot be.
    """

    def __init__(
        self,
        settings: LinkSettings,
        loop: Loop,
        reloader: Reloader,
        autopilot: AutopilotDevice,
        servos: ServoDevice,
        save: Callable[[Params], Sequence[Change]],
        shows: Shows,
    ) -> None:
        self._ticked_ns = 0
        self._cries = _Cries(lambda event: self.link.event(event))
        self._emergency = Emergency(autopilot, servos, loop.request, lambda: self._ticked_ns, self._cries)
        orders = Orders(loop, reloader, self._emergency, lambda asked, ack: self.link.settle(asked, ack), save, shows)
        self._settings, self._security = settings, _security(settings)
        self.link = Link(settings, orders, self._security)
        self._told = Notices()

    def start(self) -> None:
        """Open the link. Raises DeviceError when that cannot be."""
        try:
            self.link.start()
        except LinkError as error:
            raise DeviceError(f"link: {error}") from error
        self._emergency.start()

    def stop(self) -> None:
        """Send what waits, for a moment at most, and close."""
        self.link.stop()
        self._emergency.close()

    def renew(self) -> None:
        """Read keys and roster again; where they have changed, open the link anew. Takes time.

        Raises ConfigError for what cannot be read, and has changed nothing then.
        """
        security = _security(self._settings)
        if security == self._security:
            return
        try:
            self.link.reopen(security)
        except LinkError as error:
            raise ConfigError([f"the link could not be opened anew: {error}; read the files again"]) from None
        self._security = security
        self._told.tell(time.monotonic_ns(), Level.INFO, "Keys or roster have changed: the link was opened anew.")

    def state(self) -> LinkState:
        """What is known of the station that commands."""
        return self.link.state()

    def tick(self, tick: Tick) -> None:
        """The newest tick."""
        self._ticked_ns = tick.inputs.t_ns
        self.link.tick(tick)

    def after(self, outputs: Outputs) -> None:
        """What follows from a tick: events are told, and a kill is forgotten once preflight begins anew."""
        for event in outputs.events:
            self.link.event(event)
        if outputs.phase is Phase.PREFLIGHT:
            self._emergency.release()

    def notices(self) -> tuple[Notice, ...]:
        """What the link has had to tell since the last call."""
        return (*self._told.take(), *self.link.notices())

    def cries(self) -> tuple[Event, ...]:
        """What the emergency stop has told all stations already, since the last call."""
        return tuple(_cry(notice) for notice in self._cries.take())

    def event(self, event: Event) -> None:
        """Tell of something that no tick tells of."""
        self.link.event(event)


class _Cries(Notices):
    """Sentences of the emergency stop: stations hear them at once, for the loop may never pass them on."""

    def __init__(self, tell: Callable[[Event], None]) -> None:
        super().__init__()
        self._tell = tell

    def tell(self, t_ns: int, level: Level, text: str) -> None:
        """Add one sentence, and tell it."""
        super().tell(t_ns, level, text)
        self._tell(_cry(Notice(t_ns, level, text)))


def _cry(notice: Notice) -> Event:
    return Event(notice.t_ns, "emergency", Severity(notice.level), notice.text)


def check_link(settings: LinkSettings) -> None:
    """Raises ConfigError for a link that cannot be opened as it is configured."""
    secured = _security(settings) is not None
    if wrong := list(unfit(settings.listen, plain=settings.plain, secured=secured)):
        raise ConfigError(f"link.listen: {text}" for text in wrong)


def _security(settings: LinkSettings) -> ZenohConfig | None:
    if not settings.keys:
        return None
    folder = Path(settings.keys)
    try:
        return vehicle_security(settings.vehicle, load_identity(folder), load_roster(folder / ROSTER))
    except (IdentityError, RosterError) as error:
        raise ConfigError([f"link.keys: {error}"]) from None
