"""The shape of the code: imports point down, public interfaces are complete."""

from __future__ import annotations

import ast
import builtins
import importlib
import inspect
import re
import sys
import typing
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

import nedbus
from tests.processes import Start

ROOT = Path(__file__).parents[1]
# From the lowest to the highest: each may import those before it, through their __init__.
FLOORS = [
    "errors", "extras", "whole_file", "log_event", "transport", "settings", "events", "client", "recording", "sources",
    "daemon", "monitoring", "doctor", "bridges", "web", "cli",
]  # fmt: skip
MESSAGE_FILES = sorted(path.stem for path in ROOT.glob("schemas/nedbus_msgs/messages/[a-z]*.py"))
# Packages that only these files import, by folder; nothing else says who may use Zenoh.
ONLY_BY_FOLDER = {
    "zenoh": {
        "nedbus/transport": "session router queries zenoh_ext refusals write_probe",
        "nedbus/client": "sample", "nedbus/client/discovery": "services",
        "nedbus/client/receiving": "receiver max_rate decoder",
        "nedbus/client/publishing": "publisher publisher_registry writer flow_control "
        "downsampler query_server",
        "nedbus/sources": "px4_zenoh px4_node", "nedbus/bridges": "ros2", "nedbus/doctor": "traffic",
    },
    "msgpack": {"nedbus_msgs/codecs": "msgpack"},
    "xxhash": {"nedbus/transport": "rmw_zenoh"},
    "numpy": {
        "nedbus_msgs": "arrays", "nedbus_msgs/codecs": "arrays", "nedbus/client": "batch", "nedbus/sources": "ulog",
        "nedbus/recording": "ulog arrays alignment utc plot", "nedbus/web": "stream tracks background plots",
    },
    "bokeh": {"nedbus/web": "background map_plot playback plots send serve server style timeline tracks viewer"},
    "tornado": {"nedbus/web": "server"},
    "PIL": {"nedbus/web": "background"},
    "pydantic": {
        "nedbus_msgs": "message px4_types validation other", "nedbus_msgs/codecs": "msgpack",
        "nedbus_msgs/messages": " ".join(MESSAGE_FILES), "nedbus/settings": "model load",
        "nedbus/sources": "options spec", "nedbus/recording": "conversion arrays",
        "nedbus/client/discovery": "service_status services", "nedbus/events": "report",
    },
    "pydantic_core": {
        "nedbus_msgs": "px4_types message validation", "nedbus_msgs/codecs": "msgpack",
        "nedbus/client/publishing": "publisher_registry", "nedbus/client/discovery": "service_status",
        "nedbus/settings": "load",
    },
    "pydantic_settings": {"nedbus/settings": "model load"},
    "typing_extensions": {"nedbus_msgs": "functions", "nedbus/client": "sample subscription"},
    "pyulog": {"nedbus/recording": "ulog"},
    "mcap": {"nedbus/recording": "writer reader chunks records"},
    "lz4": {"nedbus/recording": "records"},
    "zstandard": {"nedbus/recording": "records"},
    "pandas": {"nedbus/recording": "arrays alignment"},
    "polars": {"nedbus/recording": "arrays alignment"},
    "matplotlib": {"nedbus/recording": "plot"},
    "pymavlink": {"nedbus/sources": "mavlink", "nedbus/doctor": "mavlink"},
    "serial": {"nedbus/sources": "mavlink_link"},
    "foxglove": {"nedbus/bridges": "foxglove foxglove_messages"},
    "prometheus_client": {"nedbus/monitoring": "families exposition service_metrics exporter"},
    "cryptography": {"nedbus/transport": "pki pki_renewal"},
    "rich": {"nedbus/cli": "progress files live_table logs"},
    "typer": {
        "nedbus/cli": "app bridges files pki options query echo health serve run http pki_fleet check doctor web "
        "events",
    },
}  # fmt: skip
ONLY = {
    package: {f"{folder}/{name}" for folder, names in folders.items() for name in names.split()}
    for package, folders in ONLY_BY_FOLDER.items()
}
MAX_LINES = 400
FILES = sorted([*ROOT.glob("service/**/*.py"), *ROOT.glob("schemas/**/*.py")])


def path_of(file: Path) -> str:
    """Return where a file is, as ONLY names it: nedbus/client/bus."""
    return "/".join(file.relative_to(ROOT).with_suffix("").parts[1:])


@cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text())


def imports_of(path: Path, nodes: Iterable[ast.AST] | None = None) -> list[tuple[str, list[str]]]:
    """Return what a file imports: the full name of each module, and the names that are taken from it.

    Without `nodes` also what is imported in functions, or for types.
    """
    package = path.relative_to(ROOT).parts[1:-1]
    found: list[tuple[str, list[str]]] = []
    for node in ast.walk(parse(path)) if nodes is None else nodes:
        if isinstance(node, ast.Import):
            found += [(alias.name, []) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            found.append((".".join([*base, *filter(None, [node.module])]), [alias.name for alias in node.names]))
    return found


def test_imports_point_down() -> None:
    """Each file imports what stands below it only, other packages through their __init__, and what it may use."""
    for path, name in [(path_of(file), name) for file in FILES for name, _ in imports_of(file)]:
        package, floor, *_ = path.split("/")
        top, *inner = name.split(".")
        where = f"{path} imports {name}"
        if top in ONLY:
            assert path in ONLY[top], where
        elif top == "nedbus_msgs" and package == "nedbus":
            assert inner in ([], ["arrays"], ["messages"]), f"{where}: import from nedbus_msgs, or .arrays for NumPy"
        elif top == "nedbus":
            assert package == "nedbus", f"{where}: nedbus_msgs knows nothing of the service"
            if inner and floor in FLOORS:
                assert inner[0] == floor or len(inner) == 1, f"{where}: import from nedbus.{inner[0]}"
                assert FLOORS.index(inner[0]) <= FLOORS.index(floor), f"{where}, which points up"
        else:
            assert top == "nedbus_msgs" or top in sys.stdlib_module_names, f"{where}: who may import this?"


def test_no_entry_is_left_over() -> None:
    """Every file that ONLY names exists and imports that package; every folder is a floor."""
    imported = {(name.split(".")[0], path_of(path)) for path in FILES for name, _ in imports_of(path)}
    assert {(package, path) for package, paths in ONLY.items() for path in paths} <= imported
    folders = {path.name for path in (ROOT / "service" / "nedbus").iterdir() if (path / "__init__.py").is_file()}
    assert folders <= set(FLOORS)


def test_no_import_circle() -> None:
    """Modules do not import each other in a circle, inside a package either (imports for types only are left out)."""
    graph = {path_of(path).removesuffix("/__init__").replace("/", "."): runtime_imports(path) for path in FILES}
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, f"a circle: {' -> '.join([*trail[trail.index(module) :], module])}"
        if module in done:
            return
        for name in sorted(graph[module] & graph.keys()):
            if not module.startswith(f"{name}."):  # a package's __init__ imports its own modules
                visit(name, (*trail, module))
        done.add(module)

    for module in graph:
        visit(module, ())


def runtime_imports(path: Path) -> set[str]:
    """Return the modules that are imported when a file is imported."""
    imports = imports_of(path, parse(path).body)
    return {name for name, _ in imports} | {f"{name}.{each}" for name, names in imports for each in names}


def test_file_has_one_duty() -> None:
    """No file is long, and the first line of its docstring, one sentence, says what it is for."""
    assert [path_of(path) for path in FILES if path.read_text().count("\n") > MAX_LINES] == []
    first = {path_of(path): (ast.get_docstring(parse(path)) or "\n").splitlines()[0] for path in FILES}
    without = [path for path, line in first.items() if not line.endswith((".", ":"))]
    assert [path for path in without if not path.endswith(("__main__", "__init__"))] == []


@pytest.mark.parametrize("name", ["nedbus", "nedbus_msgs"])
def test_public_interface_is_sorted_and_complete(name: str) -> None:
    """__all__ is sorted as ruff sorts it, each name is there and documented, and nothing public is missing."""
    module = importlib.import_module(name)
    constants = [word for word in module.__all__ if word.isupper()]
    classes = [word for word in module.__all__ if not word.isupper() and word[0].isupper()]
    functions = [word for word in module.__all__ if word[0].islower()]
    assert module.__all__ == sorted(constants) + sorted(classes) + sorted(functions)
    for word in [*classes, *functions]:
        public = getattr(module, word)
        ours = (inspect.isclass(public) or inspect.isfunction(public)) and public.__module__.startswith("nedbus")
        assert not ours or public.__doc__, word
    public = {word for word in vars(module) if not word.startswith("_")}
    submodules = {path.stem for path in Path(str(module.__file__)).parent.iterdir()}
    assert public - submodules - {"annotations", "TYPE_CHECKING"} <= set(module.__all__)


# What a public signature may mention besides what nedbus exports.
KNOWN = {*dir(builtins), *typing.__all__, "Path", "np", "npt", "pd", "pl", "zenoh"}
# The model's fields are int, float, bool and pairs of floats, with PX4's ranges.
KNOWN |= {
    "Definition",
    "M",
    "datetime",
    "Library",
    "np",
    "npt",
    "Uint64",
    "Uint8",
    "Bool",
    "Float32",
    "Float32x2",
    "Float64",
}


def annotations_of(public: type | typing.Callable[..., object]) -> typing.Iterator[str]:
    """Yield the annotations of a function, or of the public methods and fields of a class, as they are written."""
    if inspect.isfunction(public):
        yield from inspect.get_annotations(public).values()
    elif inspect.isclass(public):
        yield from (text for name, text in inspect.get_annotations(public).items() if not name.startswith("_"))
        for name, member in list(vars(public).items()):
            function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
            made_by_users = name == "__init__" and not re.search(r"get one from|from `connect", public.__doc__ or "")
            if inspect.isfunction(function) and (not name.startswith("_") or made_by_users):
                yield from inspect.get_annotations(function).values()


def test_public_signatures_mention_public_names_only() -> None:
    """A script can import from nedbus whatever it gets from nedbus, or gives to it."""
    known = KNOWN | set(nedbus.__all__)
    for name in nedbus.__all__:
        for annotation in map(str, annotations_of(getattr(nedbus, name))):
            expression = annotation.removeprefix("<class '").removesuffix("'>")
            names = {node.id for node in ast.walk(ast.parse(expression)) if isinstance(node, ast.Name)}
            assert not [each for each in names - known if not each.endswith("_co")], f"{name}: {annotation}"


def test_no_python_code_runs_on_threads_of_zenoh() -> None:
    """A callback would wait there for the interpreter's lock: what arrives waits in a channel.

    An advanced publisher is dropped: `undeclare` waits for Zenoh before it gives up the interpreter's lock.
    """
    for path in sorted((ROOT / "service").rglob("*.py")):
        code = path.read_text()
        assert not re.search(r"handlers\.Callback|indirect=", code), path
        assert "declare_advanced_publisher" not in code or "publisher.undeclare(" not in code, path


def test_what_is_not_used_is_not_loaded(start: Start) -> None:
    """A command is there at once: what it does not need is not imported.

    dir() of a fresh import has all public names, and loads nothing, so that a plain REPL completes them.
    """
    program = """
import sys
def absent(names):
    assert not set(names.split()) & set(sys.modules), names
sys.argv = ["nedbus", "--version"]
from nedbus.cli import main
main()
absent("pydantic zenoh typer")
import nedbus, rlcompleter
assert [name for name in dir(nedbus) if name[:2] != "__"] == sorted(nedbus.__all__) and "__version__" in dir(nedbus)
absent("zenoh")
assert rlcompleter.Completer(globals()).complete("nedbus.connect_", 0).startswith("nedbus.connect_async")
absent("numpy pyulog typer rich cryptography")
import nedbus.cli.app
absent("numpy pyulog rich.progress cryptography")
"""
    process = start("-c", program, fresh=True)
    assert process.wait() == 0, process.err


def test_error_tree_is_drawn() -> None:
    """The docstring of nedbus.errors draws every error, with the built-in error that each one also is."""
    errors = importlib.import_module("nedbus.errors")
    for name in errors.__all__:
        assert name in (errors.__doc__ or ""), name
        assert re.match("Raised (when|for) |Base of", getattr(errors, name).__doc__), name
        bases = [base.__name__ for base in getattr(errors, name).__mro__ if base.__module__ == "builtins"]
        drawn = next(line for line in (errors.__doc__ or "").splitlines() if f" {name}" in f" {line.strip()}")
        if "(" in drawn.partition(name)[2][:2]:
            assert drawn.split("(")[1].split(")")[0] in bases
