"""The file formats of flights, by suffix: the one table of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Final

from nedbus.errors import ConfigError

SUFFIXES: Final[Mapping[str, str]] = {".ulg": "ulog", ".mcap": "mcap"}
"""The kind of source that replays a file, by the file's suffix."""


def format_of(path: str | PurePath) -> str:
    """Return the format of a flight, "ulog" or "mcap"; raise ConfigError for a file with another suffix."""
    found = SUFFIXES.get(PurePath(path).suffix)
    if found is None:
        raise ConfigError(str(path), f"expected a flight log: a file that ends with {' or '.join(SUFFIXES)}")
    return found
