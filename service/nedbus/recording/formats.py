"""The file formats of flights, by suffix: the one table of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import BinaryIO, Final

from nedbus.errors import ConfigError, SourceError

SUFFIXES: Final[Mapping[str, str]] = {".ulg": "ulog", ".mcap": "mcap"}
"""The kind of source that replays a file, by the file's suffix."""


def format_of(path: str | PurePath) -> str:
    """Return the format of a flight, "ulog" or "mcap"; raise ConfigError for a file with another suffix."""
    found = SUFFIXES.get(PurePath(path).suffix)
    if found is None:
        raise ConfigError(str(path), f"expected a flight log: a file that ends with {' or '.join(SUFFIXES)}")
    return found


def check_recording(path: Path, *, flight: str) -> None:
    """Raise ConfigError for a recording that is to be written under a name of something else.

    `flight` is the file to read instead, for who wants a table or a picture.
    """
    if SUFFIXES.get(path.suffix) == "mcap":
        return
    hints = {
        ".csv": f'; for a table: nedbus.read("{flight}", dataframe="pandas").to_csv("{path.name}")',
        **dict.fromkeys((".png", ".svg", ".pdf"), f"; for a picture: nedbus plot {flight} -o {path.name}"),
    }
    raise ConfigError(str(path), f"expected a recording: a file that ends with .mcap{hints.get(path.suffix, '')}")


def open_flight(path: Path) -> BinaryIO:
    """Open a file for reading; raise SourceError when that fails, and for what is no file: a flight is read twice."""
    try:
        if path.exists() and not path.is_file():
            raise SourceError(str(path), "not a regular file: save it as one first")
        return path.open("rb")
    except OSError as exc:
        raise SourceError(str(path), (exc.strerror or str(exc)).lower()) from exc
