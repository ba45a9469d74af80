"""The service as systemd itself reads it, and as the flight process needs it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from onboard.ending import PATIENCE

ROOT = Path(__file__).resolve().parents[2]
UNIT = ROOT / "configs/systemd/pipewright.service"
JETPACK = ROOT / "configs/jetson/jetpack.conf"
RULES = ROOT / "configs/udev"
#: Where the unit expects the program.
INSTALLED = "/opt/pipewright"
#: systemd's measure of what a service could still do, from 0 to 10; 9.6 is a service that says nothing.
EXPOSED = 3.5


@pytest.fixture
def analyze() -> str:
    path = shutil.which("systemd-analyze")
    if path is None:
        pytest.skip("systemd-analyze is not on this machine (Debian, Ubuntu: apt install systemd)")
    return path


def settings(path: Path) -> dict[str, list[str]]:
    """What a unit or rules file of systemd says, by name."""
    found = defaultdict(list)
    for line in path.read_text("utf-8").splitlines():
        if line and line[0] not in "#;[":
            name, _, value = line.partition("=")
            found[name].append(value)
    return found


def rules() -> Iterator[str]:
    for path in sorted(RULES.glob("*.rules")):
        yield from (line for line in path.read_text("utf-8").splitlines() if line and not line.startswith("#"))


def seconds(values: list[str]) -> float:
    (value,) = values
    return float(value)


@pytest.mark.parametrize("drop_ins", [[], [JETPACK]], ids=["alone", "on JetPack"])
def test_systemd_has_nothing_to_say_against_it(analyze: str, tmp_path: Path, drop_ins: list[Path]) -> None:
    program = tmp_path / "opt/.venv/bin/pipewright"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for path in (UNIT, *drop_ins):
        folder = tmp_path / "units" / ("pipewright.service.d" if path in drop_ins else "")
        folder.mkdir(parents=True, exist_ok=True)
        text = path.read_text("utf-8")
        # what systemd looks for, it looks for here
        text = text.replace(INSTALLED, str(tmp_path / "opt")).replace(
            "RootDirectory=/srv/pipewright", "RootDirectory=/"
        )
        (folder / path.name).write_text(text)
    unit = tmp_path / "units" / UNIT.name
    done = subprocess.run([analyze, "verify", "--man=no", str(unit)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_it_can_do_little_beyond_its_task(analyze: str) -> None:
    command = [analyze, "security", "--offline=yes", f"--threshold={round(EXPOSED * 10)}", "--no-pager", str(UNIT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_it_never_flies_by_itself() -> None:
    """A service that is restarted waits on the ground: with ``--mission`` a crash would be answered by a takeoff."""
    (command,) = settings(UNIT)["ExecStart"]
    assert command.startswith(f"{INSTALLED}/.venv/bin/pipewright onboard --config ")
    assert "--mission" not in command


def test_a_landing_has_its_time() -> None:
    assert seconds(settings(UNIT)["TimeoutStopSec"]) >= PATIENCE + 10


def test_every_device_that_it_waits_for_gets_its_name_from_udev() -> None:
    unit = settings(UNIT)
    (wanted,) = unit["Wants"]
    (after,) = unit["After"]
    devices = [name.removeprefix("dev-").removesuffix(".device") for name in wanted.split()]
    assert set(wanted.split()) <= set(after.split())
    assert len(devices) == 3
    for device in devices:
        (rule,) = (rule for rule in rules() if f'SYMLINK+="{device}"' in rule)
        assert 'TAG+="systemd"' in rule, "else systemd would never see it come"
        (group,) = re.findall(r'GROUP="(\w+)"', rule)
        assert group in unit["SupplementaryGroups"][0].split()


def test_the_configuration_of_the_vehicle_uses_these_names() -> None:
    text = (ROOT / "configs/jetson.yaml").read_text("utf-8")
    named = set(re.findall(r"/dev/(\w+)", text))
    assert named == {"autopilot", "servos"}
    assert all(any(f'SYMLINK+="{name}"' in rule for rule in rules()) for name in named)


def test_the_service_may_read_its_keys_and_not_change_them() -> None:
    link = yaml.safe_load((ROOT / "configs/jetson.yaml").read_text("utf-8"))["link"]
    unit = settings(UNIT)
    assert unit["ReadOnlyPaths"] == [f"-{link['keys']}"]
    assert unit["ReadWritePaths"] == [f"-{Path(link['keys']).parent}"], "saved parameters"
    assert str(Path(link["keys"]).parent) in settings(JETPACK)["BindPaths"][0].split()


def test_a_rule_is_made_of_known_keys() -> None:
    """A comma or a quote that is missing makes udev drop the line, and say so only in the journal."""
    item = r"(?:ENV|ATTRS?)\{[\w/]+\}|SUBSYSTEM|KERNEL|DRIVER|ACTION|SYMLINK|TAG|GROUP|MODE|GOTO|LABEL"
    for rule in rules():
        assert re.fullmatch(rf'(?:(?:{item})(?:==|!=|\+=|=)"[\w/.*|-]+"(?:, |$))+', rule), rule
