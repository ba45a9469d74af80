"""What the tests of the simulated world share."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import yaml

from drivers.vehicle import Vehicle


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    path = Path(__file__).parents[2] / "configs" / "vehicle.yaml"
    return msgspec.convert(yaml.safe_load(path.read_text(encoding="utf-8")), Vehicle)
