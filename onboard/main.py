"""``python -m onboard``: the flight process, and what goes with it, as a person or the ground station starts them.

Exit codes: 0 the run ended by itself or as asked and its log is complete, 2 wrong input, 5 a device cannot be had,
130 interrupted before it began.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from drivers.protocols import DeviceError
from onboard.config import Config, dump_config, load_config
from onboard.core.params import Params
from onboard.core.plan import InfeasibleError
from onboard.core.types import Outputs, Phase
from onboard.layers import ConfigError

WRONG_INPUT, NO_DEVICE, INTERRUPTED = 2, 5, 130
#: Phases of a mission in order, for the progress bar.
CHAIN = (
    Phase.PREFLIGHT, Phase.TAKEOFF, Phase.APPROACH, Phase.ALIGN, Phase.ADHESIVE, Phase.TOOL_CHANGE, Phase.TARE,
    Phase.ADVANCE, Phase.PRESS, Phase.RELEASE, Phase.RETREAT, Phase.RETURN, Phase.LAND, Phase.STOPPED,
)  # fmt: skip


class Progress:
    """A bar over the phases of the mission, with the phase, the time and the speed."""

    def __init__(self, shown: bool) -> None:
        self._bar: Any = None
        self._last: Phase | None = None
        if shown:
            from tqdm import tqdm

            form = "{desc:<12} |{bar:30}| {elapsed} elapsed{postfix}"
            self._bar = tqdm(total=len(CHAIN) - 1, bar_format=form, leave=False)
        self._count = 0

    def __call__(self, outputs: Outputs, t: float) -> None:
        """Show one tick; redraws a few times a simulated second."""
        if self._bar is None:
            return
        self._count += 1
        if outputs.phase is not self._last:
            self._last = outputs.phase
            self._bar.set_description_str(outputs.phase.value, refresh=False)
            if outputs.phase in CHAIN:
                self._bar.n = CHAIN.index(outputs.phase)
        elif self._count % 250:
            return
        self._bar.set_postfix_str(f"{t:6.1f} s flown")

    def say(self, text: str) -> None:
        """A sentence, above the bar if there is one."""
        if self._bar is None:
            print(text, file=sys.stderr, flush=True)
        else:
            self._bar.write(text, file=sys.stderr)

    def close(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or (given[0].startswith("-") and given[0] not in ("-h", "--help")):
        given.insert(0, "fly")
    options = _parser().parse_args(given)
    try:
        run: Callable[[argparse.Namespace], int] = options.run
        return run(options)
    except ConfigError as error:
        print(error, file=sys.stderr)
    except InfeasibleError as error:
        print(f"this mission cannot be flown: {error}", file=sys.stderr)
    except DeviceError as error:
        print(error, file=sys.stderr)
        return NO_DEVICE
    return WRONG_INPUT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m onboard", description=__doc__.split("\n")[0] if __doc__ else "")
    commands = parser.add_subparsers(dest="command", required=True)
    sim = commands.add_parser("sim", help="fly the mission in a simulated world, in virtual time")
    fly = commands.add_parser("fly", help="the flight process: the configured devices, on the wall clock (default)")
    world = commands.add_parser("world", help="a simulated world with emulated devices, for a flight process to fly in")
    for command, name, run in ((sim, "--scenario", _sim), (fly, "--config", _fly), (world, "--config", _world)):
        default = {"default": "paper"} if command is sim else {"required": True}
        command.add_argument(name, dest="scenario", metavar="NAME|FILE", **default)
        command.add_argument("--law")
        command.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
        command.add_argument("--seed", type=int)
        command.set_defaults(run=run)
    for command in (sim, fly):
        command.add_argument("--out", type=Path, required=True, help="an existing or new run folder")
        command.add_argument("--no-progress", action="store_true")
    sim.add_argument("--longest", type=float, metavar="SECONDS", help="of simulated time, then it is broken off")
    fly.add_argument("--mission", action="store_true", help="fly the whole mission once preflight passes, then end")
    fly.add_argument("--duration", type=float, metavar="SECONDS", help="then land")
    fly.add_argument("--attended", action="store_true", help="end in order when standard input closes")
    world.add_argument("--servo-link", type=Path, metavar="PATH", help="symbolic link to make to the servo bus")
    replay = commands.add_parser("replay", help="run a log's inputs through the core again and compare to the bit")
    replay.add_argument("log", type=Path)
    replay.add_argument("--from", type=float, dest="start", metavar="SECONDS")
    replay.add_argument("--partial", action="store_true")
    replay.set_defaults(run=_replay)
    words = "run the force estimators over a log again; writes JSON to standard output"
    estimators = commands.add_parser("estimators", help=words)
    estimators.add_argument("log", type=Path)
    estimators.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    estimators.add_argument("--ukf", action="store_true")
    estimators.add_argument("--partial", action="store_true")
    estimators.set_defaults(run=_estimators)
    return parser


def _folder(config: Config, out: Path) -> Path:
    """Make the run folder, with the configuration in it; gives the path of the log."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "config.yaml").write_text(dump_config(config))
    except OSError as error:
        raise ConfigError([f"--out {out}: cannot be written: {error.strerror}; give a folder that can"]) from error
    return out / "log.mcap"


