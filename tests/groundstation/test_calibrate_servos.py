"""Zeros and signs from the command line, of an emulated arm that is stood by hand."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import yaml

from drivers.dynamixel_calibrate import FiveServos
from groundstation import calibrate, codes
from onboard.config import load_config
from sim_backend.dynamixel_emulator import DynamixelEmulator, emulate
from sim_backend.faults import Kind
from tests.drivers.test_dynamixel_calibrate import FIRST, MOUNTING, SECOND, stand

IDS = ["--ids", "3", "7", "4", "9", "12"]
Told = tuple[int, str, str]
Run = Callable[..., Told]


@pytest.fixture
def emulator() -> Iterator[DynamixelEmulator]:
    made = emulate(MOUNTING, wire=False)
    made.start()
    yield made
    made.stop()


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def running(*arguments: str) -> Told:
        parser = argparse.ArgumentParser()
        calibrate.add_parser(parser.add_subparsers())
        options = parser.parse_args(["calibrate", "servos", *arguments])
        code = options.run(options)
        told = capsys.readouterr()
        return code, told.out, told.err

    return running


@pytest.fixture
def second_pose(emulator: DynamixelEmulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever is asked for the second pose stands it."""

    def stood(text: str) -> str:
        assert "second pose" in text
        stand(emulator, SECOND)
        return ""

    monkeypatch.setattr("builtins.input", stood)


TWO_POSES = ["--angles", *map(str, FIRST), "--then", *map(str, SECOND)]


@pytest.mark.usefixtures("second_pose")
def test_signs_and_zeros(emulator: DynamixelEmulator, run: Run) -> None:
    stand(emulator, FIRST)
    code, out, _ = run("--port", emulator.path, *IDS, *TWO_POSES)
    assert code == codes.DONE
    assert "theta_2 (id 7): zero at 2600 counts, was 2048, turns the other way round" in out
    found = msgspec.convert(yaml.safe_load(out)["devices"]["servos"]["servos"], FiveServos)
    assert [servo.id for servo in found] == [mount.id for mount in MOUNTING]
    assert [servo.sign for servo in found] == [mount.sign for mount in MOUNTING]
    assert [servo.zero for servo in found] == pytest.approx([mount.zero for mount in MOUNTING], abs=1)


@pytest.mark.usefixtures("second_pose")
def test_they_are_written_into_the_configuration(emulator: DynamixelEmulator, run: Run, tmp_path: Path) -> None:
    """The file says where the bus is; all else that it says of the servos stays."""
    mine = tmp_path / "mine.yaml"
    servos = "\n".join(f"      - {{id: {mount.id}, torque_constant: 0.4}}   # of {mount.id}" for mount in MOUNTING)
    mine.write_text(
        f"devices:\n  world: 127.0.0.1:1\n  servos:\n    port: {emulator.path}   # the bus\n    servos:\n{servos}\n"
    )
    stand(emulator, FIRST)
    code, out, _ = run("--config", str(mine), *TWO_POSES)
    assert code == codes.DONE
    assert f"{mine}: written" in out
    found = load_config(str(mine)).devices.servos.servos
    assert [(servo.id, servo.sign) for servo in found] == [(mount.id, mount.sign) for mount in MOUNTING]
    assert [servo.zero for servo in found] == pytest.approx([mount.zero for mount in MOUNTING], abs=1)
    assert {servo.torque_constant for servo in found} == {0.4}
    assert mine.read_text().count("# of ") == 5


@pytest.mark.usefixtures("second_pose")
def test_into_a_file_that_says_nothing_of_servos(emulator: DynamixelEmulator, run: Run, tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("# mine\n")
    stand(emulator, FIRST)
    assert run("--config", str(mine), "--port", emulator.path, *IDS, *TWO_POSES)[0] == codes.DONE
    found = load_config(str(mine)).devices.servos.servos
    assert [servo.sign for servo in found] == [mount.sign for mount in MOUNTING]
    assert [servo.id for servo in found] == [mount.id for mount in MOUNTING]


def test_a_servo_that_was_not_turned_as_said(
    emulator: DynamixelEmulator, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand(emulator, FIRST)
    monkeypatch.setattr("builtins.input", lambda text: stand(emulator, (40.0, -22.0, -30.0, -45.0, 5.0)))
    arguments = ["--angles", *map(str, FIRST), "--then", "40", "-22", "-30", "-45", "45"]
    code, out, err = run("--port", emulator.path, *IDS, *arguments)
    assert (code, out) == (codes.WRONG_INPUT, "")
    assert "theta_2: the poses are -2 deg apart, want 5 or more" in err
    assert "gripper: turned by 0 deg, but 40 were said" in err


def test_nobody_is_there_for_the_second_pose(
    emulator: DynamixelEmulator, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(text: str) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", ended)
    code, _, err = run("--port", emulator.path, *IDS, *TWO_POSES)
    assert code == codes.WRONG_INPUT
    assert "wants a person at the terminal" in err


def test_a_servo_that_is_missing(emulator: DynamixelEmulator, run: Run) -> None:
    emulator.inject(Kind.SILENT, part="pump")
    code, _, err = run("--port", emulator.path, *IDS, "--angles", "0", "0", "0", "0", "0")
    assert code == codes.NOT_THERE
    assert "no answer from pump (id 9)" in err


def test_no_port(run: Run, tmp_path: Path) -> None:
    zero = ["--angles", "0", "0", "0", "0", "0"]
    code, _, err = run("--port", "/nowhere", *zero)
    assert code == codes.NOT_THERE
    assert "cannot open /nowhere: it is not there" in err
    code, _, err = run(*zero)
    assert code == codes.WRONG_INPUT
    assert "--port: missing" in err
    code, _, err = run("--config", str(tmp_path / "nothing.yaml"), *zero)
    assert code == codes.WRONG_INPUT
    assert "nothing.yaml" in err
    code, _, err = run("--port", "/nowhere", "--ids", "1", "2", "3", "4", "999", *zero)
    assert code == codes.WRONG_INPUT
    assert "--ids" in err
