"""Structural rules that import-linter (pyproject.toml) cannot check: package interfaces, folder sizes, threads."""

from __future__ import annotations

import ast
import importlib
import re
import resource
import tomllib
from functools import cache
from pathlib import Path

import pytest

from tests.mutants import read_table

ROOT = Path(__file__).parents[1]
PRODUCT = sorted([*ROOT.glob("service/**/*.py"), *ROOT.glob("schemas/**/*.py")])
ALL = sorted(
    [
        *PRODUCT,
        *(
            path
            for top in ("tests", "fuzz", "benchmarks", "examples")
            for path in ROOT.glob(f"{top}/**/*.py")
        ),
    ]
)
MAX_FILES = 14  # per folder: split a larger one into subpackages


@cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text())


def test_packages_are_imported_through_their_interface() -> None:
    """A package imports another through its `__init__`, or from arrays, frames, messages and text of `nedbus_msgs`."""
    for path in PRODUCT:
        package, layer, *_ = path.relative_to(ROOT).parts[1:]
        for node in ast.walk(parse(path)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += (
                [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            )
            for top, *inner in (name.split(".") for name in names):
                if top == "nedbus_msgs" and package == "nedbus":
                    assert inner in ([], ["arrays"], ["frames"], ["messages"], ["text"]), (
                        f"{path}: import from nedbus_msgs"
                    )
                if top == "nedbus" and inner and layer != "__init__.py":
                    assert inner[0] == layer or len(inner) == 1, (
                        f"{path}: import from nedbus.{inner[0]}"
                    )


@pytest.mark.slow
def test_public_names_come_from_lower_layers() -> None:
    """A package takes a public name from `nedbus` or `nedbus.health` only if a lower layer defines it.

    import-linter does not see this, because these modules import the others on first use.
    """
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    level_of = {
        name.strip(): level for level, line in enumerate(layers) for name in line.split("|")
    }
    checked = 0
    for path in PRODUCT:
        top, layer, *_ = (
            path.relative_to(ROOT / path.relative_to(ROOT).parts[0]).with_suffix("").parts
        )
        own = level_of.get(f"{top}.{layer}")
        for node in ast.walk(parse(path)):
            if (
                own is None
                or not isinstance(node, ast.ImportFrom)
                or node.module not in {"nedbus", "nedbus.health"}
            ):
                continue
            for alias in node.names:
                home = f"nedbus.{alias.name}"
                if home not in level_of:
                    value = getattr(importlib.import_module(node.module), alias.name)
                    home = ".".join(getattr(value, "__module__", "").split(".")[:2])
                if home in level_of and home != f"{top}.{layer}":
                    checked += 1
                    is_for_types = node.col_offset > 0  # below `if TYPE_CHECKING:`, or on first use
                    assert is_for_types or level_of[home] > own, (
                        f"{path}: {alias.name} is defined in {home}"
                    )
    assert checked > 50


def test_modules_state_their_responsibility() -> None:
    """The docstring of a module begins with a one-line sentence."""
    for path in PRODUCT:
        summary = (ast.get_docstring(parse(path)) or "\n").splitlines()[0]
        assert path.stem.startswith("__") or summary.endswith((".", ":")), path


@pytest.mark.parametrize(
    "folder", sorted({path.parent for path in ALL}), ids=lambda path: str(path.relative_to(ROOT))
)
def test_folder_has_at_most_14_files(folder: Path) -> None:
    """A folder has at most 14 modules."""
    modules = [path for path in folder.glob("*.py") if not path.stem.startswith("__")]
    assert len(modules) <= MAX_FILES


def test_no_python_runs_on_zenoh_threads() -> None:
    """Samples and replies are received through channels: a callback would wait for the GIL on a Zenoh thread.

    Advanced publishers are dropped without `undeclare`, which would hold the GIL while it waits for Zenoh.
    """
    for path in PRODUCT:
        code = path.read_text()
        assert not re.search(r"handlers\.Callback|indirect=", code), path
        assert "declare_advanced_publisher" not in code or "publisher.undeclare(" not in code, path


def test_panics_are_caught() -> None:
    """Only BaseException includes a panic of Zenoh or Pydantic; an `except Exception` here is in no thread's loop."""
    found = [path.name for path in PRODUCT if "except Exception" in path.read_text()]
    # `reloading` raises the error again; a Bokeh decoder for each request
    assert found == ["systemd.py", "server.py"]


def test_only_clock_module_reads_wall_clock() -> None:
    """Only `nedbus.clock` reads the wall clock; events, silence and overload are detected with a monotonic clock."""
    for path in PRODUCT:
        found = re.search(
            r"\btime\.time(_ns)?\(|datetime\.(now|utcnow|today)\(|date\.today\(", path.read_text()
        )
        assert not found or path.name == "clock.py", f"{path}: use nedbus.clock"


def test_tests_cannot_limit_their_own_process() -> None:
    """A test must not set a resource limit of pytest's process, not even for a moment."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.raises(AssertionError, match="limit a child process instead"):
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)


def test_mutants_and_their_tests_exist() -> None:
    """Each mutant of mutants.toml applies to its file, and the test files that it names exist."""
    faults = read_table()
    assert [problem for fault in faults for problem in fault.problems(ROOT)] == []
    names = {name for fault in faults for name in fault.tests.partition(" -k ")[0].split()}
    assert [name for name in sorted(names) if not (ROOT / "tests" / name).is_file()] == []
