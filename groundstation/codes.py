"""Exit codes of the commands: here and nowhere else."""

from __future__ import annotations

from typing import Final

DONE: Final = 0
"""Done as asked; a mission: completed."""
BROKEN: Final = 1
"""A replay differs, or the flight process failed."""
WRONG_INPUT: Final = 2
REFUSED: Final = 3
"""The vehicle refuses; a mission: ended safely, but not completed."""
LOST: Final = 4
"""A mission: the vehicle was lost."""
NOT_THERE: Final = 5
"""No vehicle is seen; a flight: a device cannot be had."""
TIMED_OUT: Final = 6
"""The vehicle gave no answer in time: what was asked may or may not be done."""
INTERRUPTED: Final = 130
