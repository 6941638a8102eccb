"""The public API: complete, documented, with public names only in its signatures, and one tree of all errors."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import typing
from collections.abc import Iterator
from pathlib import Path

import pytest

import nedbus
from docs.generator.api import PUBLIC_MODULES
from nedbus_msgs import MESSAGES

ROOT = Path(__file__).parents[1]
OURS = {
    name
    for folder in ("service", "schemas")
    for path in ROOT.glob(f"{folder}/**/*.py")
    # a hundred times faster than ast
    for name in re.findall(r"^ *class (\w+)", path.read_text(), re.MULTILINE)
}
# Generic over all messages, or used only in the definition of a message, which no script imports.
ALLOWED = {"Definition", "FieldType", "Layout", "RenamedField", "Rule"}


MODULES = {name: importlib.import_module(name) for name in PUBLIC_MODULES}
PUBLIC = {name: module for module in MODULES.values() for name in module.__all__}


@pytest.mark.parametrize("name", [*MODULES, "nedbus_msgs"])
def test_all_lists_every_public_name(name: str) -> None:
    """Each name of __all__ exists once and has a docstring, and no name of nedbus and nedbus_msgs is missing.

    The other packages also have names for nedbus itself, which are not public.
    """
    module = importlib.import_module(name)
    assert len(module.__all__) == len(set(module.__all__))
    for word in module.__all__:
        public = getattr(module, word)
        ours = (
            inspect.isclass(public) or inspect.isfunction(public)
        ) and public.__module__.startswith("nedbus")
        assert not ours or public.__doc__, word
    if name in {"nedbus", "nedbus_msgs"}:
        public = {word for word in vars(module) if not word.startswith("_")}
        submodules = {path.stem for path in Path(str(module.__file__)).parent.iterdir()}
        assert public - submodules - {"annotations", "TYPE_CHECKING"} <= set(module.__all__)


def test_dir_of_nedbus_lists_at_most_75_names() -> None:
    """`dir(nedbus)` has at most 75 names: __all__, the messages, and the public modules."""
    shown = {name for name in dir(nedbus) if not name.startswith("__")}
    assert shown == {*nedbus.__all__, *MESSAGES, "errors", "frames", "health"}
    assert len(shown) <= 75
    assert all(hasattr(nedbus, name) for name in shown)
    assert [nedbus.errors, nedbus.frames, nedbus.health] == list(MODULES.values())[1:4]


def annotations_of(public: object) -> Iterator[str]:
    """Yield the annotations of a function, or of the public methods and fields of a class, as source text."""
    if inspect.isfunction(public):
        yield from map(str, inspect.get_annotations(public).values())
    elif inspect.isclass(public):
        annotations = inspect.get_annotations(public)
        yield from (
            text_of(annotation)
            for name, annotation in annotations.items()
            if not name.startswith("_")
        )
        for name, member in list(vars(public).items()):
            function = (
                member.fget if isinstance(member, property) else getattr(member, "__func__", member)
            )
            returned = r"get one from|from `connect|returns one|yields them"
            is_constructor = name == "__init__" and not re.search(returned, public.__doc__ or "")
            if inspect.isfunction(function) and (not name.startswith("_") or is_constructor):
                yield from map(str, inspect.get_annotations(function).values())


def text_of(annotation: object) -> str:
    """Return an annotation as source text, without the validators of `Annotated`."""
    if isinstance(annotation, str) or "Annotated" not in str(annotation):
        return str(annotation)
    holder = type("Holder", (), {"__annotations__": {"value": annotation}})
    return str(typing.get_type_hints(holder)["value"])


@pytest.mark.parametrize("name", PUBLIC)
def test_public_signatures_mention_only_public_names(name: str) -> None:
    """A script can import every class in a public signature from nedbus or its public modules."""
    for annotation in annotations_of(getattr(PUBLIC[name], name)):
        expression = annotation.removeprefix("<class '").removesuffix("'>")
        mentioned = {
            node.id for node in ast.walk(ast.parse(expression)) if isinstance(node, ast.Name)
        }
        assert mentioned & OURS <= {*PUBLIC, *ALLOWED}, annotation


STARTED = {
    name: importlib.import_module(name)
    for name in ("nedbus.bridges", "nedbus.tables", "nedbus.web")
}
"""The packages that commands start; their `__all__` has what `cli` calls, and is no API."""

PROGRAMS = ("bridges", "cli", "doctor", "monitoring", "pki", "tables", "web")
"""The packages that use nedbus as a user's program does; the contract of imports in pyproject.toml names them, too."""

LIBRARIES = ("event_history", "event_sources", "vehicle_events")
"""The library of events, over public modules; another contract names its modules."""


def names_used(path: Path) -> Iterator[tuple[str, str]]:
    """Yield each name of a module of nedbus that a file uses, with the module: imported, or as an attribute of it."""
    tree = ast.parse(path.read_text())
    modules = dict[str, str]()  # by their name in the file
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module is not None and not node.level:
            for alias in node.names:
                imported = f"{node.module}.{alias.name}"
                if imported in MODULES | STARTED:
                    modules[alias.asname or alias.name] = imported
                else:
                    yield node.module, alias.name
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id in modules
        ):
            yield modules[node.value.id], node.attr


@pytest.mark.parametrize("program", [*PROGRAMS, *LIBRARIES])
def test_programs_use_only_public_names(program: str) -> None:
    """A program of nedbus uses only names in `__all__` of the public modules; import-linter forbids other modules.

    The commands also start the packages of STARTED.
    """
    own = f"nedbus.{program}"
    allowed = MODULES | STARTED if program == "cli" else MODULES
    folder = ROOT / "service" / "nedbus" / program
    paths = [*folder.glob("**/*.py")] or [folder.with_suffix(".py")]
    for path in paths:
        for module, name in names_used(path):
            assert program == "cli" or module == own or module not in STARTED, (
                f"{path}: {module} is a program"
            )
            if module in allowed and module not in {"nedbus", own}:
                assert name in allowed[module].__all__, f"{path}: {module}.{name} is not public"


def test_error_tree_lists_every_error() -> None:
    """The docstring of nedbus.errors lists every error, with its built-in base class."""
    errors = importlib.import_module("nedbus.errors")
    for name in errors.__all__:
        if not isinstance(getattr(errors, name), type):
            continue  # a function
        assert name in (errors.__doc__ or ""), name
        assert re.match("Raised (when|for) |Base of", getattr(errors, name).__doc__), name
        bases = [
            base.__name__ for base in getattr(errors, name).__mro__ if base.__module__ == "builtins"
        ]
        drawn = next(
            line for line in (errors.__doc__ or "").splitlines() if f" {name}" in f" {line.strip()}"
        )
        if "(" in drawn.partition(name)[2][:2]:
            assert drawn.split("(")[1].split(")")[0] in bases
