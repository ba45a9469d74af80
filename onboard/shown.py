"""What stations are shown on request: parameters, checklist, logs. The loop leaves here what is newest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import msgspec

from onboard.config import Config, dump_config
from onboard.core.types import LinkState, Tick
from onboard.logs import Logs
from onboard.loop import Loop
from onboard.orders import Shows
from onboard.preflight import Known, Lateness, checks
from onboard.recorder import Recorder
from onboard.wire import Check, ListLogs, ReadLog, ShowParams, ShowPreflight


class Shown:
    """Answers on the link's threads from what one flight has."""

    def __init__(
        self,
        loop: Loop,
        recorder: Recorder,
        logs: Logs,
        lateness: Lateness,
        link: Callable[[], LinkState],
        clock: Callable[[], int],
    ) -> None:
        self._loop, self._recorder, self._logs, self._lateness = loop, recorder, logs, lateness
        self._link, self._clock = link, clock
        self.tick: Tick | None = None
        """The newest."""
        self.statistics: Mapping[str, float] = {}
        """Of the newest device report."""
        self._written: tuple[Config, bytes] | None = None

    def by_order(self) -> Shows:
        """What to call for which order."""
        return {
            ShowParams: lambda _: self._parameters(),
            ShowPreflight: lambda _: msgspec.json.encode(self._checks()),
            ListLogs: lambda _: msgspec.json.encode(self._logs.files()),
            ReadLog: lambda ask: self._logs.read(ask.name, ask.offset, ask.size),
        }

    @property
    def _config(self) -> Config:
        return cast("Config", self._loop.params)

    def _parameters(self) -> bytes:
        """Written once for each set: that takes long, and whoever asks again and again must not make ticks late."""
        config, written = self._config, self._written
        if written is None or written[0] is not config:
            written = self._written = (config, dump_config(config).encode())
        return written[1]

    def _checks(self) -> tuple[Check, ...]:
        known = Known(
            config=self._config,
            t_ns=self._clock(),
            tick=self.tick,
            statistics=self.statistics,
            late=self._lateness.newest(),
            link=self._link(),
            free=self._free(),
            log_error="" if self._recorder.error is None else str(self._recorder.error),
            log_dropped=self._recorder.dropped,
        )
        return checks(known)

    def _free(self) -> int | None:
        try:
            return self._logs.free()
        except OSError:  # the checklist says that the disk does not tell
            return None
