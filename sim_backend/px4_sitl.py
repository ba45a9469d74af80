"""A real PX4 in software (SITL), started with the vehicle's parameters in a run folder of its own, and ended again.

It needs a build folder of PX4 (``make px4_sitl_default`` gives build/px4_sitl_default), which the environment variable
PIPEWRIGHT_PX4 may name. PX4 then looks for its simulator on TCP ``4560 + instance``. (docs/px4.md)
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

import msgspec
import yaml

from drivers.protocols import DeviceError
from drivers.px4_parameters import read_parameter_file
from drivers.vehicle import Battery, Vehicle

#: The environment variable that names a build folder.
VARIABLE = "PIPEWRIGHT_PX4"
_OUTPUT = "px4.out"
#: The airframe that waits for a simulator from outside. Its geometry is overridden by the vehicle's parameters.
_MODEL = "none_iris"
#: What PX4's start script sets by itself, after our parameters.
_SCRIPTS_OWN = ("SYS_AUTOSTART", "MAV_SYS_ID")
_PATIENCE = 5.0
_LOOK_PERIOD = 0.2
_CELLS = 4
_LAST_LINES = 15


class Px4Sitl:
    """One PX4 process. ``folder`` is kept; without one, PX4 runs in a temporary folder that ``stop`` removes.

    Its parameters are its defaults and ``parameters``, whatever it held before.
    """

    def __init__(
        self, build: Path, parameters: Mapping[str, int | float], instance: int = 0, folder: Path | None = None
    ) -> None:
        build = build.resolve()  # PX4 runs in another folder
        self._binary, self._scripts = build / "bin" / "px4", build / "etc"
        for needed in (self._binary, self._scripts):
            if not needed.exists():
                raise DeviceError(
                    f"PX4: {needed} is not there; want the build folder that make px4_sitl_default leaves "
                    "(build/px4_sitl_default)"
                )
        self._parameters = parameters
        self.instance = instance
        self._temporary = folder is None
        self.folder = folder or Path()
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def simulator_url(self) -> str:
        """Where PX4 looks for its simulator: the URL of our link."""
        return f"tcp://127.0.0.1:{4560 + self.instance}"

    @property
    def driver_url(self) -> str:
        """Where PX4 sends its MAVLink to an onboard computer: the URL of the driver."""
        return f"udpin://127.0.0.1:{14540 + self.instance}"

    @property
    def pid(self) -> int | None:
        """Of the running process."""
        return self._process.pid if self._process is not None and self._process.poll() is None else None

    def start(self) -> None:
        """Start PX4; it then waits for its simulator."""
        if self._temporary:
            self.folder = Path(tempfile.mkdtemp(prefix="px4-"))
        self.folder.mkdir(parents=True, exist_ok=True)
        for left in ("parameters.bson", "parameters_backup.bson"):
            (self.folder / left).unlink(missing_ok=True)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PX4_")}
        environment |= {f"PX4_PARAM_{name}": f"{value}" for name, value in self._parameters.items()}
        for name in _SCRIPTS_OWN:
            environment.pop(f"PX4_PARAM_{name}", None)
        environment["PX4_SIM_MODEL"] = _MODEL
        with (self.folder / _OUTPUT).open("wb") as output:
            self._process = subprocess.Popen(
                [*_until_we_die(), self._binary, "-i", str(self.instance), "-d", "-w", self.folder, self._scripts],
                cwd=self.folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def check(self) -> None:
        """Raises DeviceError, with PX4's last words, when it runs no more."""
        if self.pid is None:
            lines = self.output().splitlines()[-_LAST_LINES:]
            raise DeviceError("\n".join(("PX4 runs no more; its last words:", *lines)))

    def output(self) -> str:
        """What PX4 has printed so far."""
        path = self.folder / _OUTPUT
        return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""

    def stop(self) -> None:
        """End the process, by force if it does not obey. Safe to call twice."""
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            try:
                process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if self._temporary:
                shutil.rmtree(self.folder)

    def __enter__(self) -> Px4Sitl:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def build_folder() -> Path | None:
    """The build folder that the environment names, or None."""
    named = os.environ.get(VARIABLE, "")
    return Path(named) if named else None


def battery_parameters(battery: Battery) -> dict[str, int | float]:
    """Make the battery that PX4 simulates for itself as empty as the world's is, in a hover.

    PX4's loses its charge linearly once armed and knows no resistance, so that its voltages lie lower by what the
    hover current costs. On the ground it is then that much too low. (SIM_BAT_DRAIN, BAT1_V_CHARGED, BAT1_V_EMPTY)
    """
    sag = battery.resistance * battery.hover_current
    return {
        "SIM_BAT_DRAIN": 3600.0 * battery.capacity / battery.hover_current,
        "SIM_BAT_MIN_PCT": 0.0,
        "BAT1_N_CELLS": _CELLS,
        "BAT1_V_CHARGED": (battery.full_voltage - sag) / _CELLS,
        "BAT1_V_EMPTY": (battery.empty_voltage - sag) / _CELLS,
    }


def _until_we_die() -> tuple[str, ...]:
    """A PX4 whose simulator has gone would keep a core busy for ever: the kernel ends it with us, where it can."""
    setpriv = shutil.which("setpriv")
    return () if setpriv is None else (setpriv, "--pdeathsig", "KILL")


# -- from the command line ------------------------------------------------------------------------------------------

_CONFIGS = Path(__file__).resolve().parent.parent / "configs"


def main(arguments: Sequence[str] | None = None) -> int:
    """PX4 in software with the parameters of the vehicle, until interrupted. It waits for its simulator."""
    parser = argparse.ArgumentParser(prog="python -m sim_backend.px4_sitl", description=main.__doc__)
    parser.add_argument("build", type=Path, nargs="?", default=build_folder(), help=f"default: what {VARIABLE} names")
    parser.add_argument(
        "--parameters", type=Path, default=_CONFIGS / "px4" / "x500.params", help="file of QGroundControl"
    )
    parser.add_argument("--instance", type=int, default=0, choices=range(10), metavar="N", help="0 to 9")
    parser.add_argument("--folder", type=Path, help="where PX4 runs and leaves its logs; default: nothing is left")
    given = parser.parse_args(arguments)
    if given.build is None:
        parser.error(f"want the build folder of PX4, here or in {VARIABLE}")
    try:
        vehicle = msgspec.convert(yaml.safe_load((_CONFIGS / "vehicle.yaml").read_text(encoding="utf-8")), Vehicle)
        parameters = {**read_parameter_file(given.parameters), **battery_parameters(vehicle.battery)}
        with Px4Sitl(given.build, parameters, given.instance, given.folder) as px4:
            told = 0
            while True:
                output = px4.output()
                sys.stdout.write(output[told:])
                sys.stdout.flush()
                told = len(output)
                px4.check()
                time.sleep(_LOOK_PERIOD)
    except (DeviceError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except KeyboardInterrupt:
        return 0


if __name__ == "__main__":
    raise SystemExit(main())
