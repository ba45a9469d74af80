"""What all calibrations share: how what they found gets into a configuration, and what becomes of errors."""

from __future__ import annotations

import argparse
import functools
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from drivers.protocols import DeviceError
from groundstation import codes
from onboard.messages import LogError
from onboard.param_file import ConfigError, ParameterFile

Run = Callable[[argparse.Namespace], int]


class CalibrationError(Exception):
    """It cannot be calibrated from this; the text says why, and what would do."""


def log_of(options: argparse.Namespace) -> Path:
    """The log that was named."""
    log: Path = options.log
    return log / "log.mcap" if log.is_dir() else log


def give(options: argparse.Namespace, words: Iterable[str], found: Mapping[str, Any], shown: Any = None) -> None:
    """Print the words, then write what was found into the file of ``--config``, or print it as YAML for one.

    found: values by the names of their parameters. shown: what is printed in their place, by names too. Raises
    ConfigError, and has written nothing then.
    """
    for line in words:
        print(f"# {line}")
    if options.config is None:
        print("# put this into the configuration:")
        print(_yaml(found if shown is None else shown), end="")
        return
    changes = ParameterFile(options.config).put([f"{name}={json.dumps(value)}" for name, value in found.items()])
    for change in changes:
        print(f"{change.path} = {json.dumps(change.old)} -> {json.dumps(change.new)}")
    print(f"{options.config}: " + ("written" if changes else "holds this already"))


def _yaml(values: Mapping[str, Any]) -> str:
    """The values under the groups of their names."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        place = tree
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value
    return yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=1000)


def guarded(run: Run) -> Run:
    """Turn what a calibration may raise into a sentence and its exit code."""

    @functools.wraps(run)
    def guarding(options: argparse.Namespace) -> int:
        try:
            return run(options)
        except DeviceError as error:
            print(f"pipewright: {error}", file=sys.stderr)
            return codes.NOT_THERE
        except (LogError, CalibrationError, ConfigError) as error:
            print(f"pipewright: {error}", file=sys.stderr)
            return codes.WRONG_INPUT
        except KeyboardInterrupt:
            return codes.INTERRUPTED

    return guarding
