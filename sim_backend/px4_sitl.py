"""A real PX4 in software (SITL), started with the vehicle's parameters in a run folder of its own, and ended again.

It needs a build folder of PX4 (``make px4_sitl_default`` gives build/px4_sitl_default), which the environment variable
PIPEWRIGHT_PX4 may name. PX4 then looks for its simulator on TCP ``4560 + instance``. (docs/px4.md)
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from drivers.protocols import DeviceError

#: The environment variable that names a build folder.
VARIABLE = "PIPEWRIGHT_PX4"
_OUTPUT = "px4.out"
#: The airframe that waits for a simulator from outside. Its geometry is overridden by the vehicle's parameters.
_MODEL = "none_iris"
#: What PX4's start script sets by itself, after our parameters.
_SCRIPTS_OWN = ("SYS_AUTOSTART", "MAV_SYS_ID")
_PATIENCE = 5.0
_LAST_LINES = 15


class Px4Sitl:
    """One PX4 process. ``folder`` is kept; without one, PX4 runs in a temporary folder that ``stop`` removes.

    Its parameters are its defaults and ``parameters``, whatever it held before.
    """

    def __init__(
        self, build: Path, parameters: Mapping[str, int | float], instance: int = 0, folder: Path | None = None
    ) -> None:
        self._binary, self._scripts = build / "bin" / "px4", build / "etc"
        for needed in (self._binary, self._scripts):
            if not needed.exists():
                raise DeviceError(
                    f"PX4: {needed} is not there; want the build folder that make px4_sitl_default leaves "
                    "(build/px4_sitl_default)"
                )
        self._parameters = parameters
        self.instance = instance
        self._temporary = tempfile.TemporaryDirectory(prefix="px4-") if folder is None else None
        self.folder = Path(self._temporary.name) if self._temporary else Path(folder or ".")
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
                [self._binary, "-i", str(self.instance), "-d", "-w", self.folder, self._scripts],
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
        if self._temporary is not None:
            self._temporary.cleanup()

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
