from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.acceptance.flights import Hangar


@pytest.fixture(scope="session")
def fly() -> Iterator[Hangar]:
    """``fly(*sets, law=, scenario=, seed=)``: a whole mission, flown once per process."""
    with TemporaryDirectory(prefix="pipewright-") as folder:
        yield Hangar(Path(folder))
