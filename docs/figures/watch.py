"""Takes the pictures of ``pipewright watch``: a recorded flight, sent over a real link at the pace it was flown.

    python -m docs.figures.watch RUN_FOLDER

Writes docs/images/watch-{hover,press,lost}.png: hovering before the pipe, pressing, and with the link cut while it
presses. Takes a minute and a half. Needs Chromium (Debian: apt install chromium) and Pillow.
"""

from __future__ import annotations

import asyncio
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from itertools import takewhile
from pathlib import Path

from msgspec.structs import replace
from PIL import Image

from docs.figures.screenshots import IMAGES, QUIET
from groundstation.client import Client, StationSettings
from groundstation.watch_app import WatchApp
from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.logfile import LogReader
from onboard.messages import Phase, Tick
from onboard.wire import Ack, ShowEvents, ShowParams

#: When a picture is taken, s of the phase; how long the link is cut then, s; how long is flown before the first, s.
HOVER, PRESS, CUT, BEFORE = (Phase.TARE, 1.5), (Phase.PRESS, 14.0), 3.0, 32.0
SIZE = (80, 24)
#: Of every so many ticks of the log one is put into the link, which sends fewer.
EVERY = 5


def moment(ticks: list[Tick], phase: Phase, phase_time: float) -> int:
    """Index of the tick of this moment."""
    return next(
        i for i, tick in enumerate(ticks) if tick.outputs.phase is phase and tick.outputs.phase_time >= phase_time
    )


async def fly(ticks: list[Tick], config: str) -> dict[str, str]:
    """Send the ticks as if they were made now; gives the screens as SVG."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"

    def answer(asked: Asked) -> Ack:
        match asked.ask:
            case ShowParams():
                return asked.done("", config.encode())
            case ShowEvents():
                return asked.done("", b"[]")
        return asked.done()

    link = Link(LinkSettings(vehicle="x500", listen=(endpoint,), plain=True), answer)
    link.start()
    hover, press = (moment(ticks, *what) for what in (HOVER, PRESS))
    screens: dict[str, str] = {}
    with Client(StationSettings("x500", (endpoint,), "alice", plain=True), timeout=10.0) as client:
        app = WatchApp(client, lease=True)
        async with app.run_test(size=SIZE) as pilot:
            start = max(0, hover - round(BEFORE * 250))
            offset = time.monotonic_ns() - ticks[start].inputs.t_ns
            for i in range(start, press + 1):
                tick = ticks[i]
                for event in tick.outputs.events:
                    link.event(replace(event, t_ns=event.t_ns + offset))
                if i % EVERY and i not in (hover, press):
                    continue
                await asyncio.sleep(max(0, tick.inputs.t_ns + offset - time.monotonic_ns()) * 1e-9)
                link.tick(moved(tick, offset))
                if i in (hover, press):
                    await pilot.pause(0.15)
                    screens["hover" if i == hover else "press"] = app.export_screenshot()
            link.stop()
            await asyncio.sleep(CUT)
            await pilot.pause()
            screens["lost"] = app.export_screenshot()
    return screens


def moved(tick: Tick, offset: int) -> Tick:
    """The tick on the clock of now."""
    return replace(tick, inputs=replace(tick.inputs, t_ns=tick.inputs.t_ns + offset))


def save(svg: str, name: str) -> None:
    """Write docs/images/watch-<name>.png, with few colours: it is text."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("chromium is needed and was not found (Debian: apt install chromium)")
    svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)  # fonts of this machine
    box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
    assert box is not None
    width, height = (round(float(size)) for size in box.groups())
    with tempfile.TemporaryDirectory() as folder:
        page, shot = Path(folder) / "page.html", Path(folder) / "page.png"
        page.write_text(f"<!doctype html><meta charset=utf-8><style>body{{margin:0}}</style>{svg}", "utf-8")
        command = [chromium, *QUIET, f"--user-data-dir={folder}/profile", f"--window-size={width},{height}"]
        command += ["--force-device-scale-factor=1", "--default-background-color=00000000"]
        subprocess.run([*command, f"--screenshot={shot}", page.as_uri()], check=True, capture_output=True)
        Image.open(shot).convert("RGBA").quantize(64).save(IMAGES / f"watch-{name}.png", optimize=True)


def main() -> None:
    """Take all pictures."""
    with LogReader(Path(sys.argv[1]) / "log.mcap") as log:
        ticks = list(takewhile(lambda tick: tick.outputs.phase is not Phase.RELEASE, log.ticks()))
        config = log.config_yaml
    for name, svg in asyncio.run(fly(ticks, config)).items():
        save(svg, name)


if __name__ == "__main__":
    main()
