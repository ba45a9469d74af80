"""Declared faults come and go at their time and phase, and wrong ones are refused with every reason."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_backend.faults import Fault, Faults, Kind, read_fault_file, read_faults

KINDS = (Kind.NAN, Kind.SILENT, Kind.JUMP)


def kinds(faults: Faults, t: float) -> list[Kind]:
    return [fault.kind for fault in faults.active(t)]


def test_in_force_from_its_start_for_its_duration() -> None:
    faults = Faults("odometry", KINDS, [Fault("odometry", Kind.NAN, 2.0, 0.5)])
    assert [kinds(faults, t) for t in (1.999, 2.0, 2.499, 2.5)] == [[], [Kind.NAN], [Kind.NAN], []]


def test_without_a_duration_it_stays() -> None:
    faults = Faults("odometry", KINDS, [Fault("odometry", Kind.SILENT, 1.0)])
    assert kinds(faults, 1e6) == [Kind.SILENT]


def test_faults_of_other_devices_are_left_to_them() -> None:
    faults = Faults("odometry", KINDS, [Fault("servos", Kind.ERROR_BIT), Fault("odometry", Kind.NAN)])
    assert kinds(faults, 0.0) == [Kind.NAN]


def test_with_a_phase_it_counts_from_the_first_entry() -> None:
    faults = Faults("odometry", KINDS, [Fault("odometry", Kind.JUMP, 1.0, 2.0, 0.3, phase="press")])
    assert kinds(faults, 100.0) == []
    for t in (10.0, 10.004, 12.0):
        faults.enter("press", t)
    faults.enter("hold", 10.5)
    assert [kinds(faults, t) for t in (10.9, 11.0, 12.9, 13.0)] == [[], [Kind.JUMP], [Kind.JUMP], []]
    assert faults.active(11.0)[0].start == 11.0


def test_injected_and_cleared_on_command() -> None:
    faults = Faults("odometry", KINDS)
    faults.inject(5.0, Kind.JUMP, value=0.2)
    faults.inject(5.0, Kind.NAN, 1.0)
    assert kinds(faults, 5.5) == [Kind.JUMP, Kind.NAN]
    assert kinds(faults, 6.0) == [Kind.JUMP]
    faults.clear()
    assert kinds(faults, 6.0) == []


def test_a_count_strikes_so_many_and_no_more() -> None:
    faults = Faults("odometry", (Kind.DROP, Kind.DELAY))
    faults.inject(0.0, Kind.DROP, value=0.5, count=2)
    struck = [faults.strike(Kind.DROP, 1.0, chance=chance) is not None for chance in (0.6, 0.4, 0.5, 0.1, 0.1)]
    assert struck == [False, True, False, True, False]
    assert kinds(faults, 1.0) == []


def test_a_beginning_is_told_once_however_short() -> None:
    fault = Fault("odometry", Kind.JUMP, 1.0, 0.0)
    faults = Faults("odometry", KINDS, [fault])
    assert [faults.begun(Kind.JUMP, t) for t in (0.9, 1.1, 1.2)] == [(), (fault,), ()]


def test_cleared_by_kind() -> None:
    faults = Faults("odometry", KINDS)
    faults.inject(0.0, Kind.NAN)
    faults.inject(0.0, Kind.SILENT)
    faults.clear(Kind.NAN)
    assert kinds(faults, 0.0) == [Kind.SILENT]


@pytest.mark.parametrize(
    ("fault", "complaint"),
    [
        (Fault("servos", Kind.DROP, value=1.5), "value 1.5; want a share, above 0 and up to 1"),
        (Fault("servos", Kind.DELAY), "value 0; want seconds, above 0"),
        (Fault("servos", Kind.ERROR_BIT, value=0.5), "value 0.5; want bits, 1 to 255"),
        (Fault("servos", Kind.SILENT, count=3), "has no count; only delay, drop have one"),
        (Fault("servos", Kind.SILENT, part="elbow"), "no part 'elbow'; want one of pump, theta_1"),
    ],
)
def test_what_cannot_be(fault: Fault, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        Faults("servos", (Kind.DROP, Kind.DELAY, Kind.ERROR_BIT, Kind.SILENT), [fault], ("theta_1", "pump"))


def test_find_by_kind_and_part() -> None:
    faults = Faults("servos", (Kind.SILENT, Kind.ERROR_BIT))
    faults.inject(0.0, Kind.ERROR_BIT, value=32.0, part="theta_2")
    faults.inject(1.0, Kind.SILENT)
    found = faults.find(Kind.ERROR_BIT, 0.5, "theta_2")
    assert found is not None
    assert found.value == 32.0
    assert faults.find(Kind.ERROR_BIT, 0.5, "theta_1") is None
    assert faults.find(Kind.SILENT, 0.5, "theta_1") is None
    assert faults.find(Kind.SILENT, 1.0, "theta_1") is not None


def test_a_kind_that_the_device_cannot_show() -> None:
    with pytest.raises(ValueError, match="fault error_bit of odometry: odometry can show jump, nan, silent"):
        Faults("odometry", KINDS, [Fault("odometry", Kind.ERROR_BIT)])


def test_a_list_is_read_from_yaml() -> None:
    text = """
    - {device: odometry, kind: nan, start: 3.0, duration: 0.5}
    - {device: servos, kind: error_bit, value: 32, phase: press, part: theta_2}
    """
    assert read_faults(text, "here") == (
        Fault("odometry", Kind.NAN, 3.0, 0.5),
        Fault("servos", Kind.ERROR_BIT, 0.0, None, 32.0, "press", "theta_2"),
    )


def test_one_is_read_without_a_list_and_none_from_nothing() -> None:
    assert read_faults("{device: odometry, kind: silent}", "here") == (Fault("odometry", Kind.SILENT),)
    assert read_faults("", "here") == ()


def test_every_wrong_one_is_told() -> None:
    text = """
    - {device: odometry, kind: hiccup}
    - {device: odometry, kind: nan, start: -1}
    - {device: odometry, kind: nan}
    - {device: odometry, kind: nan, begin: 1}
    - nonsense
    """
    with pytest.raises(ValueError, match="fault 1") as caught:
        read_faults(text, "faults.yaml")
    lines = str(caught.value).splitlines()
    assert [line.split(":")[1].strip() for line in lines] == ["fault 1", "fault 2", "fault 4", "fault 5"]
    assert all(line.startswith("faults.yaml: ") for line in lines)
    assert "hiccup" in lines[0]
    assert ">= 0" in lines[1]
    assert "begin" in lines[2]


def test_what_is_no_yaml(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="here: not YAML"):
        read_faults("{", "here")
    with pytest.raises(ValueError, match=r"no-such\.yaml: No such file or directory; want a YAML list of faults"):
        read_fault_file(tmp_path / "no-such.yaml")
