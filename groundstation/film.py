"""``pipewright film``: a picture of each phase of a run, and a short film of all of it, from its log alone."""

from __future__ import annotations

import argparse
import sys
from math import cos, degrees, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from groundstation import codes

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

    from drivers.samples import Vec3
    from groundstation.run import Array, Run
    from sim_backend.bullet_scene import Scene

#: The folder beside a log, and names of what is written into it. ``pipewright report`` shows them.
FOLDER, FILM, SHEET = "film", "film.gif", "phases.png"
_EPILOG = """\
examples:
  pipewright film runs/paper-tuned                 into runs/paper-tuned/film
  pipewright film runs/paper-tuned --speed 4 --width 640 --out docs/images/film

Written are film.gif, one picture for each phase (01-takeoff.png, ...) and all of these on one sheet, phases.png. The
renderer needs no screen.
"""
#: Pictures beside each other on the sheet; height of the line of words below each, pixels.
_COLUMNS: Final = 4
_BAR: Final = 26
_GROUND, _INK, _MARK = (24, 27, 33), (235, 235, 230), (240, 160, 40)


class Pose(NamedTuple):
    """What one frame shows."""

    t: float
    phase: str
    position: Vec3
    attitude: Vec3
    """Roll, pitch, yaw, rad."""
    joints: Vec3
    force: float
    """On the pipe, N."""
    payload: bool
    """The sleeve is in the gripper."""


