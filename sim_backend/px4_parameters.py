"""The parameters of the stand-in: what the vehicle's file says, PX4's defaults beside it, and facts of the world."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

import msgspec

from drivers.px4_parameters import INT32, REAL32, Value, bits_of_float, float_of_bits, read_parameter_file
from sim_backend.world import World

#: What the vehicle is meant to hold.
FILE = Path(__file__).resolve().parent.parent / "configs" / "px4" / "x500.params"

#: Parameters that decide about something here and are not in the file: PX4's defaults.
_DEFAULTS: Mapping[str, Value] = {
    "BAT_EMERGEN_THR": 0.05,
    "BAT_LOW_THR": 0.15,
    "EKF2_DELAY_MAX": 200.0,
    "LNDMC_ROT_MAX": 20.0,
    "LNDMC_XY_VEL_MAX": 1.5,
    "LNDMC_Z_VEL_MAX": 0.25,
    "MPC_THR_MIN": 0.12,
}
#: Parameters that are facts of the world, with the field of AutopilotParams that holds them.
_HELD = {"COM_OF_LOSS_T": "offboard_timeout", "COM_DISARM_LAND": "disarm_delay", "MPC_LAND_SPEED": "descent_speed"}


class Parameters:
    """Names and values, as PX4 holds them: an int is an INT32, a float a REAL32. They outlive a reboot."""

    def __init__(self, world: World, changes: Mapping[str, Value] | None = None) -> None:
        """``changes`` are made by name. ValueError as in ``set``."""
        self._world = world
        held = {name: getattr(world.autopilot.params, field) for name, field in _HELD.items()}
        facts: dict[str, Value] = {**held, "THR_MDL_FAC": world.vehicle.rotors.curve}
        self._values = dict(sorted({**_DEFAULTS, **read_parameter_file(FILE), **facts}.items()))
        for name, value in (changes or {}).items():
            self.set(name, value)

    def __getitem__(self, name: str) -> Value:
        return self._values[name]

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __len__(self) -> int:
        return len(self._values)

    def names(self) -> tuple[str, ...]:
        """All names, in the order of their indices."""
        return tuple(self._values)

    def set(self, name: str, value: Value) -> None:
        """Change a parameter; ValueError: no such parameter, not of its type, or not what the world can be."""
        old = self._values.get(name)
        if old is None:
            near = get_close_matches(name, self._values) or [f"one of the {len(self)} of {FILE.name}"]
            raise ValueError(f"PX4 stand-in: no parameter {name}; want perhaps {', '.join(near)}")
        if isinstance(old, int) and not isinstance(value, int):
            raise ValueError(f"PX4 stand-in: {name} is {value}; want a whole number")
        value = value if isinstance(old, int) else float(value)
        if name in _HELD:
            autopilot = self._world.autopilot
            fields = {**msgspec.structs.asdict(autopilot.params), _HELD[name]: value}
            try:
                autopilot.params = msgspec.convert(fields, type(autopilot.params))
            except msgspec.ValidationError as error:
                raise ValueError(f"PX4 stand-in: {name} is {value}: {error}") from error
        if name == "THR_MDL_FAC" and not 0.0 <= value <= 1.0:
            raise ValueError(f"PX4 stand-in: {name} is {value}; want 0 to 1")
        self._values[name] = value

    def drop(self, name: str) -> None:
        """Be a PX4 that has no such parameter."""
        del self._values[name]

    def wire(self, name: str) -> tuple[float, int]:
        """MAVLink's float field and MAV_PARAM_TYPE: PX4 carries an integer's bits in the float."""
        value = self._values[name]
        return (float_of_bits(value), INT32) if isinstance(value, int) else (value, REAL32)

    def set_wire(self, name: str, field: float) -> None:
        """Change a parameter by MAVLink's float field. ValueError as in ``set``."""
        self.set(name, bits_of_float(field) if isinstance(self._values.get(name), int) else field)