def _sim(options: argparse.Namespace) -> int:
    from onboard import estimator_cost
    from onboard.core.derived import check_mission
    from onboard.devices import simulated_devices, world_of
    from onboard.simulate import simulate

    if options.longest is not None and not options.longest > 0.0:
        raise ConfigError([f"--longest {options.longest:g}: must be above 0"])
    config = load_config(options.scenario, options.law, options.sets, options.seed)
    check_mission(config)
    simulated_devices(world_of(config), config)
    log = _folder(config, options.out)
    progress = Progress(not options.no_progress and sys.stderr.isatty())
    try:
        simulate(config, log, progress, options.longest)
    finally:
        progress.close()
    estimator_cost.write(config, log)
    return 0


def _fly(options: argparse.Namespace) -> int:
    from onboard import estimator_cost
    from onboard.core.derived import check_mission
    from onboard.devices import check_devices
    from onboard.fly import Options, fly
    from onboard.param_file import Change, save_in_force
    from onboard.scheduling import event_loop
    from onboard.stations import check_link

    def load() -> Config:
        return load_config(options.scenario, options.law, options.sets, options.seed, option="--config")

    def save(params: Params) -> Sequence[Change]:
        assert isinstance(params, Config)
        return save_in_force(options.scenario, load(), params)

    config = load()
    check_devices(config)
    check_mission(config)
    check_link(config.link)
    progress = Progress(not options.no_progress and sys.stderr.isatty())

    def say(text: str) -> None:
        progress.say(text)

    how = Options(options.mission, options.duration, options.attended)
    try:
        with asyncio.Runner(loop_factory=event_loop) as runner:
            flown = runner.run(fly(config, lambda: _folder(config, options.out), how, load, save, progress, say))
    finally:
        progress.close()
    if (options.out / "log.mcap").is_file():
        estimator_cost.write(config, options.out / "log.mcap")
    return 0 if flown else INTERRUPTED


def _world(options: argparse.Namespace) -> int:
    from onboard.world import serve

    config = load_config(options.scenario, options.law, options.sets, options.seed, option="--config")
    serve(config, options.servo_link)
    return 0


def _replay(options: argparse.Namespace) -> int:
    from onboard.logfile import LogError
    from onboard.replay import replay

    try:
        result = replay(options.log, options.start, partial=options.partial)
    except LogError as error:
        print(error, file=sys.stderr)
        return WRONG_INPUT
    print(result)
    return 0 if result.same else 1


def _estimators(options: argparse.Namespace) -> int:
    import msgspec

    from onboard.logfile import LogError
    from onboard.recompute import recompute

    try:
        result = recompute(options.log, options.sets, ukf=options.ukf, partial=options.partial)
    except LogError as error:
        print(error, file=sys.stderr)
        return WRONG_INPUT
    sys.stdout.buffer.write(msgspec.json.encode(result))
    return 0
