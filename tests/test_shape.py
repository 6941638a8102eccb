"""The shape of the code that import-linter (pyproject.toml) does not hold: doors, docstrings, rooms, threads."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from tests.mutants import read_table

ROOT = Path(__file__).parents[1]
PRODUCT = sorted([*ROOT.glob("service/**/*.py"), *ROOT.glob("schemas/**/*.py")])
ALL = sorted([*PRODUCT, *(path for top in ("tests", "benchmarks", "examples") for path in ROOT.glob(f"{top}/**/*.py"))])
MAX_FILES = 14  # of a folder: above that it wants rooms
OPENINGS = re.compile(r"(What|Which|Who|Whether|How)\b")
NUMBERLESS = re.compile(r"\b(so|as) (many|much)\b")


@cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text())


def test_packages_are_imported_through_their_doors() -> None:
    """A floor imports another one through its __init__; the contract has doors for arrays, frames and messages, too."""
    for path in PRODUCT:
        package, floor, *_ = path.relative_to(ROOT).parts[1:]
        for node in ast.walk(parse(path)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            for top, *inner in (name.split(".") for name in names):
                if top == "nedbus_msgs" and package == "nedbus":
                    assert inner in ([], ["arrays"], ["frames"], ["messages"]), f"{path}: import from nedbus_msgs"
                if top == "nedbus" and inner and floor != "__init__.py":
                    assert inner[0] == floor or len(inner) == 1, f"{path}: import from nedbus.{inner[0]}"


def test_docstrings_are_no_questions() -> None:
    """The first line of a file says its one duty; no docstring opens with a question, or counts without a number."""
    for path in ALL:
        first = (ast.get_docstring(parse(path)) or "\n").splitlines()[0]
        assert path not in PRODUCT or path.stem.startswith("__") or first.endswith((".", ":")), path
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node, clean=False) or ""
                assert not OPENINGS.match(text), f"{path}: {text.splitlines()[0]}"
                assert not NUMBERLESS.search(text), f"{path}: {text}"


@pytest.mark.parametrize("folder", sorted({path.parent for path in ALL}), ids=lambda path: str(path.relative_to(ROOT)))
def test_folder_has_rooms(folder: Path) -> None:
    """No folder has more files than a newcomer reads as a table of contents."""
    assert len([*folder.glob("*.py")]) <= MAX_FILES


def test_no_python_code_runs_on_threads_of_zenoh() -> None:
    """A callback would wait there for the interpreter's lock: what arrives waits in a channel.

    An advanced publisher is dropped: `undeclare` waits for Zenoh before it gives up the interpreter's lock.
    """
    for path in PRODUCT:
        code = path.read_text()
        assert not re.search(r"handlers\.Callback|indirect=", code), path
        assert "declare_advanced_publisher" not in code or "publisher.undeclare(" not in code, path


def test_settable_clock_has_one_reader() -> None:
    """Only `nedbus.clock` reads the clock that can be set: events, silence and overload are judged by a steady one."""
    for path in PRODUCT:
        found = re.search(r"\btime\.time(_ns)?\(|datetime\.(now|utcnow|today)\(|date\.today\(", path.read_text())
        assert not found or path.name == "clock.py", f"{path}: use nedbus.clock"


def test_faults_and_their_tests_exist() -> None:
    """Each fault of mutants.toml can be put into its file, and every file of tests that it names is there."""
    faults = read_table()
    assert [problem for fault in faults for problem in fault.problems(ROOT)] == []
    names = {name for fault in faults for name in fault.tests.partition(" -k ")[0].split()}
    assert [name for name in sorted(names) if not (ROOT / "tests" / name).is_file()] == []
