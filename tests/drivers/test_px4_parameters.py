"""Parameter files of QGroundControl: what is read, what is wrong with them, and how they differ from what PX4 holds."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
import yaml
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from drivers.px4_parameters import (
    Value,
    bits_of_float,
    differences,
    float_of_bits,
    read_parameter_file,
    read_parameters,
)
from drivers.thrust import ThrustMap
from drivers.vehicle import Vehicle

CONFIGS = Path(__file__).parents[2] / "configs"
X500 = CONFIGS / "px4" / "x500.params"
VEHICLE = msgspec.convert(yaml.safe_load((CONFIGS / "vehicle.yaml").read_text(encoding="utf-8")), Vehicle)


def test_what_qgroundcontrol_writes() -> None:
    text = (
        "# Onboard parameters for Vehicle 1\n#\n# Vehicle-Id Component-Id Name Value Type\n"
        "1\t1\tCOM_OF_LOSS_T\t0.500000000000000000\t9\n1\t1\tEKF2_EV_CTRL\t15\t6\n\n1\t1\tMC_X\t-1\t6\n"
    )
    read = read_parameters(text, "file")
    assert read == {"COM_OF_LOSS_T": 0.5, "EKF2_EV_CTRL": 15, "MC_X": -1}
    assert [type(value) for value in read.values()] == [float, int, int]


def test_a_real_number_is_what_px4_can_hold_of_it() -> None:
    assert read_parameters("1\t1\tA\t0.1\t9", "file")["A"] == pytest.approx(0.1, abs=1e-8)
    assert read_parameters("1\t1\tA\t0.1\t9", "file")["A"] != 0.1


def test_every_error_is_told_at_once() -> None:
    text = "\n".join(
        (
            "1\t1\tA\t1\t6",
            "1 1 B 1 6",
            "0\t1\tC\t1\t6",
            "1\t2\tD\t1\t6",
            "1\t1\tlower\t1\t6",
            "1\t1\tA_NAME_THAT_IS_LONG\t1\t6",
            "1\t1\tE\t1.5\t6",
            "1\t1\tF\t4294967296\t6",
            "1\t1\tG\tnan\t9",
            "1\t1\tH\tmuch\t9",
            "1\t1\tI\t1\t2",
            "1\t1\tA\t2\t6",
        )
    )
    with pytest.raises(ValueError, match=r"line 2") as caught:
        read_parameters(text, "some.params")
    told = str(caught.value).splitlines()
    assert told == [
        "some.params: line 2: 1 columns; want vehicle, component, name, value and type between tabs, as: "
        "1<tab>1<tab>EKF2_EV_CTRL<tab>15<tab>6",
        "some.params: line 3: vehicle '0'; want 1 to 255",
        "some.params: line 4: component '2'; want 1, the autopilot",
        "some.params: line 5: name 'lower'; want capitals, digits and underscores, 16 at most",
        "some.params: line 6: name 'A_NAME_THAT_IS_LONG'; want capitals, digits and underscores, 16 at most",
        "some.params: line 7: E is '1.5'; want a whole number of 32 bits, for its type is 6 (INT32)",
        "some.params: line 8: F is '4294967296'; want a whole number of 32 bits, for its type is 6 (INT32)",
        "some.params: line 9: G is 'nan'; want a finite number, for its type is 9 (REAL32)",
        "some.params: line 10: H is 'much'; want a finite number, for its type is 9 (REAL32)",
        "some.params: line 11: type '2' of I; want 6 (INT32) or 9 (REAL32)",
        "some.params: line 12: A stands in line 1 already; want it once",
    ]


def test_a_file_without_parameters(tmp_path: Path) -> None:
    empty = tmp_path / "empty.params"
    empty.write_text("# nothing\n")
    with pytest.raises(ValueError, match=r"empty\.params: no parameter in it; want vehicle"):
        read_parameter_file(empty)
    with pytest.raises(ValueError, match=r"none\.params: cannot be read .*want a parameter file of QGroundControl"):
        read_parameter_file(tmp_path / "none.params")
    (tmp_path / "bytes.params").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"bytes\.params: cannot be read"):
        read_parameter_file(tmp_path / "bytes.params")


def test_differences_are_sentences() -> None:
    wanted: dict[str, Value] = {"A": 15, "B": 0.5, "C": 1, "D": 2, "E": 0.3, "F": 3}
    held: dict[str, Value | None] = {"A": 0, "B": 1.0, "C": 1.0, "D": None, "E": 0.30000001192, "F": 3}
    assert differences(wanted, held) == (
        "A is 0, wants 15",
        "B is 1, wants 0.5",
        "C is a real one in PX4 (1), a whole number in the file (1)",
        "D: PX4 does not tell it, wants 2; is there such a parameter in its version?",
    )
    assert differences(wanted, wanted) == ()


@hypothesis_settings(deadline=None, max_examples=200, derandomize=True)
@given(value=st.integers(-(2**31), 2**31 - 1).filter(lambda value: value & 0x7F800000 != 0x7F800000))
def test_whole_numbers_travel_in_a_float(value: int) -> None:
    """All but those whose bits are no finite number."""
    assert bits_of_float(float_of_bits(value)) == value


def test_the_vehicles_file_agrees_with_the_vehicle() -> None:
    """Geometry, thrust curve, hover thrust and battery stand twice: for PX4 and for us."""
    px4, rotors, battery = read_parameter_file(X500), VEHICLE.rotors, VEHICLE.battery
    assert px4["CA_ROTOR_COUNT"] == 4
    # PX4's numbering in FRD, as sim_backend/motors.py: front right, rear left, front left, rear right
    for number, (x, y, turn) in enumerate(((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))):
        assert px4[f"CA_ROTOR{number}_PX"] == pytest.approx(x * rotors.arm_x)
        assert px4[f"CA_ROTOR{number}_PY"] == pytest.approx(y * rotors.arm_y)
        assert px4[f"CA_ROTOR{number}_KM"] == pytest.approx(turn * rotors.torque_per_thrust)
    thrust = ThrustMap.of(VEHICLE)
    assert px4["THR_MDL_FAC"] == pytest.approx(rotors.curve)
    assert px4["THR_MDL_FAC"] == pytest.approx(thrust.px4_curve)
    assert (px4["MC_BAT_SCALE_EN"] == 0) is (thrust.voltage_exponent > 0.0)
    assert px4["MPC_THR_HOVER"] == pytest.approx(thrust.hover_thrust, abs=0.01)
    cells = px4["BAT1_N_CELLS"]
    assert cells * px4["BAT1_V_CHARGED"] == pytest.approx(battery.full_voltage)
    assert cells * px4["BAT1_V_EMPTY"] == pytest.approx(battery.empty_voltage)
    assert px4["BAT1_CAPACITY"] == pytest.approx(1e3 * battery.capacity)


def test_the_vehicles_file_flies_on_vision_alone() -> None:
    px4 = read_parameter_file(X500)
    wanted = {
        "EKF2_EV_CTRL": 15, "EKF2_GPS_CTRL": 0, "EKF2_HGT_REF": 3, "EKF2_MAG_TYPE": 5, "SYS_HAS_MAG": 0,
        "SYS_HAS_GPS": 0, "EKF2_EV_QMIN": 1, "COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 4,
    }  # fmt: skip
    assert {name: px4[name] for name in wanted} == wanted
    assert int(px4["COM_RCL_EXCEPT"]) & 4


def test_every_parameter_of_the_vehicles_file_has_its_reason() -> None:
    """A comment stands above each group of lines."""
    lines = X500.read_text(encoding="utf-8").splitlines()
    for before, line in pairwise(lines):
        if line and not line.startswith("#"):
            assert before.startswith("#") or "\t" in before, line
