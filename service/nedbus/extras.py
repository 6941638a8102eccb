"""Optional dependencies, imported on first use."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, Final

from .errors import ConfigError

EXTRAS: Final = frozenset({"mcap", "mavlink", "metrics", "foxglove", "plot", "pki", "web"})
"""The extras of the nedbus package, as in `pip install -e ".[mcap]"` in a clone."""


def import_optional(extra: str, module: str) -> Any:
    """Import and return a module that requires `extra`: one of EXTRAS, or the name of a package.

    Raises ConfigError, with the package to install, if a dependency of the module is missing.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as exc:
        missing = (exc.name or "").split(".")[0]
        # Never suggest installing nedbus by its name alone: on PyPI, this name belongs to another project.
        if extra in EXTRAS:
            hint = f"in a nedbus clone, run pip install -e '.[{extra}]'"
        else:
            hint = f"run pip install {extra}"
        raise ConfigError(missing, f"not installed; {hint}") from exc


def lazy_exports(package: str, modules: Mapping[str, tuple[str, str]]) -> Callable[[str], object]:
    """Return a `__getattr__` for a package that imports its exported names on first use.

    `modules`: extra ("" for none) and module of each exported name.
    """

    def get(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        extra, module = modules[name]
        return getattr(import_optional(extra, f"{package}.{module}"), name)

    return get
