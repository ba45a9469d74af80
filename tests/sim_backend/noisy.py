"""Sensors with noise, biases, drift and delay, but nothing lost, jumping or in doubt: samples come at fixed times."""

from __future__ import annotations

import msgspec

from sim_backend.sensors import REALISTIC, SensorParams

NOISY = SensorParams(
    odometry=msgspec.structs.replace(REALISTIC.odometry, delay=0.020, jump_rate=0.0, doubt_rate=0.0),
    autopilot=msgspec.structs.replace(REALISTIC.autopilot, delay=0.006, jitter=0.0, loss=0.0, accelerometer_drift=0.0),
    servos=REALISTIC.servos,
)

#: The same for ``--set``.
NOISY_SET = f"world.sensors={msgspec.json.encode(NOISY).decode()}"
