"""The whole configuration of a run, composed from the files in ``configs/`` and the command line.

Later layers win: ``vehicle.yaml`` (as ``vehicle``), ``controllers/<law>.yaml``, ``joints/<joints>.yaml`` and
``interfaces/<interface>.yaml`` (gains are chosen for what servos and autopilot are sent), the scenario, ``--set``,
``--seed``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import SequenceMatcher
from pathlib import Path
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from onboard.core.params import Params
from onboard.device_config import DeviceConfig
from onboard.layers import ConfigError, Layer, parse_set, read_yaml
from onboard.link_settings import LinkSettings
from onboard.log_settings import LogSettings
from onboard.params import compose, dump_yaml
from onboard.scheduling import ProcessParams
from sim_backend.faults import Fault
from sim_backend.world import WorldParams

#: Beside the packages, in the source tree as well as when installed.
VEHICLE = "vehicle.yaml"
CONFIGS = Path(__file__).resolve().parent.parent / "configs"

T = TypeVar("T")


def _run(meaning: str) -> Meta:
    return Meta(description=meaning, extra={"unit": "", "in_flight": False})


class Config(Params, frozen=True, kw_only=True):
    """All that is in force in one run."""

    scenario: Annotated[str, _run("name or file of the scenario")] = "paper"
    law: Annotated[str, _run("name of the controller parameter set")] = "tuned"
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1), _run("seed of everything random in the world")] = 0
    world: WorldParams = WorldParams()
    faults: tuple[Fault, ...] = ()
    """What goes wrong with emulated devices."""
    devices: DeviceConfig = DeviceConfig()
    link: LinkSettings = LinkSettings()
    logs: LogSettings = LogSettings()
    process: ProcessParams = ProcessParams()


def load_config(
    scenario: str = "paper",
    law: str | None = None,
    sets: Sequence[str] = (),
    seed: int | None = None,
    directory: Path = CONFIGS,
    option: str = "--scenario",
) -> Config:
    """Compose and check the configuration of a run.

    ``scenario`` is the name of a file in ``configs`` or ``configs/scenarios``, or a path to one; the ``config.yaml`` of
    a former run is taken as it stands. ``law`` names a file in ``configs/controllers``; else the scenario says which,
    else ``tuned``. ``option`` is what the scenario was given by. Raises ConfigError with every error, each naming its
    file and line or its option.
    """
    errors: list[str] = []

    def attempt(function: Callable[..., T], *arguments: Any) -> T | None:
        try:
            return function(*arguments)
        except ConfigError as error:
            errors.extend(error.errors)
            return None

    scene = attempt(scenario_layer, scenario, directory, option)
    no_scene = len(errors)
    options = [layer for text in sets if (layer := attempt(_option, text))]
    no_options = len(errors) - no_scene
    layers: list[Layer | None]
    if scene and "scenario" in scene.values:
        if law is not None:
            errors.append(f"--law {law}: {scene.source} is the full configuration of a run and holds its own law")
        layers = [scene]
    else:
        given, origin = ("tuned", "default law") if law is None else (law, f"--law {law}")
        if law is None and scene and "law" in scene.values:
            given, origin = scene.values["law"], scene.source
        controller = attempt(_controller, given, origin, directory)
        layers = [
            attempt(_vehicle, directory),
            controller,
            attempt(_gains, "joints", [controller, scene, *options], directory / "joints"),
            attempt(_gains, "interface", [controller, scene, *options], directory / "interfaces"),
            scene,
            Layer("--scenario", {"scenario": scenario}),
            Layer("--law", {"law": given}),
        ]
    options += [] if seed is None else [Layer(f"--seed {seed}", {"seed": seed})]
    everything = [*filter(None, layers), *options]
    # an option that cannot be read hides nothing of what is wrong with the others
    config = attempt(lambda: compose(Config, everything)) if len(errors) == no_options else None
    if config is None or errors:
        raise ConfigError(errors)
    return config


def load_config_file(path: Path) -> Config:
    """Read a full configuration, such as the ``config.yaml`` of a run."""
    return compose(Config, [read_yaml(path)])


def dump_config(config: Config) -> str:
    """The text of a run's ``config.yaml``: every parameter in force; reads back to the identical set."""
    return dump_yaml(config)


def scenario_names(directory: Path = CONFIGS) -> list[str]:
    """Names of the scenarios that exist."""
    return sorted(_scenarios(directory))


def law_names(directory: Path = CONFIGS) -> list[str]:
    """Names of the controller parameter sets that exist."""
    return list(_named_files(directory / "controllers"))


def _named_files(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _scenarios(directory: Path) -> dict[str, Path]:
    """Where to fly and what to do, and in ``configs`` itself also with which devices."""
    whole = {name: path for name, path in _named_files(directory).items() if path.name != VEHICLE}
    return {**whole, **_named_files(directory / "scenarios")}


def scenario_layer(scenario: str, directory: Path = CONFIGS, option: str = "--scenario") -> Layer:
    """What a scenario itself holds, by its name or from its file. Raises ConfigError."""
    if "/" in scenario or "\\" in scenario or scenario.endswith((".yaml", ".yml")):
        return read_yaml(Path(scenario))
    return _named("scenario", scenario, f"{option} {scenario}", _scenarios(directory), directory / "scenarios")


def _controller(law: Any, origin: str, directory: Path) -> Layer:
    folder = directory / "controllers"
    return _named("law", law, origin, _named_files(folder), folder)


def _gains(key: str, layers: Sequence[Layer | None], folder: Path) -> Layer | None:
    """What differs for the value of ``key`` that the last of ``layers`` to name one asks for; None if nothing."""
    asked = [layer.values[key] for layer in layers if layer and key in layer.values]
    path = folder / f"{asked[-1]}.yaml" if asked else None
    return read_yaml(path, _shown(path)) if path and path.is_file() else None


def _vehicle(directory: Path) -> Layer:
    path = directory / VEHICLE
    if not path.is_file():
        raise ConfigError([f"{path}: not found; run from the source tree, or install the package with its configs"])
    return read_yaml(path, _shown(path)).under("vehicle")


def _option(text: str) -> Layer:
    layer = parse_set(text)
    for name in ("scenario", "law"):
        if name in layer.values:
            raise ConfigError([f"--set {text}: the {name} chooses files; give it as --{name}"])
    return layer


def _named(kind: str, name: Any, origin: str, files: Mapping[str, Path], folder: Path) -> Layer:
    if name not in files:
        names = sorted(files, key=lambda known: -SequenceMatcher(None, str(name), known).ratio())
        known = f"there are: {', '.join(names)}" if names else f"there is none in {_shown(folder)}"
        raise ConfigError([f"{origin}: no {kind} of the name {str(name)!r}; {known}"])
    return read_yaml(files[name], _shown(files[name]))


def _shown(path: Path) -> str:
    """The path as a person would write it here."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
