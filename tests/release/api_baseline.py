"""Compare the public API with that of the last release: `python -m tests.release.api_baseline [--write]`.

packaging/public_api.pyi.txt contains the API of the last release as stubs, so that neither tags nor history are needed.
Exits with 1 for a removed name, parameter or return type, unless the major version, or before 1.0 the minor version,
has changed. `--write` renews the file, which is a step of each release.
"""

from __future__ import annotations

import inspect
import logging
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final

import griffe

import nedbus
from docs.generator.api import PUBLIC_MODULES
from nedbus_msgs import MESSAGES

ROOT: Final = Path(__file__).parents[2]
BASELINE: Final = ROOT / "packaging" / "public_api.pyi.txt"
MODULES: Final = (*PUBLIC_MODULES, "nedbus_msgs")
# not created by scripts
_NOT_MADE: Final = re.compile(r"[Gg]et one from|from `connect|returns one|yields them")
_DECORATORS: Final = ("property", "staticmethod", "classmethod")


def main() -> int:
    """Compare the API with the baseline, or write the baseline."""
    if "--write" in sys.argv[1:]:
        BASELINE.write_text(describe_api())
        return 0
    old = BASELINE.read_text()
    breakages = list(find_breakages(old, describe_api()))
    version = old.split(maxsplit=3)[2].rstrip(",")
    print("\n".join(breakages) or f"no breaking API change since {version}")
    is_allowed = compatible_range(version) != compatible_range(nedbus.__version__)
    return int(bool(breakages) and not is_allowed)


def find_breakages(old: str, new: str) -> Iterator[str]:
    """Yield a line for each difference between two descriptions that can break a script."""
    before, after = (griffe.visit("api", Path("api.py"), code=text) for text in (old, new))
    for breakage in griffe.find_breaking_changes(before, after):
        name = breakage.obj.path.removeprefix("api.").replace("__", ".", 1)
        values = (
            getattr(each, "name", each)
            for each in (breakage.old_value, breakage.new_value)
            if each is not None
        )
        yield f"{name}: {breakage.kind.value} ({' -> '.join(map(str, values))})"


def describe_api() -> str:
    """Return the public names of all modules as stubs, in one text with a class for each module."""
    loader = griffe.GriffeLoader(search_paths=[str(ROOT / "service"), str(ROOT / "schemas")])
    loader.load("nedbus_msgs")
    loader.load("nedbus")
    # otherwise it warns of packages that are not loaded
    logging.getLogger("griffe").setLevel(logging.ERROR)
    loader.resolve_aliases(implicit=True)
    lines, seen = (
        [f"# nedbus {nedbus.__version__}, written by `make api-baseline`"],
        dict[str, str](),
    )
    for module in MODULES:
        imported = import_module(module)
        lines += ["", f"class {module.replace('.', '__')}:"]
        for name in sorted({*imported.__all__, *(MESSAGES if module == "nedbus" else ())}):
            found = _find(loader, imported, name)
            public = seen.setdefault(found.path, f"{module}.{name}")
            stub = _stub(name, found) if public == f"{module}.{name}" else [f"{name} = {public}"]
            lines += [f"    {line}" for line in stub]
    return "\n".join(lines) + "\n"


def _find(loader: griffe.GriffeLoader, module: ModuleType, name: str) -> griffe.Object:
    """Return what a name refers to; for another name of a function, that function."""
    value = getattr(module, name)
    own_path = f"{module.__name__}.{name}"
    if inspect.isfunction(value) and value.__name__ != name:
        own_path = f"{value.__module__}.{value.__qualname__}"
    try:
        found = loader.modules_collection[own_path]
    except KeyError:  # imported by `*`
        found = loader.modules_collection[f"{value.__module__}.{value.__qualname__}"]
    target = found.final_target if found.is_alias else found
    assert isinstance(target, griffe.Object)
    return target


def _stub(name: str, found: griffe.Object) -> Iterator[str]:
    if isinstance(found, griffe.Class):
        yield f"class {name}({', '.join(str(base).partition('[')[0] for base in found.bases)}):"
        members = {
            key: member for key, member in found.all_members.items() if not key.startswith("_")
        }
        if "__init__" in found.all_members and not _NOT_MADE.search(
            found.docstring.value if found.docstring else ""
        ):
            members["__init__"] = found.all_members["__init__"]
        for key, member in sorted(members.items()):
            target = member.final_target if isinstance(member, griffe.Alias) else member
            yield from (f"    {line}" for line in _stub(key, target))
        yield "    ..."
    elif isinstance(found, griffe.Function):
        yield from (f"@{label}" for label in _DECORATORS if label in found.labels)
        returns = f" -> {found.returns}" if found.returns else ""
        yield f"def {name}({', '.join(_parameters(found))}){returns}: ..."
    else:
        annotation = getattr(found, "annotation", None)
        yield f"{name}: {annotation}" if annotation else f"{name} = ..."


def _parameters(function: griffe.Function) -> Iterator[str]:
    kinds = griffe.ParameterKind
    has_star = False
    for parameter in function.parameters:
        has_star |= parameter.kind is kinds.var_positional
        if parameter.kind is kinds.keyword_only and not has_star:
            has_star = True
            yield "*"
        mark = {kinds.var_positional: "*", kinds.var_keyword: "**"}.get(parameter.kind, "")
        annotation = f": {parameter.annotation}" if parameter.annotation else ""
        default = "" if parameter.default is None or mark else f" = {parameter.default}"
        yield f"{mark}{parameter.name}{annotation}{default}"


def compatible_range(version: str) -> list[str]:
    """Return the parts that compatible versions share: the major version, and before 1.0 also the minor version."""
    major, minor, *_ = version.split(".")
    return [major] if int(major) else [major, minor]


if __name__ == "__main__":
    sys.exit(main())
