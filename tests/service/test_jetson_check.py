"""The script that says what a vehicle's computer lacks, on made-up roots."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
#: The Debian root on JetPack.
INNER = "srv/pipewright"


def look(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = ["sh", str(CONFIGS / "jetson/check.sh"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def lacking(root: Path) -> dict[str, str]:
    """What is said to lack, and the remedy."""
    lines = look(str(root)).stdout.splitlines()
    found = [i for i, line in enumerate(lines) if line.startswith("LACKING")]
    return {lines[i].removeprefix("LACKING").strip(): lines[i + 1].strip() for i in found}


def write(path: Path, text: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def link(path: Path, target: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target)


def complete(root: Path, inner: str) -> None:
    """A machine that lacks nothing; ``inner`` is where Debian is, below it."""
    write(root / inner / "etc/debian_version", "12.11\n")
    write(root / "sys/devices/system/cpu/online", "0-3\n")
    write(root / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n")
    for device, target in (("autopilot", "ttyTHS1"), ("servos", "ttyUSB0"), ("t265", "bus/usb/001/004")):
        link(root / "dev" / device, target)
    write(root / "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "1\n")
    for program in (
        "usr/bin/python3.11",
        "opt/pipewright/.venv/bin/pipewright",
        "usr/local/lib/librealsense2.so.2.53.1",
        "opt/pipewright/.venv/lib/python3.11/site-packages/pyrealsense2/pyrealsense2.cpython-311-aarch64-linux-gnu.so.2.53",
    ):
        write(root / inner / program)
    write(
        root / "etc/passwd",
        f"root:x:0:0::/root:/bin/sh\npipewright:x:{os.getuid()}:997::/var/lib/pipewright:/usr/sbin/nologin\n",
    )
    for source, target in (
        ("udev/99-servos.rules", "etc/udev/rules.d/99-servos.rules"),
        ("udev/99-t265.rules", "etc/udev/rules.d/99-t265.rules"),
        ("udev/99-pixhawk.rules", "etc/udev/rules.d/99-pixhawk.rules"),
        ("systemd/pipewright.service", "etc/systemd/system/pipewright.service"),
        ("systemd/journald.conf", "etc/systemd/journald.conf.d/pipewright.conf"),
        ("jetson.yaml", "etc/pipewright/vehicle.yaml"),
    ):
        (root / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(CONFIGS / source, root / target)
    link(root / "etc/systemd/system/multi-user.target.wants/pipewright.service", "../pipewright.service")
    for name in ("ca.pem", "cert.pem", "key.pem", "roster.json"):
        write(root / "etc/pipewright/keys" / name)
        (root / "etc/pipewright/keys" / name).chmod(0o600)


@pytest.fixture
def jetpack(tmp_path: Path) -> Path:
    complete(tmp_path, INNER)
    write(tmp_path / "etc/nv_tegra_release", "# R32 (release), REVISION: 7.1, GCID: 29818004, BOARD: t210ref\n")
    write(tmp_path / "etc/debian_version", "buster/sid\n")
    write(tmp_path / "var/lib/nvpmodel/status", "pmode:0000 fmode:quiet\n")
    drop_in = tmp_path / "etc/systemd/system/pipewright.service.d/jetpack.conf"
    drop_in.parent.mkdir(parents=True)
    shutil.copy(CONFIGS / "jetson/jetpack.conf", drop_in)
    return tmp_path


def test_a_complete_machine(jetpack: Path) -> None:
    done = look(str(jetpack))
    assert (done.returncode, done.stderr, lacking(jetpack)) == (0, "", {})
    assert done.stdout.endswith("nothing lacks\n")


def test_a_complete_debian_needs_nothing_of_jetpack(tmp_path: Path) -> None:
    complete(tmp_path, ".")
    done = look(str(tmp_path))
    assert done.returncode == 0, done.stdout
    assert "JetPack" not in done.stdout


def test_an_empty_card_lacks_everything_and_each_thing_has_a_remedy(tmp_path: Path) -> None:
    done = look(str(tmp_path))
    assert (done.returncode, done.stderr) == (1, "")
    told = lacking(tmp_path)
    assert len(told) > 15
    assert all(told.values())
    assert done.stdout.count("ok  ") == 1, "only the console, which cannot be there"


@pytest.mark.parametrize(
    ("path", "content", "what", "remedy"),
    [
        ("etc/nv_tegra_release", "# R35 (release), REVISION: 4.1\n", "JetPack 4.6", "NVIDIA's image"),
        ("etc/systemd/system/multi-user.target.wants/nvgetty.service", "", "nvgetty", "disable --now nvgetty"),
        ("var/lib/nvpmodel/status", "pmode:0001 fmode:quiet\n", "power mode", "nvpmodel -m 0"),
        ("sys/devices/system/cpu/online", "0-1\n", "four processors", "nvpmodel -m 0"),
        ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "schedutil\n", "full clock", "jetson_clocks"),
        ("sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "16\n", "latency timer", "echo 1 | sudo tee /sys/bus"),
        ("etc/udev/rules.d/99-t265.rules", "# an old one\n", "99-t265.rules", "udevadm trigger"),
        ("etc/systemd/system/pipewright.service", "[Service]\n", "unit", "daemon-reload"),
        ("etc/passwd", "root:x:0:0::/root:/bin/sh\n", "user", "systemd-sysusers"),
        ("srv/pipewright/etc/debian_version", "11.9\n", "Debian 12", "debootstrap"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_alone(jetpack: Path, path: str, content: str, what: str, remedy: str) -> None:
    write(jetpack / path, content)
    ((told, how),) = lacking(jetpack).items()
    assert what in told
    assert remedy in how


@pytest.mark.parametrize(
    ("path", "what"),
    [
        ("dev/servos", "/dev/servos"),
        ("dev/t265", "/dev/t265"),
        ("srv/pipewright/usr/bin/python3.11", "Python 3.11"),
        ("srv/pipewright/usr/local/lib/librealsense2.so.2.53.1", "librealsense 2.53.1"),
        ("etc/systemd/system/multi-user.target.wants/pipewright.service", "beginning"),
        ("etc/pipewright/vehicle.yaml", "configuration"),
        ("etc/pipewright/keys/key.pem", "the vehicle's keys"),
        ("etc/pipewright/keys/roster.json", "the vehicle's keys"),
    ],
)
def test_what_is_missing_is_told_alone(jetpack: Path, path: str, what: str) -> None:
    (jetpack / path).unlink()
    (told,) = lacking(jetpack)
    assert what in told


def test_a_private_key_that_others_may_read_is_told(jetpack: Path) -> None:
    (jetpack / "etc/pipewright/keys/key.pem").chmod(0o640)
    ((told, how),) = lacking(jetpack).items()
    assert told.startswith("keys that the service may read")
    assert "chmod" in how


def test_keys_that_belong_to_another_user_are_told(jetpack: Path) -> None:
    """As after ``sudo cp``."""
    write(jetpack / "etc/passwd", f"pipewright:x:{os.getuid() + 1}:997::/var/lib/pipewright:/usr/sbin/nologin\n")
    ((told, how),) = lacking(jetpack).items()
    assert told.startswith("keys that the service may read")
    assert "chown -R pipewright" in how


def test_wrong_arguments(tmp_path: Path) -> None:
    for arguments in ([str(tmp_path / "absent")], [str(tmp_path), "more"]):
        done = look(*arguments)
        assert done.returncode == 2
        assert "usage" in done.stderr
