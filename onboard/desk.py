"""The desk mission in real time: the real PX4 driver over MAVLink to a stand-in, vision and servos still mock.

The core and the loop are those of flight; only the devices differ. The world lives in the stand-in's thread.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from drivers.mailbox import Level
from onboard.clock import WallClock
from onboard.config import Config, dump_config
from onboard.core.types import Event, Outputs, Request, Severity
from onboard.devices import DeskDevices
from onboard.errand import Errand
from onboard.loop import Loop
from onboard.recorder import Recorder
from onboard.simulate import TruthSink, run_info

#: Severity of a driver's notice in the log.
_SEVERITY = {Level.INFO: Severity.INFO, Level.WARNING: Severity.WARNING, Level.ERROR: Severity.ERROR}
#: A mission that has not ended by then is broken off, s.
LONGEST = 600.0


async def fly(
    config: Config,
    log: Path,
    watch: Callable[[Outputs, float], None],
    say: Callable[[str], None],
    duration: float = LONGEST,
) -> None:
    """Fly the whole mission of ``config`` in real time and record it to ``log``.

    ``watch`` sees outputs and time (s) of each tick; ``say`` gets sentences for the person. After ``duration`` (s) the
    vehicle is asked to land. Raises DeviceError when a device cannot be had.
    """
    clock = WallClock()
    began = clock.now_ns()
    devices = DeskDevices(config)
    started = datetime.now().astimezone().isoformat(timespec="seconds")
    info = run_info(config, realtime=True, started=started)
    with Recorder(log, info, config, dump_config(config), t_ns=began, background=True) as recorder:
        try:
            await devices.start()
            loop = Loop(devices, clock, config, TruthSink(recorder, devices.world), timed=True)
            errand = Errand(loop.request, duration + LONGEST)
            first = clock.now_ns()

            def on_tick(outputs: Outputs) -> bool:
                t = (clock.now_ns() - first) * 1e-9
                watch(outputs, t)
                for notice in devices.notices():
                    recorder.event(Event(notice.t_ns, "autopilot", _SEVERITY[notice.level], notice.text))
                    say(notice.text)
                if t >= duration:
                    errand.ask_once(Request.LAND)
                return errand.goes_on(outputs, t) and not devices.world.truth().crashed

            # what lives by now lives to the end: the collector need not look at it in flight
            gc.collect()
            gc.freeze()
            await loop.run(on_tick)
        finally:
            gc.unfreeze()
            await devices.stop()
    if recorder.error is not None:
        say(f"the log is incomplete: {recorder.error}")
    if recorder.dropped:
        say(f"{recorder.dropped} records were not written")
    if devices.slipped:
        say(f"the simulated world fell behind the wall clock by {devices.slipped:.2f} s")
