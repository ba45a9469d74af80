"""Whether what the vehicle's computer needs exists for it."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: The tags of wheels that a Debian 12 (glibc 2.36) on 64-bit ARM takes.
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in range(36, 16, -1)] + ["manylinux2014_aarch64"]


@pytest.mark.registry
def test_every_pinned_dependency_of_the_base_install_has_a_wheel_for_the_jetson(tmp_path: Path) -> None:
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["dependencies"]
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--retries=0"]
    command += ["--disable-pip-version-check", "--only-binary=:all:", f"--target={tmp_path / 'there'}"]
    command += [f"--constraint={ROOT / 'constraints.txt'}", f"--report={report}"]
    command += ["--python-version=3.11", "--implementation=cp", "--abi=cp311", "--abi=abi3", "--abi=none"]
    command += [f"--platform={platform}" for platform in PLATFORMS]
    done = subprocess.run([*command, *wanted], capture_output=True, text=True, check=False)
    if "connection broken" in done.stderr.lower():
        pytest.skip("no package registry can be reached")
    assert done.returncode == 0, done.stderr
    wheels = [item["download_info"]["url"].rpartition("/")[2] for item in json.loads(report.read_text())["install"]]
    assert len(wheels) >= len(wanted)
    assert all(wheel.endswith(("-any.whl", "_aarch64.whl")) for wheel in wheels), wheels
