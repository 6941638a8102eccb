"""Optional parts: what is not installed is said in one line, with what to install."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from .errors import ConfigError


def needs(extra: str, module: str) -> Any:
    """Return a module that needs an extra; raise ConfigError, which says what to install, when that is missing."""
    try:
        return import_module(module)
    except ModuleNotFoundError as exc:
        missing = (exc.name or "").split(".")[0]
        what = f"'nedbus[{extra}]'" if extra in EXTRAS else extra
        raise ConfigError(missing, f"this is not installed: pip install {what}") from exc


EXTRAS = frozenset({"mcap", "mavlink", "foxglove", "plot", "pki"})
