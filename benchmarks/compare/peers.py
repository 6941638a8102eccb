"""The compared forms, and virtual environments for those of other projects, under build/bench."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import venv
from pathlib import Path
from typing import Final

from benchmarks.processes import ROOT

FORMS: Final = ROOT / "benchmarks" / "compare" / "forms"
NEDBUS: Final = ("models", "fields_in", "rows", "batches")
"""Forms of nedbus."""

CORE: Final = ("raw", "straightforward", *NEDBUS)
"""Forms measured in all cases: the references, and nedbus."""


def find_forms() -> list[str]:
    """Return the names of all forms, CORE first."""
    names = sorted(path.stem for path in FORMS.glob("*.py") if "PACKAGES = " in path.read_text())
    return [*CORE, *(name for name in names if name not in CORE)]


def prepare(name: str) -> str:
    """Return the Python interpreter of a form; create a virtual environment with its packages if it needs any.

    Raises subprocess.CalledProcessError if it cannot be installed.
    """
    packages = _find_packages(name)
    if not packages:
        return sys.executable
    folder = ROOT / "build" / "bench" / name
    python = folder / "bin" / "python"
    if not python.exists():
        print(f"installing {' '.join(packages)}", flush=True)
        venv.create(folder, with_pip=True)
    subprocess.run(
        [python, "-m", "pip", "install", "-q", *packages], check=True, capture_output=True
    )
    return str(python)


def title(name: str) -> str:
    """Return the first sentence of a form's docstring."""
    doc = ast.get_docstring(_parse(name)) or name
    return re.split(r"[.;](?:\s|$)", doc.replace("\n", " "))[0]


def _find_packages(name: str) -> list[str]:
    """Return PACKAGES of a form without importing it."""
    for node in _parse(name).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "PACKAGES":
            found: list[str] = ast.literal_eval(node.value)
            return found
    return []


def _parse(name: str) -> ast.Module:
    return ast.parse(Path(FORMS / f"{name}.py").read_text())
