"""Files that are shipped in ``configs`` and known by their names."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from msgspec import Struct

from groundstation.parsing import nearest
from onboard.headless import ConfigError

_CONFIGS: Final = Path(__file__).resolve().parent.parent / "configs"


class Shipped(Struct, frozen=True):
    """The files of one folder of ``configs``."""

    what: str
    """One of them, in a sentence."""
    folder: str

    def names(self) -> list[str]:
        """Names of those that exist."""
        return sorted(path.stem for path in (_CONFIGS / self.folder).glob("*.yaml"))

    def path(self, given: str) -> Path:
        """The file of that name, or the file itself. Raises ConfigError for a name that is not shipped."""
        if "/" in given or given.endswith((".yaml", ".yml")):
            return Path(given)
        path = _CONFIGS / self.folder / f"{given}.yaml"
        if not path.is_file():
            known = nearest(given, self.names()) or self.names()
            raise ConfigError([f"{given}: no {self.what} of that name; there are: {', '.join(known)}; or give a file"])
        return path
