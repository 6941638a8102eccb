"""The shape of the code: imports point down, doors are complete."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

from tests.conftest import Start

ROOT = Path(__file__).parents[1]
LAYERS = {  # who may import whom, beside itself and the standard library
    "nedbus_msgs": {"nedbus_msgs", "pydantic", "pydantic_core", "msgpack", "numpy"},
    "nedbus": {"nedbus", "nedbus_msgs", "pydantic", "pydantic_core", "pydantic_settings", "zenoh", "typer", "rich"}
    | {"pyulog", "numpy", "cryptography", "pymavlink", "serial", "mcap", "zstandard", "pandas", "polars"}
    | {"matplotlib", "foxglove"},
}
ONLY = {  # packages that only these files import
    "zenoh": {"session", "publisher", "intake", "batches", "subscriber", "px4_zenoh", "ros2"},
    "msgpack": {"wire"},
    "pyulog": {"ulog"},
    "pymavlink": {"mavlink"},
    "serial": {"mavlink_link"},
    "mcap": {"recording", "playback"},
    "zstandard": {"playback"},
    "pandas": {"reading"},
    "polars": {"reading"},
    "numpy": {"ulog", "arrays", "batches", "recorder", "reading", "picture"},
    "matplotlib": {"picture"},
    "foxglove": {"foxglove_view"},
    "pydantic_settings": {"settings"},
    "typer": {"app", "bridge", "records", "certificates", "options", "look", "watch", "serve"},
    "rich": {"progress", "records"},
    "cryptography": {"pki", "certificates"},
}
ORDER = [  # each may import those before it only
    "errors", "extras", "pki", "session", "settings", "publisher", "batches", "intake", "subscriber", "health",
    "recording", "bus", "rmw_zenoh", "playback", "sources", "worker", "daemon", "ros2", "recorder", "reading",
    "picture", "foxglove_view",
    "cli",
]  # fmt: skip

FILES = sorted([*ROOT.glob("service/**/*.py"), *ROOT.glob("schemas/**/*.py")])


def imports_of(path: Path) -> list[str]:
    """Return the full names of all modules that a file imports."""
    package = path.relative_to(ROOT).parts[1:-1]
    found: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            found.append(".".join([*base, *filter(None, [node.module])]))
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    """Each file imports only what its layer may, and never upwards."""
    layer = path.relative_to(ROOT).parts[1]
    place = path.relative_to(ROOT).parts[2].removesuffix(".py")
    for name in imports_of(path):
        top, *rest = name.split(".")
        if top in ONLY:
            assert path.stem in ONLY[top], name
        if top in {*LAYERS, *ONLY, "pydantic", "pydantic_core"}:
            assert top in LAYERS[layer], name
        if top == "nedbus_msgs" and layer == "nedbus":
            # Arrays have a door of their own: whoever needs none should not load NumPy.
            assert not rest or rest == ["arrays"], f"{name}: import from the door"
        if top == "nedbus" and rest and place in ORDER and rest[0] in ORDER and rest[0] != place:
            assert ORDER.index(rest[0]) < ORDER.index(place), name


@pytest.mark.parametrize("name", ["nedbus", "nedbus_msgs"])
def test_door_is_sorted_and_complete(name: str) -> None:
    """__all__ is sorted as ruff sorts it, each name is there and documented, and nothing public is missing."""
    module = importlib.import_module(name)
    constants = [word for word in module.__all__ if word.isupper()]
    classes = [word for word in module.__all__ if not word.isupper() and word[0].isupper()]
    functions = [word for word in module.__all__ if word[0].islower()]
    assert module.__all__ == sorted(constants) + sorted(classes) + sorted(functions)
    for word in [*classes, *functions]:
        assert getattr(module, word).__doc__, word
    public = {word for word in vars(module) if not word.startswith("_")}
    submodules = {path.stem for path in Path(str(module.__file__)).parent.iterdir()}
    assert public - submodules - {"annotations", "TYPE_CHECKING"} <= set(module.__all__)


@pytest.mark.parametrize(
    ("program", "absent"),
    [
        ("import sys; sys.argv = ['nedbus', '--version']; from nedbus.cli import main; main()", "pydantic zenoh typer"),
        ("import nedbus; nedbus.connect", "numpy pyulog typer rich cryptography"),
        ("import nedbus.cli.app", "numpy pyulog rich.progress cryptography"),
    ],
)
def test_what_is_not_used_is_not_loaded(start: Start, program: str, absent: str) -> None:
    """A command is there at once: what it does not need is not imported."""
    process = start("-c", f"{program}\nimport sys\nassert not set({absent.split()!r}) & set(sys.modules)")
    assert process.wait() == 0, process.err


def test_error_tree_is_drawn() -> None:
    """The docstring of nedbus.errors draws every error, with the built-in error that each one also is."""
    errors = importlib.import_module("nedbus.errors")
    for name in errors.__all__:
        assert name in (errors.__doc__ or ""), name
        bases = [base.__name__ for base in getattr(errors, name).__mro__ if base.__module__ == "builtins"]
        drawn = next(line for line in (errors.__doc__ or "").splitlines() if f" {name}" in f" {line.strip()}")
        if "(" in drawn.partition(name)[2][:2]:
            assert drawn.split("(")[1].split(")")[0] in bases
