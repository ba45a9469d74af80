"""Shared by all tests: every random example is the same in every run."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

# A loaded machine is slow; that says nothing about the code.
settings.register_profile("repeatable", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("repeatable")
