"""The units as shipped, judged by systemd's own tools; tests/compose/test_systemd.py starts them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

UNITS = Path(__file__).parents[2] / "packaging" / "systemd"
EXECUTABLE = "/opt/nedbus/bin/nedbus"
EXPOSURE = 2.0  # of 10: what systemd calls OK

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing: install systemd"),
]


@pytest.fixture(params=["nedbus.service", "nedbus@.service"])
def unit(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Copy a unit, with a program that is here in place of the one that gets installed."""
    name = str(request.param)
    copy = tmp_path / name
    text = (UNITS / name).read_text()
    assert f"ExecStart={EXECUTABLE} serve" in text
    copy.write_text(text.replace(EXECUTABLE, "/bin/true"))
    return copy


def analyze(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze."""
    return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, timeout=60, check=False)


def test_unit_is_valid(unit: Path) -> None:
    """Nothing in it is unknown to systemd, or ignored."""
    done = analyze("verify", unit)
    about_it = [line for line in done.stderr.splitlines() if "nedbus" in line]
    assert (done.returncode, about_it) == (0, []), done.stderr


def test_unit_is_hardened(unit: Path) -> None:
    """Its exposure is below what the documentation says."""
    done = analyze("security", "--offline=true", f"--threshold={EXPOSURE * 10:.0f}", unit)
    assert done.returncode == 0, done.stdout + done.stderr
    assert float(done.stdout.split("Overall exposure level for")[1].split(":")[1].split()[0]) < EXPOSURE


def test_units_differ_in_their_file_only() -> None:
    """The template is the unit, for another file."""
    plain, template = ((UNITS / name).read_text().split("\n", 1)[1] for name in ("nedbus.service", "nedbus@.service"))
    description = "Description=PX4 local position over Zenoh"
    assert template == plain.replace("/nedbus.toml", "/%i.toml").replace(description, f"{description} (%i)")
