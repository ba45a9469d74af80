"""Shared by all tests: random examples are the same in every run, and a busy machine is no fault of a flight."""

from __future__ import annotations

import time
from collections.abc import Generator

import pytest
from hypothesis import HealthCheck, settings

from tests.realtime import Machine

# A loaded machine is slow; that says nothing about the code.
settings.register_profile("repeatable", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("repeatable")

_MACHINE = pytest.StashKey[Machine]()
_BEGAN = pytest.StashKey[dict[str, float]]()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Watch the machine from the first flight on; note when each module began."""
    if item.get_closest_marker("realtime") is not None:
        if _MACHINE not in item.config.stash:
            item.config.stash[_MACHINE] = Machine()
        item.config.stash.setdefault(_BEGAN, {}).setdefault(str(item.path), time.monotonic())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A flight that failed on a machine that did not keep time is skipped, and says so."""
    report = yield
    if report.failed and _MACHINE in item.config.stash and item.get_closest_marker("realtime") is not None:
        why = item.config.stash[_MACHINE].unfit(item.config.stash[_BEGAN][str(item.path)])
        if why:
            failure = str(call.excinfo.value).splitlines()[0] if call.excinfo and str(call.excinfo.value) else "failed"
            report.outcome = "skipped"
            report.longrepr = (str(item.path), item.location[1] or 0, f"Skipped: {why}; seen: {failure}")
    return report


def pytest_unconfigure(config: pytest.Config) -> None:
    """Watch no more."""
    if _MACHINE in config.stash:
        config.stash[_MACHINE].stop()
