"""Parameter files as QGroundControl writes them, and what PX4 holds otherwise.

A line has five columns between tabs: vehicle, component, name, value, type (MAV_PARAM_TYPE: 6 INT32, 9 REAL32, the two
that PX4 knows). Lines that begin with # are comments; so says QGroundControl, which reads no comment behind a value.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from math import isfinite
from pathlib import Path

Value = int | float
"""An int is an INT32, a float a REAL32."""

INT32, REAL32 = 6, 9
_LONGEST_NAME = 16
_ROW = "want vehicle, component, name, value and type between tabs, as: 1<tab>1<tab>EKF2_EV_CTRL<tab>15<tab>6"


def read_parameter_file(path: Path) -> dict[str, Value]:
    """Names and values of a file, in its order. Raises ValueError with every error of it, also when there is none."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read ({error}); want a parameter file of QGroundControl") from error
    return read_parameters(text, str(path))


def read_parameters(text: str, source: str) -> dict[str, Value]:
    """Names and values of the text of a file. Raises ValueError with every error, each with ``source`` and line."""
    found: dict[str, Value] = {}
    lines: dict[str, int] = {}
    errors: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        columns = [column.strip() for column in line.split("\t")]
        wrong = list(_wrong(columns))
        if not wrong and columns[2] in lines:
            wrong = [f"{columns[2]} stands in line {lines[columns[2]]} already; want it once"]
        errors += [f"{source}: line {number}: {what}" for what in wrong]
        if not wrong:
            _, _, name, value, kind = columns
            lines[name] = number
            found[name] = int(value) if int(kind) == INT32 else _single(float(value))
    if not found and not errors:
        errors.append(f"{source}: no parameter in it; {_ROW}")
    if errors:
        raise ValueError("\n".join(errors))
    return found


def _wrong(columns: list[str]) -> Iterable[str]:
    """What is wrong with the columns of one line."""
    if len(columns) != 5:
        yield f"{len(columns)} columns; {_ROW}"
        return
    vehicle, component, name, value, kind = columns
    if not (vehicle.isdecimal() and len(vehicle) <= 3 and 1 <= int(vehicle) <= 255):
        yield f"vehicle {vehicle!r}; want 1 to 255"
    if component != "1":
        yield f"component {component!r}; want 1, the autopilot"
    if not (name.isascii() and name.replace("_", "").isalnum() and name == name.upper() and len(name) <= _LONGEST_NAME):
        yield f"name {name!r}; want capitals, digits and underscores, {_LONGEST_NAME} at most"
    if kind == str(INT32):
        if not _is(int, value) or not -(2**31) <= int(value) < 2**31:
            yield f"{name} is {value!r}; want a whole number of 32 bits, for its type is 6 (INT32)"
    elif kind == str(REAL32):
        if not _is(float, value) or not isfinite(float(value)) or abs(float(value)) > 3.4e38:
            yield f"{name} is {value!r}; want a finite number, for its type is 9 (REAL32)"
    else:
        yield f"type {kind!r} of {name}; want 6 (INT32) or 9 (REAL32)"


def _is(number: type[int] | type[float], text: str) -> bool:
    try:
        number(text)
    except ValueError:
        return False
    return True


def _single(value: float) -> float:
    """The nearest number of single precision, which is what PX4 can hold."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def differences(wanted: Mapping[str, Value], held: Mapping[str, Value | None]) -> tuple[str, ...]:
    """One sentence for each wanted parameter that is held otherwise; None: PX4 did not tell it."""
    told: list[str] = []
    for name, want in wanted.items():
        has = held.get(name)
        if has is None:
            told.append(
                f"{name}: PX4 does not tell it, wants {_words(want)}; is there such a parameter in its version?"
            )
        elif isinstance(has, int) is not isinstance(want, int):
            kind, other = ("a whole number", "a real one")[:: 1 if isinstance(has, int) else -1]
            told.append(f"{name} is {kind} in PX4 ({_words(has)}), {other} in the file ({_words(want)})")
        elif (has != want) if isinstance(want, int) else abs(has - want) > 1e-6 * max(1.0, abs(want)):
            told.append(f"{name} is {_words(has)}, wants {_words(want)}")
    return tuple(told)


def _words(value: Value) -> str:
    return f"{value}" if isinstance(value, int) else f"{value:.7g}"


def float_of_bits(value: int) -> float:
    """The REAL32 with the bits of an INT32: how PX4 puts whole numbers into MAVLink's float field."""
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def bits_of_float(value: float) -> int:
    """The INT32 with the bits of a REAL32."""
    return int(struct.unpack("<i", struct.pack("<f", value))[0])