def add_parser(commands: Any) -> None:
    """Add ``film`` to the commands of an argparse parser."""
    words = "make pictures of each phase and a short film of a run, from its log"
    film = commands.add_parser(
        "film",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    film.add_argument("log", type=Path, metavar="LOG", help="log.mcap of a run, or its run folder")
    film.add_argument("--partial", action="store_true", help="accept a log that was cut off")
    film.add_argument("--out", type=Path, metavar="DIR", help="folder for the pictures (default: film/ beside the log)")
    film.add_argument("--speed", type=_positive, default=8.0, metavar="X", help="times faster than life (default: 8)")
    film.add_argument("--fps", type=_positive, default=10.0, metavar="N", help="frames a second (default: 10)")
    film.add_argument("--width", type=_pixels, default=480, metavar="PIXELS", help="width of a frame (default: 480)")
    film.set_defaults(run=run)


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= 1000.0:
        raise argparse.ArgumentTypeError(f"{text}: want a number above 0, and 1000 at most")
    return value


def _pixels(text: str) -> int:
    value = int(text)
    if not 160 <= value <= 1920:
        raise argparse.ArgumentTypeError(f"{text}: want 160 to 1920 pixels")
    return value


def run(options: argparse.Namespace) -> int:
    """Run ``film``; gives the exit code."""
    # Imported here so that --help and wrong input answer at once.
    from groundstation.run import read_run
    from onboard.messages import LogError

    log = options.log / "log.mcap" if options.log.is_dir() else options.log
    try:
        flown = read_run(log, partial=options.partial)
        out: Path = options.out or log.parent / FOLDER
        with _Studio(flown, options.width) as studio:
            out.mkdir(parents=True, exist_ok=True)
            written, sheet = _write_phases(studio, flown, out)
        with _Studio(flown, options.width) as studio:
            poses = frames(flown, options.speed / options.fps)
            written.append(_write_film(studio, poses, sheet, out / FILM, options.fps))
    except (LogError, ValueError) as error:
        print(f"pipewright: {error}", file=sys.stderr)
        return codes.WRONG_INPUT
    except OSError as error:
        print(f"pipewright: {error.filename or log}: {error.strerror}", file=sys.stderr)
        return codes.WRONG_INPUT
    for path in written:
        print(path)
    return codes.DONE


def frames(run: Run, period: float) -> list[Pose]:
    """What there is to show of a run every ``period`` seconds of it; from the truth of the world where there is one."""
    import numpy as np

    count = max(2, int(float(run.t[-1]) / period) + 1)
    ticks = np.searchsorted(run.t, np.arange(count) * period).clip(0, len(run.t) - 1)
    return [_pose(run, int(tick)) for tick in dict.fromkeys(ticks.tolist())]


def _pose(run: Run, tick: int) -> Pose:
    truth = run.truth if run.truth is not None and run.truth.known[tick] else None
    state = run if truth is None else truth
    force = run.force_est if truth is None else truth.force
    return Pose(
        float(run.t[tick]),
        str(run.phase[tick]),
        _three(state.p[tick]),
        _three(state.rpy[tick]),
        _three(state.joints[tick]),
        float(force[tick]),
        bool(run.payload[tick]),
    )


def _three(row: Array) -> Vec3:
    return (float(row[0]), float(row[1]), float(row[2]))


class _Studio:
    """The run's vehicle and pipe, and a camera that keeps the vehicle in sight. Time only goes on in it."""

    def __init__(self, run: Run, width: int) -> None:
        import msgspec
        import yaml

        from drivers.vehicle import Vehicle
        from sim_backend.bullet_scene import Scene
        from sim_backend.deviations import DeviationParams, deviations
        from sim_backend.picture import Camera
        from sim_backend.pipe import Pipe

        # A run's configuration was checked when it was flown.
        config = yaml.safe_load(run.config_yaml)
        vehicle = msgspec.convert(config["vehicle"], Vehicle)
        pipe = run.config.pipe
        sizes = DeviationParams()
        if run.truth is not None:
            sizes = msgspec.convert(config.get("world", {}).get("deviations", {}), DeviationParams)
        self._left_on_pipe = run.truth is None or run.truth.sleeve_on_pipe
        believed = Pipe(pipe.position, radians(pipe.heading_deg), pipe.radius, pipe.length)
        self._pipe = deviations(sizes, run.info.seed).pipe_of(believed)
        self.size = (width, round(width * 9 / 16))
        self.scene: Scene = Scene(vehicle, bars=True)
        self.scene.put_pipe(self._pipe)
        self._camera = Camera(self.scene, *self.size)

    def __enter__(self) -> _Studio:
        return self

    def __exit__(self, *_: object) -> None:
        self.scene.close()

    def picture(self, pose: Pose) -> Picture:
        """One frame with its words."""
        from PIL import Image, ImageDraw, ImageFont

        from drivers.rotation import from_euler
        from sim_backend.picture import View

        w, x, y, z = from_euler(*pose.attitude)
        self.scene.place_vehicle(pose.position, (x, y, z, w), pose.joints)
        self.scene.place_bars(pose.joints)
        if not pose.payload and self.scene.holds_sleeve:
            if self._left_on_pipe:
                self.scene.release_sleeve(on_pipe=True)
            else:
                self.scene.take_sleeve()
        ahead, (x, y, _) = self._pipe.heading, self._pipe.position
        gap = (x - pose.position[0]) * cos(ahead) + (y - pose.position[1]) * sin(ahead)
        # Near the pipe both fit into a narrow picture; far from it the vehicle is what counts.
        near = min(max((1.6 - gap) / 0.8, 0.0), 1.0)
        lead = 0.3 * near
        target = (
            pose.position[0] + lead * cos(ahead),
            pose.position[1] + lead * sin(ahead),
            pose.position[2] - 0.05,
        )
        view = View(target, 1.8 - 0.6 * near, degrees(ahead) + 30.0 - 25.0 * near, -14.0 + 6.0 * near)
        picture = Image.fromarray(self._camera.take(view))
        draw = ImageDraw.Draw(picture)
        font = ImageFont.load_default(size=15)
        width, height = self.size
        draw.rectangle((0, height - _BAR, width, height), fill=_GROUND)
        words = pose.phase.replace("_", " ")
        draw.text((10, height - _BAR + 4), f"{pose.t:5.1f} s   {words}", fill=_INK, font=font)
        if pose.force > 0.0:
            draw.text((width - 90, height - _BAR + 4), f"{pose.force:5.2f} N", fill=_MARK, font=font)
        return picture


def _write_phases(studio: _Studio, run: Run, out: Path) -> tuple[list[Path], Picture]:
    """A picture from the middle of each phase, and all on one sheet; gives what was written, and the sheet."""
    from PIL import Image

    from groundstation.metrics import phases

    pictures, written = [], []
    for number, phase in enumerate(phases(run), 1):
        tick = min(int(run.t.searchsorted(0.5 * (phase["start"] + phase["end"]))), len(run.t) - 1)
        pictures.append(studio.picture(_pose(run, tick)))
        path = out / f"{number:02d}-{phase['name'].replace('_', '-')}.png"
        pictures[-1].save(path)
        written.append(path)
    width, height = studio.size
    sheet = Image.new("RGB", (_COLUMNS * width, -(-len(pictures) // _COLUMNS) * height), _GROUND)
    for k, picture in enumerate(pictures):
        sheet.paste(picture, (k % _COLUMNS * width, k // _COLUMNS * height))
    sheet = sheet.resize((sheet.width // 2, sheet.height // 2), Image.Resampling.LANCZOS)
    sheet.save(out / SHEET)
    return [*written, out / SHEET], sheet


def _write_film(studio: _Studio, poses: list[Pose], sheet: Picture, path: Path, fps: float) -> Path:
    """The film, in the colours of the sheet for all frames so that nothing flickers."""
    from PIL import Image

    # An octree keeps what is small and bright: arm and sleeve beside all that floor.
    palette = sheet.quantize(128, method=Image.Quantize.FASTOCTREE)
    pictures = [studio.picture(pose).quantize(palette=palette, dither=Image.Dither.NONE) for pose in poses]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=round(1000.0 / fps), loop=0, optimize=False
    )
    return path
