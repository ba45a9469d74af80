"""The fuzzy surface of the tuned law, over every pitch that the gate lets pass in a press."""

from __future__ import annotations

from math import degrees, radians

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from onboard.config import load_config
from onboard.core.fuzzy import evaluate

CONFIG = load_config()
FUZZY = CONFIG.fuzzy
SPREAD = FUZZY.output_scale * (FUZZY.output_high - FUZZY.output_low)
PITCH = 15.0
"""Beyond this no press is flown: 3.5 N lean the lightest vehicle by 9 degrees. deg."""

errors = st.floats(-5.0, 5.0)
pitches = st.floats(0.0, radians(PITCH))


def test_the_gate_allows_these_pitches() -> None:
    assert degrees(CONFIG.limits.tilt) >= PITCH
    assert degrees(CONFIG.tilt.tilt_max) >= PITCH


@settings(max_examples=1000)
@given(errors, st.floats(0.0, 5.0), pitches)
def test_more_force_error_never_pushes_less(error: float, more: float, pitch: float) -> None:
    assert evaluate(error + more, pitch, FUZZY) >= evaluate(error, pitch, FUZZY) - 1e-12 * SPREAD


@settings(max_examples=500)
@given(errors, st.floats(0.0, radians(FUZZY.pitch_high_deg) / 3.0))
def test_odd_in_the_force_error_at_small_pitch(error: float, pitch: float) -> None:
    """Up to the peak of the term PS of the pitch."""
    assert evaluate(-error, pitch, FUZZY) == pytest.approx(-evaluate(error, pitch, FUZZY), abs=1e-12 * SPREAD)


@given(pitches)
def test_no_error_gives_no_push(pitch: float) -> None:
    assert evaluate(0.0, pitch, FUZZY) == pytest.approx(0.0, abs=1e-12 * SPREAD)
