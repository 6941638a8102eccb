"""Optional dependencies: modules that are imported when they are first used, and what to install for them."""

from __future__ import annotations

import gc
import json
import shlex
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit
from urllib.request import url2pathname

from .errors import ConfigError

EXTRAS: Final = frozenset({"mcap", "mavlink", "metrics", "foxglove", "plot", "pki", "web"})
"""The extras of this package, as in `pip install ".[mcap]"` in a clone."""


def needs(extra: str, module: str) -> Any:
    """Import and return a module that needs an extra, or another package.

    Raises ConfigError, which says what to install, when something that it imports is missing.
    """
    collects = gc.isenabled()
    gc.disable()  # as in the command line: nothing that is imported is garbage
    try:
        return import_module(module)
    except ModuleNotFoundError as exc:
        missing = (exc.name or "").split(".")[0]
        hint = _install_extra(extra) if extra in EXTRAS else f"pip install {extra}"
        raise ConfigError(missing, f"not installed: {hint}") from exc
    finally:
        if collects:
            gc.enable()


def _install_extra(extra: str) -> str:
    """Return the command that adds an extra from where this installation came from, as PEP 610 records it.

    Never by the name alone: on PyPI that name is not ours.
    """
    metadata = import_module("importlib.metadata")  # slow to load, and only a hint needs it
    command = f"in a clone of nedbus, pip install '.[{extra}]'"
    try:
        origin = json.loads(metadata.distribution("nedbus").read_text("direct_url.json") or "null")
        url = origin["url"].replace(" ", "%20")
        path = url2pathname(urlsplit(url).path)
        if "vcs_info" in origin:
            revision = f"{origin['vcs_info']['vcs']}+{url}@{origin['vcs_info']['commit_id']}"
            command = f"pip install {shlex.quote(f'nedbus[{extra}] @ {revision}')}"
        elif not url.startswith("file:"):
            command = f"pip install {shlex.quote(f'nedbus[{extra}] @ {url}')}"
        elif Path(path).exists():
            editable = "-e " if origin.get("dir_info", {}).get("editable") else ""
            command = f"pip install {editable}{shlex.quote(f'{path}[{extra}]')}"
    except (metadata.PackageNotFoundError, ValueError, KeyError, AttributeError, TypeError):
        pass  # copied here, or installed by a tool that records nothing
    return command


def lazy_exports(package: str, modules: Mapping[str, tuple[str, str]]) -> Callable[[str], object]:
    """Return a `__getattr__` for a package whose names are imported when they are first used.

    `modules` gives the extra ("" for none) and the module of each name.
    """

    def get(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        extra, module = modules[name]
        return getattr(needs(extra, f"{package}.{module}"), name)

    return get
