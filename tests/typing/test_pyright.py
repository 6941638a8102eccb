"""Names of nedbus for pyright, in a project that has nedbus installed."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import nedbus
import nedbus_msgs

pytestmark = [pytest.mark.slow, pytest.mark.process]

_PACKAGES = nedbus, nedbus_msgs


def pyright() -> str:
    """Return the path of basedpyright; skip the test if it is not installed."""
    found = shutil.which("basedpyright", path=Path(sys.executable).parent) or shutil.which(
        "basedpyright"
    )
    if found is None:
        pytest.skip("not installed: basedpyright")
    return found


def test_pyright_finds_every_public_name(tmp_path: Path) -> None:
    """Pyright reports no name of nedbus as private: neither one of `__all__`, nor a message, nor a module.

    It checks private imports only of installed packages with `py.typed`, therefore nedbus is copied into an
    environment.
    """
    command = pyright()
    installed = tmp_path / "venv" / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    for package in _PACKAGES:
        source = Path(package.__path__[0])
        shutil.copytree(
            source, installed / source.name, ignore=shutil.ignore_patterns("__pycache__")
        )
    (tmp_path / "venv" / "pyvenv.cfg").write_text("home = /usr/bin\n")
    names = sorted({*nedbus.__all__, *nedbus_msgs.MESSAGES, "errors", "frames", "health"})
    lines = ["import nedbus", *(f"nedbus.{name}" for name in names), "nedbus.no_such_name"]
    (tmp_path / "script.py").write_text("\n".join(lines) + "\n")
    settings = {
        "include": ["script.py"],
        "reportPrivateImportUsage": "error",
        "reportAttributeAccessIssue": "error",
    }
    settings |= {"typeCheckingMode": "off", "venvPath": str(tmp_path), "venv": "venv"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    result = subprocess.run(
        [command, "--outputjson"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    problems = json.loads(result.stdout)["generalDiagnostics"]
    found = [(lines[problem["range"]["start"]["line"]], problem["rule"]) for problem in problems]
    assert found == [("nedbus.no_such_name", "reportAttributeAccessIssue")], result.stdout
